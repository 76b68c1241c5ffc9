"""Offline monitoring: a bag's messages through the same pairing and monitor as the live node."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bags.monitoring.announcement import Run
from bags.monitoring.documents import ProvedFunnel
from bags.monitoring.watch import Stamped, Watch
from bags.recordings.bag import Bag
from bags.recordings.message_types import decode, header_stamp_ns, is_stamped
from bags.signals.signal import SignalPath
from nlsid_core import _json
from nlsid_core.errors import BagError
from nlsid_core.monitor import Nominal, Reading, Status

RESPONSE, EXCITATION = "response", "excitation"
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


def replay_bag(proved: ProvedFunnel, bag: Path | str, *, nominal: Nominal) -> Replay:
    """Every response in `bag` held against the funnel, message by message as it was recorded.

    Raises BagError if the bag cannot be read or does not hold the funnel's signals on stamped
    messages. What is wrong with the signals themselves (NaN, gaps, time going back) shows as
    unknown, as it does live.
    """
    bag, model = Path(bag), proved.model
    run = announced_run(proved, bag) if nominal is Nominal.PROFILE else None
    watch = Watch(proved.monitor(nominal), announced=run is not None)
    stamped: list[Stamped] = [] if run is None else watch.begin(run.start_ns)
    for role, stamp_ns, value in _events(bag, model.y.path, model.u.path):
        feed = watch.response if role == RESPONSE else watch.excitation
        stamped += feed(stamp_ns, value)
    stamped += watch.flush()
    if not stamped:
        raise BagError(f"{bag}: no message on {model.y.path}")
    return Replay(
        name=bag.name,
        readings=tuple(entry.reading for entry in stamped),
        stamps_ns=tuple(entry.stamp_ns for entry in stamped),
        axis=model.y.name,
        unit=model.y.unit,
        half_width=proved.funnel.half_width,
    )


def announced_run(proved: ProvedFunnel, bag: Path | str) -> Run | None:
    """The last run of this funnel that a controller announced in `bag`, None if there is none."""
    digest = _json.digest(proved.funnel.document())
    found = None
    with Bag(bag) as source:
        topics = [t for t, kind in source.topics.items() if t.endswith(RUN_TOPIC)]
        topics = [topic for topic in topics if source.types_on(topic)[0] == STRING]
        for message in source.messages(topics):
            text = decode(message.data, *source.types_on(message.topic))
            run = Run.from_document(_json.parse_document(text.data, source=message.topic))  # type: ignore[attr-defined]
            found = run if run.funnel == digest else found
    return found


def _events(bag: Path, response: str, excitation: str) -> Iterator[tuple[str, int, float]]:
    """(role, header stamp in ns, value) of every message of the two signals, in log order."""
    paths = {RESPONSE: SignalPath.parse(response), EXCITATION: SignalPath.parse(excitation)}
    with Bag(bag) as source:
        kinds = {role: source.types_on(path.topic) for role, path in paths.items()}
        for role, path in paths.items():
            path.check(*kinds[role])
            if not is_stamped(*kinds[role]):
                raise BagError(f"{bag}: {path.topic} ({kinds[role][0]}) has no header stamp")
        for message in source.messages([path.topic for path in paths.values()]):
            for role, path in paths.items():
                if path.topic == message.topic:
                    value = path.value(decode(message.data, *kinds[role]))
                    yield role, header_stamp_ns(message.data), value
