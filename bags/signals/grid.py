"""Recorded signals as trajectories on one time grid, by the rules of `bags.signals.sampling`."""

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Final

import numpy as np

from bags.recordings.bag import Bag
from bags.recordings.definitions import Definition
from bags.recordings.folders import trial_name
from bags.recordings.remote import place
from bags.signals.expressions import Expression, factors, product
from bags.signals.reader import (
    HEADER_STAMP,
    LOG_TIME,
    Samples,
    SamplesError,
    bag_origin,
    read_signals,
    stamp_text,
)
from bags.signals.sampling import (
    BRIDGED,
    LOST,
    MOST_FILLED,
    Grid,
    Sample,
    Sampler,
    held_values,
    one_clock,
)
from bags.signals.timing import seconds
from nlsid_core.arrays import FloatArray, IntArray, Json
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import BagError, DataError, apart
from nlsid_core.files import canonical
from nlsid_core.progress import Progress, silent
from nlsid_core.running.grid import OTHER_PACE
from nlsid_core.running.grid import TOLERANCE as GRID_TOLERANCE

PERIOD_TOLERANCE: Final = 0.05  # relative: a robot's rate and the one its configuration states
ON_A_GRID = "give grid.period the mean step of the samples, or set grid.resample to linear"
FEW: Final = 0.01  # of the samples, left out at the ends: nobody needs to hear of it
TOGETHER: Final = 64  # numbers that a sampler takes before it is asked for samples
MIN_STRETCH: Final = 4  # samples between gaps; fewer say nothing of the dynamics
REPEAT_GROUP: Final = "repeat_group"  # the custom datum that names the excitation a bag repeats

log = logging.getLogger(__name__)


def to_trajectories(
    responses: Sequence[Samples],
    excitations: Sequence[Samples | Sequence[Samples]],
    grid: Grid,
    *,
    name: str = "signals",
) -> list[Trajectory]:
    """Put signals on a uniform grid by the rules of `bags.signals.sampling`, t = 0 at the first.

    Responses that are samples as they come are used as they are, one on each point of the grid,
    where they follow each other in a period give or take GRID_TOLERANCE, as the monitor takes
    them; a point without one, in a gap of at most `max_gap`, is filled in on the line between its
    neighbours. A command without a limit of its own, `|hold(T s)`, gets one of `max_gap`, which
    its path says from then on. Samples that are filled in, here or by the rule of
    `bags.signals.sampling`, are counted: `filled` in the provenance, `filled_samples`. Samples
    without every signal are left out at the start and the end, and logged if they are more than
    FEW.

    Args:
        responses: signals whose paths say how they are sampled (`Grid.path`).
        excitations: likewise; of several samples one is their product.
        grid: period, max_gap and split_gaps are used.
        name: of the trajectories, with a number behind it where there are several.

    Returns:
        One trajectory, or with `split_gaps` one for each stretch without a gap.

    Raises:
        DataError: says where, if stamps repeat, a gap is too long, a response that is not
            resampled is not sampled at the period, or fewer than two samples are left.
    """
    parts = [(e,) if isinstance(e, Samples) else tuple(e) for e in excitations]
    drives = [samples for part in parts for samples in part]
    if not responses or not excitations:
        raise DataError(f"{name}: needs at least one response and one excitation")
    for samples in responses:
        _refuse_repeated_stamps(samples, name)
    signals = [Expression.parse(samples.path) for samples in responses]
    where = f"{name}: {responses[0].path}"
    period_ns = _period_ns(
        responses[0].stamp_ns,
        grid.period,
        where,
        on_grid=signals[0].operation("hold", "linear") is not None,
    )
    gap_ns = round(BRIDGED * period_ns if grid.max_gap is None else grid.max_gap * 1e9)
    rules = [[Expression.parse(samples.path) for samples in part] for part in parts]
    held = [product(str(r.sampled("hold", window=gap_ns / 1e9)) for r in part) for part in rules]
    sampler = Sampler(list(map(str, signals)), held, period=period_ns / 1e9)
    found = [
        sample for sample in _sampled(sampler, [*responses, *drives]) if sample.missing != LOST
    ]
    complete = [k for k, sample in enumerate(found) if not sample.missing]
    if len(complete) < 2:
        raise DataError(_no_overlap(name, responses, drives, len(complete)))
    last = complete[-1]
    left_out = sampler.incomplete + len(found) - last - 1
    if left_out > FEW * len(complete) and not grid.split_gaps:
        log.warning(
            "%s: %d of %d samples left out, where a signal is missing at the start or the end",
            name,
            left_out,
            sampler.incomplete + len(found),
        )
    runs = [found[: last + 1]]
    if grid.split_gaps:
        runs = [run for run in _whole_runs(runs[0], gap_ns) if len(run) >= MIN_STRETCH]
        if not runs:
            raise DataError(f"{name}: no stretch of {MIN_STRETCH} samples without a gap")
    y_paths = tuple(samples.path for samples in responses)
    trials = []
    for k, run in enumerate(runs, start=1):
        if wrong := [sample for sample in run if sample.missing]:
            raise DataError(
                f"{name}: {wrong[0].missing}, at {stamp_text(wrong[0].stamp_ns)} "
                f"({len(wrong)} of {len(run)} samples are not complete); "
                "split_gaps leaves out such stretches"
            )
        y, u, counted = _numbers(run, sampler, parts, gap_ns, name)
        t = seconds(period_ns * np.arange(len(y)), 0)
        said = {what: count for what, count in counted.items() if count}
        trials.append(
            Trajectory(
                t=t,
                y=y,
                u=u,
                name=name if len(runs) == 1 else f"{name}.{k}",
                provenance=canonical(said).decode() if said else "",
                y_names=y_paths,
                u_names=tuple(product(samples.path for samples in part) for part in parts),
                y_units=tuple(samples.unit for samples in responses),
                u_units=tuple(part[0].unit if len(part) == 1 else "" for part in parts),
                y_paths=y_paths,
                u_paths=tuple(held),
            )
        )
    return trials


