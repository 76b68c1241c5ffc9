"""Pieces of a proof: parts of time, vertices and modes, which have to cover everything."""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import product
from math import prod

from .closed_loop import Mode, Part
from .files import Node, Terms, refuse_if
from .trajectory import Field, Policy

MAX_LEVEL, MAX_PIECES = 16, 100_000

Key = tuple[int, int, tuple[int, ...]]  # interval, vertex; mode, or input, sign and mode


@dataclass(frozen=True)
class Piece:
    """What a piece is about, its members, and its place in the file."""

    key: Key
    part: Part
    members: dict[str, Node]
    place: int


def in_order(node: Node, names: str, needed: Sequence[Key], limited: int) -> list[Piece]:
    """Every piece, in the order of the file.

    Raises Rejected unless their parts of time cover [0, 1] for everything that is needed.
    """
    covered = {key: Fraction(0) for key in needed}
    names = "interval vertex level index columns squares " + names
    pieces = []
    for place, entry in enumerate(node.items(1, MAX_PIECES)):
        piece = entry.members(names)
        level = piece["level"].whole(0, MAX_LEVEL)
        index = piece["index"].whole(0, 2**level - 1)
        mode = tuple(piece["mode"].wholes(limited)) if limited else ()
        if "input" in piece:
            mode = piece["input"].whole(0), piece["sign"].whole(-1, 1), *mode
        k, v = piece["interval"].whole(0), piece["vertex"].whole(0)
        refuse_if(
            (k, v, mode) not in covered,
            f"piece {place} is about interval {k}, vertex {v}, mode {mode}: none",
            "not_covered",
        )
        pieces.append(Piece((k, v, mode), (k, level, index), piece, place))
    starts = [(p.key, Fraction(p.part[2], 2 ** p.part[1]), p.part[1]) for p in pieces]
    for key, start, level in sorted(starts):
        if start <= covered[key]:
            covered[key] = max(covered[key], start + Fraction(1, 2**level))
    for (k, v, mode), until in covered.items():
        refuse_if(
            until < 1,
            f"a piece of interval {k} is missing (vertex {v}, mode {mode})",
            "not_covered",
        )
    return pieces


def refuse_many(*counts: int) -> None:
    """Raise Rejected if there are more intervals, vertices and modes than pieces."""
    refuse_if(
        prod(counts) > MAX_PIECES,
        f"{prod(counts)} intervals, vertices and modes; at most {MAX_PIECES}",
        "too_large",
    )


def modes_of(policy: Policy) -> list[Mode]:
    """Each input with limits free, low or high."""
    return list(product((0, -1, 1), repeat=len(policy.limits)))


def pushing(field: Field, first: int, count: int) -> list[int]:
    """Which of `count` variables from `first` on only add constants to ẋ, in all time spans."""
    rows = [e for span in field.equations for equation in span for e, _ in equation]
    return [j for j in range(count) if all(sum(e) == 1 for e in rows if e[first + j])]


def pushed(equation: Terms, j: int) -> Fraction:
    """What a unit of variable j adds to one rate, for a variable that only pushes."""
    return sum((c for e, c in equation if e[j]), Fraction(0))
