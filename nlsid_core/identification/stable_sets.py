"""Convex sets of stable models: each a constraint on the model and its certificate jointly.

The conditions of `identification.conditions` with unknowns in the model's polynomials and in the
storage, as constraints of a `sos.Program` with the objective. A domain (polynomials ≥ 0, also in
the inputs) makes a condition local by the S-procedure. Variables of the second solution's gap are
named with "~". Source: thesis Chapter 2; the lemma is named at each function.
"""

from collections.abc import Sequence
from dataclasses import replace

from nlsid_core.errors import ShapeError
from nlsid_core.identification import conditions
from nlsid_core.identification.conditions import Domain, Inequality, Polynomials
from nlsid_core.polynomial import Polynomial
from nlsid_core.sos import SumOfSquares, matrix_sum_of_squares


def linear_models(E: Polynomials, F: Polynomials, *, rate: float = 1.0) -> SumOfSquares:
    """E x⁺ = F x + …, stable; with E = E' it contains every A of spectral radius below `rate`.

    Source: (2.19).
    """
    return constraint(conditions.linear(E, F, rate=rate), name="linear models (2.19)")


def increments(
    e: Polynomials, f: Polynomials, P: Polynomials, states: Sequence[str], *,
    delta: float = 1.0, domain: Domain = (),
) -> SumOfSquares:  # fmt: skip
    """e(x⁺) = f(x, w) by increments. Source: Lemma 2.12."""
    found = conditions.increments(e, f, P, states, delta=delta, domain=domain)
    return constraint(found, name="Lemma 2.12")


def derivatives(
    e: Polynomials, f: Polynomials, P: Polynomials, states: Sequence[str], *,
    delta: float = 1.0, domain: Domain = (),
) -> SumOfSquares:  # fmt: skip
    """e(x⁺) = f(x, w) by derivatives. Source: Lemma 2.13."""
    found = conditions.derivatives(e, f, P, states, delta=delta, domain=domain)
    return constraint(found, name="Lemma 2.13")


def implicit_increments(
    h: Polynomials, shift: Polynomials, V: Polynomial, v: Sequence[str], x: Sequence[str], *,
    delta: float = 1.0, domain: Domain = (),
) -> SumOfSquares:  # fmt: skip
    """0 = h(v, x, w) by increments, V in x and its gap; V ≥ 0 beside it. Source: Lemma 2.10."""
    found = conditions.implicit_increments(h, shift, V, v, x, delta=delta, domain=domain)
    return constraint(found, name="Lemma 2.10")


def implicit_derivatives(
    h: Polynomials, shift: Polynomials, M: Polynomials, v: Sequence[str], x: Sequence[str], *,
    delta: float = 1.0, domain: Domain = (),
) -> SumOfSquares:  # fmt: skip
    """0 = h(v, x, w) by derivatives, M in x; M ⪰ 0 beside it. Source: Lemma 2.11."""
    found = conditions.implicit_derivatives(h, shift, M, v, x, delta=delta, domain=domain)
    return constraint(found, name="Lemma 2.11")


def invertible(
    e: Polynomials, centre: Polynomials, states: Sequence[str], *, domain: Domain = ()
) -> SumOfSquares:
    """e is a bijection as its centre is. Source: Proposition 2.7, (2.15)."""
    return constraint(conditions.centred(e, centre, states, domain=domain), name="Proposition 2.7")


def invertible_increments(
    e: Polynomials, centre: Polynomials, states: Sequence[str], *, domain: Domain = ()
) -> SumOfSquares:
    """The same by increments. Source: Proposition 2.7, (2.14)."""
    return constraint(
        conditions.centred_increments(e, centre, states, domain=domain), name="Proposition 2.7"
    )


def box(names: Sequence[str], low: Sequence[float], high: Sequence[float]) -> Domain:
    """The domain low ≤ x ≤ high of states and inputs: (x_i - low_i)(high_i - x_i) ≥ 0."""
    if not len(names) == len(low) == len(high):
        raise ShapeError(f"{len(names)} names, {len(low)} lower and {len(high)} upper ends")
    return conditions.box(names, list(zip(low, high, strict=True)))


def constraint(inequality: Inequality, *, name: str) -> SumOfSquares:
    """The inequality as a sum of squares on its domain."""
    matrix, domain, gaps = inequality.matrix, inequality.domain, inequality.vanishing
    if len(matrix) == 1:
        return SumOfSquares(matrix[0, 0], domain=domain, vanishing=gaps, name=name)
    found = matrix_sum_of_squares(matrix, domain=domain, name=name)
    return replace(found, vanishing=(*gaps, *found.forms[1:])) if gaps else found
