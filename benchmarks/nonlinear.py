"""Public data sets: the best proved model of all classes, beside comparators and published figures.

python -m benchmarks.nonlinear --data DIR [--json] [--limit S] [--out FILE] [NAME ...]

DIR holds exchanger, wh2009, emps, kuka_kr300, schunk_arm, f1tenth and dart. One ladder of classes
and methods serves every set, those for one input and output where a set has one of each. What is
best is chosen among the models with a proof. Training and validation data are cut into three equal
parts, and each is simulated by a model of the others, which no choice of the search has seen: the
cross-validated error. The same three models are simulated over the recorded inputs played at twice
their speed, where nothing was measured; how far they are apart there is what the data leave open.
The class with the least root of the sum of both squares is taken. It is tried with one lag more
while that makes the sum less, fitted again to all data, and simulated once over the test data.
Trials are as the owners divide them; where they name no validation data it is the end, or every
third, of the training data. Least squares are chosen in the same way. On sets of more than
`SAMPLES` training samples the choice is made on that many, and fitted to all.

A set takes at most --limit of processor time: a candidate that is not judged in `SHARE` of it, or
that no time is left for, is listed as not tried. What is known of each set is printed, and written
to --out, when it is known.
"""

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import recorded
from benchmarks.limits import OutOfTimeError, stopped_after
from benchmarks.machine import parser, tell
from benchmarks.recorded import block_means, single
from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import NlsidError
from nlsid_core.identification import (
    CellRow,
    Degrees,
    Feedback,
    FilterMapFilter,
    Fit,
    LeastSquares,
    Method,
    Network,
    Polynomial,
    Rse,
    Sem,
    describe,
    identify,
)
from nlsid_core.identification.network.options import Limit
from nlsid_core.identification.prediction import simulate_trials

SAMPLES = 10_000
STEPS = 15  # of an iterated search
FOLDS = 3
ORDERS = (2, 4)
FASTER = 2  # times the recorded speed, at which models of the parts are compared
MOST_LONGER = 4  # lags more than the ladder's
LIMIT = 900.0  # s of processor time for one set
SHARE = 0.2  # of it for one candidate
KEPT = 0.3  # of it for fitting what was chosen to all data
PERCENT = "%"
Simulator = Callable[[Dataset], list[FloatArray]]


@dataclass(frozen=True, eq=False)
class PublicSet:
    """How one set is divided and scored.

    unit: of the score, the root mean square over all outputs and scored samples; "%" is that of
    the test outputs' spread. skipped: samples at the start of each trial that are not scored.
    published: figures with their sources. integrated: the score is of the sum of the output times
    the sample time, from the measured start. factor: from the output's unit to the score's.
    """

    name: str
    folder: str
    load: Callable[[Path], tuple[Dataset, Dataset, Dataset]]
    unit: str
    published: dict[str, float]
    skipped: int = 0
    integrated: bool = False
    factor: float = 1.0

    def score(self, outputs: Sequence[FloatArray], data: Dataset, *, skipped: int) -> float:
        """The error of simulated outputs (N, n_y), the first `skipped` samples left out."""
        left, measured = [], []
        for trial, simulated in zip(data, outputs, strict=True):
            error = simulated - trial.y
            if self.integrated:
                error = np.cumsum(np.where(np.arange(len(error)) >= skipped, error[:, 0], 0.0))
                error = data.period * error[:, None]
            left.append(error[skipped:])
            measured.append(trial.y[skipped:])
        with np.errstate(over="ignore", invalid="ignore"):
            rms = float(np.sqrt(np.mean(np.square(np.concatenate(left)))))
        spread = float(np.std(np.concatenate(measured)))
        scaled = 100.0 * rms / spread if self.unit == PERCENT else self.factor * rms
        return scaled if np.isfinite(scaled) else float("inf")


def exchanger(folder: Path) -> tuple[Dataset, Dataset, Dataset]:
    """The first 1500 of 4000 samples, of them the last 500 to choose; scored on all."""
    flow, temperature = recorded.heat_exchanger(folder)
    parts = (slice(0, 1000), slice(1000, 1500), slice(0, 4000))
    train, validation, test = (single(f"{p}", flow[p], temperature[p], 1.0) for p in parts)
    return train, validation, test


def wh2009(folder: Path) -> tuple[Dataset, Dataset, Dataset]:
    """Samples 5001-80000, 80001-100000, and the official test samples 105201-184000."""
    u, y = recorded.wiener_hammerstein(folder)
    parts = (slice(5000, 80_000), slice(80_000, 100_000), slice(105_200, 184_000))
    train, validation, test = (single(f"{p}", u[p], y[p], 1 / 51_200) for p in parts)
    return train, validation, test


