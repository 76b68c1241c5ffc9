"""Put recorded signals on one time grid: a response and the excitation that acted on it.

The rule, which `bags.signals.pairing` follows live: a response keeps its own stamp, and the
excitation of a sample is the latest command stamped at or before it (zero-order hold).
"""

import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final, overload

import numpy as np

from bags.signals.reader import Samples, bag_origin, read_signals, stamp_text
from bags.signals.timing import segments
from nlsid_core._json import canonical
from nlsid_core._types import FloatArray, IntArray, Json
from nlsid_core.errors import DataError
from nlsid_core.trajectory import Dataset, Trajectory

JITTER_TOLERANCE: Final = (
    0.05  # of the period: a loop's usual scatter; interpolating would filter it
)
DEFAULT_MAX_GAP: Final = 1.5  # periods: no sample may be missing
MIN_STRETCH: Final = 4  # samples between gaps; fewer say nothing of the dynamics
REPEAT_GROUP: Final = "repeat_group"  # the custom datum that names the excitation a bag repeats

log = logging.getLogger(__name__)


@overload
def seconds(stamp_ns: IntArray, origin_ns: int) -> FloatArray: ...
@overload
def seconds(stamp_ns: int, origin_ns: int) -> float: ...
def seconds(stamp_ns: IntArray | int, origin_ns: int) -> FloatArray | float:
    """Stamps in ns as float seconds after `origin_ns`: the one place where the unit changes.

    The difference is taken in integers and divided once, so equal stamps give equal seconds.
    """
    return (stamp_ns - origin_ns) / 1e9


def to_trajectory(
    responses: Sequence[Samples],
    excitations: Sequence[Samples],
    *,
    period: float | None = None,
    max_gap: float | None = None,
    tolerance: float = JITTER_TOLERANCE,
    name: str = "",
    group: str = "",
    digest: str = "",
    provenance: str = "",
) -> Trajectory:
    """One trajectory on the grid of the first response, t = 0 at its first sample.

    period: s (None: the median step of the first response). A response whose stamps all lie within
    `tolerance` periods of the grid, one on each point, is used as it is; any other is interpolated
    linearly between samples at most `max_gap` s apart (None: 1.5 periods, so none may be missing).
    A command is held for at most `max_gap` too. Responses before the first command or more than
    `max_gap` after the last are left out, and logged.

    Raises DataError, saying where, if stamps repeat, a gap is too long, the response is sampled at
    another period than asked for, or fewer than two samples are left.
    """
    label = name or "signals"
    if not responses or not excitations:
        raise DataError(f"{label}: needs at least one response and one excitation")
    for samples in responses:
        _refuse_repeated_stamps(samples, label)
    base = responses[0].stamp_ns
    period_ns = _period_ns(base, period, tolerance, f"{label}: {responses[0].path}")
    gap_ns = round(DEFAULT_MAX_GAP * period_ns if max_gap is None else max_gap * 1e9)
    for samples in responses:
        _refuse_gaps(samples, gap_ns, label)

    first = max(samples.stamp_ns[0] for samples in [*responses, *excitations])
    last = min(
        *(samples.stamp_ns[-1] for samples in responses),
        *(samples.stamp_ns[-1] + gap_ns for samples in excitations),
    )
    kept = base[(base >= first) & (base <= last)]
    if len(kept) < 2:
        raise DataError(
            f"{label}: responses and excitations overlap in {len(kept)} samples; the first common "
            f"stamp is {stamp_text(int(first))}, the last {stamp_text(int(last))}"
        )
    if len(kept) < len(base):
        log.warning(
            "%s: %d of %d samples left out, where a signal is missing at the start or the end",
            label,
            len(base) - len(kept),
            len(base),
        )
    origin = int(kept[0])
    grid = origin + period_ns * np.arange(1 + round((int(kept[-1]) - origin) / period_ns))
    on_grid = _on_grid(base, grid, period_ns, tolerance)
    if on_grid is None:
        grid = grid[grid <= kept[-1]]
    sampled_at = grid if on_grid is None else base[on_grid]
    return Trajectory(
        t=seconds(grid, origin),
        y=np.column_stack([_sample(s, grid, period_ns, tolerance) for s in responses]),
        u=np.column_stack([_hold(s, sampled_at, gap_ns, label) for s in excitations]),
        y_names=tuple(samples.path for samples in responses),
        u_names=tuple(samples.path for samples in excitations),
        y_units=tuple(samples.unit for samples in responses),
        u_units=tuple(samples.unit for samples in excitations),
        y_paths=tuple(samples.path for samples in responses),
        u_paths=tuple(samples.path for samples in excitations),
        name=name,
        group=group,
        digest=digest,
        provenance=provenance,
    )


