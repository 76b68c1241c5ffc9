"""`identify`: a dataset in, one stable model with its proof and the comparators out."""

from collections.abc import Sequence
from concurrent.futures import Executor

import numpy as np

from nlsid_core.errors import DataError, Infeasible
from nlsid_core.identification.fit import METHODS, Fit, M
from nlsid_core.identification.model_class import ModelClass
from nlsid_core.identification.searches import OFFERS, methods_of
from nlsid_core.identification.trail import Progress, Task, silent
from nlsid_core.trajectory import Dataset


def identify(
    train: Dataset,
    model_class: ModelClass[M],
    *,
    method: str | None = None,
    comparators: Sequence[str] | None = None,
    validation: Dataset | None = None,
    test: Dataset | None = None,
    iterations: int = 40,
    transient: int = 0,
    allow_unproved: bool = False,
    accept_untested_repeats: bool = False,
    rng: np.random.Generator | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Fit[M]:
    """Identify a model of the class, proved incrementally stable.

    method: a key of METHODS that is for the class (`methods_of`; None: the first of them).
    comparators: what else runs beside it (None: what is quick). `test` is only scored; so is
    `validation`, but by it a block cascade chooses its phases and knots. iterations: at most, of
    the robust simulation error. transient: samples at the start of every trial that are simulated
    and not scored. accept_untested_repeats: remove bias without testing that repeats are repeats.
    rng: of random starts (None: seed 0). executor: for moments of many bags. progress: called with
    (what was done, fraction done).
    Raises ShapeError or DataError on data or options that cannot be used, SolverError if the search
    fails, Infeasible if the chosen model has no proof (unless `allow_unproved`).
    """
    known = methods_of(model_class)
    chosen = known[0] if method is None else method
    for name in [chosen, *(comparators or ())]:
        if name not in known:
            raise DataError(_unknown(name, model_class, known))
    datasets = {"train": train, "validation": validation, "test": test}
    scored = {name: dataset for name, dataset in datasets.items() if dataset is not None}
    _refuse_other_signals(scored)
    offer = OFFERS[type(model_class)]
    quick = frozenset(offer.comparators) & {METHODS[name] for name in known}
    task = Task(
        method=METHODS[chosen],
        comparators=quick if comparators is None else frozenset(METHODS[m] for m in comparators),
        validation=validation,
        iterations=iterations,
        transient=transient,
        accept_untested_repeats=accept_untested_repeats,
        rng=np.random.default_rng(0) if rng is None else rng,
        executor=executor,
        progress=silent if progress is None else progress,
    )
    trail = offer.search(train, model_class, task)
    made = [candidate.method for candidate in trail.candidates]
    if task.method not in made:
        raise DataError(f"'{chosen}' is not for these data; there are: {', '.join(made)}")
    fit = Fit(tuple(trail.candidates), task.method, trail.history)
    if fit.chosen.proof is None and not allow_unproved:
        raise Infeasible(
            f"no proof of stability for the model of {fit.method}; try fewer lags, more or richer "
            "data, or a method that keeps a proof (rse_certified, moment_rie)"
        )
    errors = {
        name: {c.method: c.error_percent(dataset) for c in fit.candidates}
        for name, dataset in scored.items()
    }
    return Fit(fit.candidates, fit.method, fit.history, errors)


def _unknown(method: str, model_class: object, known: Sequence[str]) -> str:
    if method not in METHODS:
        return f"method is '{method}'; there are: {', '.join(METHODS)}"
    return (
        f"'{method}' is not for this model class ({type(model_class).__name__}); it has: "
        f"{', '.join(known)}"
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
