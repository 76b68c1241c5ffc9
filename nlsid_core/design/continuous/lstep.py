"""The L-step: the largest m with (ρ̇ - Ẇ)/ρ ≥ m on the boundary W = ρ at one instant.

In coordinates x̄ = √ρ L⁻ᵀz, P = LL', the boundary is |z| = 1 at every t and φ = m - ρ̇/ρ does not
depend on ρ̇. Source: thesis (6.4), in the sphere form.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.design.continuous.modes import multipliers
from nlsid_core.dynamics import VectorField
from nlsid_core.dynamics.piecewise import bernstein
from nlsid_core.dynamics.taylor import Cubic
from nlsid_core.dynamics.taylor_model import DEGREE
from nlsid_core.errors import DataError
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.sos.sphere import SphereProgram, SphereSolution

TOLERANCE = 1e-5  # of the spread of -Ẇ/ρ: margins are 50 times as much
NO_PUSH = 1e-12  # of |x̄'Pg|: less moves nothing, and κ stays finite
FINENESS = 64.0  # of κ's digits: few, for the kernel


@dataclass(frozen=True, eq=False)
class Shape:
    """P and dP/dt (n, n) at an instant, and base (n, n), with x̄ = √ρ·base·z."""

    P: FloatArray
    rate: FloatArray
    base: FloatArray


@dataclass(frozen=True, eq=False)
class Section:
    """One side of one knot: what c(s, z) is made of at that instant, except ρ.

    t: s. x, x_rate: (n,) nominal. u: (m,). K: (m, n). interval: between knots; span: which of the
    field's pieces holds.
    """

    t: float
    x: FloatArray
    x_rate: FloatArray
    u: FloatArray
    K: FloatArray
    shape: Shape
    span: int
    interval: int


def section_at(steps: "LSteps", P: FloatArray, k: int, s: float) -> Section:
    """The instant s in [0, 1] of interval k, seen from inside it; P (K, n, n) is linear there."""
    policy, t = steps.policy, steps.policy.t
    h = t[k + 1] - t[k]
    here = (1 - s) * P[k] + s * P[k + 1]
    control = policy.x.control[k]
    return Section(
        t=float(t[k] + s * h),
        x=bernstein(control, s),
        x_rate=(len(control) - 1) * bernstein(np.diff(control, axis=0), s) / h,
        u=bernstein(policy.u.control[k], s),
        K=bernstein(policy.K.control[k], s),
        shape=Shape(here, (P[k + 1] - P[k]) / h, coordinates(here, steps.nonlinear)),
        span=steps.field.span(float(t[k])),
        interval=k,
    )


def coordinates(P: FloatArray, nonlinear: tuple[int, ...]) -> FloatArray:
    """T (n, n) with T'PT = I, in which the nonlinear states are functions of the last z only."""
    n = len(P)
    order = [j for j in range(n) if j not in nonlinear] + list(nonlinear)
    L = np.linalg.cholesky(P[np.ix_(order, order)])
    T = np.zeros((n, n))
    T[order] = np.triu(np.linalg.inv(L).T)  # exactly triangular, not up to rounding
    return T


def refuse_degree(field: VectorField) -> None:
    """Raise DataError for dynamics of a degree that no program here is for."""
    if field.degree > DEGREE:
        raise DataError(
            f"the vector field has degree {field.degree}; funnels are found up to {DEGREE}: give "
            "the dynamics as a function, which is then expanded, its remainder bounded"
        )


@dataclass(frozen=True, eq=False)
class Ends:
    """One interval's L-steps: solutions at its start and end per vertex; margins include ρ̇/ρ."""

    start: list[SphereSolution]
    end: list[SphereSolution]


def corners_of(boxed: Sequence[bool]) -> FloatArray:
    """(corners, entries) of ±1 for the entries that have a box, else 0; the last changes first."""
    corners = list(product(*((-1.0, 1.0) if one else (0.0,) for one in boxed)))
    return np.array(corners).reshape(len(corners), -1)


