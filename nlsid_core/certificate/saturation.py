"""Limited inputs: u = clip(ũ), ũ = u₀ - Kx̄, is one polynomial on each of its modes.

Per limited input a mode is free, low ≤ ũ ≤ high and u = ũ; or low, ũ ≤ low and u = low; or high.
The modes of all inputs together cover every state, so V decreases on the boundary if in each mode
    c - Σ τ_l(s,z) q_l(s,z) > 0,   τ_l = y'Sy ≥ 0, y = (1, z), S linear in s,
with q ≥ 0 what holds there: (high - ũ)(ũ - low), low - ũ, or ũ - high. Source: the S-procedure;
clip is continuous, so that the closed loop has ordinary solutions that may change mode at any time.
"""

from typing import TYPE_CHECKING

import numpy as np

from nlsid_core._types import ArrayLike, FloatArray, IntArray
from nlsid_core.certificate.arithmetic import Arithmetic, Number
from nlsid_core.certificate.graded import Graded, add, multiply, negative, positions
from nlsid_core.continuous.policy import Policy
from nlsid_core.polynomial.maps import monomials

if TYPE_CHECKING:
    from nlsid_core.certificate.funnel_pieces import Pieces


def clipped(
    demands: list[Graded], policy: Policy, pieces: "Pieces", arithmetic: Arithmetic
) -> list[Graded]:
    """The inputs in each piece's mode: ũ, or a limit."""
    inputs = list(demands)
    for place, (i, low, high) in enumerate(policy.limits.tolist()):
        mode = pieces.mode[:, place]
        free = _column(mode == 0, arithmetic)
        limit = np.where(mode < 0, low, np.where(mode > 0, high, 0.0))
        inputs[int(i)] = add(
            {q: free * part for q, part in demands[int(i)].items()},
            {0: arithmetic.of(limit[:, None, None])},
        )
    return inputs


def in_mode(
    demands: list[Graded], policy: Policy, pieces: "Pieces", arithmetic: Arithmetic
) -> list[Graded]:
    """τ_l q_l for every limited input."""
    n = pieces.T.shape[1]
    terms = []
    for place, (i, low, high) in enumerate(policy.limits.tolist()):
        mode = pieces.mode[:, place]
        demand = demands[int(i)]
        above = add(demand, {0: arithmetic.of(np.full((1, 1, 1), -low))})
        below = add(negative(demand), {0: arithmetic.of(np.full((1, 1, 1), high))})
        q: Graded = {}
        for part, chosen in (
            (multiply(above, below, n), mode == 0),
            (negative(above), mode < 0),
            (negative(below), mode > 0),
        ):
            weight = _column(chosen, arithmetic)
            q = add(q, {degree: weight * factor for degree, factor in part.items()})
        terms.append(multiply(_multiplier(pieces.tau[:, :, place], n, arithmetic), q, n))
    return terms


def _multiplier(triangles: FloatArray, n: int, arithmetic: Arithmetic) -> Graded:
    """y'Sy from upper triangles (B, 2, (n+1)(n+2)/2), by degree in z."""
    i, j = np.triu_indices(n + 1)
    y = np.vstack([np.zeros((1, n), dtype=np.int64), monomials(n, [1])])
    products: IntArray = y[i] + y[j]
    entries = arithmetic.of(triangles * np.where(i == j, 1.0, 2.0))
    result: Graded = {}
    for degree in range(3):
        chosen = np.flatnonzero(products.sum(axis=1) == degree)
        order = np.argsort(positions(products[chosen], monomials(n, [degree])))
        result[degree] = entries[:, :, chosen[order]]
    return result


def _column(chosen: ArrayLike, arithmetic: Arithmetic) -> Number:
    """(B, 1, 1): 1 where chosen, else 0."""
    return arithmetic.of(np.asarray(chosen, dtype=np.float64)[:, None, None])
