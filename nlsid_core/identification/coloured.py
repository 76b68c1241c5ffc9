"""Coloured noise: W of |y - ŷ|²_W from the residual's correlation, and a fit with it, in turn.

Simulation error minimisation is maximum likelihood where the noise of the outputs is white. Where
it is correlated over samples, with covariance Σ, W = Σ⁻¹ is what gives coefficients of the least
variance. Σ is not known, the residual y - ŷ of a fit is nearly the noise, and Σ that is banded is
all that the robust simulation error needs (`banded.Rows.covariance`). So: fit, estimate, fit again.
Source: thesis Section 8.1.1 (output noise spectrum and simulation model together).
"""

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import Infeasible, OptionError, SolverError
from nlsid_core.identification.fit import Candidate, History, Step
from nlsid_core.identification.methods.options import LeastSquares, Rie
from nlsid_core.identification.noise import Noise
from nlsid_core.identification.prediction import Model, history, simulate_trials
from nlsid_core.identification.trail import Task, Trail
from nlsid_core.identification.validation import hold_out, simulation_percent

WORSE = 1.02  # times the simulation error with white noise; chance made 1.007 in 30 fits
ROUNDS = 4  # of estimate and fit
SETTLED = 0.02  # of a correlation

T = TypeVar("T", bound=Model)
log = logging.getLogger(__name__)


def fit_in_turn(
    search: Callable[[Dataset, Task, Noise | None], Trail[T]],
    train: Dataset,
    lags: int,
    task: Task,
) -> Trail[T]:
    """The search with white noise, then, with `lags` above 0, again with that of the residual until
    its correlation no longer changes.

    A fit whose simulation error on validation trials is larger by more than chance is not taken:
    what it left is then the model's own error and no noise. Without such trials some of the
    training trials are held out for that, and it is then done as often with all. Raises OptionError
    if the method takes no weights.
    """
    if lags and isinstance(task.method, LeastSquares | Rie):
        raise OptionError("noise_lags", lags, f"0 with the method {task.method.name}")
    trail = search(train, task, None)
    if not lags:
        return trail
    white = next(c for c in trail.candidates if c.method is task.method)
    alone = replace(task, comparators=())

    def again(data: Dataset, noise: Noise) -> Candidate[T]:
        return search(data, alone, noise).candidates[0]

    fitted, judged = (train, task.validation) if task.validation else hold_out(train)
    # a residual shows no more of itself, and a band is no wider than its matrix
    lags = min(lags, max(max(map(len, fitted)) - 2 * history(white.model) - 1, 0))
    found = white if fitted is train else search(fitted, alone, None).candidates[0]
    steps = [Step("noise taken as white", simulation_percent(found.model, judged))]
    said = "held-back error [%]"
    try:
        noise = _noise(found.model, fitted, lags)
        while len(steps) <= ROUNDS:
            found = again(fitted, noise)
            error = simulation_percent(found.model, judged)
            if found.proof is None or error > WORSE * steps[0].value:
                refused = "is not proved" if found.proof is None else f"has {error:.4g} %"
                how = "white" if len(steps) == 1 else "estimated before"
                said = f"noise taken as {how}: the next model {refused}; {said}"
                break
            steps.append(Step(f"noise as the residual shows it, {len(steps)}", error))
            last, noise = noise, _noise(found.model, fitted, lags)
            if np.abs(noise.correlation - last.correlation).max() < SETTLED:
                break
        chosen = white
        for _ in steps[1:]:
            chosen = again(train, _noise(chosen.model, train, lags))
        if chosen.proof is None and white.proof is not None:
            raise Infeasible("the model with coloured noise has no proof")
    except SolverError as reason:
        log.warning("the noise is taken as white: %s", reason)
        return trail
    trail.history = History(said, tuple(steps))
    trail.candidates = [chosen if c is white else c for c in trail.candidates]
    return trail


def _noise(model: Model, data: Dataset, lags: int) -> Noise:
    """Of y - ŷ after the first n samples of every trial, where the simulation starts."""
    n, outputs = history(model), simulate_trials(model, data.trajectories)
    return Noise.of([(trial.y - y)[n:] for trial, y in zip(data, outputs, strict=True)], lags)
