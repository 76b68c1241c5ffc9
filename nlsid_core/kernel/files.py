"""Reading untrusted files: strict JSON, exact numbers, digests of bytes, plain names.

A JSON number is refused unless it is a float64's shortest decimal form, or equal to it: so no
changed digit goes unnoticed. Numbers arrive as `int` or `Fraction`, never as `float`.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from math import lcm
from typing import Any, TypeAlias

MAX_BYTES = 32 * 2**20  # of one file; real proofs are a few MB
MAX_TOTAL = 48 * 2**20  # of all files of a claim: half a minute, and 50 times that in memory
MAX_WHOLE = 2**53  # beyond it a float64 no longer holds every whole number
MAX_DIGITS = 4000  # of one integer of a "p/q": bounds what one number can cost
MAX_NAME = 200  # characters of a text
MAX_NUMBER = 60  # characters of a JSON number; a float64 needs at most 25
MAX_ENTRIES = 10**6  # of a list of objects
MAX_DEGREE = 63  # of a monomial, all exponents together
MAX_STATED = 20_000  # monomials of one list
MAX_COMMON = 10_000  # bits of the common denominator of a polynomial or of a matrix
VERSION = 2  # of proofs and of all documents they are about

Read = Callable[[str], bytes]  # a file's bytes by its plain name; OSError if it cannot be read
# Of a member: what reads it, or its shape; None if it is read elsewhere, or no claim is about it.
Reader: TypeAlias = "Callable[[Node], Any] | tuple[int | None, ...] | None"
Members = dict[str, Any]  # of an object, as they were read
Table = dict[str, Reader]  # the members of an object; `name?` may be missing
NOTHING: dict[str, str] = {}
# Of a polynomial: exponents and coefficients. Exponents are bytes, whose hash no file can choose.
Terms = list[tuple[bytes, Fraction]]

RATIONAL = re.compile(rf"-?[0-9]{{1,{MAX_DIGITS}}}(/(?!0+$)[0-9]{{1,{MAX_DIGITS}}})?")


class Rejected(Exception):  # noqa: N818 - a verdict
    """The proof does not prove its claim; the message says why, `reason` is one of REASONS."""

    def __init__(self, message: str, reason: str = "malformed") -> None:
        super().__init__(message)
        self.reason = reason


def refuse_if(wrong: object, message: str, reason: str = "malformed") -> None:
    """Raise Rejected if something is wrong."""
    if wrong:
        raise Rejected(message, reason)


def limit(count: int, most: int, what: str, least: int = 0) -> int:
    """The count of `what`; Rejected unless it is from `least` to `most`."""
    refuse_if(not least <= count <= most, f"{what}: {count}, not {least} to {most}", "too_large")
    return count


def by_degree(exponents: bytes) -> tuple[int, bytes]:
    """The order of monomials: by total degree, then by their exponents."""
    return sum(exponents), exponents


@dataclass(frozen=True)
class Node:
    """A JSON value and where it stands, for messages; every reader below refuses what is wrong."""

    value: Any
    where: str

    def require(self, checks: Mapping[str, object], reason: str = "malformed") -> None:
        """Raise Rejected with the first text whose condition is false."""
        for wanted, holds in checks.items():
            joint = " " if wanted.startswith("should ") else ": "
            refuse_if(not holds, f"{self.where}{joint}{wanted}", reason)

    def members(self, names: str) -> dict[str, "Node"]:
        """An object with exactly these members, separated by spaces; `name?` may be missing."""
        self.require({"should be an object": type(self.value) is dict})
        wanted, allowed = names.split(), names.replace("?", "").split()
        missing = {f"'{n}' is missing": n[-1] == "?" or n in self.value for n in wanted}
        others = {f"unknown member {plain(n)!r}": n in allowed for n in sorted(self.value)}
        self.require(missing | others)
        return {name: Node(entry, f"{self.where} {name}") for name, entry in self.value.items()}

    def read(self, table: Table) -> Members:
        """The members of an object, by their readers or of their shapes; None for a missing one."""
        parts = self.members(" ".join(table))
        readers = {name.rstrip("?"): how for name, how in table.items()}
        return {
            name: parts[name].by(how) if name in parts else None for name, how in readers.items()
        }

    def by(self, how: Reader) -> Any:
        """What a reader finds, an array of a shape, or the node itself."""
        if how is None:
            return self
        return self.array(*how) if isinstance(how, tuple) else how(self)

    def document(
        self,
        form: str,
        table: Table,
        kinds: str = "",
        made_for: Mapping[str, str] = NOTHING,
        former: Sequence[str] = (),
    ) -> Members:
        """The members of a document nlsid/`form`, whose kind is among `kinds` if any are given.

        made_for: the digests, by role, that it has to name. former: kinds that are refused by name.
        """
        heads: Table = {"format": one_of(f"nlsid/{form}"), "version": whole(VERSION, VERSION)}
        if kinds:
            heads["kind"] = one_of(*kinds.split(), former=former)
        made = {role: one_of(digest, reason="mismatch") for role, digest in made_for.items()}
        return self.read({**heads, **made, **table})

    def items(self, least: int = 0, most: int = MAX_ENTRIES) -> list["Node"]:
        """A list of `least` to `most` entries."""
        fits = type(self.value) is list and least <= len(self.value) <= most
        self.require({f"should be a list of {least} to {most} entries": fits})
        return [Node(entry, f"{self.where}[{i}]") for i, entry in enumerate(self.value)]

    def text(self) -> str:
        """A printable text of at most MAX_NAME characters."""
        value = self.value
        fits = type(value) is str and len(value) <= MAX_NAME and value.isprintable()
        self.require({f"should be a text of one line, {MAX_NAME} characters at most": fits})
        return str(value)

    def whole(self, least: int, most: int = MAX_WHOLE) -> int:
        """A whole number in [least, most]."""
        fits = type(self.value) is int and least <= self.value <= most
        self.require({f"should be a whole number from {least} to {most}": fits})
        return int(self.value)

    def number(self) -> Fraction:
        """A float64, exactly."""
        self.require({"should be a number": type(self.value) in (int, Fraction)})
        return Fraction(self.value)

    def rational(self) -> Fraction:
        """A float64, or a text "p/q" or "p" of whole numbers."""
        if type(self.value) is not str:
            return self.number()
        fits = RATIONAL.fullmatch(self.value)
        self.require({"should be a number, or a text p/q of whole numbers, q not 0": fits})
        return Fraction(self.value)

    def integer(self) -> int:
        """A whole number; one beyond 2^53 is a text of digits."""
        whole = type(self.value) is int or (type(self.value) is str and "/" not in self.value)
        self.require({"should be a whole number": whole})
        return self.rational().numerator

    def integers(self, least: int, most: int) -> list[int]:
        """A list of `least` to `most` whole numbers; those beyond 2^53 are texts of digits."""
        if type(self.value) is not list or not {int}.issuperset(map(type, self.value)):
            return [entry.integer() for entry in self.items(least, most)]
        if not least <= len(self.value) <= most:
            raise Rejected(f"{self.where} should be a list of {least} to {most} entries")
        return self.value

    def array(self, *shape: int | None) -> Any:
        """Nested lists of float64s of this shape, as Fractions; None: any length."""
        return self._nested(self.value, shape, {int, Fraction}) if shape else self.number()

    def wholes(self, *shape: int | None) -> Any:
        """Nested lists of whole numbers (at most 2^53 in size) of this shape."""
        return self._nested(self.value, shape, {int})

    def _nested(self, value: Any, shape: Sequence[int | None], kinds: set[type]) -> Any:
        if type(value) is not list or shape[0] not in (None, len(value)):
            raise Rejected(f"{self.where} should have shape {shape}")
        if len(shape) > 1:
            return [self._nested(entry, shape[1:], kinds) for entry in value]
        if not kinds.issuperset(map(type, value)):
            wanted = "numbers" if Fraction in kinds else "whole numbers"
            raise Rejected(f"{self.where} should hold {wanted} only")
        if Fraction in kinds:
            return [e if type(e) is Fraction else Fraction(e) for e in value]
        return list(value)

    def monomials(
        self, count: int, degree: int = MAX_DEGREE, order: Callable[[bytes], Any] | None = None
    ) -> list[bytes]:
        """Distinct rows of `count` exponents, of `degree` together at most; sorted by `order`."""
        stated = self.wholes(None, count)
        limit(len(stated), MAX_STATED, f"{self.where}: terms")
        small = all(min(row, default=0) >= 0 and sum(row) <= degree for row in stated)
        self.require({f"exponents should be 0 or more, {degree} together": small})
        rows = list(map(bytes, stated))
        self.require(
            {
                "a monomial occurs twice": len(set(rows)) == len(rows),
                "monomials should be sorted": not order or rows == sorted(rows, key=order),
            }
        )
        return rows

    def polynomial(
        self, count: int, degree: int = MAX_DEGREE, order: Callable[[bytes], Any] = by_degree
    ) -> Terms:
        """`exponents` and `coefficients` of a polynomial: distinct sorted monomials, rationals."""
        parts = self.members("exponents coefficients")
        rows = parts["exponents"].monomials(count, degree, order)
        values = [entry.rational() for entry in parts["coefficients"].items(len(rows), len(rows))]
        common_denominator(values, self.where)
        return list(zip(rows, values, strict=True))

    def kind(self) -> str:
        """The member `kind` of an object."""
        kinded = type(self.value) is dict and "kind" in self.value
        self.require({"should be an object with a kind": kinded})
        return Node(self.value["kind"], f"{self.where} kind").text()


def no_more(node: Node) -> None:
    """A reader that refuses a form which left with version 0.3."""
    raise Rejected(f"{node.where} is not decided since version 0.3", "left")


def whole(least: int, most: int = MAX_WHOLE) -> Reader:
    """A reader of a whole number in [least, most]."""
    return lambda node: node.whole(least, most)


def each(reader: Reader, least: int, most: int = MAX_ENTRIES) -> Reader:
    """A reader of a list of `least` to `most` entries."""
    return lambda node: [entry.by(reader) for entry in node.items(least, most)]


def one_of(*texts: str, reason: str = "malformed", former: Sequence[str] = ()) -> Reader:
    """A reader that takes one of these texts; former ones are refused by name."""

    def read(node: Node) -> str:
        if node.value in former:
            no_more(Node(node.value, f"{node.where} {node.value}"))
        found, wanted = node.text(), " or ".join(map(repr, texts))
        node.require({f"should be {wanted}, not {found!r}": found in texts}, reason)
        return found

    return read


def common_denominator(values: Iterable[Fraction | int], where: str) -> int:
    """The least one; Rejected if it would make every number long."""
    common = 1
    for value in values:
        common = lcm(common, value.denominator)
        limit(common.bit_length(), MAX_COMMON, f"{where}: bits of the common denominator")
    return common


def parse(content: bytes, where: str) -> Node:
    """One JSON object."""
    limit(len(content), MAX_BYTES, f"{where}: bytes")
    try:
        value = json.loads(
            content.decode("utf-8"),
            object_pairs_hook=_unique,
            parse_float=_float64,
            parse_int=_whole,
            parse_constant=_float64,
        )
    except (ValueError, RecursionError, ArithmeticError) as error:
        raise Rejected(f"{where}: not a valid document: {plain(str(error))}") from error
    refuse_if(type(value) is not dict, f"{where}: expected a JSON object")
    return Node(value, where)


def digest(content: bytes) -> str:
    """`sha256:<hex>` of a file's bytes."""
    return "sha256:" + hashlib.sha256(content).hexdigest()


