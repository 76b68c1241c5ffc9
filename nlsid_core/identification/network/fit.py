"""Simulation errors of signals in a row, minimised by steps of Gauss and Newton.

With r = ŷ - y and J = ∂ŷ/∂θ, mean(r²) + |bend θ|² is minimised: where θ has bounds, in a region of
trust (scipy); else by damped steps (J'J + λ diag(J'J))δ = -J'r, of which those to slower filters
than allowed are refused. Source: Marquardt 1963; Branch, Coleman and Li 1999.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
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

    def parts(self, theta: FloatArray) -> Iterator[tuple[Trial, IntArray]]:
        """Every trial with its start in θ, and where in θ its start and the parameters are."""
        G, shared = self.signals.given, np.arange(self.starts, len(theta))
        for i, trial in enumerate(self.trials):
            if not self.signals.free:
                yield trial, shared
            else:
                at = np.arange(i * G, (i + 1) * G)
                yield replace(trial, start=theta[at]), np.concatenate([at, shared])

    def errors(self, theta: FloatArray) -> FloatArray:
        """ŷ - y at the scored samples of all trials."""
        parameters, y = theta[self.starts :], self.signals.output
        return np.concatenate(
            [(self.signals.run(parameters, t)[y] - t.y)[t.skipped :] for t, _ in self.parts(theta)]
        )

    def mean_square(self, theta: FloatArray) -> float:
        """Of the errors."""
        return float(np.mean(np.square(self.errors(theta))))

    def residual(self, theta: FloatArray) -> FloatArray:
        """What the sum of squares is minimised of: the errors, and the penalty."""
        errors, bent = self.errors(theta), self.bend @ theta[self.starts :]
        return np.concatenate([errors / np.sqrt(len(errors)), bent])

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """The derivatives of the residual."""
        blocks = []
        for trial, at in self.parts(theta):
            _, moved = self.signals.sensitivities(theta[self.starts :], trial)
            J = moved[self.signals.output][:, trial.skipped :].T
            block = np.zeros((len(J), len(theta)))
            block[:, at] = J
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
        trials=tuple(trial for trial, _ in problem.parts(theta)),
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
