"""Robust simulation error: convex upper bounds on the simulation error, made exact by iterating.

With G(θ) the banded matrix of the left side over all rows of all trials and ε(θ) the equation
errors, the simulation error is |G⁻¹ε|². With the multiplier that is exact at θ_m, P = G_m⁻ᵀ,
    J_m(θ) = min_p ε' K⁻¹ ε,   K(θ) = G G_m' + G_m G' - G_m G_m'    (first: G_m = I)
bounds it from above and equals it at θ_m, so minimising and re-linearising never goes up. K and ε
are affine in θ. p enters linearly and is projected out: with K = LL', x = K⁻¹ε at the best p and
v_i = ε_i - K_i x,
    gradient_i = 2 ε_i'x - x'K_i x,   Hessian = 2 |(I - Π) L⁻¹V|²,  Π the projection on L⁻¹Q.
K is banded (bandwidth n·n_y): O(N·p·n) a step.
Source: thesis (4.1)-(4.3), Proposition 4.3 and Section 4.4; |Δ|² - 2(PΔ)'(GΔ + ε) with Δ = G_m'η
is η'G_m G_m'η - 2η'(G G_m'η + ε).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.identification.methods.banded import Factor, Rows, shift, sparse, symmetric_product
from nlsid_core.identification.methods.newton import Point, minimise, project

WORK = 5e10  # rows times squared left parameters, of all Newton steps together: a minute


@dataclass(frozen=True, eq=False)
class Iterate:
    """One minimiser: left parameters θ, right parameters p, and J, the bound at them (scaled)."""

    theta: FloatArray
    p: FloatArray
    J: float


def robust_simulation_error(
    rows: Rows,
    *,
    start: FloatArray | None = None,
    iterations: int = 40,
    tolerance: float = 1e-6,
    steps: int | None = None,
) -> Iterator[Iterate]:
    """Yield the minimiser of each bound, first to last.

    start: left parameters at which the first bound is exact (None: the first bound is that of
    G_m = I). Stops after `iterations` bounds or when J falls by less than `tolerance` of itself.
    steps: of Newton's method for each bound, at most (None: to its minimum): J goes down all the
    same, as each bound is exact where it begins.
    Raises SolverError if Newton's method cannot go on.
    """
    linearised_at = start
    previous = float("inf")
    for _ in range(iterations):
        start = rows.identity if linearised_at is None else linearised_at
        point = minimise(Bound(rows, linearised_at), start, steps=steps).point
        yield Iterate(point.theta, point.p, point.J)
        if np.isfinite(previous) and previous - point.J <= tolerance * previous:
            return
        linearised_at, previous = point.theta, point.J


def affordable_steps(rows: Rows) -> int:
    """Newton steps that `WORK` is enough for."""
    return int(WORK / (len(rows) * len(rows.offsets) ** 2))


class Bound:
    """J_m linearised at the left parameters `theta_m` (None: the first bound)."""

    def __init__(self, rows: Rows, theta_m: FloatArray | None) -> None:
        self.rows = rows
        G_m = rows.eye if theta_m is None else rows.G(theta_m)
        self._G_m = G_m
        self._H = sparse(G_m)
        self._Ht = self._H.T
        self._constant = -0.5 * symmetric_product(G_m, G_m, rows.bandwidth)

    def at(self, theta: FloatArray) -> Point:
        """Value and best p; LinAlgError if K(θ) is not positive definite."""
        rows = self.rows
        K = self._constant + symmetric_product(rows.G(theta), self._G_m, rows.bandwidth)
        return project(rows, theta, theta, Factor.of(K))

    def derivatives(self, point: Point) -> tuple[FloatArray, FloatArray]:
        """Gradient (n_g,) and Hessian (n_g, n_g) of J at `point`."""
        return point.derivatives(self.rows.errors, self.slopes(point.x))

    def slopes(self, x: FloatArray) -> FloatArray:
        """(N, n_g): K_i x, K_i = G_i G_m' + G_m G_i', of every left parameter i."""
        rows, ahead = self.rows, self._Ht @ x
        columns, behind = np.empty_like(rows.weights), np.empty(rows.weights.shape)
        for D, group, weights in rows.groups:
            columns[:, group] = weights * shift(ahead, D)[:, None]
            behind[:, group] = shift(weights * x[:, None], -D)
        columns += self._H @ behind
        return columns
