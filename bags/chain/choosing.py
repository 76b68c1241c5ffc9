"""Which model to take: orders and bases tried on validation bags, methods scored on test bags."""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path

from bags.chain.config import Config
from bags.chain.identification_config import IdentificationConfig
from bags.chain.steps import Identified, Trials, read_trials, write_identified
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, Infeasible, NlsidError
from nlsid_core.identification import (
    Candidate,
    Fit,
    Model,
    Selection,
    Validation,
    describe,
    identify,
    select,
)
from nlsid_core.identification.prediction import history
from nlsid_core.progress import Progress, part


@dataclass(frozen=True, eq=False)
class Selected:
    """What was tried and chosen, and the files written of it."""

    selection: Selection
    identified: Identified


def sections_to_try(config: Config) -> list[IdentificationConfig]:
    """Every combination of the options in `select`; DataError if there is none."""
    if not config.select:
        raise DataError(
            "nothing to select from: give the configuration a section `select`, such as "
            "`select: {lags: [1, 2, 3, 4]}`"
        )
    return config.identification.each(config.select)


def select_trials(
    trials: Trials,
    config: Config,
    out: Path,
    *,
    executor: Executor | None = None,
    progress: Progress,
) -> Selected:
    """Every combination of the options; the files of the best by validation error.

    executor: shares them; the files are the same to the last bit. Raises DataError before anything
    is written, Infeasible if no combination has a model.
    """
    sections = sections_to_try(config)
    if trials.validation is None:
        raise DataError(
            "a selection needs validation trials: name bags in split.validation that are neither "
            "trained on nor tests"
        )
    base = config.identification
    selection = select(
        trials.train,
        trials.validation,
        [section.model_class for section in sections],
        method=base.method,
        test=trials.test,
        transient=base.transient,
        max_rate=base.max_rate,
        allow_unproved=base.allow_unproved,
        executor=executor,
        progress=part(progress, 0.3, 0.9),
    )
    if selection.refitted:
        both = Dataset((*trials.train.trajectories, *trials.validation.trajectories))
        trials = replace(trials, train=both, validation=None)
    identified = write_identified(selection.fit, trials, config, out, progress=progress)
    return Selected(selection, identified)


@dataclass(frozen=True, eq=False)
class Scored:
    """A candidate of the class `label` with its scores."""

    label: str
    candidate: Candidate[Model]
    scores: Validation


@dataclass(frozen=True, eq=False)
class Compared:
    """Every method's candidate with its scores, all on the same samples; and what failed, why."""

    rows: tuple[Scored, ...]
    refusals: tuple[str, ...]
    trials: Trials
    skipped_at_start: int


def compare_bags(
    bags: Sequence[Path],
    config: Config,
    *,
    progress: Progress,
) -> Compared:
    """Every method of every configured model class, scored on the same samples of the test trials.

    Writes nothing. Raises DataError as `identify_bags` does.
    """
    sections: list[IdentificationConfig] = list(config.compare or (config.identification,))
    trials = read_trials(bags, config, progress=part(progress, 0.0, 0.3))
    found, refusals = [], []
    for number, section in enumerate(sections):
        label = describe(section.model_class)
        done = 0.3 + 0.7 * number / len(sections)
        fit, refusal = _every_method(
            section, trials, part(progress, done, done + 0.7 / len(sections))
        )
        if refusal:
            refusals.append(f"{label}: {refusal}")
        if fit is not None:
            found += [(label, candidate) for candidate in fit.candidates]
    if not found:
        raise Infeasible("no class has a model: " + "; ".join(refusals))
    start = max(max(history(c.model), c.transient) for _, c in found)
    rows = tuple(
        Scored(label, candidate, candidate.validate(trials.test, transient=start))
        for label, candidate in found
    )
    return Compared(rows, tuple(refusals), trials, start)


def _every_method(
    section: IdentificationConfig, trials: Trials, progress: Progress
) -> tuple[Fit[Model] | None, str]:
    """A fit with a candidate of every method there is one of, and why the configured has none."""
    refusal = ""
    methods = section.every_method()
    for method in methods:
        try:
            fit = identify(
                trials.train,
                section.model_class,
                method=method,
                comparators=methods,
                validation=trials.validation,
                transient=section.transient,
                max_rate=section.max_rate,
                allow_unproved=True,
                progress=progress,
            )
        except NlsidError as reason:
            refusal = refusal or str(reason)
        else:
            return fit, refusal
    return None, refusal
