"""Polynomials modulo one equation g = 0: normal forms and the multiplier that was divided out.

One polynomial is a Gröbner basis of the ideal it generates, so division by it has a unique
remainder: p ≡ q on {g = 0} follows from equal remainders.
"""

import numpy as np

from nlsid_core.arrays import IntArray
from nlsid_core.errors import DataError
from nlsid_core.polynomial import Polynomial


class Quotient:
    """Remainders modulo one polynomial, of single monomials, remembered."""

    def __init__(self, generator: Polynomial) -> None:
        """`generator` should not be constant; its last term in canonical order leads."""
        if not generator.degree:
            raise DataError(f"cannot divide by the constant {generator}")
        self.generator = generator
        self.lead = generator.exponents[-1]
        # lead ≡ Σ tail_k · monomial_k
        self._tail = [
            (
                generator.exponents[k] - self.lead,
                -generator.coefficients[k] / generator.coefficients[-1],
            )
            for k in range(len(generator) - 1)
        ]
        self._known: dict[tuple[int, ...], dict[tuple[int, ...], float]] = {}

    def remainder(self, exponent: tuple[int, ...]) -> dict[tuple[int, ...], float]:
        """The remainder of one monomial as {exponent: coefficient}."""
        if exponent not in self._known:
            row = np.array(exponent)
            if (row < self.lead).any():
                self._known[exponent] = {exponent: 1.0}
            else:
                total: dict[tuple[int, ...], float] = {}
                for step, factor in self._tail:
                    for key, value in self.remainder(tuple((row + step).tolist())).items():
                        total[key] = total.get(key, 0.0) + factor * value
                self._known[exponent] = total
        return self._known[exponent]

    def standard(self, basis: IntArray) -> IntArray:
        """The rows of `basis` that are their own remainder; with the others they are dependent."""
        return np.asarray(basis[(basis < self.lead).any(axis=1)])


def divide(p: Polynomial, g: Polynomial) -> tuple[Polynomial, Polynomial]:
    """(μ, r) with p = μ·g + r, no term of r divisible by the leading term of g."""
    g = g.over(p.names)
    lead, top = g.exponents[-1], g.coefficients[-1]
    quotient, remainder = p * 0, p
    while True:
        divisible = (remainder.exponents >= lead).all(axis=1)
        if not divisible.any():
            return quotient, remainder
        part = Polynomial(
            remainder.exponents[divisible] - lead,
            remainder.coefficients[divisible] / top,
            p.names,
        )
        # Only the highest degree: lower terms may still change.
        part = part.homogeneous(part.degree)
        quotient = quotient + part
        product = part * g
        remainder = _without(remainder - product, part, lead)


def _without(p: Polynomial, part: Polynomial, lead: IntArray) -> Polynomial:
    """Drop what rounding leaves of the terms that were just cancelled."""
    cancelled = {tuple(row) for row in (part.exponents + lead).tolist()}
    keep = np.array([tuple(row) not in cancelled for row in p.exponents.tolist()], dtype=bool)
    return Polynomial(p.exponents[keep], p.coefficients[keep], p.names)
