"""Polynomials as files state them: their variables' names, derivatives, and text in sentences."""

from collections.abc import Sequence

from . import text
from .files import Node, Rejected, Terms
from .polynomials import CALL, Polynomial, Ring

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


def read_symmetric(node: Node, count: int, most: int, least: int = 1) -> list[list[Terms]]:
    """A symmetric matrix of polynomials, of order `least` to `most`."""
    rows = node.items(least, most)
    M = [[entry.polynomial(count) for entry in row.items(len(rows), len(rows))] for row in rows]
    if any(M[i][j] != M[j][i] for i in range(len(M)) for j in range(i)):
        raise Rejected(f"{node.where} is not symmetric")
    return M


def derivative(p: Terms, j: int) -> Terms:
    """∂p/∂(variable j)."""
    return [((*e[:j], e[j] - 1, *e[j + 1 :]), c * e[j]) for e, c in p if e[j]]


def along(
    ps: Sequence[Terms], at: Sequence[Polynomial], direction: Sequence[Polynomial], ring: Ring
) -> list[Polynomial]:
    """Σ_j ∂p/∂(variable j) direction[j] of each p, with `at` in the variables' place."""
    size = len(direction)
    ring.work.spend(CALL * size * sum(map(len, ps)))
    found = ring.substituted([derivative(p, j) for p in ps for j in range(size)], at)
    return [ring.dot(found[i : i + size], direction) for i in range(0, size * len(ps), size)]


def shown(p: Terms, names: Sequence[str], what: str) -> str:
    """p with its exact coefficients, highest degree first; if too long, its place and size."""
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
            return f"the claim's {what} of degree {degree} with {len(p)} terms"
    return result or "0"
