"""Is a recording fit for identification? Clock, regularity, excitation, saturation, quantisation,
one publisher of each signal.

Each check gives findings; the worst of them is the verdict. The thresholds are named below with
their reasons; none of them proves anything, they say where to look.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import IntEnum
from pathlib import Path
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from bags.recordings.bag import Bag
from bags.recordings.definitions import Definition
from bags.recordings.remote import StorageError, place
from bags.signals.columns import read_columns
from bags.signals.expressions import Expression
from bags.signals.grid import to_trajectories
from bags.signals.reader import HEADER_STAMP, Samples, expanded, read_signals
from bags.signals.sampling import Grid
from bags.signals.timing import RELATED, Delay, clock_relation, delay, held
from nlsid_core.arrays import FloatArray
from nlsid_core.errors import BagError, DataError

JITTER_LOOK: Final = 0.05  # of the period: up to here samples are used as they are (the grid's)
GAP: Final = 1.5  # periods: a sample is missing
SATURATED: Final = 0.02  # of the samples at one end of the range, in runs
LEVELS_FEW: Final = 8  # distinct values of a response: quantised to less than its dynamics
STEP_COARSE: Final = 0.02  # of the range: the quantisation step of a response
BAND_LOOK: Final = 0.4  # of the sampling rate: power above is close to being aliased
WINDOW: Final = 1024  # samples of a spectrum
LINES_FEW: Final = 3  # frequency lines with power: no more than one or two sinusoids
LONGEST_DELAY: Final = 5.0  # s
LEAST_OVERLAP: Final = 10  # steps of the response: less says nothing of a delay
LONGEST_HELD: Final = 1e5  # s: to see what there is, whatever limit a configuration sets


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
    """The findings about one bag.

    commands: of each excitation the values where responses were recorded.
    """

    bag: Path
    findings: list[Finding] = field(default_factory=list)
    commands: dict[str, FloatArray] = field(default_factory=dict)

    @property
    def verdict(self) -> Level:
        """The worst finding's level."""
        return max((finding.level for finding in self.findings), default=Level.GOOD)


def check_fitness(
    bags: Sequence[Path | str],
    *,
    excitations: Sequence[str],
    responses: Sequence[str],
    clock: str = "header",
    definitions: Mapping[str, Definition] | None = None,
) -> list[Fitness]:
    """Check each bag for itself, and the bags against each other.

    What a bag is refused for elsewhere (damage, NaN, no such topic) is a finding here. A command
    that is constant in one bag is bad only if it has the same value in all of them.

    Args:
        bags: where they are.
        excitations: the commands' texts.
        responses: likewise.
        clock: `header` or `log`, as in a configuration.
        definitions: of message types that the bags do not define.

    Returns:
        The findings about each bag, in the order of the bags.
    """
    if not excitations or not responses:
        raise BagError("name at least one excitation and one response")
    u_texts, y_texts = (
        [Grid(clock=clock).path(text, response=True) for text in texts]
        for texts in (excitations, responses)
    )
    looks = []
    for path in map(place, bags):
        look = Fitness(path)
        try:
            with Bag(path, unfinished=True, definitions=definitions) as bag:
                look.findings.extend(_clocks(bag, [*u_texts, *y_texts]))
                _look_at(bag, u_texts, y_texts, look)
        except StorageError:  # nothing is known of the bag
            raise
        except BagError as error:
            look.findings.append(Finding(Level.BAD, "readable", str(error)))
        looks.append(look)
    for look in looks:
        look.findings.extend(_constant(look, looks))
    return looks


def _look_at(bag: Bag, u_texts: Sequence[str], y_texts: Sequence[str], look: Fitness) -> None:
    """Add what the signals of one bag show; BagError if they cannot be read."""
    u_names, y_names = list(expanded(bag, u_texts)), list(expanded(bag, y_texts))
    read = read_signals(bag, [*u_names, *y_names], sort=True)
    commanded, measured = [read[n] for n in u_names], [read[n] for n in y_names]
    doubts = [samples.doubt(responds=name in y_names) for name, samples in read.items()]
    look.findings.extend(Finding(Level.BAD, "publishers", doubt) for doubt in doubts if doubt)
    for samples in measured:
        look.findings.extend(_regularity(samples))
        look.findings.extend(_range(samples))
    last_ns = max(int(samples.stamp_ns[-1]) for samples in measured)
    for samples in commanded:
        look.findings.extend(_commands(samples, last_ns))
        look.findings.extend(_excitation(samples))
        look.commands[samples.path] = samples.values
    look.findings.extend(_samples(measured, commanded, look.commands))
    look.findings.extend(_delays(commanded, measured))


