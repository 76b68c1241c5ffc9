"""Simulation errors of signals in a row, minimised: damped steps of Gauss and Newton.

With r = ŷ - y and J = ∂ŷ/∂θ, mean(r²) + |bend θ|² is minimised by the steps of Levenberg and
Marquardt, (J'J + λ diag(J'J))δ = -J'r. A step ends at the bounds of θ, and those at a bound that
would leave it stay; steps to slower filters than allowed are refused.
Source: Marquardt 1963; Bertsekas 1982 for the bounds.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.identification.network.signals import Signals, Trial
from nlsid_core.identification.regressors import signal_scale

FIRST_DAMPING, DAMPING_DOWN, DAMPING_UP, GIVE_UP_DAMPING = 1e-2, 0.2, 4.0, 1e8
PATIENCE = 3  # steps in a row that gain less than the tolerance
RIDGE = 1e-10  # of the largest diagonal entry: what the data do not show has no curvature
MAX_RADIUS = 1.0 - 1e-6  # of the poles


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
class Problem:
    """What is minimised over θ: [the free starts of every trial; the parameters].

    bend: (rows, parameters) of the penalty. low, high: of the parameters. radius: of the poles.
    """

    signals: Signals
    trials: Sequence[Trial]
    bend: FloatArray | None = None
    low: FloatArray | float = -np.inf
    high: FloatArray | float = np.inf
    radius: float = np.inf

    @property
    def starts(self) -> int:
        """How many entries of θ are starts."""
        return len(self.trials) * self.signals.given if self.signals.free else 0

    def joined(self, parameters: FloatArray) -> FloatArray:
        """θ, with the starts that the trials have."""
        starts = [trial.start for trial in self.trials] if self.signals.free else []
        return np.concatenate([*starts, parameters])

    def parts(self, theta: FloatArray) -> Iterator[tuple[Trial, IntArray]]:
        """Every trial with its start in θ, and where in θ its start and the parameters are."""
        G, shared = self.signals.given, np.arange(self.starts, len(theta))
        for i, trial in enumerate(self.trials):
            if not self.signals.free:
                yield trial, shared
            else:
                at = np.arange(i * G, (i + 1) * G)
                yield replace(trial, start=theta[at]), np.concatenate([at, shared])

    def mean_square(self, theta: FloatArray) -> float:
        """Of the error over the scored samples."""
        parameters = theta[self.starts :]
        errors = np.concatenate(
            [
                (self.signals.run(parameters, t)[self.signals.output] - t.y)[t.skipped :]
                for t, _ in self.parts(theta)
            ]
        )
        return float(errors @ errors) / len(errors)

    def cost(self, theta: FloatArray) -> float:
        """What is minimised; infinite where a filter is too slow."""
        parameters = theta[self.starts :]
        with np.errstate(all="ignore"):  # a wild candidate may overflow: its cost is not less
            if self.signals.radius(parameters) > self.radius:
                return np.inf
            bent = 0.0 if self.bend is None else float(np.sum((self.bend @ parameters) ** 2))
            return self.mean_square(theta) + bent

    def normal(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """J'J and J'r of what is minimised."""
        parameters, samples = theta[self.starts :], 0
        H, gradient = np.zeros((len(theta), len(theta))), np.zeros(len(theta))
        for trial, at in self.parts(theta):
            sources, moved = self.signals.sensitivities(parameters, trial)
            J = moved[self.signals.output][:, trial.skipped :]
            r = (sources[self.signals.output] - trial.y)[trial.skipped :]
            H[np.ix_(at, at)] += J @ J.T
            gradient[at] += J @ r
            samples += len(r)
        H, gradient = H / samples, gradient / samples
        if self.bend is not None:
            inner = slice(self.starts, None)
            H[inner, inner] += self.bend.T @ self.bend
            gradient[inner] += self.bend.T @ (self.bend @ parameters)
        return H, gradient


@dataclass(frozen=True, eq=False)
class Minimum:
    """rms: the error there, in the trials' unit. parameters, and trials with the starts found."""

    rms: float
    parameters: FloatArray
    trials: tuple[Trial, ...]


def minimise(problem: Problem, parameters: FloatArray, *, steps: int, tolerance: float) -> Minimum:
    """A local minimum from the parameters and the trials' starts."""
    free, size = np.full(problem.starts, np.inf), len(parameters)
    low = np.concatenate([-free, np.broadcast_to(problem.low, size)])
    high = np.concatenate([free, np.broadcast_to(problem.high, size)])
    theta = np.clip(problem.joined(parameters), low, high)
    reached, taken, small, damping = problem.cost(theta), 0, 0, FIRST_DAMPING
    while taken < steps and small < PATIENCE and damping < GIVE_UP_DAMPING:
        H, gradient = problem.normal(theta)
        held = ((theta <= low) & (gradient > 0.0)) | ((theta >= high) & (gradient < 0.0))
        moving = np.flatnonzero(~held)
        H, gradient = H[np.ix_(moving, moving)], gradient[moving]
        taken, gain, diagonal = taken + 1, 0.0, np.diag(H)
        while damping < GIVE_UP_DAMPING:
            candidate = theta.copy()
            try:
                damped = H + np.diag(damping * diagonal + RIDGE * np.max(diagonal))
                candidate[moving] -= cho_solve(cho_factor(damped), gradient)
                candidate = np.clip(candidate, low, high)
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
    trials = tuple(trial for trial, _ in problem.parts(theta))
    return Minimum(problem.mean_square(theta) ** 0.5, theta[problem.starts :], trials)


def best_for(
    problem: Problem, parameters: FloatArray, at: IntArray, ridge: float = RIDGE
) -> FloatArray:
    """The parameters with those `at` as least squares give them, in which y is affine."""
    found = parameters.copy()
    found[at] = 0.0
    H, gradient = problem.normal(problem.joined(found))
    at_theta = problem.starts + at
    H = H[np.ix_(at_theta, at_theta)]
    H += ridge * np.trace(H) / len(H) * np.eye(len(H))
    found[at] = -np.linalg.solve(H, gradient[at_theta])
    return found


def shortened(trials: Sequence[Trial], samples: int) -> tuple[Trial, ...]:
    """The first trials, of about so many samples in all."""
    kept: list[Trial] = []
    for trial in trials:
        left = samples - sum(len(one.y) for one in kept)
        if left > 3 * trial.skipped + len(trial.start):
            kept.append(replace(trial, u=trial.u[:left], y=trial.y[:left]))
    return tuple(kept)
