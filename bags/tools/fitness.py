"""Is a recording fit for identification? Clock, regularity, excitation, saturation, quantisation.

Each check gives findings; the worst of them is the verdict. The thresholds are named below with
their reasons; none of them proves anything, they say where to look.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Final

import numpy as np
from scipy.signal import welch

from bags.recordings.bag import Bag
from bags.signals.columns import expand_paths, read_columns
from bags.signals.delays import delay
from bags.signals.reader import HEADER_STAMP, Samples, read_signals
from bags.signals.repeats import find_period, same_excitation
from bags.signals.signal import SignalPath
from bags.signals.timing import clock_relation
from nlsid_core._types import FloatArray
from nlsid_core.errors import BagError, DataError

JITTER_LOOK: Final = 0.05  # of the period: up to here samples are used as they are (the grid's)
JITTER_BAD: Final = 0.5  # samples may change places
GAP: Final = 1.5  # periods: a sample is missing
SATURATED: Final = 0.02  # of the samples at one end of the range, in runs
LEVELS_FEW: Final = 8  # distinct values of a response: quantised to less than its dynamics
STEP_COARSE: Final = 0.02  # of the range: the quantisation step of a response
BAND_LOOK: Final = 0.4  # of the sampling rate: power above is close to being aliased
LINES_FEW: Final = 3  # frequency lines with power: no more than one or two sinusoids
RELATED: Final = 0.3  # correlation of command and response below which they may be unrelated
LONGEST_DELAY: Final = 5.0  # s


class Level(IntEnum):
    """How serious a finding is."""

    GOOD = 0
    LOOK = 1
    BAD = 2


@dataclass(frozen=True)
class Finding:
    """One thing a check found out about a bag and perhaps a signal."""

    level: Level
    check: str
    what: str


@dataclass(frozen=True)
class Fitness:
    """The findings about one bag; repeats: other bags of the same excitation."""

    bag: Path
    findings: tuple[Finding, ...]

    @property
    def verdict(self) -> Level:
        """The worst finding's level."""
        return max((finding.level for finding in self.findings), default=Level.GOOD)


def check_fitness(
    bags: Sequence[Path | str], *, excitations: Sequence[str], responses: Sequence[str]
) -> list[Fitness]:
    """Check each bag for itself, and the bags against each other for repeats of one excitation.

    What a bag is refused for elsewhere (damage, NaN, no such topic) is a finding here.
    """
    if not excitations or not responses:
        raise BagError("name at least one excitation and one response")
    results = []
    commands: list[tuple[str, FloatArray] | None] = []
    for path in map(Path, bags):
        findings: list[Finding] = []
        try:
            findings += _clocks(path, [*excitations, *responses])
            read = read_signals(path, [*excitations, *responses], sort=True)
        except BagError as error:
            findings.append(Finding(Level.BAD, "readable", str(error)))
            results.append(Fitness(path, tuple(findings)))
            commands.append(None)
            continue
        for samples in read.values():
            findings += _regularity(samples)
        for text in excitations:
            findings += _excitation(read[text])
        for text in responses:
            findings += _range(read[text])
        findings += _delays([read[t] for t in excitations], [read[t] for t in responses])
        results.append(Fitness(path, tuple(findings)))
        commands.append((path.name, read[excitations[0]].values))
    return [
        Fitness(found.bag, (*found.findings, *_repeats(k, commands)))
        for k, found in enumerate(results)
    ]


def _clocks(path: Path, signals: Sequence[str]) -> list[Finding]:
    with Bag(path, unfinished=True) as bag:
        findings = []
        if bag.ending is not None:
            findings.append(Finding(Level.LOOK, "whole", f"unfinished: {bag.ending}"))
        texts = [text.partition("|")[0] for text in signals]
        paths = expand_paths(bag, [SignalPath.parse(text) for text in texts])
        offsets = {}
        for topic, columns in read_columns(bag, {str(p): p for p in paths}).items():
            if columns.stamp_ns is None:
                what = f"{topic} has no header stamp; its log times carry the latency of recording"
                findings.append(Finding(Level.LOOK, "clock", what))
                continue
            if not len(columns):
                continue
            if not columns.stamp_ns.any():
                findings.append(Finding(Level.BAD, "clock", f"{topic}: every header stamp is 0"))
                continue
            back = int((np.diff(columns.stamp_ns) < 0).sum())
            if back:
                findings.append(
                    Finding(Level.BAD, "clock", f"{topic}: stamps go back in {back} places")
                )
            relation = clock_relation(columns.stamp_ns, columns.log_ns)
            offsets[topic] = relation.offset
            level = Level.LOOK if relation.drift else Level.GOOD
            findings.append(Finding(level, "clock", f"{topic}: {relation}"))
    if offsets and max(offsets.values()) - min(offsets.values()) > 1.0:
        far = max(offsets, key=lambda topic: abs(offsets[topic]))
        what = f"the topics' stamps are of different clocks: {far} is {offsets[far]:+.3f} s off"
        findings.append(Finding(Level.BAD, "clock", what))
    return findings


