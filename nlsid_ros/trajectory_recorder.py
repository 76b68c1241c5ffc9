"""Node `trajectory_recorder`: topics into a bag, serialised as they arrive, safe against kill -9.

Subscribes to each topic once a publisher shows its type and quality of service, and writes the
messages undecoded: log time is the arrival (of /clock, in simulated time), publish time the header
stamp. What a killed recorder loses is what came after the last chunk, at most `chunk_period` and
one WRITE. Counts of received and lost messages go to /diagnostics every second and into the bag's
metadata.
`~/start` and `~/stop` begin and end a bag, `~/snapshot` saves the last seconds in a bag of their
own.
"""

import time
from contextlib import suppress
from datetime import datetime
from functools import partial
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticStatus
from std_msgs.msg import String

from bags.chain.config import load_config
from bags.recordings.definitions import Definition, read_definitions
from bags.recordings.message_types import header_stamp_ns
from bags.recordings.quality import Profile
from bags.recordings.writer import BagWriter
from bags.signals.recording import Arrival, LogClock, Recent, Recording
from bags.tools.recover import repair, unfinished_bags
from nlsid_core import files
from nlsid_core.errors import BagError, DataError, NlsidError
from nlsid_ros import qos
from nlsid_ros.message_classes import message_class
from nlsid_ros.running import ManagedNode, Parameter
from nlsid_ros.starting import entry_point
from nlsid_ros.subscribing import Received, Subscriptions, Wanted

DISCOVERY = 0.05  # s: how often the graph is asked for publishers of topics not subscribed yet
WRITE = 0.05  # s between writing what has arrived
MOST_TOPICS = 12  # that a status names: with the rest it has at most 20 values
SAID_BY = "excitation/experiment"  # the topic on which an excitation says what it does,
EXPERIMENT = "experiment"  # and the custom datum that holds it


