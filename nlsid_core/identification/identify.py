"""`identify`: a dataset in, one stable model with its proof and the comparators out.

`select` does so for several classes and keeps the one with the least error on validation data.
"""

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Generic

import numpy as np

from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, Infeasible, OptionError, SolverError
from nlsid_core.identification.fit import Fit
from nlsid_core.identification.methods.options import (
    METHODS,
    M,
    Method,
    ModelClass,
    alike,
    describe,
)
from nlsid_core.identification.rates import default_max_rate
from nlsid_core.identification.searches import OFFERS, methods_of
from nlsid_core.identification.trail import Task
from nlsid_core.progress import Progress, silent

log = logging.getLogger(__name__)


def identify(
    train: Dataset,
    model_class: ModelClass[M],
    *,
    method: Method | None = None,
    comparators: Sequence[Method] | None = None,
    validation: Dataset | None = None,
    test: Dataset | None = None,
    transient: int = 0,
    max_rate: float | None = None,
    allow_unproved: bool = False,
    executor: Executor | None = None,
    progress: Progress = silent,
) -> Fit[M]:
    """Identify a model of the class, proved incrementally stable.

    method: one that is for the class (`methods_of`), such as `Rse(iterations=20)`; None: the first
    of them. comparators: what else runs beside it; None: what is quick, with the options that it
    shares with the method. `test` is only scored; so is `validation`, but by it a block cascade
    chooses its phases and knots (without it by every third training trial, the second of two, or
    the last third of one). transient: samples at the start of every trial that are simulated and
    not scored. max_rate: of the models that are searched, 0 < max_rate < 1 a sample: two solutions
    approach each other by it or faster, and a slower proof does not count (None: the time constant
    is the length of the longest training trial). executor: shares work that splits,
    such as moments of many bags. progress: called with (what was done, fraction done).
    Raises ShapeError or DataError on data or options that cannot be used, SolverError if the search
    fails, Infeasible if the chosen model has no proof (unless `allow_unproved`).
    """
    known = methods_of(model_class)
    chosen = known[0]() if method is None else method
    for asked in (chosen, *(comparators or ())):
        if type(asked) not in known:
            raise DataError(_unknown(asked, model_class, known))
    datasets = {"train": train, "validation": validation, "test": test}
    scored = {name: dataset for name, dataset in datasets.items() if dataset is not None}
    _refuse_other_signals(scored)
    if max_rate is not None and not 0.0 < max_rate < 1.0:
        raise OptionError("max_rate", max_rate, "a number between 0 and 1")
    slowest = default_max_rate(train) if max_rate is None else max_rate
    offer = OFFERS[type(model_class)]
    quick = tuple(alike(kind, chosen) for kind in offer.comparators if kind in known)
    task = Task(
        method=chosen,
        comparators=quick if comparators is None else tuple(comparators),
        max_rate=slowest,
        validation=validation,
        transient=transient,
        executor=executor,
        progress=progress,
    )
    trail = offer.search(train, model_class, task)
    fit = Fit(tuple(trail.candidates), chosen, trail.history, max_rate=slowest)
    if fit.chosen.proof is None and not allow_unproved:
        remark = fit.chosen.remark and f" ({fit.chosen.remark})"
        raise Infeasible(
            f"no proof of stability for the model of {chosen.title}{remark}; try fewer lags, more "
            "or richer data, or a method that keeps a proof (rse_certified, moment_rie)"
        )
    errors = {
        name: {c.method.name: c.error_percent(dataset) for c in fit.candidates}
        for name, dataset in scored.items()
    }
    return replace(fit, errors=errors)


