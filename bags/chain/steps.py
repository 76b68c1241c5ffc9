"""The chain's offline steps: each takes files, returns what it made, and writes it whole or not."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bags.chain.config import Config, SignalConfig
from bags.chain.training import load_training, save_training
from bags.monitoring import documents
from bags.pictures.report import report_available, write_report
from bags.signals.grid import read_dataset
from nlsid_core import _json
from nlsid_core.errors import DataError
from nlsid_core.funnels import TubeDesign, design_tube
from nlsid_core.identification import (
    AnyCandidate,
    AnyFit,
    Model,
    Validation,
    identify,
    validate,
)
from nlsid_core.trajectory import Dataset, Trajectory

Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class Identified:
    """A fit with the data it was made and scored on, and the files written."""

    fit: AnyFit
    train: Dataset
    test: Dataset
    files: tuple[Path, ...]


def identify_bags(
    bags: Sequence[Path], config: Config, out: Path, *, progress: Progress
) -> Identified:
    """Bags in; model.json, model.proof.json, training.npz and report.html in `out`.

    Raises DataError (BagError for bags) before anything is written.
    """
    train, test = read_split(
        bags, config, progress=lambda what, fraction: progress(what, 0.5 * fraction)
    )
    fit = identify(
        train,
        config.identification.model_class,
        method=config.identification.method,
        test=test,
        iterations=config.identification.iterations,
        progress=lambda what, fraction: progress(what, 0.5 + 0.4 * fraction),
    )
    out.mkdir(parents=True, exist_ok=True)
    training = out / documents.TRAINING
    model: Model = replace(fit.model, training=save_training(training, train))
    _json.write_document(out / documents.MODEL, model.document())
    proof = fit.proof.document(model, documents.MODEL)
    _json.write_document(out / documents.MODEL_PROOF, proof)
    files = [out / documents.MODEL, out / documents.MODEL_PROOF, training]
    progress("drawing the report", 0.9)
    if report_available():
        files.append(out / documents.REPORT)
        write_report(files[-1], fit, train, test, robot=config.robot)
    progress("done", 1.0)
    return Identified(fit, train, test, tuple(files))


@dataclass(frozen=True, eq=False)
class Compared:
    """Every method's candidate with its scores on the test trials."""

    rows: tuple[tuple[AnyCandidate, Validation], ...]
    test: Dataset


def compare_bags(
    bags: Sequence[Path], config: Config, lags: Sequence[int], *, progress: Progress
) -> Compared:
    """Every method of the configured model class at each number of lags, on the same test trials.

    Writes nothing. Raises DataError as `identify_bags` does.
    """
    train, test = read_split(
        bags, config, progress=lambda what, fraction: progress(what, 0.3 * fraction)
    )
    options = config.identification
    rows: list[tuple[AnyCandidate, Validation]] = []
    for number, n in enumerate(lags):
        model_class = options.model_copy(update={"lags": n}).model_class
        affine = options.model == "state_affine" and options.lagged_degree == 0
        certifiable = affine and options.leading_degree <= 2
        fit = identify(
            train,
            model_class,
            method="rse_certified" if certifiable else "rse",
            iterations=options.iterations,
            allow_unproved=True,
            progress=lambda what, fraction, done=number: progress(
                what, 0.3 + 0.7 * (done + fraction) / len(lags)
            ),
        )
        rows += [(candidate, validate(candidate.model, test)) for candidate in fit.candidates]
    return Compared(tuple(rows), test)


def read_split(
    bags: Sequence[Path], config: Config, *, progress: Progress
) -> tuple[Dataset, Dataset]:
    """(training, test) trials of the configured signals on the configured grid."""
    response, excitation = config.signals.response, config.signals.excitation
    dataset = read_dataset(
        bags,
        responses=[response.path],
        excitations=[excitation.path],
        period=config.grid.period,
        max_gap=config.grid.max_gap,
        progress=lambda done, total: progress("reading bags", done / total),
    )
    labelled = _labelled(dataset, response, excitation)
    if config.split.share is not None:
        return cut(labelled, config.split.share)
    return split(labelled, config.split.test)


def _labelled(dataset: Dataset, response: SignalConfig, excitation: SignalConfig) -> Dataset:
    """The same trials with the configured names, units and paths on their signals."""
    labels: dict[str, tuple[str, ...]] = {}
    for letter, signal in (("y", response), ("u", excitation)):
        labels[f"{letter}_names"] = (signal.name,)
        labels[f"{letter}_units"] = (signal.unit,)
        labels[f"{letter}_paths"] = (signal.path,)
    return Dataset(tuple(replace(trial, **labels) for trial in dataset))  # type: ignore[arg-type]


def split(dataset: Dataset, test: Sequence[str]) -> tuple[Dataset, Dataset]:
    """(training, test) trials by name; DataError if either would be empty."""
    present = [name for name in test if name in dataset.names]
    if not present:
        raise DataError(
            "none of the bags is a test trial, so no model can be scored; split.test names "
            f"{', '.join(test) or 'nothing'}, the bags are {', '.join(dataset.names)}"
        )
    if len(present) == len(dataset):
        raise DataError("all of the bags are test trials; give some to train on")
    return dataset.without(present), dataset.select(present)


def cut(dataset: Dataset, share: float) -> tuple[Dataset, Dataset]:
    """(training, test): every trial's start, and the `share` of it at its end."""
    parts: tuple[list[Trajectory], list[Trajectory]] = ([], [])
    for trial in dataset:
        count = round(share * len(trial.t))
        if not 2 <= count <= len(trial.t) - 2:
            raise DataError(
                f"{trial.name}: {share:g} of {len(trial.t)} samples, at least 2 of each"
            )
        for part, rows in zip(parts, (slice(None, -count), slice(-count, None)), strict=True):
            y, u = trial.y[rows], trial.u[rows]
            part.append(replace(trial, t=trial.t[: len(y)], y=y, u=u))
    return Dataset(tuple(parts[0])), Dataset(tuple(parts[1]))


def design_funnel_files(model_path: Path, config: Config, out: Path) -> TubeDesign:
    """A model file in; policy.json, funnel.json, funnel.proof.json (and model.json) in `out`.

    The disturbance is measured on training.npz beside the model. Raises DataError or Infeasible.
    """
    model = documents.load_model(model_path)
    train = load_training(model_path.with_name(documents.TRAINING), digest=model.training)
    options = config.funnel
    weights = options.policy
    design = design_tube(
        model,
        train,
        profile=options.profile,
        horizon=options.horizon,
        safety_factor=options.safety_factor,
        inlet=options.inlet,
        lqr_weights=None if weights is None else (weights.output_weight, weights.input_weight),
    )
    proof = design.proof_document(
        model=documents.MODEL, policy=documents.POLICY, funnel=documents.FUNNEL
    )
    out.mkdir(parents=True, exist_ok=True)
    for name, document in (
        (documents.MODEL, model.document()),
        (documents.POLICY, design.policy.document()),
        (documents.FUNNEL, design.funnel.document()),
        (documents.FUNNEL_PROOF, proof),
    ):
        target = out / name
        if target.resolve() != model_path.resolve():
            _json.write_document(target, document)
    return design
