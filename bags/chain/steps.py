"""The chain's offline steps: each takes files, returns what it made, and writes it whole or not."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import combinations
from pathlib import Path
from typing import Final, Literal

import numpy as np

from bags.chain.config import Config, SplitConfig
from bags.chain.sections import SignalConfig
from bags.chain.tracking_config import TrackingConfig
from bags.chain.training import load_trials, save_trials
from bags.designs import documents
from bags.monitoring.catching import Catching, what_it_catches
from bags.pictures.report import report_available, write_report
from bags.recordings.definitions import read_definitions
from bags.recordings.folders import trial_name
from bags.recordings.names import did_you_mean, listed
from bags.signals.grid import filled_samples, read_dataset, refuse_unjudgeable, skipped_samples
from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.data.calibration import CalibrationTrials, calibration_trials, check_apart
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.design import OutputTube, OutputTubeDesign, design
from nlsid_core.design.tube import least_window
from nlsid_core.errors import DataError
from nlsid_core.identification import Fit, Model
from nlsid_core.models import Signal, StableModel, signals_of
from nlsid_core.progress import Progress, part, silent

USES: Final = ("test", "calibration")  # that the split names bags for
LEAST_APART: Final = 3  # trials: of two nobody can say which is the odd one
LARGER: Final = 20.0  # times the largest value of most trials: hardly the same unit


@dataclass(frozen=True, eq=False)
class Trials:
    """The bags' trials by what they are for.

    skipped: samples that were left out in gaps; filled: those nobody measured.
    """

    train: Dataset
    test: Dataset
    calibration: Dataset | None = None
    skipped: int = 0
    filled: int = 0

    @property
    def by_use(self) -> dict[str, Dataset]:
        """Those there are, by what they are for."""
        parts = {
            "training": self.train,
            "calibration": self.calibration,
            "test": self.test,
        }
        return {use: data for use, data in parts.items() if data is not None}

    @property
    def every(self) -> Dataset:
        """All of them, by name."""
        trials = (trial for part in self.by_use.values() for trial in part)
        return Dataset(tuple(sorted(trials, key=lambda trial: trial.name)))

    @property
    def apart(self) -> list[str]:
        """Trials where a signal is nowhere near what it is in all others, in words for people.

        That is by more than the others' range: kelvin among degC, another sensor, another zero; or
        many times larger than in most of them: mm among m.
        """
        trials = self.every
        if len(trials) < LEAST_APART:
            return []
        return [
            f"{trial.name}: {signal.name} is {lows[k]:.4g} to {highs[k]:.4g} {signal.unit}, in all "
            f"other trials {low:.4g} to {high:.4g}; is it in another unit, or of another sensor?"
            for letter in ("y", "u")
            for signal, lows, highs in _ranges(trials, letter)
            for k, trial in enumerate(trials)
            for low, high in [(np.delete(lows, k).min(), np.delete(highs, k).max())]
            if max(lows[k] - high, low - highs[k]) > max(high - low, highs[k] - lows[k])
        ] + [
            f"{trial.name}: {signal.name} is up to {largest[k]:.4g} {signal.unit}, in most trials "
            f"up to {np.median(largest):.4g}; is it in another unit?"
            for letter in ("y", "u")
            for signal, lows, highs in _ranges(trials, letter)
            for largest in [np.maximum(-lows, highs)]
            for k, trial in enumerate(trials)
            if largest[k] > LARGER * np.median(largest) > 0.0
        ]


@dataclass(frozen=True, eq=False)
class Identified:
    """A fit with the data it was made and scored on, and the files written."""

    fit: Fit[Model]
    trials: Trials
    files: tuple[Path, ...]

    @property
    def train(self) -> Dataset:
        """The trials it was fitted to."""
        return self.trials.train

    @property
    def test(self) -> Dataset:
        """The trials that only scored it."""
        return self.trials.test


def identify_bags(
    bags: Sequence[Path], config: Config, out: Path, *, progress: Progress
) -> Identified:
    """Bags in; model.json, model.proof.json, trials.npz and report.html in `out`.

    Raises DataError (BagError for bags) before anything is written.
    """
    trials = read_trials(bags, config, progress=part(progress, 0.0, 0.5))
    return identify_trials(trials, config, out, progress=progress)


def identify_trials(trials: Trials, config: Config, out: Path, *, progress: Progress) -> Identified:
    """The same of trials that were read already.

    A proof file of an earlier model does not stay beside an unproved one.
    """
    fit = config.identification.identify(
        trials.train,
        test=trials.test,
        progress=part(progress, 0.5, 0.9),
    )
    out.mkdir(parents=True, exist_ok=True)
    kept, path, proof = (
        out / name for name in (documents.TRIALS, documents.MODEL, documents.MODEL_PROOF)
    )
    model: Model = replace(fit.model, training=save_trials(kept, trials.by_use))
    files.write_document(path, model.document())
    written = [path, kept]
    if fit.chosen.proof is None:
        proof.unlink(missing_ok=True)
    else:
        files.write_document(proof, fit.proof.document(model, documents.MODEL))
        written.insert(1, proof)
    progress("drawing the report", 0.9)
    if report_available():
        written.append(out / documents.REPORT)
        write_report(written[-1], fit, trials.by_use, robot=config.robot)
    progress("done", 1.0)
    return Identified(fit, trials, tuple(written))


def read_trials(bags: Sequence[Path], config: Config, *, progress: Progress) -> Trials:
    """The trials of the configured signals on the configured grid, by what they are for."""
    check_split([trial_name(bag) for bag in bags], config)
    return by_use(read_signals_of(bags, config, progress=progress), config)


def read_signals_of(
    bags: Sequence[Path] | Mapping[str, Path],
    config: Config | TrackingConfig,
    *,
    progress: Progress = silent,
) -> Dataset:
    """The configured signals of bags on the configured grid, with the configured names and units.

    Of a measured state the states are the responses.

    bags: by what the trials are called, which else is as their bags are.
    """
    responses, excitations = config.signals.roles
    dataset = read_dataset(
        bags,
        responses=[signal.path for signal in responses],
        excitations=[signal.path for signal in excitations],
        grid=config.grid.rules(config.clock),
        definitions=read_definitions(config.definitions),
        progress=progress,
    )
    return _labelled(dataset, responses, excitations)


def _ranges(
    trials: Dataset, letter: Literal["y", "u"]
) -> list[tuple[Signal, FloatArray, FloatArray]]:
    """Each response or excitation with its least and its greatest value in each trial."""
    columns = [trial.y if letter == "y" else trial.u for trial in trials]
    lows = np.array([values.min(axis=0) for values in columns])
    highs = np.array([values.max(axis=0) for values in columns])
    return list(zip(signals_of(trials.trajectories[0], letter), lows.T, highs.T, strict=True))


def by_use(labelled: Dataset, config: Config, *, left_out: Sequence[str] = ()) -> Trials:
    """The trials by what the configuration's split has them for.

    left_out: names of bags that were given and have no trial here. Raises DataError for a name in
    the split that is neither of a trial nor of these.
    """
    refuse_absent([*labelled.names, *with_parts(left_out, config)], config)
    trials = split(labelled, config.split)
    if trials.calibration is not None:
        check_apart(trials.train, trials.calibration)
    skipped, filled = skipped_samples(labelled), filled_samples(labelled)
    return replace(trials, skipped=skipped, filled=filled)


def _labelled(
    dataset: Dataset, responses: Sequence[SignalConfig], excitations: Sequence[SignalConfig]
) -> Dataset:
    """The same trials with the configured names and units on their signals."""
    labels: dict[str, tuple[str, ...]] = {}
    for letter, signals in (("y", responses), ("u", excitations)):
        labels[f"{letter}_names"] = tuple(signal.name for signal in signals)
        labels[f"{letter}_units"] = tuple(signal.unit for signal in signals)
    return Dataset(tuple(replace(trial, **labels) for trial in dataset))  # type: ignore[arg-type]


def split(dataset: Dataset, named: SplitConfig) -> Trials:
    """The trials by name of their bag; DataError if a name is for two uses, or a part is empty.

    With a share the test trials are that end of every trial that is not named for another use.
    """
    chosen = _held_out(dataset.names, named)
    train = dataset.without([name for names in chosen.values() for name in names])
    if named.share is None:
        test = dataset.select(chosen["test"])
    else:
        train, test = _cut(train, named.share)
    scales = chosen["calibration"]
    return Trials(train, test, dataset.select(scales) if scales else None)


def _cut(dataset: Dataset, share: float) -> tuple[Dataset, Dataset]:
    """Every trial in two, the second of which is this share of it."""
    parts: tuple[list[Trajectory], list[Trajectory]] = ([], [])
    for trial in dataset:
        count = round(share * len(trial.t))
        if not 2 <= count <= len(trial.t) - 2:
            raise DataError(
                f"{trial.name}: {share:g} of {len(trial.t)} samples, at least 2 of each"
            )
        for half, rows in zip(parts, (slice(None, -count), slice(-count, None)), strict=True):
            y, u = trial.y[rows], trial.u[rows]
            half.append(replace(trial, t=trial.t[: len(y)], y=y, u=u))
    return Dataset(tuple(parts[0])), Dataset(tuple(parts[1]))


def check_split(names: Sequence[str], config: Config) -> None:
    """DataError if bags called so cannot be split as configured, which needs none to be read.

    A bag may turn out to have gaps: its parts may be named.
    """
    possible = with_parts(names, config)
    refuse_absent(possible, config)
    _held_out(possible, config.split)


def absent_from(names: Sequence[str], config: Config) -> list[str]:
    """Say which names and patterns of each use in the split none of the trials has."""
    reasons = []
    for use in USES:
        absent = [name for name in getattr(config.split, use) if not _of_bags(names, [name])]
        if absent:
            near = did_you_mean(absent[0], names)
            there = listed(names)
            reasons.append(f"split.{use} names {listed(absent)}; the bags are {there}{near}")
    return reasons


def refuse_absent(names: Sequence[str], config: Config) -> None:
    """Raise DataError for names in the split that none of the trials has.

    Their trials would be trained on without a word.
    """
    if absent := absent_from(names, config):
        raise DataError("; ".join(absent))


def with_parts(names: Sequence[str], config: Config) -> list[str]:
    """The bags' names, and those in the split of parts that a bag with gaps may have."""
    wanted = {name for use in USES for name in getattr(config.split, use)}
    return [*names, *sorted(name for name in wanted if name.rpartition(".")[0] in names)]