def at_corners(field: VectorField, corners: FloatArray, widths: FloatArray) -> FloatArray:
    """(..., corners, m + n_w) (δ, w) with |δ| ≤ widths (..., m) at these corners."""
    low, high = field.uncertain.T
    half = np.broadcast_to((high - low) / 2, (*widths.shape[:-1], len(low)))
    middle = np.concatenate([np.zeros(field.m), (low + high) / 2])
    return np.asarray(middle + corners * np.concatenate([widths, half], axis=-1)[..., None, :])


class LSteps:
    """L-steps of one vector field; holds the sphere program and counts what is solved.

    A case is a corner of the box of (δ, w) in a mode of the policy: every corner in the first mode
    comes first. limits and modes: of the policy, if its inputs are clipped. widths: (intervals, m)
    of what the applied input is off, δ; None if it is not. corners: see `corners_of`.
    nonlinear: the states that the programs take as such, the field's or more. pushed: whether what
    w does is bounded, not taken at its corners; only where it adds constants to ẋ (None: the
    field's `is_pushed`). kappa: (intervals, n_w), if it is bounded; tightness: the same over
    1/max|x̄'Pg| (None: 1). local: what the dynamics are on an interval, where a search expands them
    anew; else they are the field.
    """

    def __init__(
        self,
        field: VectorField,
        policy: ContinuousPolicy,
        *,
        nonlinear: tuple[int, ...] | None = None,
        pushed: bool | None = None,
        widths: FloatArray | None = None,
    ) -> None:
        refuse_degree(field)
        self.field, self.policy = field, policy
        self.pushed = field.is_pushed if pushed is None else pushed
        taken = field.curved_states if self.pushed else field.nonlinear_states
        self.nonlinear = taken if nonlinear is None else nonlinear
        self.local: dict[int, Cubic] = {}
        self._pushes: dict[int, FloatArray] = {}
        self.limits = policy.limits
        self.modes: IntArray = policy.modes()
        self.widths = widths
        self.tightness: FloatArray | None = None
        n_w = len(field.uncertain)
        self.corners = corners_of(field.m * [widths is not None] + n_w * [not self.pushed])
        bounds = np.ones((len(policy.t) - 1, n_w))
        self.kappa: FloatArray | None = bounds if self.pushed else None
        self.solved = 0

    def like(
        self, field: VectorField, policy: ContinuousPolicy, widths: FloatArray | None = None
    ) -> "LSteps":
        """L-steps of another field and policy that take states and pushes alike."""
        made = LSteps(field, policy, nonlinear=self.nonlinear, pushed=self.pushed, widths=widths)
        made.tightness = self.tightness
        return made

    def as_it_is(self) -> "LSteps":
        """A copy that keeps what the search changes."""
        kept = copy(self)
        kept.local = dict(self.local)
        kept.kappa, kept.widths = (
            None if part is None else part.copy() for part in (self.kappa, self.widths)
        )
        return kept

    @cached_property
    def program(self) -> SphereProgram:
        """Made when it is asked for: of many states it takes seconds."""
        n, count = self.field.n, len(self.multiplied)
        # What the input is off is a term of degree 1 in Ẇ.
        return sphere_program(n, count, constant=self.widths is not None and count < n)

    @property
    def multiplied(self) -> tuple[int, ...]:
        """The states with which the program's basis has all products; they come last."""
        n, some = self.field.n, 0 < len(self.nonlinear) < self.field.n
        return self.nonlinear if some and not len(self.limits) else tuple(range(n))

    def pushes(self, section: Section) -> FloatArray:
        """(n, n_w) what each w adds to ẋ there; only where w does nothing else."""
        if section.interval in self.local:
            return self.local[section.interval].pushes()
        if section.span not in self._pushes:
            found = self.field.pushes(section.span)
            assert found is not None  # asked only where `is_pushed`
            self._pushes[section.span] = found
        return self._pushes[section.span]

    def bound_pushes(self, section: Section, rho: float) -> None:
        """If w only pushes: κ of the section's interval, for what w does where W = ρ.

        κ near 1/max|x̄'Pg| makes the bound tight where the push is largest; where the funnel is long
        along another axis, a larger one (`tightness`) makes it tight where V falls least.
        """
        if self.kappa is None:
            return
        G = self.pushes(section)
        largest = np.sqrt(rho * np.einsum("ij,ik,kj->j", G, section.shape.P, G))
        times = 1.0 if self.tightness is None else self.tightness[section.interval]
        digits, power = np.frexp(times / np.maximum(largest, NO_PUSH))
        self.kappa[section.interval] = np.ldexp(np.round(digits * FINENESS) / FINENESS, power)

    def rate(self, section: Section, X: FloatArray, U: FloatArray, w: FloatArray) -> FloatArray:
        """ẋ (N, n) at states X and inputs U on the section's interval."""
        if section.interval in self.local:
            return self.local[section.interval](section.t, X, U, w)
        return self.field(section.t, X, U, w, span=section.span)

    @property
    def cases(self) -> int:
        """Corners times modes."""
        return len(self.corners) * len(self.modes)

    def off(self, k: int) -> FloatArray:
        """(corners, m + n_w) (δ, w) on interval k."""
        widths = np.zeros(self.field.m) if self.widths is None else self.widths[k]
        return at_corners(self.field, self.corners, widths)

    def values(self, section: Section, rho: float, cases: Sequence[int]) -> FloatArray:
        """(cases, N) -Ẇ/ρ at the program's points, in each mode, from the vector field."""
        x_bar = np.sqrt(rho) * self.program.points @ section.shape.base.T
        along = x_bar @ section.shape.P
        W_rate = 2 * np.einsum("ni,cni->cn", along, self.moves(section, rho, cases))
        W_rate += np.einsum("ij,ij->i", x_bar @ section.shape.rate, x_bar)
        if self.kappa is not None:
            W_rate += self.from_pushes(section, x_bar).sum(axis=1)
        return np.asarray(-W_rate / rho - self._from_defect(section, rho))

    def moves(self, section: Section, rho: float, cases: Sequence[int]) -> FloatArray:
        """(cases, N, n) dx̄/dt at the program's points; w that is bounded is in its centre."""
        x_bar = np.sqrt(rho) * self.program.points @ section.shape.base.T
        modes, corners = np.divmod(cases, len(self.corners))
        u: FloatArray = np.tile(section.u - x_bar @ section.K.T, (len(cases), 1, 1))
        for (i, low, high), sides in zip(self.limits.tolist(), self.modes[modes].T, strict=True):
            u[sides < 0, :, int(i)], u[sides > 0, :, int(i)] = low, high
        m, off = self.field.m, self.off(section.interval)[corners]
        u += off[:, None, :m]
        X = np.tile(section.x + x_bar, (len(cases), 1))
        W = np.repeat(off[:, m:], len(x_bar), axis=0)
        rate = self.rate(section, X, u.reshape(len(X), m), W) - section.x_rate
        return rate.reshape(len(cases), *x_bar.shape)

    def from_pushes(self, section: Section, x_bar: FloatArray) -> FloatArray:
        """(N, n_w) r(κ(x̄'Pg)² + 1/κ) for every w: at least what it adds to Ẇ."""
        assert self.kappa is not None
        kappa = self.kappa[section.interval]
        along = x_bar @ section.shape.P @ self.pushes(section)
        return np.asarray((kappa * along**2 + 1 / kappa) * self.radius)

    @property
    def radius(self) -> FloatArray:
        """(n_w,) half the range of each w."""
        return np.asarray(np.ptp(self.field.uncertain, axis=1) / 2)

    def _from_defect(self, section: Section, rho: float) -> FloatArray:
        """What the nominal's defect adds to -Ẇ/ρ along z that enter linearly, of degree 1.

        The reduced basis has no product for it; the proof's Gram matrix, which has 1, does.
        """
        linear = [j for j in range(self.program.n) if j not in self.program.chosen]
        if not linear or self.program.constant:
            return np.zeros(len(self.program.points))
        centre = self.field.uncertain.mean(axis=1)
        rate = self.rate(section, section.x[None], section.u[None], centre)[0]
        slope = -2 * section.shape.base.T @ section.shape.P @ (rate - section.x_rate) / np.sqrt(rho)
        return np.asarray(self.program.points[:, linear] @ slope[linear])

    def in_mode(self, section: Section, rho: float, case: int) -> FloatArray:
        """(L, N) at the program's points: what is nonnegative where inputs are in the mode."""
        x_bar = np.sqrt(rho) * self.program.points @ section.shape.base.T
        demand = section.u - x_bar @ section.K.T
        mode = self.modes[case // len(self.corners)]
        rows = []
        for (i, low, high), side in zip(self.limits.tolist(), mode.tolist(), strict=True):
            above, below = demand[:, int(i)] - low, high - demand[:, int(i)]
            rows.append(above * below if side == 0 else -above if side < 0 else -below)
        return np.array(rows).reshape(len(self.limits), len(x_bar))

    def solve(
        self,
        section: Section,
        rho: float,
        start: list[SphereSolution] | None = None,
        *,
        least: float = -np.inf,
        enough: float = np.inf,
    ) -> list[SphereSolution]:
        """φ for every case; or, once one is below `least`, `start` for those not solved yet.

        Then the cases that `start` bounds lowest are solved first. enough: see `SphereProgram`.
        """
        cases = np.arange(self.cases)
        if start is not None and len(cases) > 1 and least > -np.inf:
            cases = np.argsort(self.bounds(section, rho, start, cases.tolist()), kind="stable")
        found = {} if start is None else dict(enumerate(start))
        for case in cases.tolist():
            found[case] = self.solved_case(section, rho, case, found.get(case), enough)
            self.solved += 1
            if start is not None and found[case].m < least:
                break
        return [found[case] for case in range(len(cases))]

    def solved_case(
        self,
        section: Section,
        rho: float,
        case: int,
        start: SphereSolution | None,
        enough: float = np.inf,
    ) -> SphereSolution:
        """φ of one case."""
        (g,) = self.values(section, rho, [case])
        tau: FloatArray = np.zeros((0, 0, 0))
        if len(self.limits):
            tau, products = multipliers(self.program, g, self.in_mode(section, rho, case))
            g = g - products
        solved = self.program.solve(g, tolerance=TOLERANCE, start=start, enough=enough)
        return replace(solved, tau=tau)

    def predicted(self, section: Section, rho: float, duals: list[SphereSolution]) -> float:
        """An upper bound of φ at another ρ or section, from dual solutions: no program solved.

        With limits it is an estimate: the multipliers of the mode stay what they are.
        """
        return min(self.bounds(section, rho, duals, range(len(duals))))

    def bounds(
        self, section: Section, rho: float, duals: list[SphereSolution], cases: Sequence[int]
    ) -> list[float]:
        """The upper bound of φ for each of these cases."""
        left = self.left(section, rho, duals, cases)
        return [float(g @ duals[case].y) for case, g in zip(cases, left, strict=True)]

    def left(
        self,
        section: Section,
        rho: float,
        found: Sequence[SphereSolution],
        cases: Sequence[int],
        radius: float = 1.0,
    ) -> FloatArray:
        """(cases, N) `values` less what holds in the mode, with the multipliers that were found.

        radius: √ρ over that of which they are the solutions; of modes, else it has no effect.
        """
        values = self.values(section, rho, cases)
        if len(self.limits):
            y = np.hstack([np.ones((len(self.program.points), 1)) / radius, self.program.points])
            for g, case in zip(values, cases, strict=True):
                q = self.in_mode(section, rho, case)
                g -= np.einsum("ln,na,lab,nb->n", q, y, found[case].tau, y)
        return values


@lru_cache(maxsize=16)
def sphere_program(n: int, multiplied: int, *, constant: bool) -> SphereProgram:
    """The program for Ẇ of n states: degree 2 only with the last ones, which are `multiplied`.

    constant: Ẇ may have terms of degree 1.
    """
    last = None if multiplied == n else tuple(range(n - multiplied, n))
    return SphereProgram(n, last, constant)