def _samples(
    responses: Sequence[Samples], excitations: Sequence[Samples], commands: dict[str, FloatArray]
) -> Iterator[Finding]:
    """What identification would make of the signals; `commands` become those of its samples."""
    if len({samples.clock for samples in (*responses, *excitations)}) > 1:
        yield Finding(
            Level.BAD,
            "samples",
            "some signals have no header stamp: identify and check them with clock log",
        )
        return
    held = [_ruled(samples, "hold") for samples in excitations]
    apart = Grid(split_gaps=True)
    try:
        trials = to_trajectories(responses, held, apart)
    except (BagError, DataError) as error:
        try:
            lines = [_ruled(samples, "linear") for samples in responses]
            trials = to_trajectories(lines, held, apart)
        except (BagError, DataError) as second:
            yield Finding(Level.BAD, "samples", f"identification refuses them: {second}")
            return
        yield Finding(
            Level.LOOK, "samples", f"only with grid.resample: linear or last; as they come: {error}"
        )
    longest = max(trials, key=len)
    count = sum(map(len, trials))
    stretches = "one stretch" if len(trials) == 1 else f"{len(trials)} stretches"
    yield Finding(
        Level.GOOD,
        "samples",
        f"{count} samples of {longest.period:.4g} s in {stretches} without a gap",
    )
    u = np.concatenate([trial.u for trial in trials])
    commands |= {samples.path: c for samples, c in zip(excitations, u.T, strict=True)}


def _constant(look: Fitness, looks: Sequence[Fitness]) -> Iterator[Finding]:
    """The commands that do not change where responses were recorded, here or in all bags."""
    for name, values in look.commands.items():
        if np.ptp(values) > 0.0:
            continue
        others = [other.commands[name] for other in looks if name in other.commands]
        what = f"{name} is {values[0]:g} wherever every response was recorded: no excitation"
        if np.ptp(np.concatenate(others)) > 0.0:
            what += " here; other bags have other values, so it is of use beside them"
            yield Finding(Level.LOOK, "excitation", what)
        else:
            yield Finding(Level.BAD, "excitation", what)


def _ruled(samples: Samples, rule: str) -> Samples:
    """The samples with a rule in their path that bridges whatever is missing."""
    return replace(
        samples, path=str(Expression.parse(samples.path).sampled(rule, window=LONGEST_HELD))
    )


def _clocks(bag: Bag, signals: Sequence[str]) -> Iterator[Finding]:
    if bag.ending is not None:
        yield Finding(Level.LOOK, "whole", f"unfinished: {bag.ending}")
    found = expanded(bag, signals).values()
    logged = {signal.path.topic for signal in found if signal.clock == "log"}
    offsets = {}
    for topic, columns in read_columns(bag, {str(s.path): s.path for s in found}).items():
        if topic in logged:
            yield Finding(
                Level.GOOD,
                "clock",
                f"{topic} by its log times, which carry the latency of recording",
            )
        elif columns.stamp_ns is None:
            yield Finding(
                Level.LOOK,
                "clock",
                f"{topic} has no header stamp; its log times carry the latency of recording",
            )
        elif len(columns) and not columns.stamp_ns.any():
            yield Finding(Level.BAD, "clock", f"{topic}: every header stamp is 0")
        elif len(columns):
            if back := int((np.diff(columns.stamp_ns) < 0).sum()):
                yield Finding(Level.BAD, "clock", f"{topic}: stamps that go back: {back}")
            relation = clock_relation(columns.stamp_ns, columns.log_ns)
            offsets[topic] = relation.offset
            level = Level.LOOK if relation.drift else Level.GOOD
            yield Finding(level, "clock", f"{topic}: {relation}")
    if offsets and max(offsets.values()) - min(offsets.values()) > 1.0:
        far = max(offsets, key=lambda topic: abs(offsets[topic]))
        yield Finding(
            Level.BAD,
            "clock",
            f"the topics' stamps are of different clocks: {far} is {offsets[far]:+.3f} s off",
        )


def _regularity(samples: Samples) -> Iterator[Finding]:
    every = np.diff(samples.stamp_ns) / 1e9
    name, steps = samples.path, every[every > 0]
    if not len(steps):
        yield Finding(Level.BAD, "regularity", f"{name} has one stamp")
        return
    if repeated := len(every) - len(steps):
        yield Finding(
            Level.LOOK,
            "regularity",
            f"{name}: {repeated} of {len(samples)} stamps repeat the one before",
        )
    period = float(np.median(steps))
    gaps = steps > GAP * period
    if gaps.any():
        yield Finding(
            Level.LOOK,
            "regularity",
            f"{name}: gaps: {gaps.sum()}, the longest {np.max(steps):.3g} s",
        )
    jitter = float(np.quantile(np.abs(steps[~gaps] - period), 0.95)) / period
    level = Level.LOOK if jitter > JITTER_LOOK else Level.GOOD
    yield Finding(
        level,
        "regularity",
        f"{name}: {_rate(samples, period)}, 95 % of steps within {100 * jitter:.3g} %",
    )


