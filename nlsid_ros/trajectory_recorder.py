"""Node `trajectory_recorder`: topics into a bag, serialised as they arrive, safe against kill -9.

Subscribes to each topic once a publisher shows its type and quality of service, and writes the
messages undecoded: log time is the arrival, publish time the header stamp. What a killed recorder
loses is what came after the last chunk, at most `chunk_period`. Counts of received and lost
messages, rate, jitter and gaps go to /diagnostics every second and into the bag's metadata.
`~/pause`, `~/resume`, and `~/snapshot`, which saves the last seconds in a bag of their own.
"""

import shutil
import sys
from datetime import datetime
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from std_srvs.srv import Trigger

from bags.recordings.message_types import definition, header_stamp_ns, is_stamped, standard_types
from bags.recordings.repair import repair, unfinished_bags
from bags.recordings.writer import BagWriter
from bags.signals.arrivals import Arrival, Recent, Regularity
from nlsid_core.errors import DataError, NlsidError
from nlsid_ros import qos
from nlsid_ros.diagnostics import status
from nlsid_ros.draining import Polled
from nlsid_ros.message_classes import message_class
from nlsid_ros.running import ManagedNode, declare, declare_number, declare_text, run

NAME = "trajectory_recorder"
DISCOVERY = 0.05  # s: how often the graph is asked for publishers of topics not subscribed yet
POLL = 0.05  # s between taking what has arrived; waking rclpy costs as much as 100 messages
UNASKED = {"/rosout", "/parameter_events"}  # every node has them; a pattern does not mean them
REPORT = 1.0  # s between diagnostics


