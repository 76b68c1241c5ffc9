"""Node `funnel_monitor`: holds the live state against the latched funnel.

Subscribes to the funnel, its model and its policy, and to the topics of its signals, of which there
may be several, by the model's own field paths, on message stamps. Publishes ~/margin
(sensor_msgs/JointState: stamped, named numbers; frame_id says of which funnel and run) for every
sample, ~/forecast if asked for (the same
type: `low` and `high` of each output `ahead` s after the newest sample, at that stamp, while the
command is held), and /diagnostics at once when the state changes, otherwise
once a second. Leaving the funnel calls
`stop_service` and `snapshot_service`. Missing, stale or NaN state is unknown, never inside. Two
latched std_msgs/Bool are for those who only want to stop: ~/inside, whether the newest sample was
judged inside, and ~/alarm, whether there was one that was not since ~/restart.
What is outside, or violates the assumption, stays so until `~/restart`, which begins a new run.
"""

import gc
import math
from collections import deque
from collections.abc import Iterable
from functools import partial
from types import SimpleNamespace

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, String

from bags.monitoring.announcement import UNANNOUNCED, Run
from bags.monitoring.announcement import WAITING as RUN_WAITING
from bags.monitoring.watch import WAITING, Stamped, Watch
from bags.signals.sampling import said_filled
from bags.signals.timing import Sequence, seconds
from bags.viewing.drawn import HalfWidths, signal_names
from nlsid_core import files
from nlsid_core.designs import AnyDesign
from nlsid_core.errors import BagError, DataError, NlsidError
from nlsid_core.running.alarm import SEVERITY, State
from nlsid_core.running.comparison import Centre
from nlsid_core.running.reading import Reading, Status
from nlsid_ros import graph, qos
from nlsid_ros.documents import DESIGN, DesignSubscription, expected_of, wiring_of
from nlsid_ros.helping import Help
from nlsid_ros.message_classes import installed_types
from nlsid_ros.messages import numbers_at, off_clock, patience
from nlsid_ros.running import REPORT, ManagedNode, Parameter, arm, now_ns
from nlsid_ros.starting import entry_point
from nlsid_ros.subscribing import Topic

LOOK = 0.1  # s of the wall's time between looks at the clock, and for the signals' types
LATEST_COMMAND = (
    1.0  # s from a command's stamp to this node's clock; one is stamped when it is sent
)
LOOK_AHEAD = 0.1  # s between forecasts
MOST_NUMBERS = 6  # of a reading that a status has: with the rest at most 20 values
MOST_STEPS = 100  # samples ahead: each takes about as long as judging one
LEVELS = {
    State.INSIDE: DiagnosticStatus.OK,
    State.WARNING: DiagnosticStatus.WARN,
    State.ASSUMPTION_VIOLATED: DiagnosticStatus.ERROR,
    State.OUTSIDE: DiagnosticStatus.ERROR,
    State.UNKNOWN: DiagnosticStatus.WARN,
}
JUDGED = {  # `inside` of ~/margin
    Status.INSIDE: 1.0,
    Status.ASSUMPTION_VIOLATED: 0.0,
    Status.OUTSIDE: 0.0,
    Status.UNKNOWN: math.nan,
}