def _held_out(trials: Sequence[str], named: SplitConfig) -> dict[str, list[str]]:
    """The trials of each use, of those called so.

    DataError if a trial is for two, if none is for a use that names some or for the test, or if
    none is left to train on.
    """
    uses = USES if named.share is None else USES[1:]
    chosen = {use: _of_bags(trials, getattr(named, use)) for use in uses}
    for use, other in combinations(uses, 2):
        if twice := set(chosen[use]) & set(chosen[other]):
            raise DataError(f"split: '{min(twice)}' is named for {use} and for {other}")
    for use in uses:
        wanted = getattr(named, use)
        if not chosen[use] and (wanted or use == "test"):
            raise DataError(
                f"none of the bags is a {use} trial; split.{use} names "
                f"{', '.join(wanted) or 'nothing'}, the bags are {listed(trials)}"
            )
    if sum(map(len, chosen.values())) == len(trials):
        said = " or ".join(use for use in uses if chosen[use])
        raise DataError(f"all of the bags are {said} trials; give some to train on")
    return chosen


def _of_bags(trials: Sequence[str], names: Sequence[str]) -> list[str]:
    """The trials of the bags called so; a bag with gaps has several, `bag.1`, `bag.2`, ...

    A name with `*` or `?` in it is a pattern.
    """
    patterns = [name for name in names if "*" in name or "?" in name]

    def called(name: str) -> bool:
        return name in names or any(fnmatchcase(name, pattern) for pattern in patterns)

    return [name for name in trials if called(name) or called(name.rpartition(".")[0])]


