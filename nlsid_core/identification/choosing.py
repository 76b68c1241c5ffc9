"""`select`: several classes identified, and the one with the least validation error kept."""

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, Infeasible, SolverError
from nlsid_core.identification.families import ModelClass, describe
from nlsid_core.identification.fit import Fit
from nlsid_core.identification.identify import identify
from nlsid_core.identification.methods.options import Method
from nlsid_core.progress import Progress, silent

log = logging.getLogger(__name__)


def select(
    train: Dataset,
    validation: Dataset,
    classes: Sequence[ModelClass],
    *,
    method: Method | None = None,
    test: Dataset | None = None,
    transient: int = 0,
    max_rate: float | None = None,
    allow_unproved: bool = False,
    executor: Executor | None = None,
    progress: Progress = silent,
) -> "Selection":
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
    tried: list[Tried] = []
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
    refit, chooses = best.fit, getattr(best.model_class, "needs_validation", False)
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
class Tried:
    """One class: its fit, or the reason why there is none."""

    model_class: ModelClass
    fit: Fit[Any] | None
    refusal: str = ""

    def error(self, dataset: str) -> float:
        """The chosen method's error in %; infinite where there is no fit."""
        return float("inf") if self.fit is None else self.fit.errors[dataset][self.fit.method.name]


def _tried(
    fitted: Callable[[Dataset, ModelClass], Fit[Any]],
    train: Dataset,
    validation: Dataset,
    model_class: ModelClass,
) -> Tried:
    """The class fitted to `train` and judged by `validation`, or why there is no fit."""
    try:
        fit = fitted(train, model_class)
    except (DataError, SolverError) as refusal:
        return Tried(model_class, None, str(refusal))
    judged = {fit.method.name: fit.chosen.error_percent(validation)}
    errors = {"train": fit.errors["train"], "validation": judged, **fit.errors}
    return Tried(model_class, replace(fit, errors=errors))


@dataclass(frozen=True, eq=False)
class Selection:
    """Everything that was tried, in order, and the class with the least validation error.

    fit: of that class, to training and validation trials together if `refitted`.
    """

    tried: tuple[Tried, ...]
    best: ModelClass
    fit: Fit[Any]
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