def bound_files(about: Node, read: Read, roles: str) -> tuple[dict[str, Node], dict[str, str]]:
    """The documents that `about` names by file and digest, and their digests, by role."""
    documents, digests = {}, {}
    for role, binding in about.members(roles).items():
        stated = binding.read({"file": Node.text, "digest": Node.text})
        name = stated["file"]
        odd = name in ("", ".", "..") or any(sign in name for sign in "/\\:\0")
        refuse_if(odd, f"{role} file {name!r} is not a plain file name")
        try:
            content = read(name)
        except OSError as error:
            unread = f"{role} file {name} cannot be read: {error.strerror}"
            raise Rejected(unread, "mismatch") from error
        digests[role] = digest(content)
        other = f"{name} is not the {role} this proof is about: its digest differs"
        refuse_if(digests[role] != stated["digest"], other, "mismatch")
        documents[role] = parse(content, role)
    return documents, digests


def plain(text: str) -> str:
    """`text` on one line, without control characters, for messages."""
    shown = "".join(sign if sign.isprintable() else "?" for sign in text[:MAX_NAME])
    return shown + ("..." if len(text) > MAX_NAME else "")


def _unique(pairs: list[tuple[str, object]]) -> dict[str, object]:
    result = dict(pairs)
    if len(result) != len(pairs):
        raise ValueError("a key occurs twice")
    return result


def _float64(text: str) -> Fraction:
    if len(text) > MAX_NUMBER:
        raise ValueError(f"{text[:24]}... has too many digits")
    nearest = float(text)
    written = repr(nearest) == text or Decimal(repr(nearest)) == Decimal(text)
    if nearest - nearest != 0.0 or not written:
        raise ValueError(f"{text} is not a float64; the nearest one is {nearest!r}")
    return Fraction(*nearest.as_integer_ratio())


def _whole(text: str) -> int:
    if len(text) < 16:  # most are
        return int(text)
    if len(text) > 20 or abs(int(text)) > MAX_WHOLE:
        raise ValueError(f"{text[:24]} is a whole number beyond 2^53")
    return int(text)
