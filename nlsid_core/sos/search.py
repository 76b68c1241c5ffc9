"""Searches that end in something provable: bounds, Lyapunov functions, regions of attraction.

A solver's answer sits at the boundary of what is true, where rounding decides. So each search
solves twice: for the optimum, then for an interior point a little below it, and returns only what
the kernel proves.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import Json
from nlsid_core.errors import CertificateRejected, Infeasible
from nlsid_core.polynomial import Gram, Polynomial, monomials, variables
from nlsid_core.proofs import decide
from nlsid_core.sos.compiled import solve
from nlsid_core.sos.program import Identity, Program, SumOfSquares, template
from nlsid_core.sos.proofs import attraction_document, bound_document

# Steps below the optimum, relative to 1 + |optimum|: the solver's tolerance is 1e-8.
BACK_OFF = (1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3)
DUST = 1e-6  # relative size below which a coefficient of V is what the solver leaves of a zero


@dataclass(frozen=True, eq=False)
class Bound:
    """p ≥ value on the domain, proved exactly by `document`; the solver's optimum was `optimum`."""

    value: float
    optimum: float
    document: Json


@dataclass(frozen=True, eq=False)
class Attraction:
    """{V ≤ level} (all, if level is None) is in the region of attraction, proved by `document`."""

    V: Polynomial
    level: float | None
    document: Json


def lower_bound(
    p: Polynomial,
    *,
    domain: Sequence[Polynomial] = (),
    equalities: Sequence[Polynomial] = (),
    degree: int | None = None,
) -> Bound:
    """The best bound that sums of squares of this degree give, and its exact proof.

    Raises Infeasible if there is none, or none that can be proved.
    """
    unknown = "bound"
    while unknown in p.names:
        unknown += "_"
    (gamma,) = variables([unknown])

    def program(level: Polynomial | float, goal: Polynomial | None) -> Program:
        squares = SumOfSquares(p - level, tuple(domain), tuple(equalities), degree, name="p")
        return Program(p.names, (squares,), maximise=goal)

    optimum = solve(program(gamma, gamma)).objective
    for step in BACK_OFF:
        value = optimum - step * (1 + abs(optimum))
        identity = solve(program(value, None))["p"]
        try:
            document = bound_document(
                p,
                value,
                identity.gram,
                domain=domain,
                multipliers=identity.multipliers,
                equalities=equalities,
                equality_multipliers=identity.equality_multipliers,
            )
            decide(document, {})
        except (CertificateRejected, Infeasible):
            continue
        return Bound(value, optimum, document)
    raise Infeasible(
        f"the bound {optimum:.9g} was found but none within {BACK_OFF[-1]:g} of it was proved; "
        "raise the degree, or give the zeros to `exact_gram`"
    )


def lyapunov(field: Sequence[Polynomial], *, degree: int = 2) -> Attraction:
    """A polynomial V of this degree that proves the origin globally attracting.

    Raises Infeasible if there is none, or none that can be proved.
    """
    names = field[0].names
    V = template("V", monomials(len(names), range(2, degree + 1)), names)
    squares = sum(x**2 for x in variables(names))
    rate = sum(V.derivative(x) * f for x, f in zip(names, field, strict=True))
    shape = SumOfSquares(V - squares, name="V")
    found = solve(Program(names, (shape, SumOfSquares(-rate, name="decrease"))))
    V = _without_dust(found.value(V).over(names))
    rate = sum(V.derivative(x) * f for x, f in zip(names, field, strict=True))
    again = solve(Program(names, (SumOfSquares(-rate, name="decrease"),)))
    return _proved(field, V, None, again["decrease"])


def attraction(
    field: Sequence[Polynomial], V: Polynomial, level: float, *, degree: int | None = None
) -> Attraction:
    """Prove that {V ≤ level} is in the region of attraction of the origin of ẋ = field(x).

    degree: of σ·(level - V); default: that of V̇, even, and at least that of V + 2.
    Raises Infeasible if sums of squares of this degree do not prove it.
    """
    names = V.names
    rate: Polynomial = -sum(V.derivative(x) * f for x, f in zip(names, field, strict=True))
    lowest = int(np.min(rate.exponents.sum(axis=1))) if len(rate) else 0
    even = rate.degree + rate.degree % 2
    room = SumOfSquares(
        rate,
        domain=(level - V,),
        degree=max(even, V.degree + 2) if degree is None else degree,
        lowest=lowest,
        name="decrease",
    )
    found = solve(Program(names, (room,)))
    return _proved(field, V, level, found["decrease"])


def largest_level(
    field: Sequence[Polynomial],
    V: Polynomial,
    *,
    upper: float,
    degree: int | None = None,
    tolerance: float = 1e-4,
) -> Attraction:
    """The largest level ≤ upper that `attraction` proves, to a relative tolerance, by bisection.

    Raises Infeasible if not even upper·tolerance is proved.
    """
    best = attraction(field, V, upper * tolerance, degree=degree)
    low, high = upper * tolerance, upper
    while high - low > tolerance * high:
        middle = (low + high) / 2
        try:
            best, low = attraction(field, V, middle, degree=degree), middle
        except Infeasible:
            high = middle
    return best


def positive_semidefinite(gram: Gram) -> Gram:
    """With its eigenvalues lifted just above zero; the identity takes the change."""
    if not len(gram):
        return gram
    lowest = float(np.linalg.eigvalsh(gram.Q)[0])
    size = float(np.abs(gram.Q).max()) or 1.0
    lift = max(0.0, -lowest) + 1e-13 * size
    return Gram(gram.basis, gram.Q + lift * np.eye(len(gram)), gram.names)


def _without_dust(p: Polynomial) -> Polynomial:
    """Without the coefficients that are zero up to solver tolerance."""
    keep = np.abs(p.coefficients) > DUST * np.abs(p.coefficients).max(initial=0.0)
    return Polynomial(p.exponents[keep], p.coefficients[keep], p.names)


def _proved(
    field: Sequence[Polynomial],
    V: Polynomial,
    level: float | None,
    decrease: Identity,
) -> Attraction:
    shape = solve(Program(V.names, (SumOfSquares(V, name="V"),)))["V"].gram
    multiplier = decrease.multipliers[0] if decrease.multipliers else None
    try:
        document = attraction_document(
            field, V, level, positive=shape, decrease=decrease.gram, multiplier_gram=multiplier
        )
        decide(document, {})
    except CertificateRejected as error:
        raise Infeasible(f"what the solver found proves nothing: {error}") from error
    return Attraction(V, level, document)