def design_funnel_files(
    model_path: Path, config: Config, out: Path, false_alarms: float | None = None
) -> OutputTubeDesign:
    """A model file in; funnel.json, funnel.proof.json (and model.json) in `out`.

    A tube around the simulation of a model of any class; with a profile around a plan of a linear
    one as well, with the policy that tracks it, policy.json. The observer is chosen on the
    training trials beside the model, the disturbance measured on the calibration trials, without
    which every second training trial is one. false_alarms: see `OutputTube`. Raises DataError or
    Infeasible.
    """
    options = config.funnel
    if options is None:
        raise DataError(
            "the configuration has no section 'funnel'; `funnel: {}` is one, for a tube around the "
            "model's simulation, and with a profile it plans a motion and its policy"
        )
    load = documents.load_stable_model if options.profile is None else documents.load_model
    model: StableModel = load(model_path)
    trials, test = _trials_beside(model_path, config, model)
    weights = options.policy
    found = design(
        OutputTube(
            model,
            trials.design,
            trials.calibration,
            reaction_time=options.reaction_time,
            safety_factor=options.safety_factor,
            false_alarms=false_alarms,
            horizon=options.horizon,
            level=options.level,
            box=getattr(config.identification.model_class, "box", None),
            profile=options.profile,
            inlet=options.inlet,
            lqr_weights=None if weights is None else (weights.output_weight, weights.input_weight),
        )
    )
    refuse_unjudgeable(test, found.funnel.settling)
    if found.policy is None:
        (out / documents.POLICY).unlink(missing_ok=True)  # of another design in this folder
    found.save(out)
    return found


