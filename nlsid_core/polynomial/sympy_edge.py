"""SymPy expressions to polynomials and back (optional extra `sympy`)."""

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from nlsid_core.errors import NotPolynomial
from nlsid_core.polynomial.algebra import Polynomial


def from_sympy(expression: Any, names: Sequence[str]) -> Polynomial:
    """The exact polynomial a SymPy expression is, in the variables `names`.

    SymPy floats enter as the binary rationals they are. Raises NotPolynomial if the expression is
    not a polynomial in these variables with rational coefficients.
    """
    import sympy

    symbols = [sympy.Symbol(name) for name in names]
    renamed = sympy.sympify(expression).subs(
        {s: sympy.Symbol(s.name) for s in sympy.sympify(expression).free_symbols}
    )
    try:
        terms = sympy.Poly(renamed, *symbols, domain=None).terms()
        rows = [(exponent, _fraction(coefficient)) for exponent, coefficient in terms]
    except (sympy.PolynomialError, TypeError, ValueError) as error:
        raise NotPolynomial(f"{expression} in {', '.join(names)}: {error}") from error
    coefficients = np.empty(len(rows), dtype=object)
    coefficients[:] = [c for _, c in rows]
    return Polynomial(np.array([e for e, _ in rows], dtype=np.int64), coefficients, tuple(names))


def to_sympy(polynomial: Polynomial) -> Any:
    """The same polynomial as a SymPy expression with exact rational coefficients."""
    import sympy

    symbols = [sympy.Symbol(name) for name in polynomial.names]
    total = sympy.Integer(0)
    for exponent, coefficient in polynomial.exact().terms():
        term = sympy.Rational(coefficient.numerator, coefficient.denominator)
        for symbol, power in zip(symbols, exponent, strict=True):
            term *= symbol**power
        total += term
    return total


def _fraction(coefficient: Any) -> Fraction:
    import sympy

    if isinstance(coefficient, sympy.Float):
        return Fraction(float(coefficient))
    if isinstance(coefficient, sympy.Rational):
        return Fraction(int(coefficient.p), int(coefficient.q))
    raise NotPolynomial(f"coefficient {coefficient} is not a rational number")
