"""Reading untrusted files: strict JSON, exact numbers, digests of bytes, plain names.

A JSON number stands for the float64 nearest to it, and is refused unless it is that float64's own
shortest decimal form (or an equal one): so no changed digit goes unnoticed. Whole numbers beyond
2^53, NaN, infinities, duplicate keys and unknown members are refused. Numbers arrive as `int` or
`Fraction`, never as `float`.
"""

import hashlib
import json
import os
import stat
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from math import lcm
from pathlib import Path
from typing import Any

MAX_BYTES = 32 * 2**20  # of one file; real proofs are a few MB
MAX_TOTAL = 48 * 2**20  # of all files of a claim: half a minute, and 50 times that in memory
MAX_WHOLE = 2**53  # beyond it a float64 no longer holds every whole number
MAX_DIGITS = 4000  # of one integer of a "p/q": bounds what one number can cost
MAX_NAME = 200
MAX_NUMBER = 60  # characters of a JSON number; a float64 needs at most 25
MAX_DEGREE = 63  # of a monomial, all exponents together
MAX_STATED = 20_000  # monomials of one list
MAX_COMMON = 10_000  # bits of the common denominator of a polynomial or of a matrix
VERSION = 2  # of proofs and of all documents they are about

Read = Callable[[str], bytes]  # a file's bytes by its plain name; OSError if it cannot be read
# Of a polynomial: exponents and coefficients. Exponents are bytes, whose hash no file can choose.
Terms = list[tuple[bytes, Fraction]]

# Why a proof is refused: the code of each "no".
REASONS = {
    "malformed": "a file is not as its page says",
    "too_large": "a stated limit on sizes is exceeded, or memory",
    "too_long": "it takes more processor time than is allowed",
    "mismatch": "a file is not the one that the proof is about",
    "unknown": "the kind of claim is not known",
    "left": "the kind of claim, or the version of the file, is not decided any more",
    "not_definite": "a matrix is not positive definite, or semidefinite",
    "not_positive": "a polynomial is not shown to be positive",
    "not_below": "a number exceeds its bound",
    "not_covered": "a piece, a vertex or a mode is missing",
    "not_valid": "the claim leaves where its model or equations hold",
    "not_decided": "the kernel met what it did not expect",
}


class Rejected(Exception):  # noqa: N818 - a verdict
    """The proof does not prove its claim; the message says why, `reason` is one of REASONS."""

    def __init__(self, message: str, reason: str = "malformed") -> None:
        super().__init__(message)
        self.reason = reason


class Mismatch(Rejected):
    """A file is not the one that the proof is about."""

    def __init__(self, message: str, reason: str = "mismatch") -> None:
        super().__init__(message, reason)


def refuse_if(wrong: object, message: str, reason: str = "malformed") -> None:
    """Raise Rejected if something is wrong."""
    if wrong:
        raise Rejected(message, reason)


def by_degree(exponents: bytes) -> tuple[int, bytes]:
    """The order of monomials: by total degree, then by their exponents."""
    return sum(exponents), exponents


