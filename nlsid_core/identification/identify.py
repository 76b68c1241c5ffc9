"""`identify`: a dataset in, one stable model with its proof and the comparators out."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import overload

import numpy as np

from nlsid_core._types import FloatArray
from nlsid_core.errors import DataError, Infeasible
from nlsid_core.identification.certified import certified_simulation_error
from nlsid_core.identification.contraction import prove_state_affine
from nlsid_core.identification.fit import (
    CERTIFIED,
    FINAL,
    FIRST,
    LEAST_SQUARES,
    RIE,
    SEM,
    AnyFit,
    Candidate,
    Fit,
    M,
    Proof,
)
from nlsid_core.identification.least_squares import least_squares
from nlsid_core.identification.regression import LinearClass, build_regression
from nlsid_core.identification.rie import robust_identification_error
from nlsid_core.identification.rows import Rows
from nlsid_core.identification.rse import Iterate, robust_simulation_error
from nlsid_core.identification.simulation_error import minimise_simulation_error
from nlsid_core.identification.stability import prove_stability
from nlsid_core.identification.state_affine import (
    StateAffineClass,
    StateAffineRows,
    build_state_affine_rows,
)
from nlsid_core.models import DifferenceEquation, StateAffineModel
from nlsid_core.trajectory import Dataset

Progress = Callable[[str, float], None]
ModelClass = LinearClass | StateAffineClass
METHODS = {
    "least_squares": LEAST_SQUARES,
    "rie": RIE,
    "rse_first": FIRST,
    "rse": FINAL,
    "rse_certified": CERTIFIED,
    "sem": SEM,
}


@dataclass(frozen=True, eq=False)
class Selection:
    """Fits of several model classes, and which has the least validation error."""

    classes: tuple[ModelClass, ...]
    errors: tuple[float, ...]  # %, of the chosen method; infinite where none was found
    best: ModelClass
    fit: AnyFit

    def __str__(self) -> str:
        rows = [
            f"{'*' if c is self.best else ' '} {c!s:70s}{error:9.2f} %"
            for c, error in zip(self.classes, self.errors, strict=True)
        ]
        return "\n".join(["model class, validation error", *rows, str(self.fit)])


@overload
def identify(
    train: Dataset,
    model_class: LinearClass,
    *,
    method: str = ...,
    validation: Dataset | None = ...,
    test: Dataset | None = ...,
    iterations: int = ...,
    allow_unproved: bool = ...,
    progress: Progress | None = ...,
) -> Fit[DifferenceEquation]: ...


@overload
def identify(
    train: Dataset,
    model_class: StateAffineClass,
    *,
    method: str = ...,
    validation: Dataset | None = ...,
    test: Dataset | None = ...,
    iterations: int = ...,
    allow_unproved: bool = ...,
    progress: Progress | None = ...,
) -> Fit[StateAffineModel]: ...


@overload
def identify(
    train: Dataset,
    model_class: ModelClass,
    *,
    method: str = ...,
    validation: Dataset | None = ...,
    test: Dataset | None = ...,
    iterations: int = ...,
    allow_unproved: bool = ...,
    progress: Progress | None = ...,
) -> AnyFit: ...


def identify(
    train: Dataset,
    model_class: ModelClass,
    *,
    method: str = "rse",
    validation: Dataset | None = None,
    test: Dataset | None = None,
    iterations: int = 40,
    allow_unproved: bool = False,
    progress: Progress | None = None,
) -> AnyFit:
    """Identify a model of the class by `method` (a key of METHODS), proved incrementally stable.

    The cheaper methods run beside it as comparators. `validation` and `test` are only scored.
    progress: called with (what was done, fraction done).
    Raises ShapeError or DataError on data or options that cannot be used, SolverError if a search
    fails, Infeasible if the chosen model has no proof (unless `allow_unproved`).
    """
    if method not in METHODS:
        raise DataError(f"method is '{method}'; there are: {', '.join(METHODS)}")
    report = progress if progress is not None else _silent
    datasets = {"train": train, "validation": validation, "test": test}
    scored = {name: dataset for name, dataset in datasets.items() if dataset is not None}
    if isinstance(model_class, LinearClass):
        linear = _linear(train, model_class, METHODS[method], iterations, report)
        return _finished(linear, scored, allow_unproved)
    affine = _state_affine(train, model_class, METHODS[method], iterations, report)
    return _finished(affine, scored, allow_unproved)


def select(
    train: Dataset,
    validation: Dataset,
    classes: Sequence[ModelClass],
    *,
    method: str = "rse",
    iterations: int = 40,
    progress: Progress | None = None,
) -> Selection:
    """Identify every class on `train` and keep the one with the least error on `validation`.

    A class that does not fit the data or has no proof counts as infinitely bad. Raises Infeasible
    if that is all of them.
    """
    report = progress if progress is not None else _silent
    errors: list[float] = []
    fits: list[AnyFit | None] = []
    reasons = []
    for number, model_class in enumerate(classes):
        report(str(model_class), number / len(classes))
        try:
            fit = identify(
                train, model_class, method=method, validation=validation, iterations=iterations
            )
        except (DataError, Infeasible) as refusal:
            reasons.append(f"{model_class}: {refusal}")
            errors.append(float("inf"))
            fits.append(None)
        else:
            errors.append(fit.errors["validation"][fit.method])
            fits.append(fit)
    best = int(np.argmin(errors)) if errors else 0
    if not fits or fits[best] is None:
        raise Infeasible("no class has a proved model: " + "; ".join(reasons))
    chosen = fits[best]
    assert chosen is not None
    return Selection(tuple(classes), tuple(errors), classes[best], chosen)


def _linear(
    train: Dataset, model_class: LinearClass, method: str, iterations: int, report: Progress
) -> Fit[DifferenceEquation]:
    regression = build_regression(train, model_class.lags)
    trail: _Trail[DifferenceEquation] = _Trail(prove_stability, report)
    start = trail.add(LEAST_SQUARES, lambda: least_squares(regression))
    bounds = trail.follow(regression.rows, iterations, lambda i: regression.model(i.theta, i.p))
    trail.add(SEM, lambda: minimise_simulation_error(regression, start))
    return trail.fit(method, bounds)


def _state_affine(
    train: Dataset, model_class: StateAffineClass, method: str, iterations: int, report: Progress
) -> Fit[StateAffineModel]:
    problem = build_state_affine_rows(train, model_class)
    trail: _Trail[StateAffineModel] = _Trail(prove_state_affine, report)
    trail.add(LEAST_SQUARES, lambda: equation_error(problem))
    if problem.has_constant_lags:
        trail.add(RIE, lambda: robust_identification_error(problem)[0])
    bounds = trail.follow(problem.rows, iterations, lambda i: problem.model(i.theta, i.p))
    if method == CERTIFIED:
        report(CERTIFIED, 0.6)
        trail.add(CERTIFIED, lambda: _certified(problem, iterations))
    return trail.fit(method, bounds)


def equation_error(problem: StateAffineRows) -> StateAffineModel:
    """Least squares on the equation error with G_0 normalised to 1 at its constant term."""
    rows = problem.rows
    fixed = rows.identity != 0.0
    free = np.array([not f and D != 0 for f, D in zip(fixed, rows.offsets, strict=True)])
    columns = np.column_stack([rows.errors[:, free], -rows.Q])
    found = np.linalg.lstsq(columns, -(rows.errors @ rows.identity), rcond=None)[0]
    theta: FloatArray = rows.identity.copy()
    theta[free] = found[: int(free.sum())]
    return problem.model(theta, found[int(free.sum()) :])


def _certified(problem: StateAffineRows, iterations: int) -> StateAffineModel:
    *_, last = certified_simulation_error(problem, iterations=iterations)
    return problem.model(last.point.theta, last.point.p)


class _Trail(list[Candidate[M]]):
    """Candidates as they are made, each proved and timed."""

    def __init__(self, prove: Callable[[M], Proof | None], report: Progress) -> None:
        super().__init__()
        self.prove: Callable[[M], Proof | None] = prove
        self.report = report

    def add(self, method: str, make: Callable[[], M]) -> M:
        """Make one candidate."""
        self.report(method, 0.1 * len(self))
        started = time.perf_counter()
        model = make()
        seconds = time.perf_counter() - started
        self.append(Candidate(method, model, self.prove(model), seconds))
        return model

    def follow(self, rows: Rows, iterations: int, model: Callable[[Iterate], M]) -> list[float]:
        """The iterates of the robust simulation error; the first and the last are candidates."""
        started, bounds, last = time.perf_counter(), [], None
        for last in robust_simulation_error(rows, iterations=iterations):
            bounds.append(last.J)
            if len(bounds) == 1:
                first, seconds = last, time.perf_counter() - started
                self.append(Candidate(FIRST, model(first), self.prove(model(first)), seconds))
            done = 0.2 + 0.4 * len(bounds) / iterations
            self.report(f"robust simulation error, iterate {len(bounds)}", done)
        assert last is not None, "there is at least one iterate"
        seconds = time.perf_counter() - started
        self.append(Candidate(FINAL, model(last), self.prove(model(last)), seconds))
        return bounds

    def fit(self, method: str, bounds: list[float]) -> Fit[M]:
        """The fit of the method that was asked for; DataError if it is not for this class."""
        made = [candidate.method for candidate in self]
        if method not in made:
            raise DataError(f"'{method}' is not for this model class; it has: {', '.join(made)}")
        return Fit(tuple(self), method, tuple(bounds))


def _finished(fit: Fit[M], scored: dict[str, Dataset], allow_unproved: bool) -> Fit[M]:
    if fit.chosen.proof is None and not allow_unproved:
        raise Infeasible(
            f"no proof of stability for the model of {fit.method}; try fewer lags, more or richer "
            "data, or the method rse_certified (state-affine models)"
        )
    errors = {
        name: {c.method: c.error_percent(dataset) for c in fit.candidates}
        for name, dataset in scored.items()
    }
    return replace(fit, errors=errors)


def _silent(_what: str, _fraction: float) -> None:
    return None
