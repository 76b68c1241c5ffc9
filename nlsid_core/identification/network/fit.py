"""Simulation errors of signals in a row, minimised by steps of Gauss and Newton.

With r = ŷ - y and J = ∂ŷ/∂θ, mean(r²) + |bend θ|² is minimised: where θ has bounds, in a region of
trust (scipy); else by damped steps (J'J + λ diag(J'J))δ = -J'r, of which those to slower filters
than allowed are refused. Source: Marquardt 1963; Branch, Coleman and Li 1999.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.optimize import least_squares

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.identification.network.signals import Signals, Trial
from nlsid_core.identification.regressors import signal_scale

FIRST_DAMPING, DAMPING_DOWN, DAMPING_UP, GIVE_UP_DAMPING = 1e-2, 0.2, 4.0, 1e8
PATIENCE = 3  # steps in a row that gain less than the tolerance
RIDGE = 1e-10  # of the largest diagonal entry: what the data do not show has no curvature
MAX_RADIUS = 1.0 - 1e-6  # of the poles
NEAR = 0.8  # of the longest trial of a stack: shorter ones are in another
LARGEST_STACK = 100_000  # samples
INSIDE = 1e-9  # of the bounds, where a search within them begins


@dataclass(frozen=True, eq=False)
class Scaled:
    """Trials in spreads, and the (mean, spread) of y and of u (q,) that they were scaled by."""

    y: tuple[float, float]
    u: tuple[FloatArray, FloatArray]
    trials: tuple[Trial, ...]

    @classmethod
    def of(
        cls, data: Dataset, skipped: int, unscored: int, like: "Scaled | None" = None
    ) -> "Scaled":
        """skipped: samples that are not scored; unscored: those that show the start, too.

        like: scales to take. Raises ShapeError for several outputs, DataError on constant signals
        or trials that are not three times as long.
        """
        if data.trajectories[0].y.shape[1] != 1:
            raise ShapeError(
                f"such a network has one output; the data have {data.trajectories[0].y.shape[1]}"
            )
        skipped, unscored = max(skipped, 0), max(skipped, unscored)
        for trial in data:
            if len(trial) <= 3 * unscored:
                raise DataError(
                    f"{trial.name or 'trajectory'}: {len(trial)} samples, of which the first "
                    f"{unscored} are not scored; give more than three times as many"
                )
        if like is None:
            mean, spread = signal_scale(data, "y")
            y, u = (float(mean[0]), float(spread[0])), signal_scale(data, "u")
        else:
            y, u = like.y, like.u
        trials = tuple(
            Trial((t.u - u[0]) / u[1], (t.y[:, 0] - y[0]) / y[1], np.zeros(0), skipped)
            for t in data
        )
        return cls(y, u, trials)


@dataclass(frozen=True, eq=False)
class Stack:
    """Several trials as one, (T, N, …), the shorter ones with samples that are not scored.

    which: (T,) their numbers. scored: (T, N), whether a sample is.
    """

    trial: Trial
    which: IntArray
    scored: NDArray[np.bool_]

    @classmethod
    def of(cls, trials: Sequence[Trial], which: Sequence[int]) -> "Stack":
        """The last of them is the longest."""
        some, N = [trials[i] for i in which], len(trials[which[-1]].y)
        u, y = (np.zeros((len(some), N, *part.shape[1:])) for part in (some[0].u, some[0].y))
        for t, trial in enumerate(some):
            u[t, : len(trial.y)], u[t, len(trial.y) :] = trial.u, trial.u[-1]
            y[t, : len(trial.y)] = trial.y
        starts = np.array([trial.start for trial in some])
        stacked = Trial(u, y, starts, some[0].skipped, some[0].held)
        place = np.arange(N)
        scored = [(place >= t.skipped) & (place < len(t.y)) for t in some]
        return cls(stacked, np.array(which), np.array(scored))


@dataclass(frozen=True, eq=False)
class Problem:
    """What is minimised over θ: [the free starts of every trial; the parameters].

    bend: (rows, parameters) of the penalty. bounds: lowest and highest parameters (None: none).
    radius: of the poles, at most.
    """

    signals: Signals
    trials: Sequence[Trial]
    bend: FloatArray
    bounds: tuple[FloatArray, FloatArray] | None = None
    radius: float = np.inf

    @property
    def starts(self) -> int:
        """How many entries of θ are starts."""
        return len(self.trials) * self.signals.given if self.signals.free else 0

    def joined(self, parameters: FloatArray) -> FloatArray:
        """θ, with the starts that the trials have."""
        starts = [trial.start for trial in self.trials] if self.signals.free else []
        return np.concatenate([*starts, parameters])

    def started(self, theta: FloatArray) -> tuple[Trial, ...]:
        """The trials with their starts in θ."""
        if not self.signals.free:
            return tuple(self.trials)
        starts = theta[: self.starts].reshape(len(self.trials), -1)
        return tuple(replace(t, start=s) for t, s in zip(self.trials, starts, strict=True))

    @cached_property
    def stacks(self) -> list["Stack"]:
        """The trials, those of about one length together."""
        order = sorted(range(len(self.trials)), key=lambda i: len(self.trials[i].y))
        found: list[list[int]] = []
        for i in order:
            N, together = len(self.trials[i].y), found[-1] if found else []
            is_near = together and len(self.trials[together[0]].y) >= NEAR * N
            if is_near and (len(together) + 1) * N <= LARGEST_STACK:
                together.append(i)
            else:
                found.append([i])
        return [Stack.of(self.trials, which) for which in found]

    def begun(self, stack: "Stack", theta: FloatArray) -> Trial:
        """The stack's trials with their starts in θ."""
        if not self.signals.free:
            return stack.trial
        starts = theta[: self.starts].reshape(len(self.trials), -1)
        return replace(stack.trial, start=starts[stack.which])

    def errors(self, theta: FloatArray) -> FloatArray:
        """ŷ - y at the scored samples of all trials."""
        parts = []
        for each in self.stacks:
            sources = self.signals.run(theta[self.starts :], self.begun(each, theta))
            parts.append((sources[self.signals.output] - each.trial.y)[each.scored])
        return np.concatenate(parts)

    def mean_square(self, theta: FloatArray) -> float:
        """The mean square of the errors."""
        return float(np.mean(np.square(self.errors(theta))))

    def residual(self, theta: FloatArray) -> FloatArray:
        """What the sum of squares is minimised of: the errors, and the penalty."""
        errors, bent = self.errors(theta), self.bend @ theta[self.starts :]
        return np.concatenate([errors / np.sqrt(len(errors)), bent])

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """The derivatives of the residual."""
        blocks, G = [], self.signals.given if self.signals.free else 0
        for each in self.stacks:
            _, moved = self.signals.sensitivities(theta[self.starts :], self.begun(each, theta))
            J = moved[self.signals.output][:, each.scored].T
            block = np.zeros((len(J), len(theta)))
            block[:, self.starts :] = J[:, G:]
            own = G * each.which[np.nonzero(each.scored)[0]]  # where the starts of a sample are
            for k in range(G):
                block[np.arange(len(J)), own + k] = J[:, k]
            blocks.append(block)
        of_errors = np.concatenate(blocks)
        none = np.zeros((len(self.bend), self.starts))
        return np.vstack([of_errors / np.sqrt(len(of_errors)), np.hstack([none, self.bend])])

    def cost(self, theta: FloatArray) -> float:
        """|residual|²; infinite where a filter is too slow."""
        with np.errstate(all="ignore"):  # a wild candidate may overflow: its cost is not less
            if self.signals.radius(theta[self.starts :]) > self.radius:
                return np.inf
            return float(np.sum(np.square(self.residual(theta))))