def emps(folder: Path) -> tuple[Dataset, Dataset, Dataset]:
    """Motor voltage to the velocity of the slide at 100 Hz; the pulses are the test."""
    trials = []
    for name in ("DATA_EMPS", "DATA_EMPS_PULSES"):
        table = recorded.emps(folder, name)
        q, vir = table["qm"][::10], table["vir"]
        voltage = vir[: len(vir) // 10 * 10].reshape(-1, 10).mean(axis=1)
        velocity = np.diff(q)[: len(voltage)] / 0.01  # what the sum of gives the position again
        trials.append((voltage[: len(velocity)], velocity))
    (u, y), (u_test, y_test) = trials
    cut = 2 * len(u) // 3
    return (
        single("start", u[:cut], y[:cut], 0.01),
        single("end", u[cut:], y[cut:], 0.01),
        single("pulses", u_test, y_test, 0.01),
    )


def kuka_first(folder: Path) -> tuple[Dataset, Dataset, Dataset]:
    """The first joint's torque to velocity: trajectory A, B to choose, C to test."""
    signals = ("act_torque_abs_nm", "act_vel_mot_deg_per_s")
    first, second, test = (
        Dataset((block_means(torque[0], np.deg2rad(velocity[0]), 4e-3, 2, letter),))
        for letter, (torque, velocity) in recorded.kuka(folder, signals).items()
    )
    return first, second, test


def schunk_first(folder: Path) -> tuple[Dataset, Dataset, Dataset]:
    """The first joint: every third of trials 1-80 to choose, 81-100 to test."""
    trials = [
        block_means(u[:, 0], y[:, 0], 4e-3, 2, str(number))
        for number, (u, y) in recorded.schunk(folder, range(1, 101)).items()
    ]
    chosen = trials[2:80:3]
    train = [trial for trial in trials[:80] if trial not in chosen]
    return Dataset(tuple(train)), Dataset(tuple(chosen)), Dataset(tuple(trials[80:]))


def f1tenth(folder: Path) -> tuple[Dataset, Dataset, Dataset]:
    """Commanded to measured speed; the test trials of the shipped configuration."""
    trials = {
        number: Trajectory(t=0.025 * np.arange(len(u)), y=motion[:, 3], u=u[:, 1], name=str(number))
        for number, (u, motion) in recorded.f1tenth_car(folder).items()
    }
    test = [5, 11, 16, 22, 27, 33, 38, 41]
    rest = [number for number in trials if number not in test]
    parts = (rest[0::3] + rest[1::3], rest[2::3], test)
    train, validation, tests = (Dataset(tuple(trials[k] for k in part)) for part in parts)
    return train, validation, tests


def dart(folder: Path) -> tuple[Dataset, Dataset, Dataset]:
    """Steering times speed, and speed, to the yaw rate at 20 Hz on the rubbery floor."""
    trials = []
    for name, drive in recorded.dart(folder).items():
        at = drive["vicon_time"] - drive["vicon_time"][0]
        t = np.arange(0.2, at[-1] - 0.2, 0.05)
        pose = [drive["vicon_x"], drive["vicon_y"], np.unwrap(drive["vicon_yaw"])]
        moved = [np.interp(t + 0.1, at, c) - np.interp(t - 0.1, at, c) for c in pose]
        speed = np.hypot(moved[0], moved[1]) / 0.2
        u = np.column_stack([np.interp(t - 0.1, at, drive["steering"]) * speed, speed])
        trials.append(Trajectory(t=t, y=moved[2] / 0.2, u=u, name=name))
    parts = [Dataset(tuple(trials[k::3])) for k in range(3)]
    return parts[0], parts[1], parts[2]


SETS = (
    PublicSet(
        "exchanger",
        "exchanger",
        exchanger,
        PERCENT,
        {
            "thesis, 5th iterate, 2 lags": 13.7,
            "3 lags": 11.4,
            "4 lags": 9.7,
            "nlarx": 26.4,
        },
    ),
    PublicSet(
        "wh2009",
        "wh2009",
        wh2009,
        "mV",
        {
            "SUBNET": 0.241,
            "block cascades": 0.28,
            "PNLSS": 0.42,
        },
        skipped=50,
        factor=1e3,
    ),
    PublicSet("EMPS", "emps", emps, "mm", {"lowest read": 2.64}, integrated=True, factor=1e3),
    PublicSet("KUKA, joint 1", "kuka_kr300", kuka_first, "rad/s", {}),
    PublicSet("Schunk, joint 1", "schunk_arm", schunk_first, "rad/s", {}),
    PublicSet("F1TENTH speed", "f1tenth", f1tenth, PERCENT, {}),
    PublicSet("DART yaw rate", "dart", dart, "rad/s", {}),
)


def ladder(data: Dataset) -> Iterator[tuple[Any, Method]]:
    """Classes with the methods whose models are proved, for signals like these."""
    first = data.trajectories[0]
    one = first.y.shape[1] == first.u.shape[1] == 1
    certified = Sem(STEPS, certified=True)
    for lags in ORDERS:
        if one:
            yield Polynomial(lags), certified
        yield Polynomial(lags, degrees=Degrees(inputs=2)), Rse(STEPS)
        yield Polynomial(lags, degrees=Degrees(inputs=2, leading=1)), certified
        if first.y.shape[1] == 1:
            yield Polynomial(lags, degrees=Degrees(left=3)), certified
        curved = Degrees(left=3, inputs=3)
        yield Polynomial(lags, degrees=curved), certified
        # Where commands change rarely only one delay is excited.
        yield Polynomial(lags, (1,), Degrees(inputs=3, leading=1)), certified
        yield Polynomial(lags, (1,), curved), certified
        if one:
            yield Polynomial(lags, degrees=Degrees(inputs=3, leading=2)), certified
            half = (lags + 1) // 2
            filters = FilterMapFilter((half, lags - half), phases=(1,), intervals=(8, 16))
            yield Network(filters), certified
    if first.y.shape[1] == 1:
        limits: tuple[Limit, ...] = ("top", "friction", "none")
        for cells, limit in product((1, 2), limits):
            yield Network(CellRow(cells, intervals=4, limit=limit)), certified
        for lags in ORDERS:
            yield Network(Feedback(lags)), certified
    if one:
        yield (
            Network(FilterMapFilter((3, 3), phases=(1, 2, 3), intervals=(12, 24, 48))),
            certified,
        )


@dataclass(frozen=True, eq=False)
class Best:
    """What a search chose, in words, how it was judged, and its test error."""

    what: str
    validation: float
    test: float


@dataclass(eq=False)
class Budget:
    """Processor time of one set. refused: candidates that were not tried, and why."""

    limit: float
    started: float
    refused: list[str]

    def left(self, kept: float) -> float:
        """Seconds that are left, a share of the limit kept back."""
        return self.limit * (1.0 - kept) - (time.process_time() - self.started)


def best_of(
    case: PublicSet,
    candidates: Sequence[tuple[Any, Method]],
    data: tuple[Dataset, ...],
    budget: Budget,
    *,
    proved: bool,
) -> Best | None:
    """The candidate that is judged best, fitted again and tested."""
    train, validation, test = data
    both = Dataset((*train.trajectories, *validation.trajectories))

    def judged(model_class: Any, method: Method) -> float:
        def simulator(few: Dataset) -> Simulator:
            model = fitted(case, few, model_class, method, proved=proved).model
            return lambda trials: simulate_trials(model, trials.trajectories)

        return judge(case, simulator, both, budget, describe(model_class))

    found = [(judged(*one), *one) for one in candidates]
    best, model_class, method = min(found, key=lambda entry: entry[0])
    for _ in range(MOST_LONGER):
        if not np.isfinite(best) or not hasattr(model_class, "lags"):
            break
        model_class = replace(model_class, lags=model_class.lags + 1)
        found.append((judged(model_class, method), model_class, method))
        if found[-1][0] >= best:
            break
        best = found[-1][0]
    for error, model_class, method in sorted(found, key=lambda entry: entry[0]):
        if not np.isfinite(error):
            break
        try:
            with stopped_after(max(budget.left(0.0), 1.0)):
                fit = fitted(case, both, model_class, method, proved=proved)
        except (NlsidError, OutOfTimeError) as reason:
            budget.refused.append(f"{describe(model_class)}, fitted to all data: {reason}")
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            outputs = simulate_trials(fit.model, test.trajectories)
        reached = case.score(outputs, test, skipped=case.skipped)
        return Best(f"{describe(model_class)}, {method.name}", error, reached)
    return None


def judge(
    case: PublicSet,
    simulator: Callable[[Dataset], Simulator],
    data: Dataset,
    budget: Budget,
    name: str,
) -> float:
    """Cross-validated error and disagreement as one, printed; infinite where there is no model."""
    started, least = time.process_time(), 1.0
    seconds = min(budget.left(KEPT), SHARE * budget.limit)
    try:
        if seconds < least:
            raise OutOfTimeError(f"the set's {budget.limit:g} s are used up")
        with stopped_after(seconds), np.errstate(over="ignore", invalid="ignore"):
            error, apart = crossed(case, simulator, data)
    except (NlsidError, ValueError, np.linalg.LinAlgError, OutOfTimeError) as reason:
        budget.refused.append(f"{name}: {reason}")
        print(f"    not tried: {name}: {str(reason)[:100]}", flush=True)
        return float("inf")
    used = time.process_time() - started
    print(f"    {error:10.4g} {apart:10.4g} {case.unit:6s}{used:7.1f} s  {name}", flush=True)
    return float(np.hypot(error, apart))


def crossed(
    case: PublicSet, simulator: Callable[[Dataset], Simulator], data: Dataset
) -> tuple[float, float]:
    """The error over all folds, each simulated by a model of the others' first SAMPLES samples;
    and how far these models are from their mean on the inputs at `FASTER` speed, rms.
    """
    parts = folds(data)
    faster = Dataset(
        tuple(
            replace(
                trial, t=trial.t[: len(trial.t[::FASTER])], y=trial.y[::FASTER], u=trial.u[::FASTER]
            )
            for trial in shortened(data)
        )
    )
    outputs: list[FloatArray] = []
    beyond: list[list[FloatArray]] = []
    for k, judged in enumerate(parts):
        others = Dataset(tuple(trial for part in parts[:k] + parts[k + 1 :] for trial in part))
        simulate = simulator(shortened(others))
        outputs += simulate(judged)
        beyond.append(simulate(faster))
    whole = Dataset(tuple(trial for part in parts for trial in part))
    mean = [np.mean(each, axis=0) for each in zip(*beyond, strict=True)]
    if not all(np.isfinite(y).all() for y in mean):
        return case.score(outputs, whole, skipped=case.skipped), float("inf")
    agreed = Dataset(tuple(replace(trial, y=y) for trial, y in zip(faster, mean, strict=True)))
    apart = [case.score(each, agreed, skipped=case.skipped) for each in beyond]
    error = case.score(outputs, whole, skipped=case.skipped)
    return error, float(np.sqrt(np.mean(np.square(apart))))


def folds(data: Dataset) -> list[Dataset]:
    """As many equal parts of the samples in their order, cut within a trial where one ends."""
    ends = np.linspace(0, sum(map(len, data)), FOLDS + 1).round().astype(int)
    parts: list[list[Trajectory]] = [[] for _ in range(FOLDS)]
    first = 0
    for trial in data:
        for part, start, end in zip(parts, ends, ends[1:], strict=False):
            rows = slice(max(start - first, 0), min(end - first, len(trial)))
            if rows.start < rows.stop:
                part.append(trial.rows(rows, f"{trial.name}[{rows.start}:{rows.stop}]"))
        first += len(trial)
    return [Dataset(tuple(part)) for part in parts]


def fitted(
    case: PublicSet, train: Dataset, model_class: Any, method: Method, *, proved: bool
) -> Fit[Any]:
    """A fit; NlsidError if there is none, or none with a proof where one is asked for."""
    return identify(
        train,
        model_class,
        method=method,
        comparators=(),
        transient=case.skipped,
        allow_unproved=not proved,
    )


def shortened(data: Dataset) -> Dataset:
    """The first SAMPLES samples."""
    kept, left = [], SAMPLES
    for trial in data:
        N = min(left, len(trial))
        if N > 0:
            kept.append(trial.rows(slice(N)))
        left -= N
    return Dataset(tuple(kept))


def measure(case: PublicSet, folder: Path, limit: float) -> dict[str, Any]:
    """The promised keys of one set."""
    started = time.process_time()
    data = case.load(folder / case.folder)
    linear = [(Polynomial(n), LeastSquares()) for n in ORDERS]
    budget = Budget(limit, started, [])
    naive = best_of(case, linear, data, budget, proved=False)
    ours = best_of(case, list(ladder(data[0])), data, budget, proved=True)
    return {
        "best_proved": None if ours is None else ours.test,
        "unit": case.unit,
        "least_squares": None if naive is None else naive.test,
        "published": case.published,
        "seconds": time.process_time() - started,
        "best": None if ours is None else ours.what,
        "validation": None if ours is None else ours.validation,
        "not_tried": budget.refused,
    }


def main() -> None:
    """Print the figures, and with --json one JSON object as the last line."""
    options = parser(__doc__, data=True)
    options.add_argument("--limit", type=float, default=LIMIT, help="s of processor time a set")
    options.add_argument("--out", type=Path, help="a file for the results, as they come")
    options.add_argument("names", nargs="*", help="parts of names; all by default")
    arguments = options.parse_args()
    wanted = [s for s in SETS if not arguments.names or any(n in s.name for n in arguments.names)]
    rows = {}
    for case in wanted:
        print(case.name, flush=True)
        if not (arguments.data / case.folder).is_dir():
            print(f"    no folder {case.folder}")
            continue
        rows[case.name] = measure(case, arguments.data, arguments.limit)
        if arguments.out is not None:
            files.write_atomically(arguments.out, (json.dumps(rows, indent=1) + "\n").encode())
    tell(rows, as_json=arguments.json)


if __name__ == "__main__":
    main()