def _sampled(sampler: Sampler, signals: Sequence[Samples]) -> Iterator[Sample]:
    """What the sampler gives for a whole recording, fed in the order of the stamps.

    Of equal stamps the excitations come first, as the latest command at a stamp counts. On a grid
    it is asked after every number: over a long gap the grid leaps as far as is known by then.
    """
    which = np.repeat(np.arange(len(signals)), [len(samples) for samples in signals])
    stamps = np.concatenate([samples.stamp_ns for samples in signals])
    values = np.concatenate([samples.values for samples in signals])
    order = np.lexsort((-which, stamps))
    columns = (which[order].tolist(), stamps[order].tolist(), values[order].tolist())
    for k, (signal, stamp_ns, value) in enumerate(zip(*columns, strict=True), start=1):
        if sampler.on_grid or k % TOGETHER == 0:
            yield from sampler.feed(signal, stamp_ns, value)
        else:
            sampler.add(signal, stamp_ns, value)
    yield from sampler.flush()


def _whole_runs(found: Sequence[Sample], gap_ns: int) -> Iterator[list[Sample]]:
    """Runs of samples with every signal and with at most `gap_ns` between neighbours."""
    run: list[Sample] = []
    for sample in found:
        if sample.missing or (run and sample.stamp_ns - run[-1].stamp_ns > gap_ns):
            if run:
                yield run
            run = []
        if not sample.missing:
            run.append(sample)
    if run:
        yield run