def read_dataset(
    bags: Sequence[Path | str],
    *,
    responses: Sequence[str],
    excitations: Sequence[str],
    period: float | None = None,
    max_gap: float | None = None,
    tolerance: float = JITTER_TOLERANCE,
    clock: str | None = None,
    sort: bool = False,
    drop_duplicates: bool = False,
    split_gaps: bool = False,
    unfinished: bool = False,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Dataset:
    """The signals (see `bags.signals.expressions`) of several bags, one trajectory a bag.

    A trajectory has the bag's name and digest, and as group its custom datum `repeat_group`. Its
    provenance is the bag's digest, files and custom data, the signals and the options. For the grid
    see `to_trajectory`, for clock, sort, drop_duplicates and unfinished `read_signals`.

    split_gaps: a bag in which a response is missing, or NaN, for more than `max_gap` gives one
    trajectory per stretch without such a gap (`name.1`, `name.2`, ...) instead of an error; they
    are no repeats, and `skipped_samples` counts what is in none of them. executor: reads
    bags in parallel (threads, processes, a Dask client's executor). `progress(done, total)` is
    called after each bag. Raises BagError and DataError as `read_signals`, `to_trajectory` and
    `Dataset` do.
    """
    paths = [Path(bag) for bag in bags]
    names = [path.stem if path.is_file() else path.resolve().name for path in paths]
    if len(twice := {name for name in names if names.count(name) > 1}):
        raise DataError(f"two bags are called '{min(twice)}'; trials are told apart by name")
    options = {
        "period": period,
        "max_gap": max_gap,
        "tolerance": tolerance,
        "clock": clock,
        "sort": sort,
        "drop_duplicates": drop_duplicates,
        "split_gaps": split_gaps,
        "unfinished": unfinished,
    }
    signals = {"responses": list(responses), "excitations": list(excitations)}
    read = partial(_read_trials, signals=signals, options=options)
    trajectories: list[Trajectory] = []
    found = (map if executor is None else executor.map)(read, paths, names)
    for done, trials in enumerate(found, start=1):
        trajectories += trials
        if progress is not None:
            progress(done, len(paths))
    return Dataset(tuple(trajectories))


def _read_trials(
    path: Path, name: str, *, signals: Mapping[str, list[str]], options: Json
) -> list[Trajectory]:
    """The trajectories of one bag."""
    read = read_signals(
        path,
        [*signals["responses"], *signals["excitations"]],
        clock=options["clock"],
        sort=options["sort"],
        drop_duplicates=options["drop_duplicates"],
        unfinished=options["unfinished"],
        gaps_in=signals["responses"] if options["split_gaps"] else (),
    )
    origin = bag_origin(path, unfinished=options["unfinished"])
    responses = [read[response] for response in signals["responses"]]
    excitations = [read[excitation] for excitation in signals["excitations"]]
    parts = [(responses, excitations)]
    if options["split_gaps"]:
        parts = list(_stretches(responses, excitations, options["max_gap"]))
        if not parts:
            raise DataError(f"{name}: no stretch of {MIN_STRETCH} samples without a gap")
    provenance = canonical({"bag": origin, "signals": signals, "options": options}).decode()
    trials = [
        to_trajectory(
            *part,
            period=options["period"],
            max_gap=options["max_gap"],
            tolerance=options["tolerance"],
            name=name if len(parts) == 1 else f"{name}.{k}",
            group=origin["custom"].get(REPEAT_GROUP, "") if len(parts) == 1 else "",
            digest=origin["digest"],
            provenance=provenance,
        )
        for k, part in enumerate(parts, start=1)
    ]
    if options["split_gaps"]:
        return _with_skipped(trials, responses[0])
    return trials


def _with_skipped(trials: list[Trajectory], base: Samples) -> list[Trajectory]:
    """The trials of one bag with the number of samples between its first and last not in them."""
    span = seconds(int(base.stamp_ns[-1]), int(base.stamp_ns[0]))
    skipped = 1 + round(span / trials[0].period) - sum(map(len, trials))
    return [
        replace(
            trial,
            provenance=canonical(json.loads(trial.provenance) | {"skipped": skipped}).decode(),
        )
        for trial in trials
    ]


def skipped_samples(dataset: Dataset) -> int:
    """How many samples `split_gaps` left out of the bags of `dataset`."""
    bags = {}
    for trial in dataset:
        origin = json.loads(trial.provenance or "{}")
        bags[trial.digest] = int(origin.get("skipped", 0))
    return sum(bags.values())


def _stretches(
    responses: Sequence[Samples], excitations: Sequence[Samples], max_gap: float | None
) -> Iterator[tuple[list[Samples], list[Samples]]]:
    """The signals cut where a response is missing; stretches of a few samples are left out."""
    starts: list[int] = []
    stops: list[int] = []
    for samples in responses:
        steps = np.diff(samples.stamp_ns)
        gap = DEFAULT_MAX_GAP * np.median(steps) / 1e9 if max_gap is None else max_gap
        runs = segments(samples.stamp_ns, gap)
        starts += [int(samples.stamp_ns[first]) for first, _ in runs[1:]]
        stops += [int(samples.stamp_ns[end - 1]) for _, end in runs[:-1]]
    starts = [min(int(s.stamp_ns[0]) for s in responses), *sorted(starts)]
    stops = [*sorted(stops), max(int(s.stamp_ns[-1]) for s in responses)]
    for start, stop in zip(starts, stops, strict=True):
        cut = [_between(samples, start, stop, held=False) for samples in responses]
        if min(map(len, cut)) >= MIN_STRETCH:
            yield cut, [_between(samples, start, stop, held=True) for samples in excitations]


def _between(samples: Samples, start: int, stop: int, *, held: bool) -> Samples:
    """The samples from start to stop; with `held`, also the one in force at the start."""
    low = int(np.searchsorted(samples.stamp_ns, start, side="right" if held else "left"))
    low = max(0, low - 1) if held else low
    high = int(np.searchsorted(samples.stamp_ns, stop, side="right"))
    return replace(samples, stamp_ns=samples.stamp_ns[low:high], values=samples.values[low:high])


def require_excitation(dataset: Dataset) -> None:
    """DataError if an input is constant over the whole dataset: nothing follows from it."""
    for column, name in enumerate(dataset.trajectories[0].u_names):
        inputs = np.concatenate([trajectory.u[:, column] for trajectory in dataset])
        if np.ptp(inputs) == 0.0:
            raise DataError(
                f"no excitation: input '{name}' is {inputs[0]:g} throughout all {len(dataset)} "
                "trials, so its effect cannot be told from an offset; record trials in which it "
                "changes, or leave it out of the excitations"
            )


def _period_ns(stamp_ns: IntArray, period: float | None, tolerance: float, label: str) -> int:
    if len(stamp_ns) < 2:
        raise DataError(f"{label} has {len(stamp_ns)} sample; a sample time needs two")
    median = float(np.median(np.diff(stamp_ns)))
    if period is None:
        return round(median)
    if not abs(median / 1e9 - period) <= tolerance * period:
        raise DataError(
            f"{label} is sampled every {median / 1e9:g} s, asked for was {period:g} s; record at "
            "one rate, or state the period of this one"
        )
    return round(period * 1e9)


def _refuse_repeated_stamps(samples: Samples, label: str) -> None:
    if len(same := np.flatnonzero(np.diff(samples.stamp_ns) <= 0)):
        i = int(same[0])
        raise DataError(
            f"{label}: {samples.path}: messages {i} and {i + 1} have the same stamp "
            f"{stamp_text(int(samples.stamp_ns[i]))} ({len(same)} such pairs); is the topic "
            "published twice?"
        )


def _refuse_gaps(samples: Samples, gap_ns: int, label: str) -> None:
    steps = np.diff(samples.stamp_ns)
    if len(wide := np.flatnonzero(steps > gap_ns)):
        worst = int(wide[np.argmax(steps[wide])])
        raise DataError(
            f"{label}: {samples.path}: a gap of {steps[worst] / 1e9:g} s after message {worst} at "
            f"{stamp_text(int(samples.stamp_ns[worst]))}; at most {gap_ns / 1e9:g} s was asked for "
            f"({len(wide)} such gaps)"
        )


def _on_grid(
    stamp_ns: IntArray, grid: IntArray, period_ns: int, tolerance: float
) -> IntArray | None:
    """Index of the sample on each grid point, or None if any point lacks its one sample."""
    points = np.rint((stamp_ns - grid[0]) / period_ns).astype(np.int64)
    inside = np.flatnonzero((points >= 0) & (points < len(grid)))
    if not np.array_equal(points[inside], np.arange(len(grid))):
        return None
    if np.abs(stamp_ns[inside] - grid).max() > tolerance * period_ns:
        return None
    return inside


def _sample(samples: Samples, grid: IntArray, period_ns: int, tolerance: float) -> FloatArray:
    """The response on the grid: its own samples where they lie on it, else interpolated."""
    on_grid = _on_grid(samples.stamp_ns, grid, period_ns, tolerance)
    if on_grid is not None:
        return samples.values[on_grid]
    origin = int(grid[0])
    interpolated = np.interp(
        seconds(grid, origin), seconds(samples.stamp_ns, origin), samples.values
    )
    return np.asarray(interpolated, dtype=np.float64)


def _hold(samples: Samples, at_ns: IntArray, gap_ns: int, label: str) -> FloatArray:
    """The latest command stamped at or before each of `at_ns`; DataError if held too long."""
    latest = np.searchsorted(samples.stamp_ns, at_ns, side="right") - 1
    age = at_ns - samples.stamp_ns[latest]
    k = int(np.argmax(age))
    if age[k] > gap_ns:
        raise DataError(
            f"{label}: {samples.path}: no command for {age[k] / 1e9:g} s after message {latest[k]} "
            f"at {stamp_text(int(samples.stamp_ns[latest[k]]))}; at most {gap_ns / 1e9:g} s was "
            "asked for"
        )
    return samples.values[latest]
