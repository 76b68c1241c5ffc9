"""The live demonstration: recorder, publisher, monitor and player as processes over real DDS.

A recorded trial is played in real time twice, as it is and with a broken sensor, and what the
nodes say is compared with the offline replay. Run by `nlsid demo` and by the tests.

python -m nlsid_ros.demo.live --funnel DIR/funnel.json --bag BAG --out DIR [--json]
"""

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.utilities import try_shutdown
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from bags.chain.faults import FAULTS, write_faulty_copy
from bags.designs.documents import load
from bags.designs.wiring import sampler_of
from bags.monitoring.replay import replay_bag
from bags.recordings.bag import Bag
from bags.recordings.message_types import header_stamp_ns
from nlsid_core.errors import NlsidError
from nlsid_core.running.comparison import Centre
from nlsid_core.running.reading import Status
from nlsid_ros import qos
from nlsid_ros.message_classes import message_class
from nlsid_ros.messages import stamp_ns_of
from nlsid_ros.processes import isolate, python, settings

FAULT = "scaled by 0.6"
PATIENCE = 120.0  # s for a process to come up or a message to arrive, on a loaded machine
SETTLE = 0.5  # s for the last messages of a pass
MARGIN_TOLERANCE = 1e-9
ALARM_LIMIT_MS = 50.0


@dataclass(frozen=True)
class LiveResult:
    """What was seen.

    alarm_ms: from the first bad sample's arrival to ERROR on /diagnostics, both at the observer;
    slightly negative when the alarm overtakes the sample on its way there. expected: the offline
    replay's reason at its first bad sample, which the alarm has to give.
    """

    sent: int
    recorded: int
    recording_equal: bool
    margins: int
    margins_expected: int
    margin_difference: float
    alarm_ms: float
    alarm: str
    expected: str

    @property
    def passed(self) -> bool:
        """Whether live and offline agree and the alarm came in time."""
        return (
            self.recording_equal
            and self.margins == self.margins_expected
            and self.margin_difference <= MARGIN_TOLERANCE
            and abs(self.alarm_ms) <= ALARM_LIMIT_MS
            and self.expected in self.alarm
        )

    def __str__(self) -> str:
        return "\n".join(
            [
                f"recorder: {self.recorded} of {self.sent} messages, "
                + ("equal to what was sent" if self.recording_equal else "NOT what was sent"),
                f"monitor: {self.margins} of {self.margins_expected} margins, at most "
                f"{self.margin_difference:.1e} from the offline replay's",
                f"sensor {FAULT}: ERROR {self.alarm_ms:.1f} ms after the first bad sample "
                f"({self.alarm})",
            ]
        )


class Observer(Node):
    """Hears what a person would: the played signals, the margins and /diagnostics."""

    def __init__(self, topics: dict[str, str]) -> None:
        super().__init__("live_observer")
        self.arrivals: dict[tuple[str, int], float] = {}
        self.margins: dict[int, float] = {}
        self.statuses: list[tuple[float, DiagnosticStatus]] = []
        for topic, msgtype in topics.items():
            self.create_subscription(
                message_class(msgtype), topic, self._heard(topic), qos.STREAM, raw=True
            )
        self.create_subscription(JointState, "/funnel_monitor/margin", self._margin, qos.STREAM)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._status, qos.EVENTS)
        self.restart = self.create_client(Trigger, "/funnel_monitor/restart")

    def _heard(self, topic: str) -> Callable[[bytes], None]:
        def heard(data: bytes) -> None:
            self.arrivals.setdefault((topic, header_stamp_ns(data)), time.monotonic())

        return heard

    def _margin(self, message: JointState) -> None:
        self.margins[stamp_ns_of(message)] = message.position[0]

    def _status(self, message: DiagnosticArray) -> None:
        self.statuses += [(time.monotonic(), entry) for entry in message.status]

    def has_said(self, node: str, text: str) -> bool:
        """Whether `node` has a status that contains `text`."""
        return any(s.name == node and text in s.message for _, s in list(self.statuses))


