"""`select`: the model class, order and basis with the least error on validation data."""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Generic

import numpy as np

from nlsid_core.errors import DataError, Infeasible, SolverError
from nlsid_core.identification.fit import Fit, M
from nlsid_core.identification.identify import identify
from nlsid_core.identification.model_class import ModelClass, describe
from nlsid_core.identification.trail import Progress, silent
from nlsid_core.trajectory import Dataset


@dataclass(frozen=True, eq=False)
class Tried(Generic[M]):
    """One class: its fit, or the reason why there is none."""

    model_class: ModelClass[M]
    fit: Fit[M] | None
    refusal: str = ""

    def error(self, dataset: str) -> float:
        """The chosen method's error in %; infinite where there is no fit."""
        return float("inf") if self.fit is None else self.fit.errors[dataset][self.fit.method]


@dataclass(frozen=True, eq=False)
class Selection(Generic[M]):
    """Everything that was tried, in order, and the class with the least validation error."""

    tried: tuple[Tried[M], ...]
    best: ModelClass[M]
    fit: Fit[M]

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
        return "\n".join(["model class, validation error", *rows, str(self.fit)])


def select(
    train: Dataset,
    validation: Dataset,
    classes: Sequence[ModelClass[M]],
    *,
    method: str | None = None,
    test: Dataset | None = None,
    iterations: int = 40,
    transient: int = 0,
    allow_unproved: bool = False,
    accept_untested_repeats: bool = False,
    seed: int = 0,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Selection[M]:
    """Identify every class on `train` and keep the one with the least error on `validation`.

    A class that does not fit the data or (unless `allow_unproved`) has no proof counts as
    infinitely bad. Options are those of `identify`; each class starts from the same seed. Raises
    Infeasible if no class has a model.
    """
    report = silent if progress is None else progress
    tried: list[Tried[M]] = []
    for number, model_class in enumerate(classes):
        report(describe(model_class), number / len(classes))
        try:
            fit = identify(
                train,
                model_class,
                method=method,
                comparators=(),
                validation=validation,
                test=test,
                iterations=iterations,
                transient=transient,
                allow_unproved=allow_unproved,
                accept_untested_repeats=accept_untested_repeats,
                rng=np.random.default_rng(seed),
                executor=executor,
            )
        except (DataError, SolverError) as refusal:
            tried.append(Tried(model_class, None, str(refusal)))
        else:
            tried.append(Tried(model_class, fit))
    report("done", 1.0)
    if not tried:
        raise DataError("no model class to select from")
    best = min(tried, key=lambda entry: entry.error("validation"))
    if best.fit is None:
        reasons = "; ".join(f"{describe(entry.model_class)}: {entry.refusal}" for entry in tried)
        raise Infeasible(f"no class has a proved model: {reasons}")
    return Selection(tuple(tried), best.model_class, best.fit)
