"""Newton's method on the robust simulation error, with a barrier where the minimiser needs one.

A minimiser can lie on the boundary of K ≻ 0, where J stays finite and damped Newton stalls at a
wrong value. Then J - μ log det K is minimised for μ → 0: the barrier has parameter N, so the last
iterate is within μN of the minimum. Matrix inequalities on θ join as further barrier terms.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import LinAlgError

from nlsid_core._types import FloatArray
from nlsid_core.errors import SolverError
from nlsid_core.identification.bound import Point
from nlsid_core.identification.inequalities import MatrixInequality
from nlsid_core.identification.rows import Rows

DECREMENT = 1e-12  # Newton decrement relative to J: 1e-6 relative accuracy of the minimiser
PERFECT_FIT = 1e-18  # J relative to Σy²: noise-free data, what is left is rounding
STALLED = 1e-7  # decrement relative to J at which rounding of J may end the line search
MAX_NEWTON = 200
ARMIJO = 1e-4  # the usual sufficient-decrease fraction
SHORTEST_STEP = 2.0**-30
BOUNDARY_PIVOT = 1e-7  # smallest pivot of K below which the minimiser is taken to the barrier
GAP = 1e-8  # μ·(barrier parameter) relative to J at which the barrier path of K ends
INEQUALITY_GAP = 1e-6  # the same for inequalities alone: J is exact, and they are relaxed again
MU_FALL = 0.1  # of μ from one point of the path to the next
CENTRED = 0.1  # decrement relative to μ at which a point of the path is close enough
PROBES = 16  # random vectors behind the metric of log det K


class Convex(Protocol):
    """A convex function of the left parameters, p projected out."""

    rows: Rows

    def at(self, theta: FloatArray) -> Point:
        """Value; LinAlgError outside its domain."""
        ...

    def derivatives(self, point: Point) -> tuple[FloatArray, FloatArray]:
        """Gradient and Hessian."""
        ...

    def log_determinant_gradient(self, point: Point) -> FloatArray:
        """Gradient of log det K."""
        ...

    def log_determinant_curvature(self, point: Point, probes: FloatArray) -> FloatArray:
        """Hessian of -log det K, exact or estimated with random probes."""
        ...


@dataclass(frozen=True, eq=False)
class Minimum:
    """The point found, the extra unknowns beside θ, and how many Newton steps it took."""

    point: Point
    extra: FloatArray
    steps: int
    on_boundary: bool


def minimise(
    bound: Convex,
    start: FloatArray,
    *,
    inequalities: Sequence[MatrixInequality] = (),
    extra: FloatArray | None = None,
) -> Minimum:
    """Minimise J_m from θ = `start`, strictly inside K ≻ 0 and every inequality.

    extra: start of further unknowns that only occur in the inequalities.
    Raises SolverError if no minimiser is found.
    """
    z = start if extra is None else np.concatenate([start, extra])
    search = _Search(bound, tuple(inequalities), len(start))
    if inequalities:
        found = search.path(z, barrier_on_K=False)
    else:
        found = search.descend(z, mu=0.0, barrier_on_K=False)
    if found is not None and found.point.factor.smallest_pivot > BOUNDARY_PIVOT:
        return found
    inside = search.path(z, barrier_on_K=True)
    if inside is None:
        raise SolverError(f"no minimiser of J after {search.steps} Newton steps")
    if found is not None and found.point.J < inside.point.J:
        return found
    return inside


class _Search:
    def __init__(
        self, bound: Convex, inequalities: tuple[MatrixInequality, ...], parameters: int
    ) -> None:
        self.bound, self.inequalities, self.parameters = bound, inequalities, parameters
        self.perfect = PERFECT_FIT * bound.rows.unit
        self.steps = 0
        self._probes: FloatArray | None = None

    def path(self, z: FloatArray, *, barrier_on_K: bool) -> Minimum | None:
        """Follow the barrier's minimisers for μ → 0."""
        size = len(self.bound.rows) if barrier_on_K else 0
        size += sum(inequality.F.shape[1] for inequality in self.inequalities)
        J = self.bound.at(z[: self.parameters]).J
        mu = J / size
        gap = GAP if barrier_on_K else INEQUALITY_GAP
        best: Minimum | None = None
        while True:
            found = self.descend(z, mu=mu, barrier_on_K=barrier_on_K)
            if found is None:
                return best
            best, z = found, np.concatenate([found.point.theta, found.extra])
            if mu * size <= gap * found.point.J or self.perfect >= found.point.J:
                return Minimum(found.point, found.extra, self.steps, barrier_on_K)
            mu *= MU_FALL

    def descend(self, z: FloatArray, *, mu: float, barrier_on_K: bool) -> Minimum | None:
        """Damped Newton on J + μ·barrier; None if it stalls before the decrement is small."""
        value, point = self._value(z, mu, barrier_on_K)
        if point is None:
            raise SolverError("Newton's method was started where J is infinite")
        for _ in range(MAX_NEWTON):
            gradient, hessian = self._derivatives(z, point, mu, barrier_on_K)
            scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), np.finfo(float).tiny))
            step = (
                -scale
                * np.linalg.lstsq(hessian * np.outer(scale, scale), gradient * scale, rcond=None)[0]
            )
            decrement = -float(gradient @ step)
            enough = max(DECREMENT * point.J, CENTRED * mu)
            if decrement <= enough or self.perfect >= point.J:
                return Minimum(point, z[self.parameters :], self.steps, barrier_on_K)
            self.steps += 1
            length = 1.0
            while True:
                candidate = z + length * step
                new_value, new_point = self._value(candidate, mu, barrier_on_K)
                if new_point is not None and new_value <= value - ARMIJO * length * decrement:
                    break
                length /= 2
                if length < SHORTEST_STEP and decrement <= max(STALLED * point.J, mu):
                    return Minimum(point, z[self.parameters :], self.steps, barrier_on_K)
                if length < SHORTEST_STEP:
                    return None
            z, value, point = candidate, new_value, new_point
        return None

    def _value(self, z: FloatArray, mu: float, barrier_on_K: bool) -> tuple[float, Point | None]:
        barrier = sum(inequality.barrier(z) for inequality in self.inequalities)
        if not np.isfinite(barrier):
            return np.inf, None
        try:
            point = self.bound.at(z[: self.parameters])
        except LinAlgError:
            return np.inf, None
        if barrier_on_K:
            barrier -= point.factor.log_determinant
        return point.J + mu * barrier, point

    def _derivatives(
        self, z: FloatArray, point: Point, mu: float, barrier_on_K: bool
    ) -> tuple[FloatArray, FloatArray]:
        gradient, hessian = np.zeros(len(z)), np.zeros((len(z), len(z)))
        inner = slice(0, self.parameters)
        gradient[inner], hessian[inner, inner] = self.bound.derivatives(point)
        if barrier_on_K:
            gradient[inner] -= mu * self.bound.log_determinant_gradient(point)
            if self._probes is None:
                rng = np.random.default_rng(0)
                signs = rng.integers(0, 2, size=(len(self.bound.rows), PROBES))
                self._probes = np.where(signs, 1.0, -1.0)
            curvature = self.bound.log_determinant_curvature(point, self._probes)
            hessian[inner, inner] += mu * curvature
        for inequality in self.inequalities:
            slope, curvature = inequality.derivatives(z)
            gradient += mu * slope
            hessian += mu * curvature
        return gradient, hessian
