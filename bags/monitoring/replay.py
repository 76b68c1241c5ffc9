"""Offline monitoring: a bag's messages through the same sampling and monitor as the live node."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, Final

import numpy as np

from bags.monitoring.announcement import Run
from bags.monitoring.watch import Stamped, Watch
from bags.recordings.bag import Bag
from bags.recordings.definitions import Definition
from bags.recordings.folders import trial_name
from bags.recordings.message_types import decode
from bags.recordings.remote import place
from bags.signals.columns import read_columns
from bags.signals.reader import bag_digest
from bags.signals.sampling import FILLED, LOST, MOST_FILLED, Sampler, said_filled
from nlsid_core import files
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.designs import AnyDesign
from nlsid_core.errors import BagError
from nlsid_core.funnels.tube import TubeFunnel
from nlsid_core.running.comparison import Centre
from nlsid_core.running.reading import Reading, Status, cause
from nlsid_core.running.tubes import BEYOND
from nlsid_core.shown import BLUE, GREY, card, line

Definitions = Mapping[str, Definition]
STRING = "std_msgs/msg/String"
RUN_TOPIC = "/run"  # how the topic of a controller's announcement ends


OTHER_PACE: Final = 0.02  # of the period: clocks differ by less
LEAST_PACED: Final = 3  # samples of which a pace is told
MOST_WIDE: Final = 0.05  # of the samples: a tube wider than the signal in more is said


@dataclass(frozen=True)
class Stretch:
    """Samples that were not judged, from `start` to `end` s: how many, and why, as it came.

    starting: the last of them, from which a new run was started.
    """

    start: float
    end: float
    samples: int
    reasons: tuple[str, ...]
    starting: int = 0

    @property
    def where(self) -> str:
        """How many samples, and when."""
        if self.samples == 1:
            return f"1 sample at {self.start:.3f} s"
        return f"{self.samples} samples from {self.start:.3f} to {self.end:.3f} s"

    @property
    def why(self) -> str:
        """The reasons one after another, and what a new run needed."""
        started = f"{self.starting} to start a new run"
        return "; then ".join([*self.reasons, started] if self.starting else self.reasons)


def _joined(row: Sequence[Stretch]) -> Stretch:
    """Stretches that follow each other as one; a cause is said where it comes first."""
    reasons = {cause(why): why for part in reversed(row) for why in reversed(part.reasons)}
    starting = sum(1 for _ in takewhile(lambda part: not part.reasons, reversed(row)))
    samples = sum(part.samples for part in row)
    return Stretch(
        row[0].start,
        max(part.end for part in row),
        samples,
        tuple(reversed(reasons.values())),
        starting,
    )


@dataclass(frozen=True, eq=False, repr=False)
class Replay:
    """One bag's readings, and what a summary says of them.

    axis: what is measured; unit, half_width: of the one output of a tube, else empty and 0.
    """

    name: str
    readings: tuple[Reading, ...]
    axis: str
    unit: str
    half_width: float
    period: float = 0.0
    stamps_ns: tuple[int, ...] = ()

    def __repr__(self) -> str:
        worst = self.first_bad or self.worst
        at = f", margin {worst.margin:.2f} at {worst.t:.3f} s" if worst else ""
        return f"{self.name}: {self.verdict}{at}" + (self.reason and f": {self.reason}")

    def _repr_html_(self) -> str:
        """The same, and the first signal as measured (blue), with the tube around its nominal."""
        rows = [
            (r.t, r.measured[0], r.nominal[0], [*r.half_widths, self.half_width][0])
            for r in self.judged
            if r.measured and r.nominal
        ]
        t, y, middle, width = np.array(rows or [(0.0,) * 4]).T
        drawn = [(middle - width, GREY), (middle + width, GREY), (y, BLUE)]
        span = np.concatenate([values for values, _ in drawn])
        return card(repr(self), *(line(t, values, colour, span) for values, colour in drawn))

    @property
    def span(self) -> float:
        """S of the run, from the first sample after those that start it to the last."""
        stamps = [r.t for r in self.readings if not r.waits]
        return stamps[-1] - stamps[0] + self.period if stamps else 0.0

    @property
    def starting(self) -> int:
        """How many samples make the run's start."""
        return sum(1 for _ in takewhile(lambda reading: reading.waits, self.readings))

    @property
    def judged_span(self) -> float:
        """S of it that were judged."""
        return min(self.period * len(self.judged), self.span)

    @property
    def paced(self) -> float:
        """S between samples, the median, where nothing was judged and it is not the period; else 0.

        A sample is judged only on the grid of the period.
        """
        stamps = [reading.t for reading in self.readings if reading.reason != LOST]
        if self.judged or len(stamps) < LEAST_PACED or not self.period:
            return 0.0
        pace = float(np.median(np.diff(stamps)))
        return pace if abs(pace - self.period) > OTHER_PACE * self.period else 0.0

    @property
    def filled(self) -> int:
        """How many samples nobody measured: they are filled in between others, and not judged."""
        return sum(map(_filled, self.readings))

    @property
    def said_filled(self) -> str:
        """The same in words, of how many; empty if there is none."""
        return said_filled(self.filled, sum(not reading.waits for reading in self.readings))

    @property
    def said_wide(self) -> str:
        """In how many samples the tube is wider than all that was measured here; empty if few.

        All that was measured: the range, or the largest value of a signal that hardly changes.
        """
        judged = [r for r in self.judged if r.measured]
        widths = np.array(
            [list(r.half_widths) or [self.half_width] * len(r.measured) for r in judged]
        )
        if not widths.any():
            return ""
        measured = np.array([r.measured for r in judged])
        ranges = np.maximum(np.ptp(measured, axis=0), np.abs(measured).max(axis=0))
        share = (widths > ranges).mean(axis=0)
        worst = int(np.argmax(share))
        if share[worst] <= MOST_WIDE:
            return ""
        which = f" of output {worst}" if len(share) > 1 else ""
        return (
            f"in {100 * share[worst]:.0f} % of the samples judged the half-width{which} is more "
            f"than all that was measured here, {ranges[worst]:.3g} {self.unit}".rstrip()
            + ": the tube says nothing there"
        )

    @property
    def unjudged(self) -> tuple[Stretch, ...]:
        """Every stretch that was not judged, without the starts of runs outside such stretches.

        Filled samples are one stretch where they are more than MOST_FILLED of all.
        """
        found: list[Stretch] = []
        if self.filled > MOST_FILLED * len(self.readings):
            times = [reading.t for reading in self.readings if _filled(reading)]
            reason = f"{self.said_filled}: more than {100 * MOST_FILLED:g} %"
            found.append(Stretch(times[0], times[-1], len(times), (reason,)))
        row: list[Stretch] = []
        for part, opens in (*self._parts(), (None, False)):
            if part is not None and (row or opens):
                row.append(part)
            elif row:
                found.append(_joined(row))
                row = []
        return tuple(found)

    def _parts(self) -> Iterator[tuple[Stretch | None, bool]]:
        """Sample by sample what was not judged, None if it was, and whether that is a loss.

        Samples that never came are one part; those that start a run and filled ones are no loss.
        """
        before: Reading | None = None
        for reading in self.readings:
            if reading.reason == LOST:
                continue  # the next one that came says how many
            starts = before is not None and before.waits and reading.waits
            if before is not None and self.period > 0.0 and not starts:
                lost = round((reading.t - before.t) / self.period) - 1
                if lost > 0:
                    said = "1 sample is" if lost == 1 else f"{lost} samples are"
                    first, last = before.t + self.period, before.t + lost * self.period
                    yield Stretch(first, last, lost, (f"{said} missing",)), True
            why = () if reading.waits else (reading.reason,)
            unknown = reading.status is Status.UNKNOWN
            loses = unknown and not reading.waits and not _filled(reading)
            yield Stretch(reading.t, reading.t, 1, why) if unknown else None, loses
            before = reading

    @property
    def judged(self) -> tuple[Reading, ...]:
        """The readings that are not unknown."""
        return tuple(r for r in self.readings if r.status is not Status.UNKNOWN)

    @property
    def worst(self) -> Reading | None:
        """The reading with the least margin."""
        return min(self.judged, key=lambda r: r.margin, default=None)

    @property
    def first_bad(self) -> Reading | None:
        """The first reading that is outside or whose assumption is violated."""
        return next((r for r in self.judged if r.status is not Status.INSIDE), None)

    @property
    def first_outside(self) -> Reading | None:
        """The first reading that is outside; often the assumption is violated before."""
        return next((r for r in self.judged if r.status is Status.OUTSIDE), None)

    @property
    def first_alarm(self) -> Reading | None:
        """The first reading with a second alarm, which is no verdict."""
        return next((r for r in self.judged if r.alarm), None)

    @property
    def beyond(self) -> str:
        """What was commanded that no training trial had, and from when on; empty if nothing."""
        said = (r.assuming.partition(BEYOND) for r in self.judged)
        return next((f"{BEYOND}{what}" for _, found, what in said if found), "")

    @property
    def assumption(self) -> float:
        """The largest used part of the assumption; 1 is all of it, NaN where none was measured."""
        used = [r.assumption for r in self.judged if not math.isnan(r.assumption)]
        return max(used, default=math.nan)

    @property
    def verdict(self) -> str:
        """The status at the first bad sample, else inside, else unknown.

        Inside says that every sample was judged; those that start a run are not counted, nor up to
        MOST_FILLED that are filled in.
        """
        if self.first_bad is not None:
            return self.first_bad.status.value
        whole = self.judged and not self.unjudged
        return Status.INSIDE.value if whole else Status.UNKNOWN.value

    @property
    def reason(self) -> str:
        """Why it is not inside; empty if it is."""
        if self.first_bad is not None:
            return self.first_bad.reason
        if self.paced:
            return f"its samples come every {self.paced:.4g} s, the model's every {self.period:g} s"
        if self.unjudged:
            return self.unjudged[0].reasons[0]
        return "" if self.judged or not self.readings else self.readings[-1].reason


