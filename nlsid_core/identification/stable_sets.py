"""Convex sets of stable models: each a constraint on the model and its certificate jointly.

A model is e(x⁺) = f(x, w), or 0 = h(v, x, w) with x⁺ = [v; ã(x, w)] and known ã. Its polynomials
may hold unknowns linearly; the constraints go into a `sos.Program` with the objective. A domain
(polynomials ≥ 0, also in the inputs) makes a condition local by the S-procedure. The conditions of
2.10 to 2.13 do not change when e, f, h, V, M, P are scaled together: take δ = 1.
Source: thesis Chapter 2; the lemma is named at each function.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlsid_core.errors import ShapeError
from nlsid_core.polynomial import Polynomial, jacobian, variables
from nlsid_core.polynomial.algebra import as_polynomial
from nlsid_core.sos import SumOfSquares, matrix_sum_of_squares

Polynomials = NDArray[Any]  # object array of `Polynomial`
Domain = tuple[Polynomial, ...]
HAT = "^"  # appended to a variable's name: the second of two solutions


def linear_models(E: Polynomials, F: Polynomials) -> SumOfSquares:
    """[E - I, F'; F, E] ⪰ 0: E x⁺ = F x + …, stable; with E = E' it contains every stable A.

    Source: (2.19).
    """
    n = len(E)
    matrix = np.block([[E - np.eye(n), F.T], [F, E]])
    return matrix_sum_of_squares(matrix, name="linear models (2.19)")


def increments(
    e: Polynomials, f: Polynomials, P: Polynomials, states: Sequence[str], *,
    delta: float = 1.0, domain: Domain = (),
) -> SumOfSquares:  # fmt: skip
    """2Δ'(e(x) - e(x̂)) - |Δ|²_P - |f(x, w) - f(x̂, w)|²_{P⁻¹} ≥ δ|Δ|² with Δ = x - x̂, as a matrix.

    e, f: (n,) polynomials in `states` (and f in the inputs); P: (n, n). Source: Lemma 2.12.
    """
    hat = _hats(states)
    gap = np.array(variables(list(states))) - np.array(list(hat.values()))
    moved = e - _substituted(e, hat)
    corner = 2.0 * (gap @ moved) - gap @ P @ gap - delta * (gap @ gap)
    image = f - _substituted(f, hat)
    matrix = np.empty((len(e) + 1,) * 2, dtype=object)
    matrix[0, 0] = corner
    matrix[0, 1:] = matrix[1:, 0] = image
    matrix[1:, 1:] = P
    both = domain + tuple(g.substitute(hat) for g in domain)
    return matrix_sum_of_squares(matrix, domain=both, name="Lemma 2.12")


def derivatives(
    e: Polynomials, f: Polynomials, P: Polynomials, states: Sequence[str], *,
    delta: float = 1.0, domain: Domain = (),
) -> SumOfSquares:  # fmt: skip
    """[He(E(x)) - P - δI, F(x, w)'; F(x, w), P] ⪰ 0 with E = ∂e/∂x, F = ∂f/∂x.

    Global only if deg E ≥ 2 deg F; otherwise give a domain. Source: Lemma 2.13.
    """
    return matrix_sum_of_squares(
        derivatives_matrix(e, f, P, states, delta=delta), domain=domain, name="Lemma 2.13"
    )


def derivatives_matrix(
    e: Polynomials, f: Polynomials, P: Polynomials, states: Sequence[str], *, delta: float = 1.0
) -> Polynomials:
    """The matrix of `derivatives`."""
    E, F = _slopes(e, states), _slopes(f, states)
    corner = E + E.T - P - delta * np.eye(len(e))
    matrix = np.block([[corner, F.T], [F, P]])
    return np.array([[as_polynomial(entry) for entry in row] for row in matrix], dtype=object)


def implicit_increments(
    h: Polynomials, shift: Polynomials, V: Polynomial, v: Sequence[str], x: Sequence[str], *,
    delta: float = 1.0, domain: Domain = (),
) -> SumOfSquares:  # fmt: skip
    """2(v - v̂)'(h - ĥ) + V(x, x̂) - V(x⁺, x̂⁺) - δ|x - x̂|² ≥ 0, x⁺ = [v; ã(x, w)].

    h: (n_v,) in v, x and inputs; shift: ã, (n_x - n_v,); V in x and x̂ (names with "^").
    `storage_conditions` asks V ≥ 0. Source: Lemma 2.10.
    """
    if len(h) != len(v) or len(shift) != len(x) - len(v):
        raise ShapeError(f"{len(h)} equations for {len(v)} unknowns, {len(shift)} shifted states")
    hat = _hats([*v, *x])
    now, unknown = np.array(variables(list(x))), np.array(variables(list(v)))
    gap_v = unknown - _substituted(unknown, hat)
    gap_x = now - _substituted(now, hat)
    after = np.concatenate([unknown, shift])
    after_hat = _substituted(after, hat)
    names = [*x, *(name + HAT for name in x)]
    next_V = V.substitute(dict(zip(names, [*after, *after_hat], strict=True)))
    p = 2.0 * (gap_v @ (h - _substituted(h, hat))) + V - next_V - delta * (gap_x @ gap_x)
    both = domain + tuple(g.substitute(hat) for g in domain)
    return SumOfSquares(p, domain=both, name="Lemma 2.10")


def implicit_derivatives(
    h: Polynomials, shift: Polynomials, M: Polynomials, v: Sequence[str], x: Sequence[str], *,
    delta: float = 1.0, domain: Domain = (),
) -> SumOfSquares:  # fmt: skip
    """2ν'(H₁ν + H₂Δ) + |Δ|²_{M(x)-δI} - |[ν; ÃΔ]|²_{M(x⁺)} ≥ 0 for every ν, Δ, as a matrix.

    H₁ = ∂h/∂v, H₂ = ∂h/∂x, Ã = ∂ã/∂x; M: (n_x, n_x) in x, M ⪰ 0 to be asked for beside it.
    Source: Lemma 2.11.
    """
    n_v, n_x = len(v), len(x)
    H1, H2 = _slopes(h, v), _slopes(h, x)
    A = _slopes(shift, x) if len(shift) else np.zeros((0, n_x), dtype=object)
    after = dict(zip(x, [*variables(list(v)), *shift], strict=True))
    next_M = _substituted(M, after)
    top = H1 + H1.T - next_M[:n_v, :n_v]
    side = H2 - next_M[:n_v, n_v:] @ A
    corner = M - delta * np.eye(n_x) - A.T @ next_M[n_v:, n_v:] @ A
    matrix = np.block([[top, side], [side.T, corner]])
    return matrix_sum_of_squares(matrix, domain=domain, name="Lemma 2.11")


def invertible(
    e: Polynomials, centre: Polynomials, states: Sequence[str], *, domain: Domain = ()
) -> SumOfSquares:
    """E₀'E + E'E₀ - E₀'E₀ ⪰ 0: e is a bijection if e₀ is one with invertible Jacobian E₀.

    Source: Proposition 2.7, (2.15).
    """
    E, E0 = _slopes(e, states), _slopes(centre, states)
    matrix = E0.T @ E + E.T @ E0 - E0.T @ E0
    return matrix_sum_of_squares(matrix, domain=domain, name="Proposition 2.7")


def invertible_increments(
    e: Polynomials, centre: Polynomials, states: Sequence[str], *, domain: Domain = ()
) -> SumOfSquares:
    """2(e₀(x) - e₀(x̂))'(e(x) - e(x̂)) ≥ |e₀(x) - e₀(x̂)|². Source: Proposition 2.7, (2.14)."""
    hat = _hats(states)
    gap, gap_0 = e - _substituted(e, hat), centre - _substituted(centre, hat)
    both = domain + tuple(g.substitute(hat) for g in domain)
    return SumOfSquares(2.0 * (gap_0 @ gap) - gap_0 @ gap_0, domain=both, name="Proposition 2.7")


def box(names: Sequence[str], low: Sequence[float], high: Sequence[float]) -> Domain:
    """The domain low ≤ x ≤ high of states and inputs: (x_i - low_i)(high_i - x_i) ≥ 0."""
    if not len(names) == len(low) == len(high):
        raise ShapeError(f"{len(names)} names, {len(low)} lower and {len(high)} upper ends")
    return tuple(
        (x - a) * (b - x) for x, a, b in zip(variables(list(names)), low, high, strict=True)
    )


def _hats(names: Sequence[str]) -> dict[str, Polynomial]:
    """Each variable's counterpart of the second solution."""
    return dict(zip(names, variables([name + HAT for name in names]), strict=True))


def _substituted(polynomials: Polynomials, values: dict[str, Polynomial]) -> Polynomials:
    result = np.empty(polynomials.shape, dtype=object)
    for index in np.ndindex(polynomials.shape):
        entry = as_polynomial(polynomials[index])
        known = {name: value for name, value in values.items() if name in entry.names}
        result[index] = entry.substitute(known)
    return result


def _slopes(polynomials: Polynomials, names: Sequence[str]) -> Polynomials:
    """(m, n) derivatives; a variable that does not occur has derivative zero."""
    wide = [p.over(tuple(dict.fromkeys([*p.names, *names]))) for p in polynomials]
    result = np.empty((len(wide), len(names)), dtype=object)
    for i, p in enumerate(wide):
        result[i] = jacobian([p], names)[0]
    return result
