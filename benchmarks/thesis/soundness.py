"""Simulated attempts to break a proved funnel: starts on its boundary, followed to its end.

A simulation proves nothing; one start that leaves would show that the proof or the code is wrong.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

import numpy as np

from nlsid_core.arrays import ArrayLike, FloatArray
from nlsid_core.dynamics.piecewise import bernstein
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy

SUBSTEPS = 5  # Runge-Kutta steps of order four per interval: errors of 1e-8 on the satellite
TOLERANCE = 1e-6  # of V above 1, for the integration's error
CHUNK = 4096  # trajectories integrated together: their monomials fit the cache


class Dynamics(Protocol):
    """What is simulated: a `VectorField`, or what it stands for."""

    @property
    def uncertain(self) -> FloatArray:
        """(n_w, 2) bounds of w."""

    def span(self, t: float) -> int:
        """The index of the equations that hold from time t on."""

    def __call__(
        self, t: float, X: ArrayLike, U: ArrayLike, W: ArrayLike | None, *, span: int | None
    ) -> FloatArray:
        """ẋ (N, n)."""


class OneSet:
    """Equations that hold from the first to the last second."""

    def span(self, t: float) -> int:
        """There is one set of equations."""
        del t
        return 0


@dataclass(frozen=True)
class TrueDynamics(OneSet):
    """rate(X, U) -> ẋ (N, n): what a Taylor model stands for, without uncertainty."""

    rate: Callable[[FloatArray, FloatArray], FloatArray]
    uncertain: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))

    def __call__(
        self, t: float, X: ArrayLike, U: ArrayLike, W: ArrayLike | None, *, span: int | None
    ) -> FloatArray:
        """ẋ (N, n)."""
        del t, W, span
        X, U = np.asarray(X, dtype=np.float64), np.asarray(U, dtype=np.float64)
        return self.rate(X, U)


@dataclass(frozen=True)
class Soundness:
    """starts: how many; violations: how many had V > 1 at some step; max_v: the largest V seen."""

    starts: int
    violations: int
    max_v: float


@dataclass(frozen=True, eq=False)
class Simulation:
    """Dynamics under a policy, and the funnel that they should not leave."""

    dynamics: Dynamics
    policy: ContinuousPolicy
    funnel: ContinuousFunnel

    def boundary(
        self,
        *,
        starts: int,
        rng: np.random.Generator,
        knot: int = 0,
        scale: float = 1.0,
        substeps: int = SUBSTEPS,
        adversary: bool = False,
    ) -> Soundness:
        """Follow `starts` random points of {V = scale²} at a knot to the end; w at random corners.

        adversary: w at the corner that raises V most instead, anew at every step.
        """
        violations, largest = 0, 0.0
        for first in range(0, starts, CHUNK):
            count = min(CHUNK, starts - first)
            X = _boundary(self.funnel, knot, count, rng, scale)
            worst = np.zeros(count)
            for k in range(knot, len(self.funnel.t) - 1):
                X, V = self.follow(k, X, rng, substeps, adversary=adversary)
                worst = np.maximum(worst, V)
            violations += int((worst > 1 + TOLERANCE).sum())
            largest = max(largest, float(np.max(worst)))
        return Soundness(starts, violations, largest)

    def held(
        self,
        *,
        hold: float,
        error: FloatArray,
        starts: int,
        rng: np.random.Generator,
        knot: int = 0,
        largest_step: float = 0.01,
    ) -> Soundness:
        """`boundary` by a computer: samples at most `hold` s apart, measured wrong.

        Samples come after a random time of a half to all of `hold`; each state is off by a random
        corner of |e_a| ≤ error_a (n,), and the input stays until the next sample.
        """
        X = _boundary(self.funnel, knot, starts, rng, 1.0)
        low, high = self.dynamics.uncertain.T
        worst, t = np.zeros(starts), float(self.funnel.t[knot])
        while t < self.funnel.tf:
            U = self.policy(t, X + error * rng.choice([-1.0, 1.0], size=X.shape))
            apart = min(hold * rng.uniform(0.5, 1.0), self.funnel.tf - t)
            for _ in range(count := 1 + int(apart / largest_step)):
                w = low + (high - low) * rng.integers(0, 2, size=(starts, len(low)))
                h, span = apart / count, self.dynamics.span(t)
                X = _stepped(lambda s, Y: self.dynamics(s, Y, U, w, span=span), t, X, h)  # noqa: B023
                t = min(t + h, self.funnel.tf)
                worst = np.maximum(worst, self.funnel.value(t, X))
        return Soundness(starts, int((worst > 1 + TOLERANCE).sum()), float(np.max(worst)))

    def escape(
        self,
        goal: FloatArray,
        *,
        starts: int,
        rng: np.random.Generator,
        highest: float = 10.0,
    ) -> float:
        """The smallest scaling of the start set from which some trajectory misses the goal.

        goal: (n, n) of {|x - x₀|²_goal ≤ 1}. To a ratio of 1.02; `highest` if none was found below.
        """
        low, high = 1.0, highest
        while high / low > 1.02:
            middle = float(np.sqrt(low * high))
            X = _boundary(self.funnel, 0, starts, rng, middle)
            with np.errstate(over="ignore", invalid="ignore"):
                for k in range(len(self.funnel.t) - 1):
                    X, _ = self.follow(k, X, rng, 2 * SUBSTEPS)
                d = X - self.funnel.x.ends()[-1]
                missed = not (np.einsum("ni,ij,nj->n", d, goal, d) <= 1).all()
            low, high = (low, middle) if missed else (middle, high)
        return high

    def follow(
        self,
        k: int,
        X: FloatArray,
        rng: np.random.Generator,
        substeps: int,
        *,
        adversary: bool = False,
    ) -> tuple[FloatArray, FloatArray]:
        """States at the end of interval k from X (N, n) at its start; the largest V on the way."""
        t, length = self.funnel.t[k], self.funnel.t[k + 1] - self.funnel.t[k]
        span = self.dynamics.span(float(t))
        x, u, K = (part.control[k] for part in (self.policy.x, self.policy.u, self.policy.K))
        low, high = self.dynamics.uncertain.T
        worst = np.zeros(len(X))

        def rate(s: float, states: FloatArray, w: FloatArray) -> FloatArray:
            inputs = self.policy.clipped(
                bernstein(u, s) - (states - bernstein(x, s)) @ bernstein(K, s).T
            )
            when = float(t + s * length)
            return self.dynamics(when, states, inputs, w, span=span)

        for j in range(substeps):
            s, end = j / substeps, (j + 1) / substeps
            if adversary:
                P = (1 - s) * self.funnel.P[k] + s * self.funnel.P[k + 1]
                w = _worst(partial(rate, s, X), (X - bernstein(x, s)) @ P, low, high)
            else:
                w = low + (high - low) * rng.integers(0, 2, size=(len(X), len(low)))
            X = _stepped(lambda s, Y: length * rate(s, Y, w), s, X, 1 / substeps)  # noqa: B023
            P = (1 - end) * self.funnel.P[k] + end * self.funnel.P[k + 1]
            rho = (1 - end) * self.funnel.rho[k] + end * self.funnel.rho[k + 1]
            x_bar = X - bernstein(x, end)
            worst = np.maximum(worst, np.einsum("ni,ij,nj->n", x_bar, P / rho, x_bar))
        return X, worst


def _stepped(
    rate: Callable[[float, FloatArray], FloatArray], t: float, X: FloatArray, h: float
) -> FloatArray:
    """X (N, n) h s later: one step of Runge-Kutta of order four."""
    a = rate(t, X)
    b = rate(t + h / 2, X + h / 2 * a)
    c = rate(t + h / 2, X + h / 2 * b)
    d = rate(t + h, X + h * c)
    return X + h / 6 * (a + 2 * b + 2 * c + d)


def _worst(
    rate: Callable[[FloatArray], FloatArray], slope: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """(N, n_w) the corner that makes slope'ẋ largest; ẋ is affine in each entry of w."""
    middle = np.tile((low + high) / 2, (len(slope), 1))
    chosen = middle.copy()
    for j in range(len(low)):
        ends = []
        for value in (low[j], high[j]):
            w = middle.copy()
            w[:, j] = value
            ends.append(np.einsum("ni,ni->n", slope, rate(w)))
        chosen[:, j] = np.where(ends[1] > ends[0], high[j], low[j])
    return chosen


def _boundary(
    funnel: ContinuousFunnel, knot: int, count: int, rng: np.random.Generator, scale: float
) -> FloatArray:
    directions = rng.normal(size=(count, funnel.n))
    directions *= scale / np.linalg.norm(directions, axis=1)[:, None]
    return funnel.boundary(float(funnel.t[knot]), directions)
