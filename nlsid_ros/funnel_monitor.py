"""Node `funnel_monitor`: holds the live state against the latched funnel.

Subscribes to the funnel, its model and its policy, and to the topics of its signals, of which there
may be several, by the model's own field paths, on message stamps. Publishes ~/margin
(sensor_msgs/JointState: stamped, named numbers; frame_id says of which funnel and run) for every
sample, ~/forecast if asked for (the same
type: `low` and `high` of each output `ahead` s after the newest sample, at that stamp, while the
command is held), ~/events when the state changes, and /diagnostics at once when it does, otherwise
once a second. Leaving the funnel calls
`stop_service` and `snapshot_service`. Missing, stale or NaN state is unknown (STALE), never inside.
What is outside, or violates the assumption, stays so until `~/restart`, which begins a new run.
"""

import sys
from array import array
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import fields
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.client import Client
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.designs.design import AnyDesign
from bags.monitoring.announcement import UNANNOUNCED, Run
from bags.monitoring.announcement import WAITING as RUN_WAITING
from bags.monitoring.watch import WAITING, Stamped, Watch
from bags.signals.arrivals import Sequence
from bags.signals.grid import seconds
from bags.signals.sampling import said_filled
from bags.viewing.drawn import HalfWidths, signal_names
from nlsid_core import files
from nlsid_core.errors import BagError, DataError, NlsidError
from nlsid_core.running.alarm import SEVERITY, AlarmOptions, State
from nlsid_core.running.comparison import Centre
from nlsid_core.running.reading import Reading, Status
from nlsid_ros import graph, qos
from nlsid_ros.diagnostics import name_of, status
from nlsid_ros.documents import (
    DesignSubscription,
    declare_expected,
    declare_limits,
    declare_wiring,
)
from nlsid_ros.message_classes import installed_types, message_class
from nlsid_ros.messages import frame_of, off_clock, patience, stamp_ns_of
from nlsid_ros.running import Arguments, ManagedNode, declare, declare_number, declare_text, run
from nlsid_ros.subscribing import Informed, Silence

NAME = "funnel_monitor"
LOOK = 0.1  # s of the wall's time between looks at the clock, and for the signals' types
RETRY = 0.5  # s until a service that has not answered is called again
THROTTLE = 5.0  # s between log lines about a service that does not answer
LATEST_COMMAND = (
    1.0  # s from a command's stamp to this node's clock; one is stamped when it is sent
)
HEARTBEAT = 1.0  # s: diagnostics are repeated this often while nothing changes
LOOK_AHEAD = 0.1  # s between forecasts
MOST_STEPS = 100  # samples ahead: each takes about as long as judging one
LEVELS = {
    State.INSIDE: DiagnosticStatus.OK,
    State.WARNING: DiagnosticStatus.WARN,
    State.ASSUMPTION_VIOLATED: DiagnosticStatus.ERROR,
    State.OUTSIDE: DiagnosticStatus.ERROR,
    State.UNKNOWN: DiagnosticStatus.STALE,
}
ALARM = [field.name for field in fields(AlarmOptions)]


