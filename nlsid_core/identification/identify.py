"""`identify`: a dataset in, one stable model with its proof and the comparators out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, Infeasible, OptionError
from nlsid_core.identification.families import ModelClass, methods_of, search
from nlsid_core.identification.fit import Fit
from nlsid_core.identification.methods.options import METHODS, Method
from nlsid_core.identification.rates import rate_of_memory
from nlsid_core.identification.trail import Task
from nlsid_core.progress import Progress, silent


def identify(
    train: Dataset,
    model_class: ModelClass,
    *,
    method: Method | None = None,
    comparators: Sequence[Method] | None = None,
    test: Dataset | None = None,
    transient: int = 0,
    max_rate: float | None = None,
    allow_unproved: bool = False,
    progress: Progress = silent,
) -> Fit[Any]:
    """Identify a model of the class, proved incrementally stable.

    method: one that is for the class (`model_class.methods`), such as `Rse(iterations=20)`; None:
    the first of them. comparators: what else runs beside it; None: what is quick. `test` is only
    scored. transient: samples at the start of every trial that are simulated and not scored.
    max_rate: of models that are searched, 0 < max_rate < 1 a sample: two solutions approach each
    other by it or faster, and a slower proof does not count (None: the time constant is the length
    of the longest training trial). progress: called with (what was done, fraction done).
    Raises ShapeError or DataError on data or options that cannot be used, SolverError if the search
    fails, Infeasible if the chosen model has no proof (unless `allow_unproved`).
    """
    if not isinstance(train, Dataset):
        raise DataError(
            f"the data are a {type(train).__name__}; Dataset.from_pandas(frames, y=[...], u=[...]) "
            "makes a Dataset of DataFrames, and read_bags one of bags"
        )
    known = methods_of(model_class)
    chosen = known[0] if method is None else method
    for asked in (chosen, *(comparators or ())):
        if getattr(asked, "name", None) not in [one.name for one in known]:
            raise DataError(_unknown(asked, known))
    scored = {"train": train} | ({} if test is None else {"test": test})
    for dataset in scored.values():  # a dataset has the same signals and period throughout
        Dataset((train.trajectories[0], dataset.trajectories[0]))
    if max_rate is not None and not 0.0 < max_rate < 1.0:
        raise OptionError("max_rate", max_rate, "a number between 0 and 1")
    slowest = rate_of_memory(train) if max_rate is None else max_rate
    quick = tuple(one for one in model_class.comparators if one.name != chosen.name)
    task = Task(
        method=chosen,
        comparators=quick if comparators is None else tuple(comparators),
        max_rate=slowest,
        transient=transient,
        progress=progress,
    )
    trail = search(train, model_class, task)
    fit = Fit(tuple(trail.candidates), chosen, trail.history, scored, slowest)
    if fit.chosen.proof is None and not allow_unproved:
        remark = fit.chosen.remark and f" ({fit.chosen.remark})"
        raise Infeasible(
            f"no proof of stability for the model of {chosen.title}{remark}; try fewer lags, more "
            "or richer data, or a method that keeps a proof (`certified`)"
        )
    return fit


def _unknown(asked: object, known: Sequence[Method]) -> str:
    names = ", ".join(one.name for one in known)
    if not isinstance(asked, Method):
        return f"{asked!r} is no method; there are: {', '.join(METHODS)}"
    return f"{asked!r} is not for this model class; it has: {names}"