class TrajectoryRecorder(ManagedNode):
    """Records topics into one new bag after another."""

    name = "trajectory_recorder"
    task = "recording"
    is_watched = True
    parameters = (
        Parameter("topics", [""], "/topic, /topic:=package/msg/Type or /pattern*, each"),
        Parameter("bag", "", "folder of the new bag, later ones _2, _3, ...; empty: by date"),
        Parameter("at_once", True, "begin a bag when activated; false: wait for ~/start"),
        Parameter("chunk_period", 0.5, "s of messages a kill may lose", (0.05, 0.9)),
        Parameter("least_free", 200.0, "MB left on the disk at which recording stops", (0.0, 1e12)),
        Parameter("snapshot", 0.0, "s kept in memory for ~/snapshot; 0: none", (0.0, 600.0)),
        Parameter("repair", True, "finish unfinished bags beside the new one first"),
        Parameter("definitions", [""], ".msg files and packages' share folders of custom types"),
        Parameter("config", "", "a robot's configuration: its signals' topics are recorded too"),
    )
    _bags = 0

    def read_parameters(self) -> None:
        """Find what is to be recorded; DataError if that is nothing."""
        values = self.values
        self._given = [Path(path) for path in values.definitions if path]
        entries = [entry for entry in values.topics if entry]
        if values.config:
            settings = load_config(Path(values.config))
            entries += [self.signal_topic(topic) for topic in settings.signals.topics]
            self._given += settings.definitions
        parsed = [Wanted.parse(entry, self.get_namespace()) for entry in entries]
        self._wanted = list({wanted.topic: wanted for wanted in reversed(parsed)}.values())[::-1]
        if not self._wanted:
            raise DataError(
                "no topics to record; set the parameter topics, e.g. ['/odom'], or config"
            )

    def prepare(self) -> None:
        """Finish what a killed recorder left, and refuse what could not be recorded."""
        for wanted in self._wanted:
            if wanted.is_pattern and wanted.msgtype:
                raise DataError("a pattern cannot have a type; topics found by it have their own")
            if wanted.msgtype:
                message_class(wanted.msgtype)
        self._definitions = read_definitions(self._given)
        for bag in unfinished_bags(Path(self.values.bag).parent) if self.values.repair else []:
            try:
                count = repair(bag)
            except (NlsidError, OSError) as error:
                self.get_logger().error(f"{bag} was not closed and cannot be repaired: {error}")
                continue
            self.get_logger().warning(f"{bag} was not closed; repaired, {count} messages kept")

    def start(self) -> None:
        """Subscribe to what is there already, and open a bag unless that is to wait."""
        self._expected: list[str] = []
        self._recorded: dict[str, Definition] = {}
        self._offered: dict[str, tuple[Profile, ...]] = {}
        self._recent = Recent(self.values.snapshot) if self.values.snapshot else None
        self._snapshots = 0
        self._experiment: dict[str, str] = {}
        self._recording: Recording | None = None
        self._warned = ""
        self._simulated = bool(self.get_parameter("use_sim_time").value)
        self._clock_of_log = LogClock()
        if self.values.at_once:
            self._begin()
        else:
            self.get_logger().info("waiting for ~/start")
        self.keep_reporting(self._report)
        self._topics = Subscriptions(self, self._definitions, self, self._wanted)
        self.create_subscription(String, SAID_BY, self._on_experiment, qos.DOCUMENT)
        self.every(WRITE, self._take)
        self.every(DISCOVERY, self._topics.look)
        self.every(self.values.chunk_period, self._keep_up)
        self.serve("start", self._on_start)
        self.serve("stop", self._on_stop)
        self.serve("snapshot", self._on_snapshot)
        self._topics.look()

    def stop(self) -> None:
        """Take what has arrived, write what came of each topic into the bag, and close it."""
        self._topics.take()
        self._topics.drop_all()
        if self._recording is not None:
            self._close(self._recording)

    def _close(self, recording: Recording) -> str:
        """Close it; what is then to be said of it."""
        recording.close()
        said = recording.ended or f"{recording.bag.path} is closed"
        if not recording.ended:
            self.get_logger().info(said)
        return said

    def _take(self) -> None:
        """Write what has arrived; before simulated time goes on it waits."""
        if self._simulated:
            simulated_ns = self.get_clock().now().nanoseconds
            if not simulated_ns:
                return
            self._clock_of_log.look(time.time_ns(), simulated_ns)
            if not self._clock_of_log.goes:
                return
        self._topics.take()

    def _begin(self) -> Path:
        """Open the next bag."""
        values = self.values
        name = values.bag or datetime.now().strftime("trajectory_%Y%m%d_%H%M%S")
        path = Path(name if not (values.bag and self._bags) else f"{name}_{self._bags + 1}")
        writer = BagWriter(path)
        self._bags += 1
        self._ended = ""
        self._recording = Recording(writer, least_free=values.least_free)
        for topic in self._expected:
            self._recording.expect(topic)
        for topic, definition in self._recorded.items():
            self._recording.add_topic(topic, definition, self._offered[topic])
        self._recording.annotate(self._experiment)
        self.get_logger().info(
            f"recording {', '.join(each.topic for each in self._wanted)} to {path}"
        )
        return path

    def expect(self, topic: str) -> None:
        """Say what is missing while nobody publishes a topic."""
        self._expected.append(topic)
        if self._recording is not None:
            self._recording.expect(topic)

    def begin(self, topic: str, definition: Definition, offered: tuple[Profile, ...]) -> Received:
        """Take a topic's messages from now on."""
        if self._recording is not None:
            self._recording.add_topic(topic, definition, offered)
        self._recorded[topic], self._offered[topic] = definition, offered
        return partial(self._record, topic, definition.msgtype, definition.is_stamped)

    def _record(
        self, topic: str, msgtype: str, stamped: bool, data: bytes, info: dict[str, int]
    ) -> None:
        arrival_ns = self._clock_of_log.at(info["received_timestamp"])
        stamp_ns = arrival_ns
        if stamped:
            with suppress(BagError):  # serialised by rules whose header we do not know
                stamp_ns = header_stamp_ns(data)
        publish_ns = stamp_ns if stamp_ns >= 0 else arrival_ns
        number = info["publication_sequence_number"]
        arrival = Arrival(topic, msgtype, data, arrival_ns, publish_ns, number)
        if self._recent is not None:
            self._recent.add(arrival)
        if self._recording is not None:
            self._recording.add(arrival)

    def _on_experiment(self, message: String) -> None:
        """Keep what an excitation says it does; how one ended is for the bag it was in."""
        try:
            said = files.parse_document(message.data)
        except NlsidError as error:
            self.get_logger().warning(f"{SAID_BY} is not in the bag's metadata: {error}")
            return
        ended = "ended" in said
        if ended and not self._experiment:  # latched, of an experiment before this recorder
            return
        group = said.get("repeat_group")
        now = {EXPERIMENT: message.data}
        if isinstance(group, str):
            now["repeat_group"] = group
        if self._recording is not None:
            self._recording.annotate(now)
        self._experiment = {} if ended else now

    def _keep_up(self) -> None:
        if self._recording is None:
            return
        self._recording.keep_up()
        if self._recording.ended != self._ended:
            self._ended = self._recording.ended
            self.get_logger().error(self._ended)
            self._report()

    def _on_start(self) -> tuple[bool, str]:
        if self._recording is not None and not self._recording.ended:
            return False, f"recording {self._recording.bag.path} already"
        self._take()  # what came before belongs to before
        return True, str(self._begin())

    def _on_stop(self) -> tuple[bool, str]:
        if self._recording is None:
            return False, "nothing is being recorded"
        self._take()
        recording, self._recording = self._recording, None
        said = self._close(recording)
        return not recording.ended, said

    def _on_snapshot(self) -> tuple[bool, str]:
        """Save the last seconds in a bag of their own."""
        if self._recent is None:
            return False, "no snapshots are kept; set the parameter snapshot to seconds"
        self._take()
        self._snapshots += 1
        base = (
            self._recording.bag.path
            if self._recording is not None
            else Path(self.values.bag or self.name)
        )
        path = base.with_name(f"{base.name}_snapshot_{self._snapshots}")
        count = self._recent.save(path, definitions=self._recorded, offered=self._offered)
        return True, f"{count} messages in {path}"

    def _report(self) -> None:
        """Counts; a warning while a topic is missing, silent or losing messages."""
        recording = self._recording
        level, text, values = DiagnosticStatus.OK, "waiting for ~/start", {}
        if recording is not None:
            values = {"bag": str(recording.bag.path)} | recording.summary(MOST_TOPICS)
            text = "recording"
            self._topics.follow()
            if warnings := [*recording.warnings(), *self._topics.warnings.values()]:
                level, text = DiagnosticStatus.WARN, "; ".join(warnings)
        if problems := self._topics.problems:
            level = DiagnosticStatus.ERROR
            text = "; ".join(f"{topic}: {why}" for topic, why in problems.items())
        if recording is not None and recording.ended:
            level, text = DiagnosticStatus.ERROR, recording.ended
        if self._simulated and not self.get_clock().now().nanoseconds:
            level, text = DiagnosticStatus.ERROR, f"nobody publishes /clock; {text}"
        if level == DiagnosticStatus.WARN and text != self._warned:
            self.get_logger().warning(text)
        self._warned = text
        self.report(level, text, values)


main = entry_point(TrajectoryRecorder)

if __name__ == "__main__":
    main()