def select(
    train: Dataset,
    validation: Dataset,
    classes: Sequence[ModelClass[M]],
    *,
    method: Method | None = None,
    test: Dataset | None = None,
    transient: int = 0,
    max_rate: float | None = None,
    allow_unproved: bool = False,
    executor: Executor | None = None,
    progress: Progress = silent,
) -> "Selection[M]":
    """Identify every class on `train`, choose by the error on `validation`, fit to both again.

    No class sees `validation` before it is judged by it. A class that does not fit the data or
    (unless `allow_unproved`) has no proof counts as infinitely bad. The chosen class is identified
    once more on both datasets together, or, where it makes choices by validation trials, on `train`
    with these. executor: tries the classes beside each other; what it finds is the same to the last
    bit, in the order of `classes`. The other options are those of `identify`. Raises Infeasible if
    no class has a model.
    """
    fitted = partial(
        identify,
        method=method,
        comparators=(),
        test=test,
        transient=transient,
        max_rate=max_rate,
        allow_unproved=allow_unproved,
    )
    one = partial(_tried, fitted, train, validation)
    tried: list[Tried[M]] = []
    for entry in map(one, classes) if executor is None else executor.map(one, classes):
        tried.append(entry)
        progress(describe(entry.model_class), len(tried) / (len(classes) + 1))
    if not tried:
        raise DataError("no model class to select from")
    best = min(tried, key=lambda entry: entry.error("validation"))
    if best.fit is None:
        reasons = "; ".join(f"{describe(entry.model_class)}: {entry.refusal}" for entry in tried)
        raise Infeasible(f"no class has a proved model: {reasons}")
    progress("fitting to training and validation trials", len(classes) / (len(classes) + 1))
    refit, chooses = best.fit, OFFERS[type(best.model_class)].needs_validation
    try:
        if chooses:
            refit = fitted(train, best.model_class, validation=validation)
        else:
            both = Dataset((*train.trajectories, *validation.trajectories))
            refit = fitted(both, best.model_class)
    except (DataError, SolverError) as refusal:
        log.warning("not fitted with the validation trials: %s", refusal)
    progress("done", 1.0)
    refitted = refit is not best.fit and not chooses
    return Selection(tuple(tried), best.model_class, refit, refitted)


@dataclass(frozen=True, eq=False)
class Tried(Generic[M]):
    """One class: its fit, or the reason why there is none."""

    model_class: ModelClass[M]
    fit: Fit[M] | None
    refusal: str = ""

    def error(self, dataset: str) -> float:
        """The chosen method's error in %; infinite where there is no fit."""
        return float("inf") if self.fit is None else self.fit.errors[dataset][self.fit.method.name]


def _tried(
    fitted: Callable[[Dataset, ModelClass[M]], Fit[M]],
    train: Dataset,
    validation: Dataset,
    model_class: ModelClass[M],
) -> Tried[M]:
    """The class fitted to `train` and judged by `validation`, or why there is no fit."""
    try:
        fit = fitted(train, model_class)
    except (DataError, SolverError) as refusal:
        return Tried(model_class, None, str(refusal))
    judged = {fit.method.name: fit.chosen.error_percent(validation)}
    errors = {"train": fit.errors["train"], "validation": judged, **fit.errors}
    return Tried(model_class, replace(fit, errors=errors))


@dataclass(frozen=True, eq=False)
class Selection(Generic[M]):
    """Everything that was tried, in order, and the class with the least validation error.

    fit: of that class, to training and validation trials together if `refitted`.
    """

    tried: tuple[Tried[M], ...]
    best: ModelClass[M]
    fit: Fit[M]
    refitted: bool

    @property
    def errors(self) -> tuple[float, ...]:
        """Validation errors in % of the chosen method; infinite where none was found."""
        return tuple(entry.error("validation") for entry in self.tried)

    def __str__(self) -> str:
        rows = [
            f"{'*' if entry.model_class is self.best else ' '} {describe(entry.model_class):70s}"
            + (entry.refusal or f"{entry.error('validation'):9.2f} %")
            for entry in self.tried
        ]
        on = "training and validation trials" if self.refitted else "training trials"
        return "\n".join(
            ["model class, validation error", *rows, f"fitted to {on}:", str(self.fit)]
        )


def _unknown(asked: object, model_class: object, known: Sequence[type[Method]]) -> str:
    if type(asked) not in METHODS.values():
        there_are = ", ".join(kind.__name__ for kind in METHODS.values())
        return f"{asked!r} is no method; there are: {there_are}"
    return (
        f"{asked!r} is not for this model class ({type(model_class).__name__}); it has: "
        f"{', '.join(kind.__name__ for kind in known)}"
    )


def _refuse_other_signals(datasets: dict[str, Dataset]) -> None:
    first = datasets["train"].trajectories[0]
    for name, dataset in datasets.items():
        other = dataset.trajectories[0]
        if (other.y_names, other.u_names) != (first.y_names, first.u_names):
            raise DataError(
                f"the {name} data hold {other.y_names + other.u_names}, the training data "
                f"{first.y_names + first.u_names}"
            )
        if not np.isclose(dataset.period, datasets["train"].period, rtol=1e-6, atol=0.0):
            raise DataError(
                f"the {name} data are sampled every {dataset.period:g} s, the training data every "
                f"{datasets['train'].period:g} s"
            )