@dataclass(frozen=True)
class Node:
    """A JSON value and where it stands, for messages; every reader below refuses what is wrong."""

    value: object
    where: str

    def members(self, required: str, optional: str = "") -> dict[str, "Node"]:
        """An object with exactly these members (names separated by spaces)."""
        wanted, allowed = required.split(), optional.split()
        if type(self.value) is not dict:
            raise Rejected(f"{self.where} should be an object")
        for name in wanted:
            if name not in self.value:
                raise Rejected(f"{self.where}: '{name}' is missing")
        for name in self.value:
            if name not in wanted and name not in allowed:
                raise Rejected(f"{self.where}: unknown member {plain(name)!r}")
        return {name: Node(entry, f"{self.where} {name}") for name, entry in self.value.items()}

    def member(self, name: str) -> "Node":
        """One member of an object that may have others."""
        if type(self.value) is not dict or name not in self.value:
            raise Rejected(f"{self.where}: '{name}' is missing")
        return Node(self.value[name], f"{self.where} {name}")

    def items(self, least: int = 0, most: int = 10**6) -> list["Node"]:
        """A list of `least` to `most` entries."""
        if type(self.value) is not list or not least <= len(self.value) <= most:
            raise Rejected(f"{self.where} should be a list of {least} to {most} entries")
        return [Node(entry, f"{self.where}[{i}]") for i, entry in enumerate(self.value)]

    def text(self) -> str:
        """A printable text of at most MAX_NAME characters."""
        value = self.value
        if type(value) is not str or len(value) > MAX_NAME or not value.isprintable():
            wanted = f"at most {MAX_NAME} characters, none of them a control character"
            raise Rejected(f"{self.where} should be a text of {wanted}")
        return value

    def number(self) -> Fraction:
        """A float64, exactly."""
        if type(self.value) is int or type(self.value) is Fraction:
            return Fraction(self.value)
        raise Rejected(f"{self.where} should be a number")

    def whole(self, least: int, most: int = MAX_WHOLE) -> int:
        """A whole number in [least, most]."""
        if type(self.value) is not int or not least <= self.value <= most:
            raise Rejected(f"{self.where} should be a whole number from {least} to {most}")
        return self.value

    def rational(self) -> Fraction:
        """A float64, or a text "p/q" or "p" of whole numbers."""
        if type(self.value) is not str:
            return self.number()
        above, slash, below = self.value.partition("/")
        digits = above.removeprefix("-")
        parts = [digits] + ([below] if slash else [])
        for part in parts:
            refuse_if(
                not (part.isascii() and part.isdigit() and len(part) <= MAX_DIGITS),
                f"{self.where} should be a number or a text p/q of whole numbers",
            )
        refuse_if(slash and not int(below), f"{self.where} divides by zero")
        return Fraction(int(above), int(below) if slash else 1)

    def integer(self) -> int:
        """A whole number; one beyond 2^53 is a text of digits."""
        refuse_if(
            type(self.value) is not int and (type(self.value) is not str or "/" in self.value),
            f"{self.where} should be a whole number",
        )
        return self.rational().numerator

    def integers(self, least: int, most: int) -> tuple[int, ...]:
        """A list of `least` to `most` whole numbers; those beyond 2^53 are texts of digits."""
        entries = self.value
        if type(entries) is list and all(type(e) is int for e in entries):
            numbers: list[int] = entries
        else:
            numbers = [entry.integer() for entry in self.items(least, most)]
        refuse_if(
            not least <= len(numbers) <= most,
            f"{self.where} should be a list of {least} to {most} entries",
        )
        return tuple(numbers)

    def array(self, *shape: int | None) -> list:  # type: ignore[type-arg]
        """Nested lists of float64s of this shape, as Fractions; None: any length."""
        return self._nested(self.value, shape, Fraction)

    def wholes(self, *shape: int | None) -> list:  # type: ignore[type-arg]
        """Nested lists of whole numbers (at most 2^53 in size) of this shape."""
        return self._nested(self.value, shape, int)

    def _nested(self, value: object, shape: tuple[int | None, ...], kind: type) -> list:  # type: ignore[type-arg]
        if type(value) is not list or (shape[0] is not None and len(value) != shape[0]):
            wanted = " x ".join("any" if size is None else str(size) for size in shape)
            raise Rejected(f"{self.where} should have shape {wanted}")
        if len(shape) > 1:
            return [self._nested(entry, shape[1:], kind) for entry in value]
        for entry in value:
            if type(entry) is not int and (kind is int or type(entry) is not Fraction):
                wanted = "whole numbers" if kind is int else "numbers"
                raise Rejected(f"{self.where} should hold {wanted} only")
        return list(value) if kind is int else [Fraction(entry) for entry in value]

    def monomials(
        self, count: int, degree: int = MAX_DEGREE, order: Callable[[bytes], Any] | None = None
    ) -> list[bytes]:
        """Distinct rows of `count` exponents, of `degree` together at most; sorted by `order`."""
        stated = self.wholes(None, count)
        refuse_if(
            len(stated) > MAX_STATED,
            f"{self.where}: {len(stated)} terms; at most {MAX_STATED} are taken",
            "too_large",
        )
        refuse_if(
            any(min(row, default=0) < 0 or sum(row) > degree for row in stated),
            f"{self.where}: exponents should be 0 or more, {degree} together at most",
        )
        rows = list(map(bytes, stated))
        if len(set(rows)) < len(rows) or (order and rows != sorted(rows, key=order)):
            wanted = "in increasing order" if order else "each once"
            raise Rejected(f"{self.where}: monomials should be distinct, {wanted}")
        return rows

    def polynomial(self, count: int, degree: int = MAX_DEGREE, order: Any = by_degree) -> Terms:
        """`exponents` and `coefficients` of a polynomial: distinct sorted monomials, rationals."""
        parts = self.members("exponents coefficients")
        rows = parts["exponents"].monomials(count, degree, order)
        values = [entry.rational() for entry in parts["coefficients"].items(len(rows), len(rows))]
        common_denominator(values, self.where)
        return list(zip(rows, values, strict=True))

    def kind(self) -> str:
        """The member `kind` of an object."""
        if type(self.value) is not dict or "kind" not in self.value:
            raise Rejected(f"{self.where} should be an object with a kind")
        return Node(self.value["kind"], f"{self.where} kind").text()

    def document(
        self,
        form: str,
        names: str,
        kinds: str = "",
        *,
        optional: str = "",
        made_for: Mapping[str, str] | None = None,
    ) -> dict[str, "Node"]:
        """The members of a document nlsid/`form`, of one of `kinds` if there are any.

        made_for: the digests, by role, that it has to name; Mismatch if it names another.
        """
        required = f"format version {'kind' * bool(kinds)} {' '.join(made_for or ())} {names}"
        parts = self.members(required, optional)
        found, version = parts["format"].text(), parts["version"].whole(0)
        if found != f"nlsid/{form}" or version != VERSION:
            wanted = f"{self.where} should be of format nlsid/{form}, version {VERSION}"
            raise Rejected(f"{wanted}; it is of format {found!r}, version {version}")
        if kinds and parts["kind"].text() not in kinds.split():
            wanted = " or ".join(map(repr, kinds.split()))
            raise Rejected(f"the kind of {self.where} is {self.kind()!r}, expected {wanted}")
        for role, made in (made_for or {}).items():
            if parts[role].text() != made:
                raise Mismatch(f"the {self.where} was made for another {role}")
        return parts


