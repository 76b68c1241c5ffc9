"""Newton's method on the robust simulation error, with a barrier where the minimiser needs one.

Damped Newton can come too near the boundary of K ≻ 0 on its way, where J stays finite, and stall at
a wrong value. J + μ tr(U'K⁻¹U), U a few random vectors, is as convex as J and nearly as cheap, and
infinite on the boundary. So its minimisers for μ → 0 lead to a minimiser of J inside or, where J is
least on the boundary, there. Matrix inequalities on θ join as further barriers.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import SolverError
from nlsid_core.identification.methods.banded import Rows
from nlsid_core.identification.methods.inequalities import MatrixInequality

DECREMENT = 1e-12  # Newton decrement relative to J: 1e-6 relative accuracy of the minimiser
PERFECT_FIT = 1e-18  # J relative to Σy²: noise-free data, what is left is rounding
STALLED = 1e-7  # decrement relative to J at which rounding of J may end the line search
MAX_NEWTON = 200
MAX_CENTRING = 20  # with a barrier; more, and some eigenvalue vanishes that it does not hold
ARMIJO = 1e-4  # the usual sufficient-decrease fraction
SHORTEST_STEP = 2.0**-30
BOUNDARY_PIVOT = 1e-7  # smallest pivot of K below which the minimiser is taken to the barrier
SHORT_STEP, SHORT_STEPS = 2.0**-2, 2  # so many steps so short, and Newton alone has stalled
GAP = 1e-7  # μ·(barrier parameter) relative to J at which the barrier path of K ends
INEQUALITY_GAP = 1e-6  # the same for inequalities alone: J is exact, and they are relaxed again
FIRST_GAP = 0.1  # the same at the start of the path of K: Newton has come near by itself
VECTORS = 3  # one stops short of 2 of 7 hard minima (by 21 % of J), two and three of none
MU_FALL = 0.01
CENTRED = 0.1  # decrement relative to μ at which a point of the path is close enough
CENTRED_K = 1.0  # the same on the path of K, whose barrier is of low rank


class Root(Protocol):
    """A matrix L with J = |L⁻¹ε|², by what it solves."""

    def half_solve(self, B: FloatArray, *, overwrite: bool = False) -> FloatArray:
        """L⁻¹B for B (N,) or (N, m)."""
        ...

    def half_solve_transposed(self, B: FloatArray) -> FloatArray:
        """L⁻ᵀB for B (N,) or (N, m)."""
        ...

    @property
    def pivots(self) -> FloatArray:
        """(N,): the pivots of the elimination of LL', or what stands for them."""
        ...


