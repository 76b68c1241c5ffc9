"""Robust simulation error: convex upper bounds on the simulation error, made exact by iterating.

With G(θ) the lower-triangular banded matrix of the left side over all rows of all trials (block
diagonal over trials) and ε(θ) the equation errors, the simulation error is |G⁻¹ε|². Around θ_m,
    J_m(θ) = ε' K⁻¹ ε,   K(θ) = G G_m' + G_m G' - G_m G_m'      (first: K = G + G' - I)
bounds it from above and equals it at θ_m, so minimising and re-linearising never goes up. K and ε
are affine in θ: with x = K⁻¹ε and v_i = ε_i - K_i x,
    gradient_i = ε_i'x + x'v_i,   Hessian = 2 V'K⁻¹V.
K is banded, so a Newton step costs O(N·p·n).
Source: thesis (4.1)-(4.3), Proposition 4.3 and Section 4.4.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded

from nlsid_core._types import FloatArray
from nlsid_core.errors import SolverError
from nlsid_core.identification.regression import Regression
from nlsid_core.models import DifferenceEquation

DECREMENT = 1e-12  # Newton decrement relative to J: 1e-6 relative accuracy of the minimiser
PERFECT_FIT = 1e-18  # J relative to Σy²: noise-free data, what is left is rounding
MAX_NEWTON = 200
ARMIJO = 1e-4  # the usual sufficient-decrease fraction
SHORTEST_STEP = 2.0**-40


@dataclass(frozen=True, eq=False)
class Iterate:
    """One minimiser: g (n+1,) and p (n+2,) of Y g = Q p, and J, the bound at them (scaled)."""

    g: FloatArray
    p: FloatArray
    J: float


def robust_simulation_error(
    regression: Regression,
    *,
    iterations: int = 40,
    tolerance: float = 1e-6,
    progress: Callable[[int, float], None] | None = None,
) -> Iterator[tuple[Iterate, DifferenceEquation]]:
    """Yield the minimiser of each bound, first to last, with its model.

    Stops after `iterations` bounds or when J falls by less than `tolerance` of itself. `progress`
    is called with (iterate number, J). Raises SolverError if Newton's method cannot go on.
    """
    previous: Iterate | None = None
    for number in range(1, iterations + 1):
        current = _minimise(regression, previous)
        if progress is not None:
            progress(number, current.J)
        yield current, regression.model(current.g, current.p)
        if previous is not None:
            decrease = previous.J - current.J
            if decrease <= tolerance * previous.J:
                return
        previous = current


def _minimise(regression: Regression, linearised_at: Iterate | None) -> Iterate:
    """Damped Newton on J_m from a point where K ≻ 0: θ_m itself, or G = I for the first bound."""
    band = _Band(regression.row, regression.lags)
    errors = np.column_stack([regression.Y, -regression.Q])
    split = regression.lags + 1
    if linearised_at is None:
        theta = np.zeros(errors.shape[1])
        theta[0] = 1.0
    else:
        theta = np.concatenate([linearised_at.g, linearised_at.p])
    bound = _Bound(band, errors, None if linearised_at is None else linearised_at.g)
    J, x, factor = bound.value(theta)
    perfect = PERFECT_FIT * float(np.sum(regression.Y[:, 0] ** 2))
    for _ in range(MAX_NEWTON):
        gradient, hessian = bound.derivatives(x, factor)
        step = -np.linalg.lstsq(hessian, gradient, rcond=None)[0]
        decrement = -float(gradient @ step)
        if decrement <= DECREMENT * J or perfect >= J:
            return Iterate(theta[:split], theta[split:], J)
        length = 1.0
        while True:
            candidate = theta + length * step
            try:
                J_new, x_new, factor_new = bound.value(candidate)
                if J_new <= J - ARMIJO * length * decrement:
                    break
            except LinAlgError:
                pass
            length /= 2
            if length < SHORTEST_STEP:
                raise SolverError(
                    f"no step decreases J = {J:.6g}; decrement {decrement / J:.1e} of it"
                )
        theta, J, x, factor = candidate, J_new, x_new, factor_new
    raise SolverError(f"no minimiser of J after {MAX_NEWTON} Newton steps; J = {J:.6g}")


class _Band:
    """Masked shifts: (S_k x)(t) = x(t-k) within a trial, 0 where t-k is before its first row."""

    def __init__(self, row: FloatArray, lags: int) -> None:
        self.masks = [row >= k for k in range(lags + 1)]

    def shift(self, k: int, x: FloatArray) -> FloatArray:
        """S_k x."""
        moved = np.zeros_like(x)
        moved[k:] = x[: len(x) - k]
        return np.where(self.masks[k], moved, 0.0)

    def shift_back(self, k: int, x: FloatArray) -> FloatArray:
        """S_k' x."""
        moved = np.zeros_like(x)
        moved[: len(x) - k] = np.where(self.masks[k], x, 0.0)[k:]
        return moved

    def lower(self, g: FloatArray, h: FloatArray) -> FloatArray:
        """(n+1, N): row d holds (G H')[t, t-d] at t, G = Σ g_k S_k, H = Σ h_k S_k."""
        n = len(g) - 1
        product = np.zeros((n + 1, len(self.masks[0])))
        for d in range(n + 1):
            for k in range(d, n + 1):
                reach = np.zeros(len(self.masks[0]))
                reach[d:] = self.masks[k - d][: len(reach) - d]
                product[d] += g[k] * h[k - d] * (self.masks[k] & (reach > 0))
        return product