def common_denominator(values: Iterable[Fraction | int], where: str) -> int:
    """The least one; Rejected if it would make every number long."""
    common = 1
    for value in values:
        common = lcm(common, value.denominator)
        refuse_if(
            common.bit_length() > MAX_COMMON,
            f"{where}: denominators of more than {MAX_COMMON} bits together",
            "too_large",
        )
    return common


def parse(content: bytes, where: str) -> Node:
    """One JSON object."""
    refuse_if(
        len(content) > MAX_BYTES, f"{where}: {len(content)} bytes; at most {MAX_BYTES}", "too_large"
    )
    try:
        value = json.loads(
            content.decode("utf-8"),
            object_pairs_hook=_unique,
            parse_float=_float64,
            parse_int=_whole,
            parse_constant=_refused,
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
    documents: dict[str, Node] = {}
    digests: dict[str, str] = {}
    for role, binding in about.members(roles).items():
        entry = binding.members("file digest")
        name, stated = entry["file"].text(), entry["digest"].text()
        refuse_if(
            not name or name in (".", "..") or any(sign in name for sign in "/\\:\0"),
            f"{role} file {name!r} is not a plain file name",
        )
        try:
            content = read(name)
        except OSError as error:
            raise Mismatch(f"{role} file {name} cannot be read: {error.strerror}") from error
        found = digest(content)
        if found != stated:
            raise Mismatch(
                f"{name} is not the {role} this proof is about: digest {found[:23]}..., "
                f"the proof says {plain(stated[:23])}..."
            )
        documents[role], digests[role] = parse(content, role), found
    return documents, digests


def read_regular(path: Path) -> bytes:
    """A regular file's bytes; OSError for anything else, Rejected if it is too large."""
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with os.fdopen(handle, "rb") as stream:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(0, "not a regular file", str(path))
        content = stream.read(MAX_BYTES + 1)
    refuse_if(
        len(content) > MAX_BYTES, f"{plain(path.name)}: more than {MAX_BYTES} bytes", "too_large"
    )
    return content


def plain(text: str) -> str:
    """`text` on one line, without control characters, for messages."""
    shown = "".join(sign if sign.isprintable() else "?" for sign in text[:MAX_NAME])
    return shown + ("..." if len(text) > MAX_NAME else "")


def _unique(pairs: list[tuple[str, object]]) -> dict[str, object]:
    result = dict(pairs)
    if len(result) != len(pairs):
        raise ValueError("a key occurs twice")
    return result


def _refused(name: str) -> object:
    raise ValueError(f"{name} is not a number")


def _float64(text: str) -> Fraction:
    if len(text) > MAX_NUMBER:
        raise ValueError(f"{text[:24]}... has too many digits")
    nearest = float(text)
    if nearest - nearest != 0.0:
        raise ValueError(f"{text} does not fit a float64")
    if repr(nearest) != text and Decimal(repr(nearest)) != Decimal(text):
        raise ValueError(f"{text} is not a float64; the nearest one is {nearest!r}")
    return Fraction(*nearest.as_integer_ratio())


def _whole(text: str) -> int:
    value = int(text) if len(text) <= 20 else 2**64
    if abs(value) > MAX_WHOLE:
        raise ValueError(f"{text[:24]} is a whole number beyond 2^53")
    return value
