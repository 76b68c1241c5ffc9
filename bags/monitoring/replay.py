"""Offline monitoring: a bag's messages through the same pairing and monitor as the live node."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bags.monitoring.announcement import Run
from bags.monitoring.designs import Design, LinearDesign, TrackingDesign
from bags.monitoring.documents import Proved
from bags.monitoring.watch import Stamped, Watch
from bags.recordings.bag import Bag
from bags.recordings.message_types import decode, header_stamp_ns, is_stamped
from nlsid_core import _json
from nlsid_core.errors import BagError
from nlsid_core.monitor import Nominal, Reading, Status

STRING = "std_msgs/msg/String"
RUN_TOPIC = "/run"  # how the topic of a controller's announcement ends


@dataclass(frozen=True, eq=False)
class Replay:
    """One bag's readings, and what a summary says of them."""

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
    def budget_spent(self) -> float:
        """The fraction of the disturbance budget spent at the last judged sample."""
        return self.judged[-1].budget_spent if self.judged else float("nan")

    @property
    def verdict(self) -> str:
        """The status at the first bad sample, else inside, else unknown."""
        bad = self.first_bad
        if bad is not None:
            return bad.status.value
        return Status.INSIDE.value if self.judged else Status.UNKNOWN.value

    @property
    def reason(self) -> str:
        """Why it is not inside; empty if it is."""
        if self.first_bad is not None:
            return self.first_bad.reason
        return "" if self.judged or not self.readings else self.readings[-1].reason


def replay_bag(proved: Proved[LinearDesign], bag: Path | str, *, nominal: Nominal) -> Replay:
    """Every response in `bag` held against a tube of a difference equation.

    Raises BagError as `replay_messages`.
    """
    design = proved.design
    stamped = replay_messages(design, bag, nominal=nominal)
    return Replay(
        name=Path(bag).name,
        readings=tuple(e.reading for e in stamped if isinstance(e.reading, Reading)),
        stamps_ns=tuple(entry.stamp_ns for entry in stamped),
        axis=design.name,
        unit=design.model.y.unit,
        half_width=design.funnel.half_width,
    )


def replay_messages(design: Design, bag: Path | str, *, nominal: Nominal) -> list[Stamped]:
    """What the live monitor says of the messages in `bag`, one by one as they were recorded.

    Runs that a controller announced in it begin where it said, if the tube is around its plan;
    without an announcement the first response is sample 0. Raises BagError if the bag cannot be
    read or does not hold the funnel's signals on stamped messages. What is wrong with the signals
    themselves (NaN, gaps, time going back) shows as unknown, as it does live.
    """
    bag = Path(bag)
    planned = nominal is Nominal.PROFILE or isinstance(design, TrackingDesign)
    announced = planned and bool(announced_runs(design, bag))
    watch = Watch(design, nominal=nominal, announced=announced)
    stamped = [entry for said in _fed(watch, bag, announced=announced) for entry in said]
    stamped += watch.flush()
    if not stamped:
        raise BagError(f"{bag}: no message on {design.response}")
    return stamped


def announced_runs(design: Design, bag: Path | str) -> list[Run]:
    """The runs of this funnel that a controller announced in `bag`, in the order it did."""
    with Bag(bag) as source:
        messages = source.messages(_run_topics(source))
        found = [_run(message, source) for message in messages]
    digest = _json.digest(design.funnel.document())
    return [run for run in found if run.funnel == digest]


def _fed(watch: Watch, bag: Path, *, announced: bool) -> Iterator[list[Stamped]]:
    """What `watch` says to every message, in log order."""
    design = watch.design
    digest = _json.digest(design.funnel.document())
    with Bag(bag) as source:
        for path in (design.response, design.command):
            kind = source.types_on(path.topic)
            path.check(*kind)
            if not is_stamped(*kind):
                raise BagError(f"{bag}: {path.topic} ({kind[0]}) has no header stamp")
        run_topics = _run_topics(source) if announced else []
        topics = [*run_topics, design.response.topic, design.command.topic]
        for message in source.messages(topics):
            if message.topic in run_topics:
                run = _run(message, source)
                if run.funnel == digest:
                    yield watch.begin(run.start_ns)
                continue
            stamp_ns = header_stamp_ns(message.data)
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
    return Run.from_document(_json.parse_document(text.data, source=message.topic))  # type: ignore[attr-defined]
