"""Numbers in sentences, rounded outward: no printed bound is better than the proved one."""

from fractions import Fraction
from math import isqrt

DIGITS = 4  # significant


def above(value: Fraction, digits: int = DIGITS) -> str:
    """A decimal number at least `value`."""
    return _decimal(value, digits, up=True)


def below(value: Fraction, digits: int = DIGITS) -> str:
    """A decimal number at most `value`."""
    return _decimal(value, digits, up=False)


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


def _decimal(value: Fraction, digits: int, *, up: bool) -> str:
    if not value:
        return "0"
    up_in_size = up == (value > 0)
    size = abs(value)
    bits = size.numerator.bit_length() - size.denominator.bit_length()
    exponent = bits * 30103 // 100000  # near log10(size)
    while Fraction(10) ** (exponent + 1) <= size:
        exponent += 1
    while Fraction(10) ** exponent > size:
        exponent -= 1
    unit = Fraction(10) ** (exponent - digits + 1)
    whole = -(-size // unit) if up_in_size else size // unit
    if whole >= 10**digits:
        whole, exponent = whole // 10, exponent + 1
    sign = "-" if value < 0 else ""
    text = str(whole)
    if -4 <= exponent < digits + 3:
        places = digits - 1 - exponent
        if places <= 0:
            return sign + text + "0" * -places
        text = text.rjust(places + 1, "0")
        return sign + (text[:-places] + "." + text[-places:]).rstrip("0").rstrip(".")
    mantissa = (text[0] + "." + text[1:]).rstrip("0").rstrip(".")
    return f"{sign}{mantissa}e{exponent:+03d}"