def _filled(reading: Reading) -> bool:
    return reading.reason.startswith(FILLED)


@dataclass(frozen=True)
class ToJudge:
    """Bags to hold against a design, and those that it was made with, each with its use.

    One that it was made with is judged only if all of them are such.
    """

    judged: tuple[Path, ...]
    used: Mapping[Path, str]

    @property
    def said(self) -> list[str]:
        """A line for each use, with the names of its bags; empty if there is none."""
        uses: dict[str, list[str]] = {}
        for path, use in self.used.items():
            uses.setdefault(use, []).append(trial_name(path))
        what = "judged all the same" if set(self.judged) & set(self.used) else "not judged"
        return [f"{what}: {', '.join(names)} (used for {use})" for use, names in uses.items()]


def to_judge(design: AnyDesign, bags: Sequence[Path]) -> ToJudge:
    """The bags that the design was not made with, by their content, else all of them.

    A verdict on a recording that made a design says little.
    """
    made_with = design.made_with
    used = {bag: made_with[digest] for bag in bags if (digest := bag_digest(bag)) in made_with}
    return ToJudge(tuple(bag for bag in bags if bag not in used) or tuple(bags), used)


def replay_bag(
    design: AnyDesign,
    bag: Path | str,
    *,
    centre: Centre,
    definitions: Definitions | None = None,
) -> Replay:
    """Every response in `bag` held against a funnel.

    definitions: of message types that the bag does not define. Raises BagError as
    `replay_messages`.
    """
    stamped = replay_messages(design, bag, centre=centre, definitions=definitions)
    readings = tuple(entry.reading for entry in stamped)
    stamps_ns = tuple(entry.stamp_ns for entry in stamped)
    return replace(_replayed(design, Path(bag).name, readings), stamps_ns=stamps_ns)