class FunnelMonitor(ManagedNode):
    """Reads stamped signals, asks the core's Monitor, publishes what it says."""

    is_watched = True

    def __init__(self, arguments: Arguments = None) -> None:
        super().__init__(NAME, arguments)

    def read_parameters(self) -> None:
        """Declare them; take the values that they have now."""
        self._source = declare_text(
            self, "source", "funnel_publisher", "node that publishes the funnel"
        )
        self._controller = declare_text(
            self, "controller", "", "node that announces when a run starts; empty: first sample"
        )
        what = "what the tube is around: command, motion (command, begun in motion) or profile"
        nominal = declare_text(self, "nominal", "command", what)
        if nominal not in [centre.value for centre in Centre]:
            raise DataError(f"nominal is '{nominal}'; it should be command, motion or profile")
        self._centre = Centre(nominal)
        self._wiring = declare_wiring(self)
        self._expected = declare_expected(self)
        declare_limits(self)  # which the subscription reads
        number = partial(declare_number, self, tunable=True)
        what = (
            "s without a response, or from its stamp to this node's clock: unknown; "
            "0: 4 periods, at least 0.1"
        )
        number("stale_after", 0.0, what, between=(0.0, 60.0))
        number("command_wait", 0.02, "s a response waits for its command", between=(1e-4, 1.0))
        number("warning_margin", 0.2, "warn below", between=(0.0, 1.0))
        number("warning_time", 0.0, "s: warn if exit is predicted sooner", between=(0.0, 60.0))
        number("hysteresis", 0.0, "margin above a threshold to come back", between=(0.0, 1.0))
        number("clear_after", 0.0, "s a better state lasts before it is said", between=(0.0, 60.0))
        number("forecast", 0.0, "s ahead of the newest sample; 0: none", between=(0.0, 60.0))
        what = "judge stamps that are not of now: a recording that is played again"
        self._allow_old_stamps = bool(declare(self, "allow_old_stamps", False, what))
        what = "frame_id that the response must have; empty: that of the first"
        self._frame = declare_text(self, "response_frame", "", what)
        self._watch: Watch | None = None
        self.tune(self.tunable())
        self._stop_service = declare_text(
            self, "stop_service", "", "std_srvs/Trigger called on leaving the funnel; empty: none"
        )
        self._snapshot_service = declare_text(
            self, "snapshot_service", "", "std_srvs/Trigger called on leaving; empty: none"
        )

    def tune(self, values: Mapping[str, Any]) -> None:
        """Take patience and warnings, also in the middle of a run."""
        self._options = AlarmOptions(**{name: values[name] for name in ALARM})
        self._stale_after, self._command_wait = values["stale_after"], values["command_wait"]
        self._forecast = values["forecast"]
        if self._watch is not None:
            self._watch.warn(self._options)

    @property
    def _patient_for(self) -> float:
        """s without a response."""
        return patience(self._stale_after, self._watch.design.period if self._watch else 0.0)

    def start(self) -> None:
        """Listen for the funnel; its signals are subscribed to once it is there."""
        self._signals: dict[str, Subscription] = {}  # by topic
        self._kinds: dict[str, str] = {}  # topic -> the type it is subscribed with
        self._frames: dict[str, str] = {}  # response topic -> the frame it has to have
        self._doubts: dict[str, str] = {}  # topic -> who publishes on it, if several do
        self._unheard: dict[str, str] = {}  # response topic -> who publishes on it in vain
        self._silences: dict[str, Silence] = {}
        self._numbers: dict[str, Sequence] = {}  # topic -> its publisher's count
        self._unfit_commands: dict[str, str] = {}  # topic -> what is wrong with the newest command
        self._unfit = ""
        self._watch = None
        self._names = ""
        self._latched: tuple[State, str] | None = None
        self._heard_ns: dict[str, int] = {}  # response topic -> when its last message came
        self._run: Run | None = None
        waiting = Reading(0.0, Status.UNKNOWN, reason="waiting for a design")
        self._said: tuple[Reading, State] = waiting, State.UNKNOWN
        self._deadlines: deque[tuple[int, int]] = deque()  # (clock ns, stamp ns) of a response
        self._slowest_ns = 0
        self._judged = 0
        self._foreseen_ns = -1
        self._margin = self.create_publisher(JointState, "~/margin", qos.STREAM)
        self._ahead = self.create_publisher(JointState, "~/forecast", qos.STREAM)
        self._events = self.create_publisher(DiagnosticArray, "~/events", qos.EVENTS)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", qos.EVENTS)
        self._funnel = DesignSubscription(
            self,
            self._source,
            self._on_design,
            self._on_news,
            wiring=self._wiring,
            expected=self._expected,
        )
        if self._controller:
            self.create_subscription(String, f"{self._controller}/run", self._on_run, qos.DOCUMENT)
        self.create_service(Trigger, "~/restart", self._on_restart)
        names = (self._stop_service, self._snapshot_service)
        self._on_exit = [self.create_client(Trigger, name) for name in names if name]
        self._unanswered: dict[Client, Future | None] = {}
        self._failures: dict[str, str] = {}
        self._simulated = bool(self.get_parameter("use_sim_time").value)
        wall = Clock(clock_type=ClockType.STEADY_TIME)
        self._patience = self.get_clock() if self._simulated else wall
        self._clock_ns = self._beat_ns = -1
        self.create_timer(LOOK, self._look, clock=wall)
        self._retry = self.create_timer(RETRY, self._call, clock=wall)
        self._retry.cancel()
        self.create_timer(HEARTBEAT, self._on_heartbeat, clock=wall)
        self.create_timer(LOOK_AHEAD, self._look_ahead, clock=wall)
        self._stale = self.create_timer(self._patient_for, self._on_stale, clock=self._patience)
        self._stale.cancel()
        self._release = self.create_timer(
            self._command_wait, self._on_release, clock=self._patience
        )
        self._release.cancel()

    def stop(self) -> None:
        """Call off a check that is on."""
        self._funnel.close()

    def _on_design(self, design: AnyDesign, digest: str) -> None:
        """A proved design came, or another one: watch its signals from scratch."""
        watch = Watch(
            design, centre=self._centre, options=self._options, announced=bool(self._controller)
        )
        for subscription in self._signals.values():
            self.destroy_subscription(subscription)
        self._signals.clear()
        self._watch, self._digest = watch, digest
        self._widths, self._names = HalfWidths(design), "\n".join(signal_names(design))
        self._kinds, self._unfit = {}, ""
        for known in (self._doubts, self._numbers, self._unfit_commands, self._unheard):
            known.clear()
        self._silences.clear()
        self._frames.clear()
        self._heard_ns.clear()
        self._deadlines.clear()
        self._tell(f"no {design.name} yet")
        self.get_logger().info(f"watching {watch.pairing}")
        if self._forecast and not watch.monitor.goes_on:
            self.get_logger().warning("no forecasts: they are of tubes around a simulation")
        self._begin()

    def _on_news(self) -> None:
        """A check began, or a design was used again or refused: what is in use stays in use."""
        if self._watch is None:
            self._tell(self._funnel.state)
        else:
            self._diagnostics.publish(self._status_message())

    def _on_run(self, message: String) -> None:
        """A controller announced the stamp of its sample 0, or the end of that run."""
        try:
            self._run = Run.from_document(files.parse_document(message.data, source="run"))
        except NlsidError as error:
            self.get_logger().error(f"announcement not used: {error}")
            return
        if self._run.ended:
            if self._watch is not None:
                self._watch.stop(self._run.last_ns, self._run.ended)
            return
        if self._latched is not None:  # what happened before has not been looked at
            self._call_for_help()
        self._begin()

    def _begin(self) -> None:
        """Begin the announced run if it is of the funnel at hand, and on."""
        if self._watch is None or self._run is None or self._run.ended:
            return
        if self._run.funnel != self._digest:
            self._tell("the controller tracks another funnel than the one in use here")
            return
        self._publish(self._watch.begin(self._run.start_ns))

    def _look(self) -> None:
        """Look whether simulated time went back, which would hold up all that waits for a later
        one; and for the signals' topics.
        """
        clock_ns = self._patience.now().nanoseconds
        back_ns, self._clock_ns = self._clock_ns - clock_ns, clock_ns
        if back_ns > 0 and self._watch is not None:
            self._deadlines.clear()
            self._release.cancel()
            self._stale.cancel()
            reason = f"this node's clock went back by {seconds(back_ns, 0):.3g} s"
            self._publish(self._watch.missing(reason))
        self._connect()

    def _connect(self) -> None:
        """Subscribe to the signals' topics, each with a type that is published and carries them.

        A subscription whose type is no longer published is replaced.
        """
        if self._watch is None:
            return
        for topic in self._watch.pairing.topics:
            name = self.resolve_topic_name(self.signal_topic(topic))
            publishers = self.get_publishers_info_by_topic(name)
            if kind := self._kind(topic, [publisher.topic_type for publisher in publishers]):
                heard = [each for each in publishers if each.topic_type == kind]
                self._subscribe(topic, name, kind, heard)
                self._doubt(topic, graph.several(name, heard))
                self._unheard[topic] = graph.unheard(name, heard) if self._is_silent(topic) else ""

    def _kind(self, topic: str, kinds: list[str]) -> str:
        """The type to subscribe with: the one in use, or the first that fits; empty if none."""
        kind = self._kinds.get(topic, "")
        if not kinds or kind in kinds:
            return kind
        try:
            kind = self._fitting(topic, list(dict.fromkeys(kinds)))
        except BagError as error:
            if str(error) != self._unfit:
                self._unfit = str(error)
                self.get_logger().error(str(error))
                self._tell(str(error))
            return ""
        self._unfit = ""
        return kind

    def _subscribe(
        self, topic: str, name: str, kind: str, publishers: list[TopicEndpointInfo]
    ) -> None:
        """Subscribe as the publishers offer, and anew where that or their type has changed."""
        now = self._signals.get(topic)
        offered = [publisher.qos_profile.reliability for publisher in publishers]
        profile = qos.subscription_to(offered)
        if not publishers:
            return
        self._silences.setdefault(topic, Silence())
        if now is not None:
            if self._kinds[topic] == kind and now.qos_profile == profile:
                return
            said = f"{name} is subscribed to anew, as {graph.names(publishers)} offers it"
            self.get_logger().warning(said)
            self.destroy_subscription(now)
        self._kinds[topic] = kind
        callback = Informed(partial(self._on_signal, topic))
        self._signals[topic] = self.create_subscription(
            message_class(kind), name, callback, profile
        )

    def _is_silent(self, topic: str) -> bool:
        """Whether a response should be heard and is not; commands may rest."""
        assert self._watch is not None
        return topic in self._watch.pairing.response_topics and self._silences[topic].is_odd

    def _doubt(self, topic: str, reason: str) -> None:
        """Remember why nobody knows whose messages are on a topic; a response is unknown then.

        Transforms have one topic for whoever knows one. Of several publishers of commands all but
        one may be silent, and the robot hears the same as this node: they are named.
        """
        assert self._watch is not None
        if topic in self._watch.pairing.shared_topics:
            return
        news = reason and not self._doubts.get(topic)
        self._doubts[topic] = reason
        if news:
            self.get_logger().warning(reason)
            if topic in self._watch.pairing.response_topics:
                self._publish(self._watch.missing(reason))

    def _fitting(self, topic: str, kinds: list[str]) -> str:
        """The first of the types that carries the signals; BagError about the last if none does."""
        assert self._watch is not None
        for kind in kinds:
            try:
                self._watch.pairing.check(topic, kind, installed_types(kind))
            except BagError as error:
                unfit = error
                continue
            return kind
        raise unfit

    def _on_signal(self, topic: str, message: Any, info: dict[str, int]) -> None:
        """Decode stamp and values, and judge whatever samples are complete."""
        watch = self._watch
        if watch is None:
            return
        logged = watch.pairing.clock == "log"
        stamp_ns = self.get_clock().now().nanoseconds if logged else stamp_ns_of(message)
        responds = topic in watch.pairing.response_topics
        self._silences[topic].end(1)
        if watch.pairing.measures(topic, message):
            self._numbers.setdefault(topic, Sequence()).update(info["publication_sequence_number"])
        if not responds:
            unfit = self._unfit_commands[topic] = "" if logged else self._off_clock(topic, stamp_ns)
            if unfit:  # nor does a stamp far ahead say that no other command is still to come
                self._publish(watch.missing(unfit, doubted=True))
                return
        elif reason := self._distrust(topic, stamp_ns, message, logged=logged):
            self._publish(watch.refuse(stamp_ns, reason))
            return
        try:
            judged = watch.message(topic, stamp_ns, message)
        except BagError as error:
            self._publish(watch.unreadable(topic, stamp_ns, str(error)))
            return
        self._publish(judged)
        if not responds:
            return
        heard_ns = self._heard_ns[topic] = self._patience.now().nanoseconds
        if self._stale.is_canceled():
            self._stale.reset()
        if not judged:
            if watch.is_waiting:  # also before the first command, without which there is no sample
                self._say(Reading(0.0, Status.UNKNOWN, reason=WAITING), State.UNKNOWN)
            due = heard_ns + round(self._command_wait * 1e9)
            self._deadlines.append((due, stamp_ns))
            if self._release.is_canceled():
                self._release_in(due - heard_ns)

    def _distrust(self, topic: str, stamp_ns: int, message: Any, *, logged: bool) -> str:
        """Why a response is not to be judged though its number could be; empty if it is."""
        if doubt := self._doubts.get(topic, ""):
            return doubt
        for each, numbers in self._numbers.items():
            if numbers.alternates:
                return f"messages of several publishers come in turn on {each}"
        if logged:
            return ""
        frame = frame_of(message)
        wanted = self._frames.setdefault(topic, self._frame or frame)
        if frame != wanted:
            return f"the response is in frame '{frame}', not in '{wanted}'"
        off = ""
        if not self._allow_old_stamps:
            off = off_clock(stamp_ns, self.get_clock(), self._patient_for)
        return off or next(filter(None, self._unfit_commands.values()), "")

    def _off_clock(self, topic: str, stamp_ns: int) -> str:
        """Why the stamp of a command is none; empty if it is one, or a recording is played."""
        if self._allow_old_stamps:
            return ""
        most = max(self._patient_for, LATEST_COMMAND)
        return off_clock(stamp_ns, self.get_clock(), most, f"a command on {topic}")

    def _release_in(self, ahead_ns: int) -> None:
        self._release.timer_period_ns = ahead_ns
        self._release.reset()

    def _on_release(self) -> None:
        """Let go of samples whose command did not come in time."""
        now, until = self._patience.now().nanoseconds, None
        while self._deadlines and self._deadlines[0][0] <= now:
            until = self._deadlines.popleft()[1]
        if until is not None and self._watch is not None:
            self._publish(self._watch.flush(until))
        self._release.cancel()
        if self._deadlines:
            self._release_in(self._deadlines[0][0] - now)

    def _on_stale(self) -> None:
        """A response stopped coming, or did so a while ago: look again when it would have."""
        patience_ns = round(self._patient_for * 1e9)
        heard_ns = min(self._heard_ns.values(), default=0)
        ahead_ns = heard_ns + patience_ns - self._patience.now().nanoseconds
        self._stale.timer_period_ns = ahead_ns if ahead_ns > 0 else patience_ns
        if ahead_ns > 0:  # a reset wakes the executor, so it is not done with every message
            self._stale.reset()
            return
        self._stale.cancel()
        if self._watch is not None:
            name = self._watch.design.name
            self._publish(self._watch.flush())
            for entry in self._watch.missing(f"no {name} for {self._patient_for:g} s"):
                self._say(entry.reading, entry.state)

    def _publish(self, judged: Iterable[Stamped]) -> None:
        """Diagnostics first: an alarm should not wait behind a number."""
        for stamp_ns, reading, state in judged:
            self._say(reading, state)
            self._publish_margin(stamp_ns, reading)

    @property
    def _judging(self) -> str:
        """Of which funnel and run the verdicts are."""
        assert self._watch is not None
        if not self._controller or self._watch.monitor.goes_on:
            return f"{self._digest} {UNANNOUNCED}"
        if self._run is None or self._run.ended or self._run.funnel != self._digest:
            return f"{self._digest} {RUN_WAITING}"
        return self._run.name

    def _publish_margin(self, stamp_ns: int, reading: Reading) -> None:
        latency_ns = self.get_clock().now().nanoseconds - stamp_ns
        self._slowest_ns = max(self._slowest_ns, latency_ns)
        self._judged += 1
        message = JointState()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        message.header.frame_id = self._judging
        numbers = reading.numbers | self._widths.of(reading)
        message.name = [*numbers, "latency"]
        message.position = array("d", (*numbers.values(), latency_ns * 1e-9))
        self._margin.publish(message)

    def _look_ahead(self) -> None:
        """Publish what the outputs can be, once after a newest sample, while the state is known."""
        watch, (reading, _) = self._watch, self._said
        if watch is None or not self._forecast or reading.status is Status.UNKNOWN:
            return
        steps = min(max(1, round(self._forecast / watch.design.period)), MOST_STEPS)
        found = watch.forecast(steps)
        if found is None or not len(found[1].t) or found[0] == self._foreseen_ns:
            return
        self._foreseen_ns, (_, (t, low, high, _)) = found[0], found
        message = JointState()
        stamp_ns = found[0] + round(float(t[-1]) * 1e9)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        ends = zip(low[-1].tolist(), high[-1].tolist(), strict=True)
        for i, pair in enumerate(ends):
            index = f"[{i}]" if low.shape[1] > 1 else ""
            message.name += [f"low{index}", f"high{index}"]
            message.position.extend(pair)
        message.name.append("ahead")
        message.position.append(float(t[-1]))
        self._ahead.publish(message)

    def _tell(self, reason: str) -> None:
        """Unknown, and why, at once."""
        self._say(Reading(0.0, Status.UNKNOWN, reason=reason), State.UNKNOWN, at_once=True)

    def _say(self, reading: Reading, state: State, *, at_once: bool = False) -> None:
        """Publish diagnostics, and an event, if the state changed; remember what to repeat.

        An alarm is repeated until ~/restart, whatever comes after it.
        """
        before = self._said[1]
        self._said = reading, state
        if state is before and not at_once:
            return
        severity = SEVERITY.get(state, 0)
        news = self._latched is None or severity > SEVERITY[self._latched[0]]
        if severity >= SEVERITY[State.ASSUMPTION_VIOLATED]:
            if news:
                self._latched = state, reading.reason
            if not self._unanswered:
                self._call_for_help()
        message = self._status_message()
        self._diagnostics.publish(message)
        self._events.publish(message)
        if news and state is not before:
            self._log(message.status[0])

    def _log(self, said: DiagnosticStatus) -> None:
        """Into the terminal, for whoever sees nothing else."""
        if said.level == DiagnosticStatus.OK:
            self.get_logger().info(said.message, throttle_duration_sec=HEARTBEAT)
        elif said.level == DiagnosticStatus.ERROR:
            self.get_logger().error(said.message)
        else:
            self.get_logger().warning(said.message, throttle_duration_sec=HEARTBEAT)

    def _call_for_help(self) -> None:
        """Have the configured services stop the robot and keep what led here; ask until they do."""
        self._unanswered = dict.fromkeys(self._on_exit)
        self._call()
        self._retry.reset()

    def _call(self) -> None:
        """Call those who have not said that they did; the failures are in every status."""
        for client, future in list(self._unanswered.items()):
            answer = future.result() if future is not None and future.done() else None
            if answer is not None and answer.success:
                self.get_logger().info(f"{client.srv_name}: {answer.message}")
                del self._unanswered[client]
                continue
            if future is not None:
                client.remove_pending_request(future)
                why = answer.message if answer is not None else "no answer"
                self._failures[client.srv_name] = why
            self._unanswered[client] = None
            if client.service_is_ready():
                self._unanswered[client] = client.call_async(Trigger.Request())
            else:
                self._failures[client.srv_name] = "not there to be called"
        asked = {client.srv_name for client in self._unanswered}
        for name in self._failures.keys() - asked:
            del self._failures[name]
        for name, why in self._failures.items():
            self.get_logger().error(f"{name}: {why}", throttle_duration_sec=THROTTLE)
        if not self._unanswered:
            self._retry.cancel()

    def _on_heartbeat(self) -> None:
        clock_ns = self.get_clock().now().nanoseconds
        if self._simulated and clock_ns == self._beat_ns and self._watch is not None:
            reason = "simulated time stands still"
            if not self.count_publishers("/clock"):
                reason += ": nobody publishes /clock"
            self._say(Reading(0.0, Status.UNKNOWN, reason=reason), State.UNKNOWN)
        self._beat_ns = clock_ns
        self._diagnostics.publish(self._status_message())
        self._slowest_ns = 0

    def _status_message(self) -> DiagnosticArray:
        reading, state = self._said
        watch = self._watch
        values = {
            **{name.replace("_", " "): f"{n:.6g}" for name, n in reading.numbers.items()},
            "now": state.value,
            "worst axis": reading.worst_axis,
            "assuming": reading.assuming,
            "alarm": reading.alarm,
            "time in run [s]": f"{reading.t:.9g}",
            "judged": str(self._judged),
            "judged in this run": str(watch.judged if watch else 0),
            "lost": str(watch.lost if watch else 0),
            "filled in": said_filled(watch.filled, watch.samples) if watch else "",
            "late commands": str(watch.pairing.late if watch else 0),
            "duplicate responses": str(watch.pairing.duplicate_responses if watch else 0),
            "design": self._funnel.state.partition("\n")[0],
            "signals": self._names,
            "slowest of the last second [ms]": f"{self._slowest_ns * 1e-6:.3f}",
        }
        level, text = LEVELS[state], state.value + (f": {reading.reason}" if reading.reason else "")
        if reading.alarm:  # no verdict: it warns, and latches nothing
            level = max(level, DiagnosticStatus.WARN)
            text += f"; {reading.alarm}"
        named = [*self._doubts.values(), *self._unheard.values(), graph.namesakes(self)]
        if named := [each for each in named if each and each not in text]:
            level, text = max(level, DiagnosticStatus.WARN), "; ".join([text, *named])
        if self._latched is not None:
            level, text = DiagnosticStatus.ERROR, self._latched[0].value + f": {self._latched[1]}"
            text += "".join(f"; {name}: {why}" for name, why in self._failures.items())
        if self._funnel.refusal:
            level = DiagnosticStatus.ERROR
            text += f"; {self._funnel.refusal}" if watch else ""
        stamp = self.get_clock().now().to_msg()
        return status(stamp, name_of(self), level, text, values)

    def _on_restart(self, _request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Begin a new run: forget stamps, lags and budget."""
        answer.success = self._watch is not None
        answer.message = "new run" if answer.success else "there is no design yet"
        if self._watch is not None:
            self._watch.restart()
            self._run = self._latched = None
            self._unanswered.clear()
            self._failures.clear()
            self._frames.clear()
            self._numbers.clear()
            self._deadlines.clear()
            self._tell("restarted")
        return answer


def main(args: list[str] | None = None) -> None:
    """Entry point of `ros2 run nlsid funnel_monitor`."""
    try:
        run(FunnelMonitor, args)
    except NlsidError as error:
        sys.exit(f"{NAME}: {error}")


if __name__ == "__main__":
    main()