class FunnelMonitor(ManagedNode):
    """Reads stamped signals, asks the core's Monitor, publishes what it says."""

    name = "funnel_monitor"
    task = "verdict"
    is_watched = True
    parameters = (
        *DESIGN,
        Parameter("controller", "", "node that announces when a run starts; empty: first sample"),
        Parameter(
            "nominal",
            Centre.COMMAND.value,
            "what the tube is around: command or profile",
        ),
        Parameter(
            "stale_after",
            0.0,
            "s without a response, or from its stamp to this node's clock: unknown; "
            "0: 4 periods, at least 0.1",
            (0.0, 60.0),
            tunable=True,
        ),
        Parameter(
            "command_wait", 0.02, "s a response waits for its command", (1e-4, 1.0), tunable=True
        ),
        Parameter("warning_margin", 0.2, "warn below", (0.0, 1.0), tunable=True),
        Parameter(
            "forecast", 0.0, "s ahead of the newest sample; 0: none", (0.0, 60.0), tunable=True
        ),
        Parameter(
            "allow_old_stamps",
            False,
            "judge stamps that are not of now: a recording that is played again",
        ),
        Parameter(
            "response_frame", "", "frame_id that the response must have; empty: that of the first"
        ),
        Parameter("stop_service", "", "std_srvs/Trigger called on leaving the funnel; empty: none"),
        Parameter("snapshot_service", "", "std_srvs/Trigger called on leaving; empty: none"),
    )

    def read_parameters(self) -> None:
        """Refuse what makes no sense."""
        nominal = self.values.nominal
        if nominal not in [centre.value for centre in Centre]:
            raise DataError(f"nominal is '{nominal}'; it should be command or profile")
        wiring_of(self.values)
        expected_of(self.values)
        self._watch: Watch | None = None

    def tune(self, values: SimpleNamespace) -> None:
        """Take patience and warnings, also in the middle of a run."""
        if self._watch is not None:
            self._watch.warning_margin = values.warning_margin

    @property
    def _patient_for(self) -> float:
        """s without a response."""
        return patience(self.values.stale_after, self._watch.design.period if self._watch else 0.0)

    @property
    def _oldest(self) -> float:
        """s that a stamp may be off this node's clock, but for a recording that is played."""
        return math.inf if self.values.allow_old_stamps else self._patient_for

    def start(self) -> None:
        """Listen for the funnel; its signals are subscribed to once it is there."""
        self._watch = None
        self._run: Run | None = None
        self._topics: dict[str, Topic] = {}  # of the signals, as the model calls them
        self._unfit_commands: dict[str, str] = {}  # topic -> what is wrong with the newest command
        self._unfit = ""
        self._names = ""
        self._latched: tuple[State, str] | None = None
        waiting = Reading(0.0, Status.UNKNOWN, reason="waiting for a design")
        self._said: tuple[Reading, State] = waiting, State.UNKNOWN
        self._heard_ns: dict[str, int] = {}  # response topic -> when its last message came
        self._deadlines: deque[tuple[int, int]] = deque()  # (clock ns, stamp ns) of a response
        self._slowest_ns = self._judged = 0
        self._clock_ns = self._beat_ns = self._foreseen_ns = -1
        self._simulated = bool(self.get_parameter("use_sim_time").value)

        self.keep_reporting(self._on_heartbeat)
        self._margin = self.create_publisher(JointState, "~/margin", qos.STREAM)
        self._ahead = self.create_publisher(JointState, "~/forecast", qos.STREAM)
        self._flags: dict[str, bool] = {}
        self._bools = {
            name: self.create_publisher(Bool, f"~/{name}", qos.DOCUMENT)
            for name in ("inside", "alarm")
        }
        self._flag()
        self._funnel = DesignSubscription(self, self._on_design, self._on_news)
        if controller := self.values.controller:
            self.create_subscription(String, f"{controller}/run", self._on_run, qos.DOCUMENT)
        self._help = Help(self, (self.values.stop_service, self.values.snapshot_service))
        self.serve("restart", self._on_restart)

        self._patience = self.data_clock
        self._stale = self.later(self._on_stale, self._patience)
        self._release = self.later(self._on_release, self._patience)
        self.every(LOOK, self._look)
        self.every(LOOK_AHEAD, self._look_ahead)

    def stop(self) -> None:
        """Call off a check that is on."""
        self._funnel.close()

    def _on_design(self, design: AnyDesign, digest: str) -> None:
        """A proved design came, or another one: watch its signals from scratch."""
        watch = Watch(
            design,
            centre=Centre(self.values.nominal),
            warning_margin=self.values.warning_margin,
            announced=bool(self.values.controller),
        )
        for topic in self._topics.values():
            topic.drop()
        self._topics = {
            topic: Topic(
                self,
                self.resolve_topic_name(self.signal_topic(topic)),
                partial(self._on_signal, topic),
            )
            for topic in watch.pairing.topics
        }
        self._watch, self._digest = watch, digest
        self._widths, self._names = HalfWidths(design), "\n".join(signal_names(design))
        self._unfit = ""
        self._unfit_commands.clear()
        self._heard_ns.clear()
        self._forget()
        heard = ", ".join(sorted(topic.name for topic in self._topics.values()))
        self._tell(f"no {design.name} yet; listening on {heard}")
        self.get_logger().info(f"watching {watch.pairing}, on {heard}")
        if self.values.forecast and not watch.monitor.goes_on:
            self.get_logger().warning("no forecasts: they are of tubes around a simulation")
        self._begin()
        self._look()
        gc.freeze()  # a collection that looks through a design and its proof stops it for 0.1 s

    def _forget(self) -> None:
        """Whatever the next messages are compared with."""
        self._deadlines.clear()
        for topic in self._topics.values():
            topic.frame, topic.numbers = self.values.response_frame or None, Sequence()

    def _on_news(self) -> None:
        """A check began, or a design was used again or refused: what is in use stays in use."""
        if self._watch is None:
            self._tell(self._funnel.state)
        else:
            self._report()

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
            self._help.call()
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
        clock_ns = now_ns(self._patience)
        back_ns, self._clock_ns = self._clock_ns - clock_ns, clock_ns
        if back_ns > 0 and self._watch is not None:
            self._deadlines.clear()
            self._release.cancel()
            self._stale.cancel()
            reason = f"this node's clock went back by {seconds(back_ns, 0):.3g} s"
            self._publish(self._watch.missing(reason))
        for topic in self._topics:
            self._connect(topic)

    def _connect(self, topic: str) -> None:
        """Subscribe to a signal's topic with a type that is published and carries it.

        Where several publish it, nobody knows whose messages come: a response is unknown then. Of
        several publishers of commands all but one may be silent, and the robot hears the same as
        this node: they are named.
        """
        assert self._watch is not None
        heard = self._topics[topic]
        found = self.get_publishers_info_by_topic(heard.name)
        kind = self._kind(topic, [each.topic_type for each in found])
        if not kind:
            return
        before = self._doubt(topic)
        heard.look(kind, found)
        if (doubt := self._doubt(topic)) and not before:
            self.get_logger().warning(doubt)
            if topic in self._watch.pairing.response_topics:
                self._publish(self._watch.missing(doubt))

    def _kind(self, topic: str, kinds: list[str]) -> str:
        """The type to subscribe with: the one in use, or the first that fits; empty if none."""
        assert self._watch is not None
        kind = self._topics[topic].kind
        if not kinds or kind in kinds:
            return kind
        for kind in dict.fromkeys(kinds):
            try:
                self._watch.pairing.check(topic, kind, installed_types(kind))
            except BagError as error:
                unfit = str(error)
                continue
            self._unfit = ""
            return kind
        if unfit != self._unfit:
            self._unfit = unfit
            self.get_logger().error(unfit)
            self._tell(unfit)
        return ""

    def _doubt(self, topic: str) -> str:
        """Why nobody knows whose messages are on a topic; transforms have one for all."""
        assert self._watch is not None
        return "" if topic in self._watch.pairing.shared_topics else self._topics[topic].several

    def _on_signal(self, topic: str, data: bytes, info: dict[str, int]) -> None:
        """Read stamp and values, and judge whatever samples are complete."""
        watch, heard = self._watch, self._topics[topic]
        assert watch is not None
        logged = watch.pairing.clock == "log"
        clock_ns = stamp_ns = now_ns(self.get_clock())
        heard.silence.end(1)
        try:
            stamp_ns = watch.pairing.stamp(data, clock_ns)
            if not watch.pairing.measures(topic, data):
                return  # of other transforms: it does not even say that the signals still come
            heard.numbers.update(info["publication_sequence_number"])
            responds = topic in watch.pairing.response_topics
            if not responds:
                most = max(self._oldest, math.inf if logged else LATEST_COMMAND)
                unfit = off_clock(stamp_ns, clock_ns, most, f"a command on {topic}")
                self._unfit_commands[topic] = unfit
                if unfit:  # nor does a stamp far ahead say that no other command is still to come
                    self._publish(watch.missing(unfit, doubted=True))
                    return
            elif reason := self._distrust(topic, data, None if logged else clock_ns):
                self._publish(watch.refuse(stamp_ns, reason))
                return
            judged = watch.message(topic, stamp_ns, data)
        except BagError as error:
            self._publish(watch.unreadable(topic, stamp_ns, str(error)))
            return
        self._publish(judged)
        if responds:
            self._await_next(topic, None if judged else stamp_ns)

    def _await_next(self, topic: str, waiting_ns: int | None) -> None:
        """Have the silence noticed after a response, and its sample let go of if it still waits.

        waiting_ns: the stamp of a response that is not judged yet.
        """
        assert self._watch is not None
        heard_ns = self._heard_ns[topic] = now_ns(self._patience)
        if self._stale.is_canceled():
            arm(self._stale, round(self._patient_for * 1e9))
        if waiting_ns is None:
            return
        if self._watch.is_waiting:  # also before the first command, without which is no sample
            self._say(Reading(0.0, Status.UNKNOWN, reason=WAITING), State.UNKNOWN)
        wait_ns = round(self.values.command_wait * 1e9)
        self._deadlines.append((heard_ns + wait_ns, waiting_ns))
        if self._release.is_canceled():
            arm(self._release, wait_ns)

    def _distrust(self, topic: str, data: bytes, clock_ns: int | None) -> str:
        """Why a response is not to be judged though its number could be; empty if it is.

        clock_ns: None where it has no stamp but the time at which it came.
        """
        said = self._doubt(topic)
        for each in self._topics.values():
            said = said or each.alternating
        if said or clock_ns is None:
            return said
        said = self._topics[topic].distrust(data, clock_ns, self._oldest)
        return said or next(filter(None, self._unfit_commands.values()), "")

    def _on_release(self) -> None:
        """Let go of samples whose command did not come in time."""
        now, until = now_ns(self._patience), None
        while self._deadlines and self._deadlines[0][0] <= now:
            until = self._deadlines.popleft()[1]
        if until is not None and self._watch is not None:
            self._publish(self._watch.flush(until))
        self._release.cancel()
        if self._deadlines:
            arm(self._release, self._deadlines[0][0] - now)

    def _on_stale(self) -> None:
        """A response stopped coming, or did so a while ago: look again when it would have."""
        patience_ns = round(self._patient_for * 1e9)
        heard_ns = min(self._heard_ns.values(), default=0)
        ahead_ns = heard_ns + patience_ns - now_ns(self._patience)
        if ahead_ns > 0:  # a reset wakes the executor, so it is not done with every message
            arm(self._stale, ahead_ns)
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
            latency_ns = now_ns(self.get_clock()) - stamp_ns
            self._slowest_ns = max(self._slowest_ns, latency_ns)
            self._judged += 1
            numbers = {
                **reading.numbers,
                **self._widths.of(reading),
                "inside": JUDGED[reading.status],
                "latency": latency_ns * 1e-9,
            }
            self._margin.publish(numbers_at(stamp_ns, numbers, self._judging))

    @property
    def _judging(self) -> str:
        """The funnel and the run that are judged."""
        assert self._watch is not None
        if not self.values.controller or self._watch.monitor.goes_on:
            return f"{self._digest} {UNANNOUNCED}"
        if self._run is None or self._run.ended or self._run.funnel != self._digest:
            return f"{self._digest} {RUN_WAITING}"
        return self._run.name

    def _look_ahead(self) -> None:
        """Publish what the outputs can be, once after a newest sample, while the state is known."""
        watch, (reading, _) = self._watch, self._said
        if watch is None or not self.values.forecast or reading.status is Status.UNKNOWN:
            return
        steps = min(max(1, round(self.values.forecast / watch.design.period)), MOST_STEPS)
        found = watch.forecast(steps)
        if found is None or not len(found[1].t) or found[0] == self._foreseen_ns:
            return
        self._foreseen_ns, (_, (t, low, high, _)) = found[0], found
        numbers: dict[str, float] = {}
        for i in range(low.shape[1]):
            index = f"[{i}]" if low.shape[1] > 1 else ""
            numbers |= {f"low{index}": float(low[-1, i]), f"high{index}": float(high[-1, i])}
        ahead = float(t[-1])
        stamp_ns = self._foreseen_ns + round(ahead * 1e9)
        self._ahead.publish(numbers_at(stamp_ns, numbers | {"ahead": ahead}))

    def _tell(self, reason: str) -> None:
        """Unknown, and why, at once."""
        self._say(Reading(0.0, Status.UNKNOWN, reason=reason), State.UNKNOWN, at_once=True)

    def _say(self, reading: Reading, state: State, *, at_once: bool = False) -> None:
        """Publish diagnostics if the state, what it assumes or a second alarm changed; remember
        what to repeat.

        An alarm is repeated until ~/restart, whatever comes after it.
        """
        (earlier, before), self._said = self._said, (reading, state)
        if not at_once and (state, reading.assuming, bool(reading.alarm)) == (
            before,
            earlier.assuming,
            bool(earlier.alarm),
        ):
            return
        severity = SEVERITY.get(state, 0)
        news = self._latched is None or severity > SEVERITY[self._latched[0]]
        if severity >= SEVERITY[State.ASSUMPTION_VIOLATED]:
            if news:
                self._latched = state, reading.reason
            if not self._help.asked:
                self._help.call()
        self._flag()
        message = self._report()
        if news and state is not before:
            self._log(message.status[0])

    def _flag(self) -> None:
        """Publish whether the newest sample is inside, and whether an alarm is on, as they change.

        `inside` is false while the state is unknown.
        """
        inside = self._said[1] in (State.INSIDE, State.WARNING)
        for name, flag in (("inside", inside), ("alarm", self._latched is not None)):
            if self._flags.get(name) is not flag:
                self._flags[name] = flag
                self._bools[name].publish(Bool(data=flag))

    def _log(self, said: DiagnosticStatus) -> None:
        """Into the terminal, for whoever sees nothing else."""
        if said.level == DiagnosticStatus.OK:
            self.get_logger().info(said.message, throttle_duration_sec=REPORT)
        elif said.level == DiagnosticStatus.ERROR:
            self.get_logger().error(said.message)
        else:
            self.get_logger().warning(said.message, throttle_duration_sec=REPORT)

    def _on_heartbeat(self) -> None:
        clock_ns = now_ns(self.get_clock())
        if self._simulated and clock_ns == self._beat_ns and self._watch is not None:
            reason = "simulated time stands still"
            if not self.count_publishers("/clock"):
                reason += ": nobody publishes /clock"
            self._say(Reading(0.0, Status.UNKNOWN, reason=reason), State.UNKNOWN)
        self._beat_ns = clock_ns
        self._report()
        self._slowest_ns = 0

    def _report(self) -> DiagnosticArray:
        """Say what was said last, and whatever else is odd; an alarm comes before it."""
        reading, state = self._said
        level, text = LEVELS[state], state.value + (f": {reading.reason}" if reading.reason else "")
        if reading.alarm:  # no verdict: it warns, and latches nothing
            level = max(level, DiagnosticStatus.WARN)
            text += f"; {reading.alarm}"
        if named := [each for each in self._odd() if each not in text]:
            level, text = max(level, DiagnosticStatus.WARN), "; ".join([text, *named])
        if self._latched is not None:
            level, text = DiagnosticStatus.ERROR, self._latched[0].value + f": {self._latched[1]}"
            text += "".join(f"; {name}: {why}" for name, why in self._help.failures.items())
        if self._funnel.refusal:
            level = DiagnosticStatus.ERROR
            text += f"; {self._funnel.refusal}" if self._watch else ""
        return self.report(level, text, self._numbers())

    def _odd(self) -> list[str]:
        """What is odd about the graph: whose messages come, and whose do not; commands may rest."""
        responses = self._watch.pairing.response_topics if self._watch else ()
        said = [self._doubt(topic) for topic in self._topics]
        said += [self._topics[topic].unheard for topic in responses]
        return [each for each in (*said, graph.namesakes(self)) if each]

    def _numbers(self) -> dict[str, str]:
        """The reading's numbers, and counts, as diagnostics have them."""
        (reading, state), watch = self._said, self._watch
        return {
            **{  # ~/margin has all
                name.replace("_", " "): f"{n:.6g}"
                for name, n in list(reading.numbers.items())[:MOST_NUMBERS]
            },
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

    def _on_restart(self) -> tuple[bool, str]:
        """Begin a new run: forget stamps, lags and budget."""
        if self._watch is None:
            return False, "there is no design yet"
        self._watch.restart()
        self._run = self._latched = None
        self._help.call_off()
        self._forget()
        self._tell("restarted")
        return True, "new run"


main = entry_point(FunnelMonitor)

if __name__ == "__main__":
    main()