@dataclass(frozen=True, eq=False)
class Point:
    """J at θ with the best p (n_p,), and the factors its derivatives are made of."""

    theta: FloatArray
    p: FloatArray
    J: float
    residual: FloatArray  # L⁻¹ε
    x: FloatArray  # L⁻ᵀL⁻¹ε
    factor: Root
    projected: FloatArray  # L⁻¹Q
    normal: tuple[FloatArray, bool]  # Cholesky factor of Q'K⁻¹Q

    def curvature(self, V: FloatArray) -> FloatArray:
        """2 |(I - Π) L⁻¹V|² for columns V (N, n)."""
        solved = self.factor.half_solve(V)
        inner = self.projected.T @ solved
        square = solved.T @ solved - inner.T @ cho_solve(self.normal, inner, check_finite=False)
        return np.asarray(2.0 * square)

    def derivatives(self, errors: FloatArray, slopes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradient and Hessian of ε'K⁻¹ε from ε_i and K_i x, columns (N, n)."""
        gradient = 2.0 * errors.T @ self.x - slopes.T @ self.x
        return gradient, self.curvature(errors - slopes)


def project(rows: Rows, unknowns: FloatArray, theta: FloatArray, factor: Root) -> Point:
    """The point of J = min_p |L⁻¹(errors θ - Q p)|²; LinAlgError if rounding decides it."""
    both = np.empty((len(rows), 1 + rows.Q.shape[1]), order="F")  # as LAPACK takes it: no copy
    both[:, 0], both[:, 1:] = rows.errors @ theta, rows.Q
    return project_columns(both, unknowns, factor)


@np.errstate(over="ignore", invalid="ignore")  # an unstable candidate is refused below
def project_columns(both: FloatArray, unknowns: FloatArray, factor: Root) -> Point:
    """`project` for columns [errors θ, Q] of any rows; overwrites them."""
    solved = factor.half_solve(both, overwrite=True)
    left, projected = solved[:, 0], solved[:, 1:]
    if not np.isfinite(left @ left):
        raise LinAlgError("the errors overflow")
    normal = cho_factor(projected.T @ projected, check_finite=False)
    p = cho_solve(normal, projected.T @ left, check_finite=False)
    residual = left - projected @ p
    J = float(residual @ residual)
    if not np.isfinite(J):
        raise LinAlgError("K is positive definite to rounding only")
    x = factor.half_solve_transposed(residual)
    return Point(unknowns, p, J, residual, x, factor, projected, normal)


class Objective(Protocol):
    """A function of the left parameters, p projected out."""

    rows: Rows

    def at(self, theta: FloatArray) -> Point:
        """Value; LinAlgError outside its domain."""
        ...

    def derivatives(self, point: Point) -> tuple[FloatArray, FloatArray]:
        """Gradient, and Hessian or a positive semidefinite stand-in."""
        ...


class Convex(Objective, Protocol):
    """min_p ε'K⁻¹ε with ε and K affine in the left parameters."""

    def slopes(self, x: FloatArray) -> FloatArray:
        """(N, n): K_i x, K_i the derivatives of K."""
        ...


@dataclass(frozen=True, eq=False)
class Minimum:
    """The point found, the extra unknowns beside θ, and how many Newton steps it took.

    converged: the decrement is small; otherwise no step goes down any more.
    """

    point: Point
    extra: FloatArray
    steps: int
    converged: bool

    @property
    def is_inside(self) -> bool:
        """Whether it is a minimiser where no eigenvalue of K vanishes."""
        pivots = self.point.factor.pivots
        return self.converged and bool(np.min(pivots) > BOUNDARY_PIVOT * np.median(pivots))


def minimise(
    bound: Convex,
    start: FloatArray,
    *,
    inequalities: Sequence[MatrixInequality] = (),
    extra: FloatArray | None = None,
    steps: int | None = None,
    gap: float = INEQUALITY_GAP,
) -> Minimum:
    """Minimise J_m from θ = `start`, strictly inside K ≻ 0 and every inequality.

    extra: start of further unknowns that only occur in the inequalities. Where the path around the
    boundary does not converge, the lowest point is returned: a bound may be made exact there too.
    steps: only so many of Newton's method, without a barrier of K and with that of the inequalities
    at the one μ whose minimiser is within `gap`·J of the minimum.
    """
    descent = Descent(bound, inequalities, len(start))
    z = start if extra is None else np.concatenate([start, extra])
    if steps is not None:
        return descent.to_minimum(z, mu=descent.weight(z, gap), limit=steps)
    found = descent.freely(z)
    if not found.is_inside:
        z = 0.5 * (z + _unknowns(found))  # K is affine: half way back no eigenvalue is small
        here = bound.at(z[: len(start)])
        away = descent.path(z, barrier=Repulsion(bound, here))
        if away.converged:  # J is least on the boundary there, unless Newton goes lower
            found = replace(descent.freely(_unknowns(away)), converged=True)
    return replace(found, steps=descent.steps)


class Repulsion:
    """tr(U'K⁻¹U) with random vectors U, 1 at the point it is made at."""

    def __init__(self, bound: Convex, at: Point) -> None:
        U = np.random.default_rng(0).standard_normal((len(at.x), VECTORS))
        self.bound, self.U = bound, U / np.linalg.norm(at.factor.half_solve(U))

    def value(self, point: Point) -> float:
        """At a point of J."""
        return float(np.square(point.factor.half_solve(self.U)).sum())

    def derivatives(self, point: Point) -> tuple[FloatArray, FloatArray]:
        """Gradient -Σ x'K_i x and Hessian 2 Σ (L⁻¹K_i x)'(L⁻¹K_j x) over x of K⁻¹U."""
        X = point.factor.half_solve_transposed(point.factor.half_solve(self.U))
        slopes = [self.bound.slopes(x) for x in X.T]
        halves = [point.factor.half_solve(each) for each in slopes]
        gradient = -sum(each.T @ x for each, x in zip(slopes, X.T, strict=True))
        return np.asarray(gradient), np.asarray(2.0 * sum(half.T @ half for half in halves))


def _unknowns(found: Minimum) -> FloatArray:
    return np.concatenate([found.point.theta, found.extra])


def _newton_step(gradient: FloatArray, hessian: FloatArray) -> FloatArray:
    """-H⁺g in the scale of the diagonal; a parameter with hardly any curvature keeps its scale.

    SolverError if that overflows: on what is not finite LAPACK's lstsq may not return.
    """
    diagonal, number = np.diag(hessian), np.finfo(float)
    scale = 1.0 / np.sqrt(np.maximum(diagonal, max(diagonal.max() * number.eps**2, number.tiny)))
    with np.errstate(over="ignore", invalid="ignore"):
        matrix, side = scale[:, None] * hessian * scale, gradient * scale
    if not (np.isfinite(matrix).all() and np.isfinite(side).all()):
        raise SolverError("Newton's method met derivatives beyond all numbers; try fewer lags")
    return np.asarray(-scale * np.linalg.lstsq(matrix, side, rcond=None)[0])


class Descent:
    """Damped Newton on J + μ·barriers in z = [θ; extra]; counts its steps."""

    def __init__(
        self, objective: Objective, inequalities: Sequence[MatrixInequality], parameters: int
    ) -> None:
        self.objective, self.inequalities = objective, tuple(inequalities)
        self.parameters = parameters
        self.perfect = PERFECT_FIT * objective.rows.unit
        self.steps = 0

    def weight(self, z: FloatArray, gap: float) -> float:
        """μ of the inequalities at which the path is within gap·J, J that at z; 0 without any."""
        size = sum(inequality.order for inequality in self.inequalities)
        return gap * self.objective.at(z[: self.parameters]).J / size if size else 0.0

    def freely(self, z: FloatArray) -> Minimum:
        """Without a barrier of K."""
        return self.path(z) if self.inequalities else self.to_minimum(z)

    def path(self, z: FloatArray, *, barrier: Repulsion | None = None) -> Minimum:
        """Follow the minimisers for μ → 0; the last that was reached, if one is not."""
        size = sum(inequality.order for inequality in self.inequalities)
        size += 0 if barrier is None else barrier.U.shape[1]
        gap, last = INEQUALITY_GAP if barrier is None else GAP, None
        mu = FIRST_GAP * self.objective.at(z[: self.parameters]).J / size
        while True:
            found = self.to_minimum(z, mu=mu, barrier=barrier)
            if not found.converged:
                return found if last is None else replace(last, converged=False)
            if mu * size <= gap * found.point.J or self.perfect >= found.point.J:
                return found
            z, last = _unknowns(found), found
            mu *= MU_FALL

    def to_minimum(
        self,
        z: FloatArray,
        *,
        mu: float = 0.0,
        barrier: Repulsion | None = None,
        limit: int = MAX_NEWTON,
    ) -> Minimum:
        """Newton's method for one μ, of `limit` steps at most."""
        value, point = self._value(z, mu, barrier)
        if point is None:
            raise SolverError("Newton's method was started where J is infinite")
        short = 0
        for _ in range(limit if barrier is None else MAX_CENTRING):
            gradient, hessian = self._derivatives(z, point, mu, barrier)
            if not (np.isfinite(gradient).all() and np.isfinite(hessian).all()):
                raise SolverError(
                    "the simulation of the model that the search starts from grows beyond all "
                    "numbers, so its derivatives are not known; try fewer lags or another method"
                )
            step = _newton_step(gradient, hessian)
            decrement = -float(gradient @ step)
            enough = max(DECREMENT * point.J, (CENTRED if barrier is None else CENTRED_K) * mu)
            if decrement <= enough or self.perfect >= point.J:
                return Minimum(point, z[self.parameters :], self.steps, converged=True)
            self.steps += 1
            length = 1.0
            while True:
                candidate = z + length * step
                new_value, new_point = self._value(candidate, mu, barrier)
                if new_point is not None and new_value <= value - ARMIJO * length * decrement:
                    break
                length /= 2
                if length < SHORTEST_STEP:
                    near = decrement <= max(STALLED * point.J, mu)
                    return Minimum(point, z[self.parameters :], self.steps, converged=near)
            z, value, point = candidate, new_value, new_point
            short += length < SHORT_STEP
            if short >= SHORT_STEPS and not mu:
                break
        return Minimum(point, z[self.parameters :], self.steps, converged=False)

    def _value(
        self, z: FloatArray, mu: float, barrier: Repulsion | None
    ) -> tuple[float, Point | None]:
        total = sum(inequality.barrier(z) for inequality in self.inequalities)
        if not np.isfinite(total):
            return np.inf, None
        try:
            point = self.objective.at(z[: self.parameters])
        except LinAlgError:
            return np.inf, None
        if barrier is not None:
            total += barrier.value(point)
        return point.J + mu * total, point

    def _derivatives(
        self, z: FloatArray, point: Point, mu: float, barrier: Repulsion | None
    ) -> tuple[FloatArray, FloatArray]:
        gradient, hessian = np.zeros(len(z)), np.zeros((len(z), len(z)))
        inner = slice(0, self.parameters)
        gradient[inner], hessian[inner, inner] = self.objective.derivatives(point)
        if barrier is not None:
            slope, curvature = barrier.derivatives(point)
            gradient[inner] += mu * slope
            hessian[inner, inner] += mu * curvature
        for inequality in self.inequalities:
            slope, curvature = inequality.derivatives(z)
            gradient += mu * slope
            hessian += mu * curvature
        return gradient, hessian
