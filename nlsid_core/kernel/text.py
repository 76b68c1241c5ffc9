"""Numbers in sentences, rounded outward: no printed bound is better than the proved one."""

from decimal import MAX_EMAX, MIN_EMIN, ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from fractions import Fraction
from math import isqrt

DIGITS = 4  # significant


def above(value: Fraction, digits: int = DIGITS) -> str:
    """A decimal number at least `value`."""
    return _decimal(value, digits, ROUND_CEILING)


def below(value: Fraction, digits: int = DIGITS) -> str:
    """A decimal number at most `value`."""
    return _decimal(value, digits, ROUND_FLOOR)


def exact(value: Fraction) -> str:
    """`value` itself: the shortest decimal form of a float64, or p/q."""
    if value.denominator == 1:
        return str(value.numerator)
    try:
        nearest = float(value)
        if Fraction(*nearest.as_integer_ratio()) == value:
            return repr(nearest)
    except OverflowError:
        pass
    return str(value)


def root_above(value: Fraction, bits: int = 64) -> Fraction:
    """A rational at least the square root of value >= 0, within 2^(1 - bits) of it, relatively."""
    if not value:
        return Fraction(0)
    shift = max(0, 2 * bits - value.numerator.bit_length() + value.denominator.bit_length())
    shift += shift % 2
    scaled = -((-value.numerator << shift) // value.denominator)
    root = isqrt(scaled)
    return Fraction(root if root * root == scaled else root + 1, 1 << (shift // 2))


def _decimal(value: Fraction, digits: int, rounding: str) -> str:
    context = Context(prec=digits, rounding=rounding, Emax=MAX_EMAX, Emin=MIN_EMIN)
    shown = context.divide(Decimal(value.numerator), Decimal(value.denominator)).normalize()
    exponent = shown.adjusted()
    if not shown or -4 <= exponent < digits + 3:
        return f"{shown:f}"
    return f"{shown.scaleb(-exponent):f}e{exponent:+03d}"
