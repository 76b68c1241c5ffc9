"""`Verdict`: a sentence that is proved; the numbers in sentences, and their one printer.

A sentence is a template with slots, `{name:how}`, and `how` is one of PRINTED. A bound is printed
exactly where its shortest decimal form is short, else rounded outward.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from decimal import MAX_EMAX, MIN_EMIN, ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from fractions import Fraction
from html import escape
from math import isqrt
from string import Formatter
from typing import Any

DIGITS = 4  # significant, of a number that is rounded
LONGEST = 10_000  # bits of a fraction that is printed whole
SHORT = 6  # significant digits of a number that is not
# Not the context of whoever calls, which may round.
EXACT = Context(prec=60, Emax=MAX_EMAX, Emin=MIN_EMIN)


@dataclass(frozen=True, repr=False)
class Verdict:
    """What is proved: it exists only for a claim that was decided.

    statement: one sentence. margin: how much room the proof has, in the unit that the kind states;
    rounded down when printed. assumptions: what the statement rests on and the kernel cannot know.
    digests: by role, of the files that it is about, and of the proof itself (role `proof`). files:
    the digests by name of all that was read beside the proof.
    """

    statement: str
    margin: Fraction
    assumptions: tuple[str, ...]
    digests: dict[str, str]
    kind: str = ""
    files: dict[str, str] = field(default_factory=dict)

    @property
    def short_margin(self) -> str:
        """The margin as p/q, or rounded down where that is longer than Python would read."""
        longest = max(self.margin.numerator.bit_length(), self.margin.denominator.bit_length())
        return str(self.margin) if longest < LONGEST else below(self.margin)

    def _repr_html_(self) -> str:
        """The same, with a tick."""
        return (
            '<div><svg viewBox="0 0 24 24" width="24" fill="none" stroke="#2e7d32">'
            '<circle cx="12" cy="12" r="10"/><path d="M7 12.5l3.5 3.5L17 9"/></svg>'
            f"<pre>{escape(str(self))}</pre></div>"
        )

    def __str__(self) -> str:
        return "\n  assuming ".join(
            [f"PROVED {self.statement}, margin {below(self.margin)}", *self.assumptions]
        )

    __repr__ = __str__


def above(value: Fraction, digits: int = DIGITS) -> str:
    """A decimal number at least `value`, or the short form of a float64 that is `value`."""
    return _decimal(value, digits, ROUND_CEILING)


def below(value: Fraction, digits: int = DIGITS) -> str:
    """A decimal number at most `value`, or the short form of a float64 that is `value`."""
    return _decimal(value, digits, ROUND_FLOOR)


def exact(value: Fraction) -> str:
    """`value` itself: the shortest decimal form of a float64, or p/q."""
    if value.denominator == 1:
        return str(value.numerator)
    nearest = _nearest(value)
    return str(value) if nearest is None else repr(nearest)


def root_above(value: Fraction, bits: int = 64) -> Fraction:
    """A rational at least the square root of value >= 0, within 2^(2 - bits) of it, relatively."""
    shift = max(0, bits + (value.denominator.bit_length() - value.numerator.bit_length()) // 2)
    scaled = -((-value.numerator << 2 * shift) // value.denominator)
    root = isqrt(scaled)
    return Fraction(root + (root * root < scaled), 1 << shift)


PRINTED: dict[str, Callable[[Any], str]] = {
    "": str,
    "up": above,
    "down": below,
    "exact": exact,
    "quoted": json.dumps,  # in quotation marks, which can end no sentence
    "exact_range": lambda ends: f"[{exact(ends[0])}, {exact(ends[1])}]",
    "outer_range": lambda ends: f"[{below(ends[0])}, {above(ends[1])}]",
    "inner_range": lambda ends: _inner(*ends),
}


class _Printer(Formatter):
    def format_field(self, value: Any, how: str) -> str:
        """A slot's value, printed as its template says."""
        return PRINTED[how](value)


say = _Printer().format


def _nearest(value: Fraction) -> float | None:
    """The float64 that `value` is, if it is one."""
    try:
        nearest = value.numerator / value.denominator
    except OverflowError:
        return None
    return nearest if Fraction(*nearest.as_integer_ratio()) == value else None


def _decimal(value: Fraction, digits: int, rounding: str) -> str:
    nearest = _nearest(value)
    own = None if nearest is None else Decimal(repr(nearest)).normalize(EXACT)
    if own is not None and len(own.as_tuple().digits) <= SHORT:
        shown = own
    else:
        context = Context(prec=digits, rounding=rounding, Emax=MAX_EMAX, Emin=MIN_EMIN)
        shown = context.divide(Decimal(value.numerator), Decimal(value.denominator))
        shown = shown.normalize(EXACT)
    exponent = shown.adjusted()
    if not shown or -4 <= exponent < digits + 3:
        return f"{shown:f}"
    return f"{shown.scaleb(-exponent, EXACT):f}e{exponent:+03d}"


def _inner(low: Fraction, high: Fraction) -> str:
    """[low, high] rounded inward, to as many digits as leave a range."""
    digits = DIGITS
    while Fraction(above(low, digits)) >= Fraction(below(high, digits)):
        digits += 1
    return f"[{above(low, digits)}, {below(high, digits)}]"