def _regularity(samples: Samples) -> list[Finding]:
    steps = np.diff(samples.stamp_ns) / 1e9
    name = samples.path
    if not len(steps):
        return [Finding(Level.BAD, "regularity", f"{name} has one sample")]
    findings = []
    duplicates = int((steps == 0).sum())
    if duplicates:
        what = f"{name}: {duplicates} of {len(samples)} stamps repeat the one before"
        findings.append(Finding(Level.BAD, "regularity", what))
        steps = steps[steps > 0]
        if not len(steps):
            return findings
    period = float(np.median(steps))
    gaps = steps > GAP * period
    if gaps.any():
        what = f"{name}: {int(gaps.sum())} gaps, the longest {np.max(steps):.3g} s"
        findings.append(Finding(Level.LOOK, "regularity", what))
    jitter = float(np.quantile(np.abs(steps[~gaps] - period), 0.95)) / period
    level = Level.GOOD
    if jitter > JITTER_LOOK:
        level = Level.BAD if jitter > JITTER_BAD else Level.LOOK
    clock = "" if samples.clock == HEADER_STAMP else f" by {samples.clock}"
    what = f"{name}: {1 / period:.4g} Hz{clock}, 95 % of steps within {100 * jitter:.2g} %"
    findings.append(Finding(level, "regularity", what))
    return findings


def _excitation(samples: Samples) -> list[Finding]:
    x, name = samples.values, samples.path
    if not np.ptp(x) > 0:
        return [Finding(Level.BAD, "excitation", f"{name} is {x[0]:g} throughout: no excitation")]
    findings = []
    period = max(float(np.median(np.diff(samples.stamp_ns))) / 1e9, 1e-9)
    f, power = welch(x - x.mean(), fs=1 / period, nperseg=min(len(x), 1024))
    share = np.cumsum(power) / power.sum()
    band = float(f[np.searchsorted(share, 0.95)])
    lines = int((power > 1e-3 * power.max()).sum())
    level = Level.GOOD
    if lines < LINES_FEW or band * period > BAND_LOOK:
        level = Level.LOOK
    what = f"{name}: 95 % of its power below {band:.3g} Hz, {lines} frequency lines carry power"
    findings.append(Finding(level, "excitation", what))
    repeat = find_period(x)
    if repeat is not None:
        what = f"{name} repeats every {repeat * period:.4g} s, {len(x) // repeat} times"
        findings.append(Finding(Level.GOOD, "repeats", what))
    return findings


def _range(samples: Samples) -> list[Finding]:
    x, name = samples.values, samples.path
    if not np.ptp(x) > 0:
        return [Finding(Level.BAD, "response", f"{name} is {x[0]:g} throughout: it does not move")]
    findings = []
    for end, what in ((np.max(x), "largest"), (np.min(x), "smallest")):
        held = (x[1:] == end) & (x[:-1] == end)
        share = float(held.mean())
        if share > SATURATED and end != x[0]:
            text = f"{name}: {100 * share:.0f} % of samples stay at its {what} value {end:g}"
            findings.append(Finding(Level.LOOK, "saturation", text))
    levels = np.unique(x)
    step = float(np.min(np.diff(levels))) / float(np.ptp(x))
    coarse = len(levels) < LEVELS_FEW or step > STEP_COARSE
    text = f"{name}: {len(levels)} distinct values, steps of {step:.1e} of its range"
    findings.append(Finding(Level.LOOK if coarse else Level.GOOD, "quantisation", text))
    return findings


def _delays(excitations: Sequence[Samples], responses: Sequence[Samples]) -> list[Finding]:
    findings = []
    for u in excitations:
        for y in responses:
            period_ns = int(np.median(np.diff(y.stamp_ns))) if len(y) > 1 else 0
            start, end = max(u.stamp_ns[0], y.stamp_ns[0]), min(u.stamp_ns[-1], y.stamp_ns[-1])
            if period_ns <= 0 or end - start < 10 * period_ns:
                what = f"{u.path} and {y.path} do not overlap in time by their stamps"
                findings.append(Finding(Level.BAD, "delay", what))
                continue
            at = np.arange(start, end, period_ns)
            held = u.values[np.searchsorted(u.stamp_ns, at, side="right") - 1]
            heard = np.interp(at, y.stamp_ns, y.values)
            longest = min(LONGEST_DELAY, (end - start) / 4e9)
            try:
                found = delay(held, heard, period_ns / 1e9, longest)
            except DataError:
                continue  # constant: said already
            level = Level.GOOD if abs(found.correlation) > RELATED else Level.LOOK
            what = (
                f"{y.path} follows {u.path} after {found.seconds:.3g} s "
                f"(correlation {found.correlation:+.2f})"
            )
            findings.append(Finding(level, "delay", what))
    return findings


def _repeats(k: int, commands: Sequence[tuple[str, FloatArray] | None]) -> list[Finding]:
    mine = commands[k]
    if mine is None:
        return []
    same = [
        other[0]
        for j, other in enumerate(commands)
        if j != k and other is not None and same_excitation(mine[1], other[1])
    ]
    if not same:
        return []
    return [Finding(Level.GOOD, "repeats", f"the same excitation as {', '.join(same)}")]