class TrajectoryRecorder(ManagedNode):
    """Records topics from its start to its end into one new bag."""

    def __init__(self) -> None:
        super().__init__(NAME)
        topics: Any = declare(
            self, "topics", [""], "/topic, /topic:=package/msg/Type or /pattern*, each"
        )
        self._name = declare_text(
            self, "bag", "", "folder of the new bag; empty: trajectory_DATE_TIME"
        )
        self._period = declare_number(
            self, "chunk_period", 0.5, "s of messages a kill may lose", between=(0.05, 1.0)
        )
        self._least_free = declare_number(
            self,
            "least_free",
            200.0,
            "MB left on the disk at which recording stops",
            between=(0.0, 1e12),
        )
        self._snapshot = declare_number(
            self, "snapshot", 0.0, "s kept in memory for ~/snapshot; 0: none", between=(0.0, 600.0)
        )
        self._repair = bool(
            declare(self, "repair", True, "finish unfinished bags beside the new one first")
        )
        self._topics = dict(_topic_and_type(entry) for entry in topics if entry)
        if not self._topics:
            raise DataError("no topics to record; set the parameter topics, e.g. ['/odom']")

    def prepare(self) -> None:
        """Finish what a killed recorder left, and refuse types that are not known."""
        path = Path(self._name)
        for bag in unfinished_bags(path.parent) if self._repair else []:
            count = repair(bag)
            self.get_logger().warning(f"{bag} was not closed; repaired, {count} messages kept")
        if any(_is_pattern(topic) and kind for topic, kind in self._topics.items()):
            raise DataError("a pattern cannot have a type; topics found by it have their own")
        for msgtype in filter(None, self._topics.values()):
            message_class(msgtype)
            definition(msgtype)

    def start(self) -> None:
        """Open a new bag and subscribe to what is there already."""
        self._waiting = {t: kind for t, kind in self._topics.items() if not _is_pattern(t)}
        self._patterns = [topic for topic in self._topics if _is_pattern(topic)]
        self._lost = dict.fromkeys(self._waiting, 0)
        self._regularity = {topic: Regularity() for topic in self._waiting}
        self._recent = Recent(self._snapshot) if self._snapshot else None
        self._snapshots = 0
        self._paused = False
        self._refused: dict[str, str] = {}
        self._full = ""
        path = Path(self._name or datetime.now().strftime("trajectory_%Y%m%d_%H%M%S"))
        self._bag = BagWriter(path, in_place=True, max_chunk_age=self._period)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", qos.EVENTS)
        self._polled = Polled(self)
        self.create_timer(POLL, self._polled.take)
        self._discovery = self.create_timer(DISCOVERY, self._connect)
        self.create_timer(self._period, lambda: None if self._full else self._bag.close_chunk())
        self.create_timer(REPORT, self._report)
        self.create_service(Trigger, "~/pause", partial(self._on_pause, True))
        self.create_service(Trigger, "~/resume", partial(self._on_pause, False))
        self.create_service(Trigger, "~/snapshot", self._on_snapshot)
        self.get_logger().info(f"recording {', '.join(self._topics)} to {path}")
        self._connect()

    def stop(self) -> None:
        """Take what has arrived, write what came of each topic into the bag, and close it."""
        self._polled.take()
        self._polled.destroy()
        if not self._full:
            self._bag.annotate(self._counts())
        self._bag.close()

    def _connect(self) -> None:
        """Subscribe to topics that have publishers now."""
        if self._patterns:
            self._find()
        for topic, asked in list(self._waiting.items()):
            publishers = self.get_publishers_info_by_topic(topic)
            if not publishers:
                continue
            del self._waiting[topic]
            msgtype = asked or publishers[0].topic_type
            try:
                kind = message_class(msgtype)
                self._bag.add_topic(topic, msgtype)
            except NlsidError as error:
                self._refused[topic] = str(error)
                self.get_logger().error(f"{topic} is not recorded: {error}")
                continue
            self._polled.subscribe(
                kind,
                topic,
                partial(self._record, topic, msgtype, is_stamped(msgtype, standard_types())),
                qos.recording_of([publisher.qos_profile for publisher in publishers]),
                on_lost=partial(self._lose, topic),
            )
        if not self._waiting and not self._patterns:
            self._discovery.cancel()

    def _find(self) -> None:
        """Wait for topics that match a pattern too."""
        for topic, _ in self.get_topic_names_and_types():
            known = topic in self._lost or topic in UNASKED
            if not known and any(fnmatchcase(topic, pattern) for pattern in self._patterns):
                self._waiting[topic] = ""
                self._lost[topic] = 0
                self._regularity[topic] = Regularity()

    def _stop_if_the_disk_is_nearly_full(self) -> None:
        free = shutil.disk_usage(self._bag.path).free / 1e6
        if free >= self._least_free or self._full:
            return
        self._full = f"recording stopped: {free:.0f} MB left, {self._least_free:g} are to stay free"
        self.get_logger().error(self._full)
        self._polled.take()
        self._bag.close()

    def _record(
        self, topic: str, msgtype: str, stamped: bool, data: bytes, info: dict[str, int]
    ) -> None:
        if self._full:
            return
        arrival_ns = info["received_timestamp"]
        stamp_ns = arrival_ns
        if stamped and len(data) >= 12:
            stamp_ns = header_stamp_ns(data)
        self._regularity[topic].update(stamp_ns)
        stamp_ns = stamp_ns if stamp_ns >= 0 else arrival_ns
        if self._recent is not None:
            self._recent.add(Arrival(topic, msgtype, data, arrival_ns, stamp_ns))
        if not self._paused:
            self._bag.write(topic, msgtype, data, log_time_ns=arrival_ns, publish_time_ns=stamp_ns)

    def _lose(self, topic: str, count: int) -> None:
        self._lost[topic] = count
        self.get_logger().warning(f"{topic}: {count} messages lost so far")

    def _counts(self) -> dict[str, str]:
        """What came on each topic, in words."""
        values = {}
        for topic, lost in self._lost.items():
            regularity = self._regularity[topic]
            values[f"{topic} received"] = str(self._bag.counts.get(topic, 0))
            values[f"{topic} lost"] = str(lost)
            values[f"{topic} gaps"] = str(regularity.gaps)
            values[f"{topic} rate [Hz]"] = f"{regularity.rate:.4g}"
            values[f"{topic} jitter [ms]"] = f"{regularity.jitter * 1e3:.3g}"
        return values

    def _on_pause(
        self, pause: bool, _request: Trigger.Request, answer: Trigger.Response
    ) -> Trigger.Response:
        self._polled.take()  # what came before belongs to before
        self._paused = pause
        answer.success, answer.message = True, "paused" if pause else "recording"
        return answer

    def _on_snapshot(self, _request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Save the last seconds in a bag of their own."""
        if self._recent is None:
            answer.message = "no snapshots are kept; set the parameter snapshot to seconds"
            return answer
        self._polled.take()
        self._snapshots += 1
        path = self._bag.path.with_name(f"{self._bag.path.name}_snapshot_{self._snapshots}")
        try:
            count = self._recent.save(path)
        except (NlsidError, OSError) as error:
            answer.message = str(error)
            return answer
        answer.success, answer.message = True, f"{count} messages in {path}"
        return answer

    def _report(self) -> None:
        """Counts per topic; a warning while a topic is missing, silent or losing messages."""
        self._stop_if_the_disk_is_nearly_full()
        values = {"bag": str(self._bag.path)} | self._counts()
        level, text = DiagnosticStatus.OK, "paused" if self._paused else "recording"
        silent = [topic for topic in self._lost if not self._bag.counts.get(topic)]
        losing = [topic for topic, lost in self._lost.items() if lost]
        if silent or losing:
            level = DiagnosticStatus.WARN
            text = "; ".join(
                [f"nothing on {topic} yet" for topic in silent]
                + [f"messages lost on {topic}" for topic in losing]
            )
        if self._refused:
            level = DiagnosticStatus.ERROR
            text = "; ".join(f"{topic}: {why}" for topic, why in self._refused.items())
        if self._full:
            level, text = DiagnosticStatus.ERROR, self._full
        now = self.get_clock().now().to_msg()
        self._diagnostics.publish(status(now, NAME, level, text, values))


def _is_pattern(topic: str) -> bool:
    return "*" in topic or "?" in topic


def _topic_and_type(entry: str) -> tuple[str, str]:
    topic, _, msgtype = entry.partition(":=")
    return topic if topic.startswith("/") else f"/{topic}", msgtype


def main(args: list[str] | None = None) -> None:
    """Entry point of `ros2 run nlsid trajectory_recorder`."""
    try:
        run(TrajectoryRecorder, args)
    except (NlsidError, OSError) as error:
        sys.exit(f"{NAME}: {error}")


if __name__ == "__main__":
    main()