def _numbers(
    run: Sequence[Sample],
    sampler: Sampler,
    drives: Sequence[Sequence[Samples]],
    gap_ns: int,
    label: str,
) -> tuple[FloatArray, FloatArray, dict[str, int]]:
    """Responses and excitations (N, ...) of complete samples; how many were filled in, and how
    often a monitor begins a new run.
    """
    stamps = np.array([sample.stamp_ns for sample in run], dtype=np.int64)
    y = np.array([sample.y for sample in run])
    u = np.array([sample.u for sample in run])
    if sampler.on_grid:
        return y, u, {"filled": sum(bool(sample.filled) for sample in run)}
    period_ns, where = sampler.period_ns, f"{label}: {sampler.responses[0]}"
    _refuse_gaps(stamps, gap_ns, where)
    points = _points(stamps, period_ns, where)
    grid = np.arange(points[-1][0] + 1)
    at, rows = (np.array(column) for column in zip(*points, strict=True))
    restarts = _restarts(stamps[rows], at, period_ns)
    y = np.column_stack([np.interp(grid, at, column) for column in y[rows].T])
    if len(grid) == len(rows):
        return y, u[rows], {"restarts": restarts}
    before = np.searchsorted(at, grid, side="right") - 1
    at_ns = stamps[rows[before]] + period_ns * (grid - at[before])
    u = np.ones((len(grid), len(drives)))
    for column, part, rules in zip(u.T, drives, sampler.excitations, strict=True):
        for samples, signal in zip(part, rules, strict=True):
            column *= held_values(
                signal, samples.stamp_ns.tolist(), samples.values.tolist(), at_ns.tolist()
            )
    return y, u, {"filled": len(grid) - len(rows), "restarts": restarts}


def _points(stamps: IntArray, period_ns: int, where: str) -> list[tuple[int, int]]:
    """(point of the grid, sample on it); the grid follows the samples, other than a monitor's.

    A sample more than GRID_TOLERANCE periods off the grid from the last one is on no point.
    DataError if that leaves more than MOST_FILLED of the points empty.
    """
    points = [(0, 0)]
    worst, last_ns = 0.0, int(stamps[0])
    for row, stamp_ns in enumerate(stamps.tolist()):
        steps = (stamp_ns - last_ns) / period_ns
        whole = round(steps)
        if whole < 1 or abs(steps - whole) > GRID_TOLERANCE:
            worst = max(worst, abs(steps - max(whole, 1))) if row else 0.0
            continue
        points.append((points[-1][0] + whole, row))
        last_ns = stamp_ns
    empty = 1 + points[-1][0] - len(points)
    off = len(stamps) - len(points)
    if off and max(empty, off) > MOST_FILLED * (1 + points[-1][0]):
        raise DataError(
            f"{where}: {off} of {len(stamps)} samples are up to {100 * worst:.0f} % of a period "
            f"off a grid of {period_ns / 1e9:g} s; set grid.resample to linear or last"
        )
    return points


def _no_overlap(
    label: str, responses: Sequence[Samples], excitations: Sequence[Samples], complete: int
) -> str:
    signals = [*responses, *excitations]
    first = max(int(samples.stamp_ns[0]) for samples in signals)
    last = min(int(samples.stamp_ns[-1]) for samples in signals)
    said = (
        f"{label}: responses and excitations overlap in {complete} samples; the first common "
        f"stamp is {stamp_text(first)}, the last {stamp_text(last)}"
    )
    if len({samples.path.partition(":")[0] for samples in responses}) > 1:
        said += "; responses on several topics need one stamp each sample, or grid.resample"
    return said