def replay(design: AnyDesign, run: Trajectory) -> Replay:
    """Hold a run that is in memory against a funnel, sample by sample.

    Args:
        design: with a proof.
        run: what was measured (y) and commanded (u); the state (y) of other funnels than tubes.

    Returns:
        What the monitor says of it; it prints as one sentence.

    Raises:
        DataError: if the funnel cannot be monitored in float64.
    """
    monitor, rows = design.monitor(), zip(run.t.tolist(), run.y, run.u, strict=True)
    return _replayed(design, run.name, tuple(monitor.update(*row) for row in rows))


def _replayed(design: AnyDesign, name: str, readings: tuple[Reading, ...]) -> Replay:
    """The replay without what only a bag has."""
    unit, half_width = "", 0.0
    if isinstance(design.funnel, TubeFunnel) and len(design.signals[0]) == 1:
        unit, half_width = design.signals[0][0].unit, float(design.funnel.half_widths[0])
    return Replay(
        name=name,
        readings=readings,
        axis=design.name,
        unit=unit,
        half_width=half_width,
        period=design.period,
    )


def replay_messages(
    design: AnyDesign,
    bag: Path | str,
    *,
    centre: Centre = Centre.PROFILE,
    definitions: Definitions | None = None,
) -> list[Stamped]:
    """What the live monitor says of the messages in `bag`, one by one as they were recorded.

    Runs that a controller announced in it begin where it said, if the tube is around its plan;
    without an announcement the first complete sample is sample 0. Raises BagError if the bag cannot
    be read or does not hold the funnel's signals with stamps of their clock. What is wrong with the
    signals themselves (NaN, gaps, time going back) shows as unknown, as it does live.
    """
    bag = place(bag)
    planned = centre is Centre.PROFILE or not isinstance(design.funnel, TubeFunnel)
    announced = planned and bool(announced_runs(design, bag, definitions))
    watch = Watch(design, centre=centre, announced=announced)
    stamped = [
        entry for said in _fed(watch, bag, definitions, announced=announced) for entry in said
    ]
    stamped += watch.end()
    if not stamped:
        raise BagError(f"{bag}: no sample with all of {watch.pairing}")
    return stamped


