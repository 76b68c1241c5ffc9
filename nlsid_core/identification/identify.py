"""`identify`: a dataset in, one stable model with its proof and the comparators out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, Infeasible, OptionError
from nlsid_core.identification.families import ModelClass, methods_of, searched
from nlsid_core.identification.fit import Fit
from nlsid_core.identification.methods.options import Method
from nlsid_core.identification.rates import rate_of_memory
from nlsid_core.identification.trail import Task
from nlsid_core.progress import Progress, silent


@dataclass(frozen=True)
class Search:
    """What a search may find, and what is shown beside it.

    comparators: what else runs; None: what is quick. transient: samples at the start of every trial
    that are simulated and not scored. max_rate: of models that are searched, 0 < max_rate < 1 a
    sample: two solutions approach each other by it or faster, and a slower proof does not count
    (None: the time constant is the length of the longest training trial). allow_unproved: a model
    without a proof of stability is returned too.
    """

    comparators: Sequence[Method] | None = None
    transient: int = 0
    max_rate: float | None = None
    allow_unproved: bool = False


USUAL = Search()


def identify(
    train: Dataset,
    model_class: ModelClass,
    *,
    method: Method | None = None,
    test: Dataset | None = None,
    search: Search = USUAL,
    progress: Progress = silent,
) -> Fit[Any]:
    """Identify a model of the class, proved incrementally stable.

    method: one that is for the class (`model_class.methods`), such as `Rse(iterations=20)`; None:
    the first of them. `test` is only scored. progress: called with (what was done, fraction done).
    Raises ShapeError or DataError on data or options that cannot be used, SolverError if the search
    fails, Infeasible if the chosen model has no proof (unless `search.allow_unproved`).
    """
    if not isinstance(train, Dataset):
        raise DataError(
            f"the data are a {type(train).__name__}; Dataset.from_pandas(frames, y=[...], u=[...]) "
            "makes a Dataset of DataFrames, and read_bags one of bags"
        )
    known = methods_of(model_class)
    chosen = known[0] if method is None else method
    for asked in (chosen, *(search.comparators or ())):
        if getattr(asked, "name", None) not in [one.name for one in known]:
            names = ", ".join(one.name for one in known)
            raise DataError(f"{asked!r} is no method for this model class; it has: {names}")
    scored = {"train": train} | ({} if test is None else {"test": test})
    for dataset in scored.values():  # a dataset has the same signals and period throughout
        Dataset((train.trajectories[0], dataset.trajectories[0]))
    if search.max_rate is not None and not 0.0 < search.max_rate < 1.0:
        raise OptionError("max_rate", search.max_rate, "a number between 0 and 1")
    slowest = search.max_rate or rate_of_memory(train)
    quick = tuple(one for one in model_class.comparators if one.name != chosen.name)
    task = Task(
        method=chosen,
        comparators=quick if search.comparators is None else tuple(search.comparators),
        max_rate=slowest,
        transient=search.transient,
        progress=progress,
    )
    trail = searched(train, model_class, task)
    fit = Fit(tuple(trail.candidates), chosen, trail.history, scored, slowest)
    if fit.chosen.proof is None and not search.allow_unproved:
        remark = fit.chosen.remark and f" ({fit.chosen.remark})"
        raise Infeasible(
            f"no proof of stability for the model of {chosen.title}{remark}; try fewer lags, more "
            "or richer data, or a method that keeps a proof (`certified`)"
        )
    return fit