@dataclass(frozen=True, eq=False)
class Minimum:
    """rms: the error there, in the trials' unit. parameters, and trials with the starts found."""

    rms: float
    parameters: FloatArray
    trials: tuple[Trial, ...]


def minimise(problem: Problem, parameters: FloatArray, *, steps: int, tolerance: float) -> Minimum:
    """A local minimum from the parameters and the trials' starts."""
    theta = problem.joined(parameters)
    if problem.bounds is None:
        theta = _damped(problem, theta, steps, tolerance)
    else:
        free = np.full(problem.starts, np.inf)
        ends = zip((-free, free), problem.bounds, strict=True)
        low, high = (np.concatenate(pair) for pair in ends)
        theta = least_squares(
            problem.residual,
            np.clip(theta, low + INSIDE, high - INSIDE),
            jac=problem.jacobian,
            bounds=(low, high),
            x_scale="jac",
            ftol=tolerance,
            xtol=tolerance,
            max_nfev=steps,
        ).x
    return Minimum(
        rms=problem.mean_square(theta) ** 0.5,
        parameters=theta[problem.starts :],
        trials=problem.started(theta),
    )


def _damped(problem: Problem, theta: FloatArray, steps: int, tolerance: float) -> FloatArray:
    """Without bounds, but where poles are within the radius."""
    reached, taken, small, damping = problem.cost(theta), 0, 0, FIRST_DAMPING
    while taken < steps and small < PATIENCE and damping < GIVE_UP_DAMPING:
        J = problem.jacobian(theta)
        H, gradient = J.T @ J, J.T @ problem.residual(theta)
        taken, gain, diagonal = taken + 1, 0.0, np.diag(H)
        while damping < GIVE_UP_DAMPING:
            try:
                damped = H + np.diag(damping * diagonal + RIDGE * np.max(diagonal))
                candidate = theta - cho_solve(cho_factor(damped), gradient)
                lower = problem.cost(candidate)
            except (LinAlgError, ValueError):
                lower = np.inf
            if lower < reached:
                gain = (reached - lower) / reached
                theta, reached = candidate, lower
                damping *= DAMPING_DOWN
                break
            damping *= DAMPING_UP
        small = small + 1 if gain < tolerance else 0
    return theta


def best_for(
    problem: Problem, parameters: FloatArray, at: IntArray, ridge: float = RIDGE
) -> FloatArray:
    """The parameters with those `at` as least squares give them, in which y is affine."""
    found = parameters.copy()
    found[at] = 0.0
    theta = problem.joined(found)
    J = problem.jacobian(theta)[:, problem.starts + at]
    H = J.T @ J
    H += ridge * np.trace(H) / len(H) * np.eye(len(H))
    found[at] = -np.linalg.solve(H, J.T @ problem.residual(theta))
    return found


def shortened(trials: Sequence[Trial], samples: int) -> tuple[Trial, ...]:
    """The first trials, of about so many samples in all."""
    kept: list[Trial] = []
    for trial in trials:
        left = samples - sum(len(one.y) for one in kept)
        if left > 3 * trial.skipped + len(trial.start):
            kept.append(replace(trial, u=trial.u[:left], y=trial.y[:left]))
    return tuple(kept)