def run_live(funnel: Path, bag: Path, out: Path) -> LiveResult:
    """Play `bag` to the live nodes, clean and with a broken sensor, and compare with offline."""
    proved = load(funnel)
    signals = sampler_of(proved)
    with Bag(bag) as source:
        topics = {topic: source.types_on(topic)[0] for topic in signals.topics}
    faulty = out / f"{bag.name}, {FAULT}"
    write_faulty_copy(bag, faulty, str(signals.responses[0].path), FAULTS[FAULT])
    bad = replay_bag(proved, faulty, centre=Centre.COMMAND)
    if bad.first_bad is None:
        raise NlsidError(
            f"{bag.name} with its sensor {FAULT} is not flagged: {bad.reason or bad.verdict}. The "
            "demonstration needs a funnel that such a fault leaves"
        )
    bad_stamp = bad.stamps_ns[bad.readings.index(bad.first_bad)]
    recording = out / f"{bag.name}, recorded"
    with _observing(topics) as observer, _node("funnel_publisher", {"funnel": funnel}):
        with _node("funnel_monitor", {"allow_old_stamps": True}) as monitor:
            ready = partial(observer.has_said, "funnel_monitor", " yet")
            _wait("the monitor to be ready", ready, monitor)
            with _node("trajectory_recorder", {"bag": recording, "topics": list(topics)}) as node:
                _wait("the recorder", partial(observer.has_said, "trajectory_recorder", ""), node)
                _play(bag, list(topics), listeners=3)
                time.sleep(SETTLE)
            margins = dict(observer.margins)
            _restart(observer)
            observer.arrivals.clear()
            started = time.monotonic()
            _play(faulty, list(topics), listeners=2)
            time.sleep(SETTLE)
        alarms = [
            (t, s.message)
            for t, s in observer.statuses
            if t > started and s.name == "funnel_monitor" and s.level == DiagnosticStatus.ERROR
        ]
    clean = replay_bag(proved, bag, centre=Centre.COMMAND)
    expected = {
        stamp: reading.margin
        for stamp, reading in zip(clean.stamps_ns, clean.readings, strict=True)
        if reading.status is not Status.UNKNOWN
    }
    live = {stamp: margin for stamp, margin in margins.items() if stamp in expected}
    heard = observer.arrivals.get((signals.responses[0].path.topic, bad_stamp), float("nan"))
    sent, recorded = _contents(bag, list(topics)), _contents(recording, list(topics))
    return LiveResult(
        sent=len(sent),
        recorded=len(recorded),
        recording_equal=sorted(sent) == sorted(recorded),
        margins=len(live),
        margins_expected=len(expected),
        margin_difference=max(
            (abs(live[stamp] - expected[stamp]) for stamp in live), default=float("nan")
        ),
        alarm_ms=(alarms[0][0] - heard) * 1e3 if alarms else float("nan"),
        alarm=alarms[0][1] if alarms else "no alarm",
        expected=bad.reason,
    )


def _contents(bag: Path, topics: list[str]) -> list[tuple[str, int, bytes]]:
    """(topic, header stamp, bytes) of every message on `topics`."""
    with Bag(bag) as source:
        return [(m.topic, header_stamp_ns(m.data), m.data) for m in source.messages(topics)]


def _play(bag: Path, topics: list[str], *, listeners: int) -> None:
    with _node("bag_player", {"bag": bag, "topics": topics, "wait_for": listeners}) as player:
        if player.wait(timeout=PATIENCE + 60.0):
            raise NlsidError(f"bag_player ended with status {player.returncode}")


def _restart(observer: Observer) -> None:
    answer = observer.restart.call_async(Trigger.Request())
    _wait("the monitor to restart", answer.done)
    _wait("the monitor to say so", lambda: observer.has_said("funnel_monitor", "restarted"))


@contextmanager
def _observing(topics: dict[str, str]) -> Iterator[Observer]:
    """An Observer spinning in a thread of this process."""
    rclpy.init()
    observer = Observer(topics)
    executor = SingleThreadedExecutor()
    executor.add_node(observer)
    thread = threading.Thread(target=_spin, args=(executor,), daemon=True)
    thread.start()
    try:
        yield observer
    finally:
        executor.shutdown()
        thread.join(timeout=PATIENCE)
        observer.destroy_node()
        try_shutdown()


def _spin(executor: SingleThreadedExecutor) -> None:
    try:
        executor.spin()
    except ExternalShutdownException:
        return


def _node(
    name: str, parameters: Mapping[str, object]
) -> AbstractContextManager[subprocess.Popen[bytes]]:
    return python(f"nlsid_ros.{name}", settings(parameters))


def _wait(
    what: str, done: Callable[[], bool], process: subprocess.Popen[bytes] | None = None
) -> None:
    """Until it is done; NlsidError if the process that is to do it ends, or takes too long."""
    deadline = time.monotonic() + PATIENCE
    while not done():
        if process is not None and process.poll() is not None:
            raise NlsidError(f"{what}: its process ended with status {process.returncode}")
        if time.monotonic() > deadline:
            alive = "" if process is None else "Its process is alive. "
            raise NlsidError(
                f"waited {PATIENCE:g} s for {what}, in vain. {alive}{os.getloadavg()[0]:.0f} "
                f"processes want {os.cpu_count()} processors now: on a busy computer repeat this, "
                "or see that DDS reaches this computer's own processes"
            )
        time.sleep(0.02)


def main(args: list[str] | None = None) -> None:
    """Run once; status 0 if live and offline agree and the alarm came in time."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--funnel", type=Path, required=True, help="funnel.json, proof beside it")
    parser.add_argument("--bag", type=Path, required=True, help="the trial to play")
    parser.add_argument("--out", type=Path, required=True, help="folder for the recordings")
    parser.add_argument("--json", action="store_true", help="last line is one JSON object")
    options = parser.parse_args(args)
    isolate()
    try:
        result = run_live(options.funnel, options.bag, options.out)
    except (NlsidError, OSError) as error:
        sys.exit(f"live: {error}")
    print(result)
    if options.json:
        print(json.dumps(asdict(result)))
    sys.exit(0 if result.passed else 1)


if __name__ == "__main__":
    main()