def read_dataset(
    bags: Sequence[Path | str] | Mapping[str, Path | str],
    *,
    responses: Sequence[str],
    excitations: Sequence[str],
    grid: Grid | None = None,
    definitions: Mapping[str, Definition] | None = None,
    progress: Progress = silent,
) -> Dataset:
    """Read signals of several bags as trajectories, one a bag.

    A trajectory has the bag's digest, and as group its custom datum `repeat_group`. Its provenance
    is the bag's digest, files and custom data, the signals and the rules.

    Args:
        bags: where they are; by the trajectories' names, which are else those of the bags.
        responses: their texts (see `bags.signals.expressions`).
        excitations: likewise.
        grid: how messages become samples (None: samples as they come, none missing). The rules are
            written into the signals' paths, so that a model knows how its samples are made. With
            `split_gaps` the stretches of a bag are `name.1`, `name.2`, ...; they are no repeats,
            and `skipped_samples` counts what is in none of them.
        definitions: of message types that the bags do not define (`bags.recordings.definitions`).
        progress: told after each bag.

    Returns:
        The trajectories, in the order of the bags.

    Raises:
        BagError: as `read_signals`.
        DataError: as `to_trajectories` and `Dataset`.
    """
    named = bags if isinstance(bags, Mapping) else _named(list(map(place, bags)))
    signals = {"responses": list(responses), "excitations": list(excitations)}
    trajectories: list[Trajectory] = []
    for done, (name, path) in enumerate(named.items(), start=1):
        with Bag(path, definitions=definitions) as bag:
            trajectories += _read_trials(bag, name, signals, grid or Grid())
        progress("reading bags", done / len(named))
    return Dataset(tuple(trajectories))


def _named(paths: Sequence[Path]) -> dict[str, Path]:
    """The bags by their names; DataError for two of one name."""
    found: dict[str, Path] = {}
    for path in paths:
        first = found.setdefault(trial_name(path), path)
        if first is not path:
            raise DataError(
                f"two bags are called '{trial_name(path)}': {first} and {path}; trials are told "
                "apart by name (with --workers 1 `nlsid identify` takes their folders into the "
                "name)"
            )
    return found


def _read_trials(
    bag: Bag, name: str, signals: Mapping[str, list[str]], grid: Grid
) -> list[Trajectory]:
    """The trajectories of one bag."""
    texts = {
        role: [grid.path(text, response=role == "responses") for text in paths]
        for role, paths in signals.items()
    }
    parts = [part for paths in texts.values() for text in paths for part in factors(text)]
    parts = list(dict.fromkeys(parts))
    if several := [text for text in parts if Expression.parse(text).path.every]:
        raise BagError(f"{several[0]} is several signals; name one element of it for each")
    wanted = one_clock([Expression.parse(text) for text in parts])
    read = read_signals(bag, parts, gaps_in=texts["responses"] if grid.split_gaps else ())
    _refuse_other_clocks(bag.path, read, wanted)
    for text, samples in read.items():
        if doubt := samples.doubt(responds=text in texts["responses"]):
            raise SamplesError(f"{bag.path}: {doubt}; record it again with one of them")
    measured = [read[text] for text in texts["responses"]]
    drives = [[read[part] for part in factors(text)] for text in texts["excitations"]]
    trials = to_trajectories(measured, drives, grid, name=name)
    origin = bag_origin(bag)
    said: Json = {"bag": origin, "signals": dict(signals), "grid": asdict(grid)}
    if grid.split_gaps:
        base = measured[0].stamp_ns
        span = seconds(int(base[-1]), int(base[0]))
        said["skipped"] = 1 + round(span / trials[0].period) - sum(map(len, trials))
    return [
        replace(
            trial,
            group=origin["custom"].get(REPEAT_GROUP, "") if len(trials) == 1 else "",
            digest=origin["digest"],
            provenance=canonical(said | json.loads(trial.provenance or "{}")).decode(),
        )
        for trial in trials
    ]


def _refuse_other_clocks(path: Path, read: Mapping[str, Samples], wanted: str) -> None:
    """BagError if a signal has no stamps of the clock that is wanted for all of them."""
    clock = HEADER_STAMP if wanted == "header" else LOG_TIME
    if all(samples.clock == clock for samples in read.values()):
        return
    said = "; ".join(f"{text} has a {samples.clock}" for text, samples in read.items())
    raise BagError(
        f"{path}: not every signal has a {clock}, and times of two clocks cannot be paired: "
        f"{said}; set `clock: log` to pair all of them by the times at which they were logged"
    )


def skipped_samples(dataset: Dataset) -> int:
    """How many samples `split_gaps` left out of the bags of `dataset`."""
    read = {trial.digest: json.loads(trial.provenance or "{}") for trial in dataset}
    return sum(int(bag.get("skipped", 0)) for bag in read.values())