def announced_runs(
    design: AnyDesign, bag: Path | str, definitions: Definitions | None = None
) -> list[Run]:
    """The runs of this funnel that a controller announced in `bag`, in the order it did."""
    with Bag(bag, definitions=definitions) as source:
        found = [_run(message, source) for message in source.messages(_run_topics(source))]
    digest = design.digest
    return [run for run in found if run.funnel == digest and not run.ended]


def _fed(
    watch: Watch,
    bag: Path,
    definitions: Definitions | None,
    *,
    announced: bool,
) -> Iterator[list[Stamped]]:
    """What `watch` says to every message, by log time; as recorded where it goes back itself."""
    digest = watch.design.digest
    with Bag(bag, definitions=definitions) as source:
        _check(watch.pairing, source, bag)
        run_topics = _run_topics(source) if announced else []
        topics = watch.pairing.topics
        doubt = _doubt(watch.pairing, source)
        set_back = watch.pairing.clock == "log" and bool(source.log_order(topics).back)
        for message in source.messages([*run_topics, *topics], as_recorded=set_back):
            if message.topic in run_topics:
                run = _run(message, source)
                if run.funnel == digest and run.ended:
                    watch.stop(run.last_ns, run.ended)
                elif run.funnel == digest:
                    yield watch.begin(run.start_ns)
                continue
            stamp_ns = watch.pairing.stamp(message.data, message.log_time_ns)
            if doubt and message.topic in watch.pairing.response_topics:
                yield watch.refuse(stamp_ns, doubt)
                continue
            yield watch.message(message.topic, stamp_ns, message.data)


def _doubt(sampler: Sampler, source: Bag) -> str:
    """Why nobody knows whose signals these are; empty if it is known, or they cannot be read."""
    driving = [factor for part in sampler.excitations for factor in part]
    paths = {str(signal.path): signal.path for signal in (*sampler.responses, *driving)}
    measured = {str(signal.path) for signal in sampler.responses}
    try:
        columns = read_columns(source, paths)
    except BagError:
        return ""  # a message that cannot be read is unknown anyway
    for name, path in paths.items():
        if said := columns[path.topic].doubt(name, responds=name in measured):
            return f"{name}: {said}"
    return ""


def _check(sampler: Sampler, source: Bag, bag: Path) -> None:
    """BagError unless the bag has the signals and their clock."""
    for topic in sampler.topics:
        kind = source.types_on(topic)
        try:
            sampler.check(topic, *kind)
        except BagError as error:
            raise BagError(f"{bag}: {error}") from error


def _run_topics(source: Bag) -> list[str]:
    return [
        topic
        for topic in source.topics
        if topic.endswith(RUN_TOPIC) and source.types_on(topic)[0] == STRING
    ]


def _run(message: Any, source: Bag) -> Run:
    text = decode(message.data, *source.types_on(message.topic))
    return Run.from_document(files.parse_document(text.data, source=message.topic))  # type: ignore[attr-defined]