class _Bound:
    """J_m and its derivatives; g_m is None for the first bound, K = G + G' - I."""

    def __init__(self, band: _Band, errors: FloatArray, g_m: FloatArray | None) -> None:
        self.band, self.errors, self.g_m = band, errors, g_m
        n = len(band.masks) - 1
        unit = np.eye(n + 1)
        if g_m is None:
            self.constant = -band.lower(unit[0], unit[0])
            self.linear = [
                band.lower(unit[k], unit[0]) + band.lower(unit[0], unit[k]) for k in range(n + 1)
            ]
        else:
            self.constant = -band.lower(g_m, g_m)
            self.linear = [
                band.lower(unit[k], g_m) + band.lower(g_m, unit[k]) for k in range(n + 1)
            ]

    def value(self, theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """J, x = K⁻¹ε and the banded Cholesky factor of K; LinAlgError if K is not PD."""
        K = self.constant + sum(g * L for g, L in zip(theta, self.linear, strict=False))
        stored = np.zeros_like(K)
        for d in range(len(K)):
            stored[d, : K.shape[1] - d] = K[d, d:]
        factor = cholesky_banded(stored, lower=True, overwrite_ab=True, check_finite=False)
        error = self.errors @ theta
        x = cho_solve_banded((factor, True), error, check_finite=False)
        return float(error @ x), x, factor

    def derivatives(self, x: FloatArray, factor: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradient and Hessian of J at the point where x and factor were made."""
        V = self.errors.copy()
        for k in range(len(self.linear)):
            V[:, k] -= self._slope(k, x)
        gradient = self.errors.T @ x + V.T @ x
        hessian = 2.0 * V.T @ cho_solve_banded((factor, True), V, check_finite=False)
        return gradient, hessian

    def _slope(self, k: int, x: FloatArray) -> FloatArray:
        """K_k x with K_k = S_k H' + H S_k', H = G_m (or I)."""
        band, h = self.band, self.g_m
        if h is None:
            return band.shift(k, x) + band.shift_back(k, x)
        H_transposed = sum(h[j] * band.shift_back(j, x) for j in range(len(h)))
        back = band.shift_back(k, x)
        slope: FloatArray = band.shift(k, np.asarray(H_transposed)) + np.asarray(
            sum(h[j] * band.shift(j, back) for j in range(len(h)))
        )
        return slope
