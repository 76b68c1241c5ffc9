"""The grid of a proposed configuration, from the responses' steps and the commands' ages."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.signal import welch

from bags.recordings.bag import Bag
from bags.recordings.definitions import Definition
from bags.setup.proposal import Proposal
from bags.signals.expressions import factors
from bags.signals.reader import Samples, read_signals
from bags.signals.sampling import BRIDGED, MOST_FILLED, Grid
from bags.signals.timing import held
from nlsid_core.arrays import FloatArray
from nlsid_core.errors import BagError
from nlsid_core.running.grid import TOLERANCE

ON_GRID: Final = 0.95  # of the steps near the period: samples are used as they come
ROUND: Final = 0.002  # relative: a period this near a round number is that number
FEW_GAPS: Final = 5.0  # periods: gaps up to here are filled in, longer ones cut out
DYNAMICS: Final = 40.0  # samples in a period of the fastest motion that are enough
STEADY: Final = 0.5 * TOLERANCE  # periods that stamps may be off one grid to be used as they come
SLOW: Final = 1.0  # s between samples: of most robots milliseconds that were taken for seconds
LONG_HELD: Final = 20.0  # periods a command is held: lost ones are then noticed late


@dataclass(frozen=True)
class Steps:
    """The responses' steps in s.

    on_grid: the share of them that is near the period. off_grid: periods by which the stamps of a
    run stray from one grid of the period. repeated: stamps that are the one before. wide: longer
    ones than these two, without the gaps, are as much of the time as a monitor lets be filled in,
    and half as much.
    """

    period: float
    on_grid: float
    off_grid: float
    repeated: int
    longest: float
    wide: tuple[float, ...]


@dataclass(frozen=True)
class Ages:
    """The commands' ages in s.

    tail: of responses after the last command, where those have come to an end and the last is not
    held.
    """

    period: float
    longest: float
    tail: float


@dataclass(frozen=True)
class Paces:
    """What the chosen signals of all bags show.

    band: Hz below which a response has 99 % of its power. topics: that responses are on.
    """

    steps: Steps
    ages: Ages
    band: float
    u_ranges: tuple[tuple[float, float], ...]
    y_ranges: tuple[tuple[float, float], ...]
    topics: int


def read_paces(
    bags: Sequence[Path],
    chosen: Mapping[str, Sequence[str]],
    clock: str,
    types: Mapping[str, Definition] | None,
) -> Paces:
    """The paces of the chosen signals over all bags; BagError where a period cannot be said."""
    rules = Grid(clock=clock)
    y_paths = [rules.path(text, response=True) for text in chosen["response"]]
    u_texts = [rules.path(text, response=False) for text in chosen["excitation"]]
    drives = [factors(text) for text in u_texts]
    u_paths = list(dict.fromkeys(part for parts in drives for part in parts))
    steps, commanded, bands, u_steps = [], [], [], []
    ranges: dict[str, list[list[tuple[float, float]]]] = {"u": [], "y": []}
    repeated = 0
    for path in bags:
        with Bag(path, definitions=types) as bag:
            read = read_signals(bag, [*y_paths, *u_paths], sort=True, gaps_in=y_paths)
        for name in read:
            if doubt := read[name].doubt(responds=name in y_paths):
                raise BagError(f"{path.name}: {doubt}; record it again with one of them")
        for name in y_paths:
            diffs = np.diff(read[name].stamp_ns) / 1e9
            repeated += int((diffs <= 0).sum())
            steps.append(diffs[diffs > 0])
            bands.append(_band(read[name]))
        last = max(int(read[name].stamp_ns[-1]) for name in y_paths)
        for name in u_paths:
            stamps = read[name].stamp_ns
            commanded.append(held(stamps, last))
            u_steps.append(np.diff(stamps) / 1e9)
        ranges["u"].append([_range([read[name] for name in parts]) for parts in drives])
        ranges["y"].append([_range([read[name]]) for name in y_paths])
    every, u_every = np.concatenate(steps), np.concatenate(u_steps)
    if not len(every):
        raise BagError(f"{y_paths[0]} has one sample a bag; a period needs two")
    median = float(np.median(every))
    near = np.abs(every / median - np.rint(every / median)) <= TOLERANCE
    period, off_grid = _grid(steps, median)
    between = np.sort(every[every <= FEW_GAPS * median])
    narrow = (1.0 - MOST_FILLED * np.array([1.0, 0.5])) * between.sum()
    wide = between[np.searchsorted(np.cumsum(between), narrow)].tolist()
    return Paces(
        Steps(period, float(near.mean()), off_grid, repeated, float(every.max()), tuple(wide)),
        Ages(
            period=float(np.median(u_every)) if len(u_every) else math.inf,
            longest=max(each.longest for each in commanded),
            tail=max(each.tail for each in commanded),
        ),
        band=float(np.median([b for b in bands if b > 0] or [0.0])),
        u_ranges=_whole(ranges["u"]),
        y_ranges=_whole(ranges["y"]),
        topics=len({name.partition(":")[0] for name in y_paths}),
    )


def _grid(steps: Sequence[FloatArray], median: float) -> tuple[float, float]:
    """The period of responses with these steps in s, and how far from its grid they stray.

    A round one near the median step if all stamps of a run are near its grid, which a monitor holds
    them to; else the mean step.
    """
    runs = [run for each in steps for run in _runs(each, median) if len(run)]
    if not runs:
        return _round(median), 0.0

    counts = [np.cumsum(np.rint(run / median)) for run in runs]
    times = [np.cumsum(run) for run in runs]
    mean = sum(float(t[-1]) for t in times) / sum(float(k[-1]) for k in counts)
    strays = {
        period: max(
            float(np.ptp(np.r_[0.0, t / period - k])) for t, k in zip(times, counts, strict=True)
        )
        for period in (_round(median), float(f"{mean:.6g}"))
    }
    period = next(
        (p for p, stray in strays.items() if stray <= STEADY), min(strays, key=strays.__getitem__)
    )
    return period, strays[period]


def _runs(steps: FloatArray, median: float) -> list[FloatArray]:
    """The steps between gaps."""
    gaps = np.flatnonzero(steps > FEW_GAPS * median)
    return [part[part <= FEW_GAPS * median] for part in np.split(steps, gaps)]


def _whole(ranges: Sequence[Sequence[tuple[float, float]]]) -> tuple[tuple[float, float], ...]:
    """The range of each signal over all bags."""
    ends = np.array(ranges)
    lows, highs = ends.min(axis=0)[:, 0], ends.max(axis=0)[:, 1]
    return tuple(zip(lows.tolist(), highs.tolist(), strict=True))


def _range(parts: Sequence[Samples]) -> tuple[float, float]:
    """The least and the greatest that a product of signals can be."""
    low, high = 1.0, 1.0
    for part in parts:
        ends = [x * y for x in (low, high) for y in (part.values.min(), part.values.max())]
        low, high = float(min(ends)), float(max(ends))
    return low, high


def _band(samples: Samples) -> float:
    """Hz below which a response has 99 % of its power; 0 if it cannot be said."""
    steps = np.diff(samples.stamp_ns) / 1e9
    if len(samples) < 64 or not (steps > 0).any() or not np.ptp(samples.values) > 0:
        return 0.0
    rate = 1.0 / float(np.median(steps[steps > 0]))
    x = samples.values - samples.values.mean()
    f, power = welch(x, fs=rate, nperseg=min(len(x), 4096))
    return float(f[np.searchsorted(np.cumsum(power) / power.sum(), 0.99)])


def _round(period: float) -> float:
    """A round rate or period if one is near: 0.025 of 0.02498."""
    for round_one in (
        1.0 / max(round(1.0 / period), 1),
        float(f"{period:.1g}"),
        float(f"{period:.2g}"),
    ):
        if abs(round_one / period - 1.0) <= ROUND:
            return float(f"{round_one:.6g}")
    return float(f"{period:.4g}")


def _up(value: float) -> float:
    """The next number of two digits."""
    digits = 1 - math.floor(math.log10(value))
    return float(f"{math.ceil(value * 10**digits - 1e-9) / 10**digits:.2g}")


def say_grid(proposal: Proposal, read: Paces) -> None:
    """Period, resampling, gaps and holding of the configuration, and what follows from them."""
    steps, ages = read.steps, read.ages
    grid: dict[str, Any] = {"period": steps.period}
    why, walls = proposal.why, proposal.walls
    why["period"] = (
        f"the response's step; {100 * steps.on_grid:.0f} % of steps are near it, and stamps of a "
        f"run stray by {steps.off_grid:.2g} periods from its grid"
    )
    steady = steps.on_grid >= ON_GRID and steps.off_grid <= TOLERANCE
    regular = steady and read.topics == 1 and not steps.repeated
    if steps.period >= SLOW:
        walls.append(
            f"samples are {steps.period:.4g} s apart, {1.0 / steps.period:.2g} Hz; if times in "
            "milliseconds were taken for seconds, read them again with their unit"
        )
    part = DYNAMICS * read.band * steps.period  # that a step is of the longest that is enough
    factor = max(int(1.0 / part), 1) if part > 0.0 else 1
    if factor > 1:
        grid["period"] = float(f"{factor * steps.period:.4g}")
        why["period"] = (
            f"{factor} times {steps.period:g} s: 99 % of the response's power is below "
            f"{read.band:.3g} Hz"
        )
        regular = False
    if not regular:
        grid["resample"] = "last" if factor > 1 and steady else "linear"
        reasons = {
            "fewer samples than are recorded": factor > 1,
            "responses come from several topics": read.topics > 1,
            f"only {100 * steps.on_grid:.0f} % of steps are near the period": (
                steps.on_grid < ON_GRID
            ),
            f"stamps of a run stray by {steps.off_grid:.2g} periods from one grid, and a monitor "
            f"takes {TOLERANCE:g}": True,
        }
        why["resample"] = next(reason for reason, holds in reasons.items() if holds)
    if not regular and min(steps.wide) > BRIDGED * grid["period"]:
        grid["period"] = _up(max(steps.wide) / BRIDGED)
        why["period"] = (
            f"responses come up to {max(steps.wide):.3g} s apart; a sample is measured where it "
            f"has messages at most {BRIDGED:g} periods apart"
        )
    most = FEW_GAPS * steps.period
    grid["max_gap"] = _up(max(min(1.2 * steps.longest, most), 2.0 * grid["period"]))
    why["max_gap"] = f"the longest step of a response is {steps.longest:.3g} s"
    if steps.longest > grid["max_gap"]:
        grid["split_gaps"] = True
        why["split_gaps"] = "longer gaps end a trial and begin the next"
        walls.append(
            f"a response is missing for up to {steps.longest:.3g} s: trials are cut there, and "
            "a monitor says unknown from there on"
        )
    if ages.longest > grid["max_gap"]:
        grid["hold"] = _up(1.1 * ages.longest)
        why["hold"] = f"one was held for {ages.longest:.3g} s in these bags"
        if ages.longest > LONG_HELD * min(ages.period, 1.0):
            walls.append(
                f"commands are held for up to {ages.longest:.3g} s: a lost one is not noticed "
                "before"
            )
    if ages.tail > grid.get("hold", grid["max_gap"]):
        grid["split_gaps"] = True
        why.setdefault("split_gaps", "what comes after the last command is not fitted")
        walls.append(
            f"commands end up to {ages.tail:.3g} s before the responses do: what the robot "
            "does there is not fitted, as nothing says what it was told"
        )
    proposal.content["grid"] = grid
    if steps.repeated:
        walls.append(
            f"{steps.repeated} stamps of the response repeat the one before, which identification "
            "refuses; is the topic published twice?"
        )
