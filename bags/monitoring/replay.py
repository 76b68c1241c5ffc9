"""Offline monitoring: a bag's messages through the same sampling and monitor as the live node."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import dropwhile, takewhile
from pathlib import Path
from typing import Any

from bags.designs.design import AnyDesign, is_linear
from bags.designs.documents import Proved
from bags.monitoring.announcement import Run
from bags.monitoring.watch import Stamped, Watch
from bags.recordings.bag import Bag
from bags.recordings.message_types import decode
from nlsid_core import files
from nlsid_core.errors import BagError
from nlsid_core.running.comparison import Centre
from nlsid_core.running.monitor import OVER
from nlsid_core.running.reading import Reading, Status

STRING = "std_msgs/msg/String"
RUN_TOPIC = "/run"  # how the topic of a controller's announcement ends


@dataclass(frozen=True, eq=False)
class Replay:
    """One bag's readings, and what a summary says of them.

    axis: what is measured; unit, half_width: of the one output of a linear tube, else empty and 0.
    """

    name: str
    readings: tuple[Reading, ...]
    stamps_ns: tuple[int, ...]
    axis: str
    unit: str
    half_width: float

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
    def lost(self) -> Reading | None:
        """The first reading that is unknown in a run that had begun, its proof not over."""
        begun = dropwhile(lambda r: r.status is Status.UNKNOWN, self.readings)
        return next((r for r in begun if _lost(r)), None)

    @property
    def over(self) -> Reading | None:
        """The first reading after the end of the last run's proof, which says nothing of it."""
        after = takewhile(lambda r: r.reason.startswith(OVER), reversed(self.readings))
        return min(after, key=lambda r: r.t, default=None)

    @property
    def assumption(self) -> float:
        """The part of what is assumed that is used at the last judged sample; 1 is all of it."""
        return self.judged[-1].assumption if self.judged else float("nan")

    @property
    def verdict(self) -> str:
        """The status at the first bad sample, else inside, else unknown.

        Inside says that every sample was, so a run that is lost on its way is unknown.
        """
        bad = self.first_bad
        if bad is not None:
            return bad.status.value
        whole = self.judged and self.lost is None
        return Status.INSIDE.value if whole else Status.UNKNOWN.value

    @property
    def reason(self) -> str:
        """Why it is not inside; empty if it is."""
        if self.first_bad is not None:
            return self.first_bad.reason
        if self.lost is not None:
            return self.lost.reason
        return "" if self.judged or not self.readings else self.readings[-1].reason


def _lost(reading: Reading) -> bool:
    waiting = reading.reason.startswith("waiting for ")
    over = reading.reason.startswith(OVER)
    return reading.status is Status.UNKNOWN and not (waiting or over)


def replay_bag(proved: Proved[AnyDesign], bag: Path | str, *, centre: Centre) -> Replay:
    """Every response in `bag` held against a funnel.

    Raises BagError as `replay_messages`.
    """
    design = proved.design
    stamped = replay_messages(design, bag, centre=centre)
    return Replay(
        name=Path(bag).name,
        readings=tuple(entry.reading for entry in stamped),
        stamps_ns=tuple(entry.stamp_ns for entry in stamped),
        axis=design.name,
        unit=design.model.y.unit if is_linear(design) else "",
        half_width=design.funnel.half_width if is_linear(design) else 0.0,
    )


def replay_messages(
    design: AnyDesign, bag: Path | str, *, centre: Centre = Centre.PROFILE
) -> list[Stamped]:
    """What the live monitor says of the messages in `bag`, one by one as they were recorded.

    Runs that a controller announced in it begin where it said, if the tube is around its plan;
    without an announcement the first complete sample is sample 0. Raises BagError if the bag cannot
    be read or does not hold the funnel's signals with stamps of their clock. What is wrong with the
    signals themselves (NaN, gaps, time going back) shows as unknown, as it does live.
    """
    bag = Path(bag)
    planned = centre is Centre.PROFILE or design.has_plan
    announced = planned and bool(announced_runs(design, bag))
    watch = Watch(design, centre=centre, announced=announced)
    stamped = [entry for said in _fed(watch, bag, announced=announced) for entry in said]
    stamped += watch.flush()
    if not stamped:
        raise BagError(f"{bag}: no sample with both {design.response} and {design.command}")
    return stamped


def announced_runs(design: AnyDesign, bag: Path | str) -> list[Run]:
    """The runs of this funnel that a controller announced in `bag`, in the order it did."""
    with Bag(bag) as source:
        messages = source.messages(_run_topics(source))
        found = [_run(message, source) for message in messages]
    digest = design.digest
    return [run for run in found if run.funnel == digest]


def _fed(watch: Watch, bag: Path, *, announced: bool) -> Iterator[list[Stamped]]:
    """What `watch` says to every message, in log order."""
    design = watch.design
    digest = design.digest
    with Bag(bag) as source:
        for topic in watch.pairing.topics:
            kind = source.types_on(topic)
            try:
                watch.pairing.check(topic, *kind)
            except BagError as error:
                raise BagError(f"{bag}: {error}") from error
        run_topics = _run_topics(source) if announced else []
        topics = [*run_topics, design.response.topic, design.command.topic]
        for message in source.messages(topics):
            if message.topic in run_topics:
                run = _run(message, source)
                if run.funnel == digest:
                    yield watch.begin(run.start_ns)
                continue
            stamp_ns = watch.pairing.stamp(message.data, message.log_time_ns)
            decoded = decode(message.data, *source.types_on(message.topic))
            if message.topic == design.response.topic:
                yield watch.response(stamp_ns, design.response.value(decoded))
            if message.topic == design.command.topic:
                yield watch.excitation(stamp_ns, design.command.value(decoded))


def _run_topics(source: Bag) -> list[str]:
    topics = [topic for topic in source.topics if topic.endswith(RUN_TOPIC)]
    return [topic for topic in topics if source.types_on(topic)[0] == STRING]


def _run(message: Any, source: Bag) -> Run:
    text = decode(message.data, *source.types_on(message.topic))
    return Run.from_document(files.parse_document(text.data, source=message.topic))  # type: ignore[attr-defined]
