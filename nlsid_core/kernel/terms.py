"""Polynomials as files state them: exponents and coefficients, and what claims do with them."""

from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise
from math import lcm

from . import text
from .files import Node, Rejected
from .polynomials import MAX_DEGREE, MAX_TERMS, Polynomial, Ring

Terms = tuple[tuple[tuple[int, ...], Fraction], ...]  # (exponents, coefficient) of each monomial
MAX_STATED = 20_000  # terms of one polynomial of a file
MAX_COMMON = 8192  # bits of a polynomial's common denominator
MAX_SHOWN = 2000  # characters of a polynomial in a sentence
MAX_VARIABLES = 100


def read_names(node: Node) -> tuple[str, ...]:
    """1 to MAX_VARIABLES distinct variable names of letters, digits and _ . [ ]."""
    names = tuple(entry.text() for entry in node.items(1, MAX_VARIABLES))
    for name in names:
        letters = "".join(sign for sign in name if sign not in "_.[]")
        if not (
            name.isascii() and (letters + "a").isalnum() and (name[:1].isalpha() or name[:1] == "_")
        ):
            raise Rejected(f"{node.where}: {name!r} is not a plain name")
    if len(set(names)) != len(names):
        raise Rejected(f"{node.where}: a name occurs twice")
    return names


def read_terms(node: Node, count: int) -> Terms:
    """`exponents` and `coefficients` of one polynomial, each monomial once, sorted by degree.

    Monomials of one degree are sorted by their exponents. A coefficient may be a text p/q.
    """
    parts = node.members("exponents coefficients")
    rows = [tuple(row) for row in parts["exponents"].wholes(None, count)]
    _check_monomials(rows, node.where)
    if any((sum(a), a) >= (sum(b), b) for a, b in pairwise(rows)):
        raise Rejected(f"{node.where}: monomials should be distinct and sorted by degree")
    values = [entry.rational() for entry in parts["coefficients"].items(len(rows), len(rows))]
    _common(values, node.where)
    return tuple(zip(rows, values, strict=True))


def read_stack(node: Node, count: int, size: int) -> list[Terms]:
    """`size` polynomials with the same distinct `exponents`, `coefficients` a row for each."""
    parts = node.members("exponents coefficients")
    rows = [tuple(row) for row in parts["exponents"].wholes(None, count)]
    _check_monomials(rows, node.where)
    if len(set(rows)) != len(rows):
        raise Rejected(f"{node.where}: a monomial occurs twice")
    values = parts["coefficients"].array(len(rows), size)
    columns = [[row[i] for row in values] for i in range(size)]
    return [tuple((e, c) for e, c in zip(rows, column, strict=True) if c) for column in columns]


def derivative(p: Terms, j: int) -> Terms:
    """∂p/∂(variable j)."""
    return tuple(((*e[:j], e[j] - 1, *e[j + 1 :]), c * e[j]) for e, c in p if e[j])


def substituted(p: Terms, values: Sequence[Polynomial], ring: Ring) -> Polynomial:
    """p with a polynomial in the place of each variable."""
    powers: list[list[Polynomial]] = [[ring.constant(1)] for _ in values]
    known: dict[tuple[int, ...], Polynomial] = {}

    def monomial(exponents: tuple[int, ...]) -> Polynomial:
        if not exponents:
            return ring.constant(1)
        if exponents not in known:
            j, power = len(exponents) - 1, exponents[-1]
            while len(powers[j]) <= power:
                powers[j].append(ring.times(powers[j][-1], values[j]))
            rest = monomial(exponents[:-1])
            known[exponents] = ring.times(rest, powers[j][power]) if power else rest
        return known[exponents]

    total = ring.sum([ring.scaled(monomial(e), c) for e, c in p])
    if len(total.terms) > MAX_TERMS:
        raise Rejected(f"a polynomial of more than {MAX_TERMS} terms")
    return total


def along(
    p: Terms, at: Sequence[Polynomial], direction: Sequence[Polynomial], ring: Ring, first: int = 0
) -> Polynomial:
    """Σ_j ∂p/∂(variable first + j) direction[j], with polynomials `at` in the variables' place."""
    slopes = [substituted(derivative(p, first + j), at, ring) for j in range(len(direction))]
    return dot(slopes, direction, ring)


def dot(a: Sequence[Polynomial], b: Sequence[Polynomial], ring: Ring) -> Polynomial:
    """a'b."""
    return ring.sum([ring.times(left, right) for left, right in zip(a, b, strict=True)])


def form(M: Sequence[Sequence[Polynomial]], y: Sequence[Polynomial], ring: Ring) -> Polynomial:
    """y'M y."""
    return dot(y, [dot(row, y, ring) for row in M], ring)


def shown(p: Terms, names: Sequence[str]) -> str:
    """p with its exact coefficients, highest degree first; its size alone if that is too long."""
    result = ""
    for exponents, coefficient in reversed(p):
        if not coefficient:
            continue
        factors = [
            name if power == 1 else f"{name}^{power}"
            for name, power in zip(names, exponents, strict=True)
            if power
        ]
        size = text.exact(abs(coefficient))
        if "/" in size and factors:
            size = f"({size})"
        parts = ([size] if size != "1" or not factors else []) + factors
        sign = "-" if coefficient < 0 else "+"
        result += f" {sign} " if result else "-" if sign == "-" else ""
        result += " ".join(parts)
        if len(result) > MAX_SHOWN:
            degree = max(sum(e) for e, _ in p)
            return f"the claim's polynomial of degree {degree} with {len(p)} terms"
    return result or "0"


def _check_monomials(rows: Sequence[tuple[int, ...]], where: str) -> None:
    if len(rows) > MAX_STATED:
        raise Rejected(f"{where}: {len(rows)} terms; at most {MAX_STATED} are taken")
    if any(e < 0 for row in rows for e in row):
        raise Rejected(f"{where}: an exponent is negative")
    if any(sum(row) > MAX_DEGREE for row in rows):
        raise Rejected(f"{where}: a degree is above {MAX_DEGREE}")


def _common(values: Sequence[Fraction], where: str) -> None:
    """Refuse denominators that together would make every number long."""
    common = 1
    for denominator in {value.denominator for value in values}:
        common = lcm(common, denominator)
        if common.bit_length() > MAX_COMMON:
            raise Rejected(f"{where}: denominators of more than {MAX_COMMON} bits together")