def _commands(samples: Samples, last_ns: int) -> Iterator[Finding]:
    """Commands are held until the next one: their stamps may come as they like.

    last_ns: the last stamp of a response.
    """
    steps = np.diff(samples.stamp_ns) / 1e9
    name = samples.path
    if not len(steps):
        yield Finding(Level.LOOK, "commands", f"{name} has one command")
        return
    rate = _rate(samples, float(np.median(steps)))
    found = held(samples.stamp_ns, last_ns)
    yield Finding(
        Level.GOOD,
        "commands",
        f"{name}: {rate}, one held for at most {found.longest:.3g} s (grid.hold)",
    )
    if found.tail:
        yield Finding(
            Level.LOOK,
            "commands",
            f"{name} ends {found.tail:.3g} s before the responses do: what follows is not fitted",
        )
    if repeated := int((steps == 0).sum()):
        yield Finding(
            Level.LOOK,
            "commands",
            f"{name}: {repeated} of {len(samples)} stamps repeat the one before; the last counts",
        )


def _rate(samples: Samples, period: float) -> str:
    rate = f"{1 / period:.4g} Hz" if period > 0 else "several at one time"
    return rate if samples.clock == HEADER_STAMP else f"{rate} by {samples.clock}"


def _excitation(samples: Samples) -> Iterator[Finding]:
    x, name = samples.values, samples.path
    if not np.ptp(x) > 0:
        return
    period = max(float(np.median(np.diff(samples.stamp_ns))) / 1e9, 1e-9)
    f, power = _spectrum(x - x.mean(), period)
    band = float(f[np.searchsorted(np.cumsum(power) / power.sum(), 0.95)])
    lines = int((power > 1e-3 * power.max()).sum())
    level = Level.LOOK if lines < LINES_FEW or band * period > BAND_LOOK else Level.GOOD
    yield Finding(
        level,
        "excitation",
        f"{name}: 95 % of its power below {band:.3g} Hz, {lines} frequency lines carry power",
    )


def _spectrum(x: FloatArray, period: float) -> tuple[FloatArray, FloatArray]:
    """Frequencies in Hz, and the power of x (N,) there, up to a factor.

    Source: P. D. Welch, IEEE Trans. AU-15 (1967) 70: Hann windows that overlap by half.
    """
    n = min(len(x), WINDOW)
    parts = sliding_window_view(x, n)[:: n - n // 2]
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(n) / n)
    lines = np.fft.rfft(window * (parts - parts.mean(axis=1, keepdims=True)))
    power = np.mean(np.abs(lines) ** 2, axis=0)
    power[1 : n - n // 2] *= 2  # those of negative frequencies
    return np.fft.rfftfreq(n, period), power


def _range(samples: Samples) -> Iterator[Finding]:
    x, name = samples.values, samples.path
    if not np.ptp(x) > 0:
        yield Finding(Level.BAD, "response", f"{name} is {x[0]:g} throughout: it does not move")
        return
    for end, what in ((np.max(x), "largest"), (np.min(x), "smallest")):
        share = float(((x[1:] == end) & (x[:-1] == end)).mean())
        if share > SATURATED and end != x[0]:
            yield Finding(
                Level.LOOK,
                "saturation",
                f"{name}: {100 * share:.0f} % of samples stay at its {what} value {end:g}",
            )
    levels = np.unique(x)
    step = float(np.min(np.diff(levels))) / float(np.ptp(x))
    coarse = len(levels) < LEVELS_FEW or step > STEP_COARSE
    yield Finding(
        Level.LOOK if coarse else Level.GOOD,
        "quantisation",
        f"{name}: {len(levels)} distinct values, steps of {step:.1e} of its range",
    )


def _delays(excitations: Sequence[Samples], responses: Sequence[Samples]) -> Iterator[Finding]:
    """For each response the command that it follows most clearly."""
    for y in responses:
        found: list[tuple[Delay, str]] = []
        period_ns = int(np.median(np.diff(y.stamp_ns))) if len(y) > 1 else 0
        for u in excitations:
            start, end = max(u.stamp_ns[0], y.stamp_ns[0]), min(u.stamp_ns[-1], y.stamp_ns[-1])
            if period_ns <= 0 or end - start < LEAST_OVERLAP * period_ns:
                yield Finding(
                    Level.BAD,
                    "delay",
                    f"{u.path} and {y.path} overlap for {max(end - start, 0) / 1e9:.3g} s by their "
                    f"stamps, less than {LEAST_OVERLAP} steps of the response",
                )
                continue
            at = np.arange(start, end, period_ns)
            held = u.values[np.searchsorted(u.stamp_ns, at, side="right") - 1]
            heard = np.interp(at, y.stamp_ns, y.values)
            longest = min(LONGEST_DELAY, (end - start) / 4e9)
            with suppress(DataError):  # constant: said already
                found.append((delay(held, heard, period_ns / 1e9, longest), u.path))
        if found:
            best, command = max(found, key=lambda pair: abs(pair[0].correlation))
            level = Level.GOOD if abs(best.correlation) > RELATED else Level.LOOK
            yield Finding(
                level,
                "delay",
                f"{y.path} follows {command} after {best.seconds:.3g} s "
                f"(correlation {best.correlation:+.2f})",
            )