def filled_samples(dataset: Dataset) -> int:
    """How many samples of `dataset` were not measured but filled in between others."""
    return sum(json.loads(trial.provenance or "{}").get("filled", 0) for trial in dataset)


def _restarts(stamp_ns: IntArray, points: IntArray, period_ns: int) -> int:
    """How often a monitor begins a new run with samples that are on these points of the grid.

    It holds every stamp against the start of its run, and their mean step against the period: where
    that is another, it begins again at each.
    """
    mean = (stamp_ns[-1] - stamp_ns[0]) / max(points[-1] - points[0], 1)
    if abs(mean - period_ns) > OTHER_PACE * period_ns:
        return len(points)
    count, start = 0, 0
    for k in range(len(points)):
        due = stamp_ns[start] + (points[k] - points[start]) * period_ns
        if abs(int(stamp_ns[k] - due)) > GRID_TOLERANCE * period_ns:
            count, start = count + 1, k
    return count


def restarts_in(trial: Trajectory) -> int:
    """How often a monitor begins a new run in it, as its stamps stray from the grid."""
    return int(json.loads(trial.provenance or "{}").get("restarts", 0))


def said_restarts(dataset: Dataset) -> list[str]:
    """Of each trial that a monitor would not judge as one run: that, and what to do."""
    return [
        f"{trial.name}: its stamps stray from a grid of {trial.period:g} s, so that a monitor "
        f"begins {count} new runs in it and judges it in pieces or not at all; {ON_A_GRID}"
        for trial in dataset
        if (count := restarts_in(trial))
    ]


def refuse_unjudgeable(dataset: Dataset, settling: int) -> None:
    """Raise DataError if most of such trials would be starts of runs, `settling` samples each."""
    samples = sum(map(len, dataset))
    lost = settling * sum(map(restarts_in, dataset))
    if lost > 0.5 * samples:
        raise DataError(
            f"a monitor would judge little of such trials: their stamps stray from a grid of "
            f"{dataset.period:g} s, and new runs take {min(lost, samples)} of {samples} samples to "
            f"start; {ON_A_GRID}"
        )


def _period_ns(stamp_ns: IntArray, period: float | None, label: str, *, on_grid: bool) -> int:
    if len(stamp_ns) < 2:
        raise DataError(f"{label} has {len(stamp_ns)} sample; a sample time needs two")
    median = float(np.median(np.diff(stamp_ns)))
    if period is None:
        return round(median)
    if not abs(median / 1e9 - period) <= PERIOD_TOLERANCE * period:
        said = f"{label} is sampled every {median / 1e9:g} s, asked for was {period:g} s"
        if not on_grid:
            raise DataError(
                f"{said}; state the period of this one, or set grid.resample to linear or last"
            )
        if not median / 1e9 <= period:
            raise DataError(f"{said}; no rule makes more samples than there are")
    return round(period * 1e9)


def _refuse_repeated_stamps(samples: Samples, label: str) -> None:
    if len(same := np.flatnonzero(np.diff(samples.stamp_ns) <= 0)):
        i = int(same[0])
        raise DataError(
            f"{label}: {samples.path}: messages {i} and {i + 1} have the same stamp "
            f"{stamp_text(int(samples.stamp_ns[i]))} ({len(same)} such pairs); is the topic "
            "published twice?"
        )


def _refuse_gaps(stamp_ns: IntArray, gap_ns: int, where: str) -> None:
    steps = np.diff(stamp_ns)
    if len(wide := np.flatnonzero(steps > gap_ns)):
        worst = int(wide[np.argmax(steps[wide])])
        gap, most = apart(float(steps[worst]) / 1e9, gap_ns / 1e9)
        raise DataError(
            f"{where}: a gap of {gap} s after sample {worst} at "
            f"{stamp_text(int(stamp_ns[worst]))}; at most {most} s was asked for "
            f"({len(wide)} such {'gap' if len(wide) == 1 else 'gaps'}); split_gaps leaves them out"
        )