def what_a_funnel_catches(model_path: Path, config: Config, design: OutputTubeDesign) -> Catching:
    """What a designed funnel catches in the test trials beside its model.

    The trials are held against the model driven by the recorded commands. Raises DataError.
    """
    trials, test = _trials_beside(model_path, config, design.model)
    y = np.concatenate([trial.y for trial in (*trials.design, *trials.calibration)])
    return what_it_catches(
        design,
        held_back=test,
        calibration=trials.calibration,
        ranges=np.ptp(y, axis=0),
    )


def _trials_beside(
    model_path: Path, config: Config, model: StableModel
) -> tuple[CalibrationTrials, Dataset]:
    """The trials that design and scale the tube of a model, and the test trials.

    Raises DataError if they are not those that the configuration names.
    """
    kept = load_trials(model_path.with_name(documents.TRIALS), digest=model.training)
    _refuse_another_split(model_path, kept, config)
    assert config.funnel is not None
    least = least_window(model, kept["training"], config.funnel.horizon)
    trials = calibration_trials(kept["training"], kept.get("calibration"), least=least)
    return trials, kept["test"]


def _refuse_another_split(model_path: Path, kept: Mapping[str, Dataset], config: Config) -> None:
    """Raise DataError if the trials beside a model are not those that the configuration names.

    Of many bags some may have been left out when the model was identified.
    """
    were_left_out = model_path.with_name(documents.FLEET).exists()
    for use in USES if config.split.share is None else USES[1:]:
        named, names = getattr(config.split, use), kept[use].names if use in kept else ()
        absent = [name for name in named if not _of_bags(names, [name])]
        others = set(names) - set(_of_bags(names, named))
        if others or (absent and not (were_left_out and names)):
            raise DataError(
                f"split.{use} names {listed(absent or named)}, and the {use} trials beside the "
                f"model are {listed(names)}: run `nlsid identify` with this configuration"
            )
