"""`identify`: a dataset in, one stable model with its proof and the comparators out."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nlsid_core.errors import Infeasible
from nlsid_core.identification.least_squares import least_squares
from nlsid_core.identification.regression import build_regression
from nlsid_core.identification.rse import robust_simulation_error
from nlsid_core.identification.simulation_error import (
    minimise_simulation_error,
    simulation_error_percent,
)
from nlsid_core.identification.stability import StabilityProof, prove_stability
from nlsid_core.models import DifferenceEquation
from nlsid_core.trajectory import Dataset

LEAST_SQUARES = "least squares"
FIRST = "robust simulation error, first iterate"
FINAL = "robust simulation error, final iterate"
SEM = "simulation error minimisation"


@dataclass(frozen=True, eq=False)
class Candidate:
    """One method's model, its stability proof if there is one, and the seconds it took."""

    method: str
    model: DifferenceEquation
    proof: StabilityProof | None
    seconds: float

    def error_percent(self, dataset: Dataset) -> float:
        """100·‖y - ŷ‖/‖y - mean(y)‖ of the simulation over `dataset`."""
        return simulation_error_percent(self.model, dataset)


@dataclass(frozen=True, eq=False)
class Fit:
    """What `identify` returns: every candidate in order, and the chosen one."""

    candidates: tuple[Candidate, ...]
    bounds: tuple[float, ...]  # J after each iterate of the robust simulation error, scaled

    def __getitem__(self, method: str) -> Candidate:
        return next(c for c in self.candidates if c.method == method)

    @property
    def chosen(self) -> Candidate:
        """The final iterate of the robust simulation error, which carries the proof."""
        return self[FINAL]

    @property
    def model(self) -> DifferenceEquation:
        """The chosen model."""
        return self.chosen.model

    @property
    def proof(self) -> StabilityProof:
        """The chosen model's proof; `identify` does not return a Fit without one."""
        assert self.chosen.proof is not None
        return self.chosen.proof

    def __str__(self) -> str:
        rows = [
            f"  {c.method:40s} {c.seconds:7.3f} s  {'proved' if c.proof else 'not proved'}"
            for c in self.candidates
        ]
        return "\n".join([f"{len(self.model)} lags, {self.model.period:g} s a sample", *rows])


def identify(
    train: Dataset,
    *,
    lags: int,
    iterations: int = 40,
    progress: Callable[[str, float], None] | None = None,
) -> Fit:
    """Identify a difference equation by robust simulation error, proved incrementally stable.

    progress: called with (what was done, fraction of `iterations` at most).
    Raises ShapeError or DataError on data that cannot be used, SolverError if Newton's method
    fails, Infeasible if the final iterate is not stable (then no proof exists for it).
    """
    regression = build_regression(train, lags)
    report = progress if progress is not None else _silent
    started = time.perf_counter()
    model = least_squares(regression)
    candidates = [_candidate(LEAST_SQUARES, model, started)]
    report(LEAST_SQUARES, 0.0)
    started = time.perf_counter()
    bounds: list[float] = []
    for iterate in robust_simulation_error(regression.rows, iterations=iterations):
        model = regression.model(iterate.theta, iterate.p)
        if not bounds:
            candidates.append(_candidate(FIRST, model, started))
        bounds.append(iterate.J)
        report(f"robust simulation error, iterate {len(bounds)}", len(bounds) / iterations)
    candidates.append(_candidate(FINAL, model, started))
    started = time.perf_counter()
    minimum = minimise_simulation_error(regression, candidates[0].model)
    candidates.append(_candidate(SEM, minimum, started))
    report(SEM, 1.0)
    fit = Fit(tuple(candidates), tuple(bounds))
    if fit.chosen.proof is None:
        radius = float(np.abs(fit.model.poles).max())
        raise Infeasible(
            f"the final iterate is not stable (slowest pole {radius:.4f}): no proof exists for it; "
            "try fewer lags or more trials"
        )
    return fit


def _candidate(method: str, model: DifferenceEquation, started: float) -> Candidate:
    seconds = time.perf_counter() - started
    return Candidate(method, model, prove_stability(model), seconds)


def _silent(_what: str, _fraction: float) -> None:
    return None
