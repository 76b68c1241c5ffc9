"""Node `trajectory_recorder`: topics into a bag, serialised as they arrive, safe against kill -9.

Subscribes to each topic once a publisher shows its type and quality of service, and writes the
messages undecoded: log time is the arrival, publish time the header stamp. What a killed recorder
loses is what came after the last chunk, at most `chunk_period`. Counts of received and lost
messages go to /diagnostics every second.
"""

import shutil
import sys
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.event_handler import QoSMessageLostInfo, SubscriptionEventCallbacks

from bags.message_types import definition, header_stamp_ns, is_stamped, standard_types
from bags.repair import repair, unfinished_bags
from bags.writer import BagWriter
from nlsid_core.errors import DataError, NlsidError
from nlsid_ros import qos
from nlsid_ros.diagnostics import status
from nlsid_ros.draining import Polled
from nlsid_ros.message_classes import message_class
from nlsid_ros.running import ManagedNode, declare, declare_number, declare_text, run

NAME = "trajectory_recorder"
DISCOVERY = 0.05  # s: how often the graph is asked for publishers of topics not subscribed yet
POLL = 0.005  # s between taking what has arrived; the middleware says when it did
REPORT = 1.0  # s between diagnostics


class TrajectoryRecorder(ManagedNode):
    """Records topics from its start to its end into one new bag."""

    def __init__(self) -> None:
        super().__init__(NAME)
        topics: Any = declare(self, "topics", [""], "/topic or /topic:=package/msg/Type, each")
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
        for msgtype in filter(None, self._topics.values()):
            message_class(msgtype)
            definition(msgtype)

    def start(self) -> None:
        """Open a new bag and subscribe to what is there already."""
        self._waiting = dict(self._topics)
        self._lost = dict.fromkeys(self._waiting, 0)
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
        self.get_logger().info(f"recording {', '.join(self._waiting)} to {path}")
        self._connect()

    def stop(self) -> None:
        """Take what has arrived, and close the bag."""
        self._polled.take()
        self._bag.close()

    def _connect(self) -> None:
        """Subscribe to topics that have publishers now."""
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
                events=SubscriptionEventCallbacks(message_lost=partial(self._lose, topic)),
            )
        if not self._waiting:
            self._discovery.cancel()

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
        self._bag.write(
            topic,
            msgtype,
            data,
            log_time_ns=arrival_ns,
            publish_time_ns=stamp_ns if stamp_ns >= 0 else arrival_ns,
        )

    def _lose(self, topic: str, event: QoSMessageLostInfo) -> None:
        self._lost[topic] = event.total_count
        self.get_logger().warning(f"{topic}: {event.total_count} messages lost so far")

    def _report(self) -> None:
        """Counts per topic; a warning while a topic is missing, silent or losing messages."""
        self._stop_if_the_disk_is_nearly_full()
        values = {"bag": str(self._bag.path)}
        for topic, lost in self._lost.items():
            values[f"{topic} received"] = str(self._bag.counts.get(topic, 0))
            values[f"{topic} lost"] = str(lost)
        level, text = DiagnosticStatus.OK, "recording"
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
