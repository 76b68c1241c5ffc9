"""Node `tracking_controller`: runs the certified policy on the live state.

Of a difference equation sample k's input is known one period ahead; it is published when it comes
into force, stamped a quarter of a period before its sample is due, so that a sample off the grid by
that much is still paired with it. Of a state model it answers sample k, and carries its stamp.
Of equations that are proved with a hold samples may come at any time within it: each is answered at
once, and the run ends when the input in force, on this node's clock, answers an older state than is
proved. Without a hold nothing is proved of what a robot does, and nothing moves.
`~/start` begins a run, `~/run` (latched) announces the stamp of its sample 0 and the funnel's
digest, and then that it has ended. Stale or impossible state, `~/stop`, a required monitor that
does not judge this run against this funnel, and the end of the plan ramp the input to `stop_at`.
With `commissioning` it runs a policy from files of which nothing is proved, and says so in every
status; `stop_service` then has to be there.
"""

import math
import time
from collections import deque
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.duration import Duration
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.designs.documents import load_unproved
from bags.designs.wiring import read_at, written_at
from bags.monitoring.announcement import UNANNOUNCED, WAITING, Run
from bags.recordings.message_types import header_stamp_ns
from bags.signals.timing import Sequence, seconds
from nlsid_core import files
from nlsid_core.designs import AnyDesign
from nlsid_core.errors import BagError, DataError, NlsidError
from nlsid_core.running.controller import Controller, Limits
from nlsid_ros import graph, qos
from nlsid_ros.documents import (
    CHECKING,
    DESIGN,
    DesignSubscription,
    Unproved,
    expected_of,
    wiring_of,
)
from nlsid_ros.message_classes import installed_types
from nlsid_ros.messages import (
    OTHERS,
    ZERO,
    SignalMessage,
    base_stopped,
    off_clock,
    other_fields,
    patience,
    stamp_ns_of,
)
from nlsid_ros.running import ManagedNode, Parameter, arm, now_ns
from nlsid_ros.starting import entry_point
from nlsid_ros.subscribing import Silence, Topic

LAST_WORD = 1.0  # s for the last command to be received before the node goes
BIG = 1e9
LOOK = 0.02  # s between looks at whether responses come, commands go and the monitor judges
ENDED = ("the plan is over", "the proof is over")  # as it should
ASKED = ("asked to by ~/stop", "the node stops")


class TrackingController(ManagedNode):
    """Samples in, inputs out; between runs it is silent, so that others may drive."""

    name = "tracking_controller"
    task = "tracking"
    parameters = (
        *DESIGN,
        Parameter("response_type", "nav_msgs/msg/Odometry", "type of the response's topic"),
        Parameter(
            "command_type", "geometry_msgs/msg/TwistStamped", "type of the commands published"
        ),
        Parameter("others", ZERO, f"fields of the commands that are not the input: {OTHERS}"),
        Parameter(
            "stale_after",
            0.0,
            "s without a response, or from its stamp to this node's clock: stop; "
            "0: 4 periods, at least 0.1",
            (0.0, 60.0),
            tunable=True,
        ),
        Parameter(
            "settling", 5.0, "s to wait for a state in the inlet", (0.0, 600.0), tunable=True
        ),
        Parameter(
            "lowest",
            0.0,
            "least input, or a list for each input",
            (-BIG, BIG),
            tunable=True,
            several=True,
        ),
        Parameter(
            "highest",
            0.0,
            "greatest input, or a list; must be set",
            (-BIG, BIG),
            tunable=True,
            several=True,
        ),
        Parameter(
            "stop_at",
            0.0,
            "input of a robot at rest, or a list",
            (-BIG, BIG),
            tunable=True,
            several=True,
        ),
        Parameter(
            "stop_rate",
            1.0,
            "fastest change while stopping, 1/s, or a list",
            (1e-6, BIG),
            tunable=True,
            several=True,
        ),
        Parameter(
            "stop_within",
            5.0,
            "s until a robot that is stopped is at rest, faster than stop_rate if need be",
            (0.01, 60.0),
            tunable=True,
        ),
        Parameter(
            "commissioning",
            "",
            "folder of model.json (vector_field.json) and policy.json that are NOT proved: run "
            "them",
        ),
        Parameter(
            "stop_service",
            "",
            "std_srvs/Trigger that stops the robot if a run of commissioning ends early; mandatory",
        ),
        Parameter("require_monitor", False, "track only while the monitor judges"),
        Parameter("monitor", "funnel_monitor", "node required"),
        Parameter(
            "monitor_patience",
            1.0,
            "s without a verdict of the required monitor: stop",
            (0.01, 60.0),
            tunable=True,
        ),
        Parameter(
            "response_frame", "", "frame_id that the response must have; empty: that of the first"
        ),
    )

    def read_parameters(self) -> None:
        """Refuse what makes no sense."""
        values = self.values
        self._controller: Controller | None = None
        self._stopping = ""
        other_fields(values.command_type, values.others)
        if values.commissioning and not values.stop_service:
            raise DataError("commissioning runs what is not proved: set stop_service")
        wiring_of(values)
        expected_of(values)

    def tune(self, values: SimpleNamespace) -> None:
        """Take limits and patience between runs; DataError while a run lasts."""
        if self._is_on:
            raise DataError("a run is on; stop it first")
        limits = Limits(
            values.lowest, values.highest, stop_rate=values.stop_rate, stop_at=values.stop_at
        )
        if np.any(np.equal(limits.lowest, limits.highest)):
            raise DataError("no room between lowest and highest; set the limits of the input")
        self._limits = limits

    @property
    def _is_on(self) -> bool:
        """Whether a run is on, or its ramp down."""
        return self._controller is not None or bool(self._stopping)

    @property
    def _patient_for(self) -> float:
        """s without a response."""
        return patience(self.values.stale_after, self._design.period if self._design else 0.0)

    @property
    def _now(self) -> float:
        """S on the clock of the data, on which silence counts."""
        return now_ns(self._patience) * 1e-9

    def start(self) -> None:
        """Listen for the funnel; it names the signals."""
        self._patience = self.data_clock
        self._design: AnyDesign | None = None
        self._stopping = self._text = ""
        self._input: Any = self._limits.stop_at  # as the command takes it: one number or several
        self._first_ns: int | None = None
        self._run: Run | None = None  # as it was announced
        self._last_ns = 0  # the stamp of the last response under the policy's own input
        self._stamped_ns = 0  # the newest stamp of a response or command
        self._answered_ns = 0  # the stamp of the state that the input in force answers
        self._oldest_ns = 0  # how old that was at most in the last second
        self._sent = -math.inf  # when the last command went out, s of `_now`
        self._due: deque[tuple[int, Any]] = deque()  # (stamp ns, input) to be published
        self._ramp = self._limits

        self.keep_reporting(self._report)
        self._announce = self.create_publisher(String, "~/run", qos.DOCUMENT)
        self.serve("start", self._on_start)
        self.serve("stop", self._on_stop)
        self._funnel: DesignSubscription | Unproved = Unproved()
        if self.values.commissioning:
            self._brake = self.create_client(Trigger, self.values.stop_service)
            wiring = wiring_of(self.values)
            unproved: Any = load_unproved(self.values.commissioning, wiring=wiring)
            self._on_design(unproved, unproved.digest)
        else:
            self._funnel = DesignSubscription(self, self._on_design, self._report)
        if self.values.require_monitor:
            self._margin = self.create_subscription(
                JointState, f"{self.values.monitor}/margin", self._on_margin, qos.STREAM
            )
        self._next = self.later(self._on_due, self.get_clock())
        self._step = self.later(self._on_step)
        self._expiry = self.later(self._look_at_age, self.get_clock())
        self.every(LOOK, self._look)

    def stop(self) -> None:
        """Ramp down before going, in real time."""
        self._funnel.close()
        if not self._is_on:
            return
        assert self._design is not None
        self._halt("the node stops")
        while not self._limits.at_rest(self._input):
            self._on_step()
            time.sleep(self._design.period)
        self._commands.wait_for_all_acked(Duration(seconds=LAST_WORD))

    def _on_design(self, design: AnyDesign, digest: str) -> None:
        """Take a design, but never in the middle of a run: stop that first."""
        values, response, command = self.values, read_at(design), written_at(design)
        types = installed_types(values.response_type)
        response.check(values.response_type, types)
        message = SignalMessage(command, values.command_type, values.others)
        if self._is_on:
            self._halt("the design was replaced")
        if self._design is None:
            self._command = message
            message.listen(self)
            self._reader = response.reader(values.response_type, types)
            self._commands = self.create_publisher(
                message.kind, self.signal_topic(message.path.topic), qos.command(design.period)
            )
            topic = self.resolve_topic_name(self.signal_topic(response.topic))
            self._responses = Topic(self, topic, self._on_response, qos.SENSOR)
            self._responses.look(values.response_type)
        elif (response, command) != (read_at(self._design), written_at(self._design)):
            raise DataError("it is about other signals; deactivate and activate again")
        self._design, self._digest = design, digest
        self._hold_ns = round(design.held.hold * 1e9) if design.held else 0
        self._say_run(Run(0, digest, ended="the controller has another design, or began anew"))
        self._run = None
        self._tell("idle")

    def _begin(self) -> str:
        """Begin a run; why not, empty if it began."""
        if self._design is None:
            return f"there is no design yet: {self._funnel.state}"
        if self._funnel.refusal or self._funnel.state.startswith(CHECKING):
            return self._funnel.state
        if self._is_on:
            return "a run is on"
        self._responses.look(self.values.response_type)
        if lacking := self._command.lacking() or self._responses.several:
            return lacking
        if self.values.commissioning and not self._brake.service_is_ready():
            return f"{self.values.stop_service} is not there: nothing unproved runs without it"
        try:
            controller = self._design.controller(self._limits, self.values.settling)
        except NlsidError as error:
            self._tell(f"idle; not started: {error}")
            return str(error)
        watched = self.values.require_monitor
        if watched and (count := self.count_publishers(self._margin.topic_name)) != 1:
            judging = f"{count} nodes publish" if count else "nobody publishes"
            return f"require_monitor is set and {judging} {self._margin.topic_name}"
        self._controller = controller
        self._first_ns, self._run = None, None
        self._stamped_ns, self._hears, self._accompanied = 0, False, not watched
        self._responses.silence, self._responses.numbers = Silence(), Sequence()
        self._responses.frame = self.values.response_frame or None
        self._tell("waiting for the response")
        return ""

    def _on_response(self, data: bytes, info: dict[str, int]) -> None:
        """Read it, ask the core for the next input, and set it down for when it is due."""
        controller, design = self._controller, self._design
        if controller is None:
            return
        assert design is not None
        self._heard = self._now
        if not self._hears:
            self._hears, self._judged, self._sent = True, self._heard, self._heard
        self._responses.silence.end(1)
        self._responses.numbers.update(info["publication_sequence_number"])
        try:
            stamp_ns, numbers = header_stamp_ns(data), self._reader.numbers(data)
            distrust = self._responses.distrust(data, now_ns(self.get_clock()), self._patient_for)
        except BagError as error:
            self._halt(str(error))
            return
        if reason := self._responses.alternating or distrust:
            self._halt(reason)
            return
        self._stamped_ns = max(self._stamped_ns, stamp_ns)
        self._on_due()  # what was due before this response, whatever it brings
        if self._controller is None:
            return
        u = controller.u
        if not self._accompanied:
            u = self._limits.stop_at  # until the required monitor is heard
        elif self._first_ns is None:
            self._first_ns = stamp_ns  # its input is not ours; the next sample's is
        else:
            waiting = controller.k < 1
            value = numbers[0] if design.is_single else np.array(numbers)
            controller.update(seconds(stamp_ns, self._first_ns), value)
            if controller.lead or not controller.ended:
                self._last_ns = stamp_ns
            if controller.ended:
                self._halt(controller.ended)
                return
            if waiting and controller.k >= 1:
                self._judged = self._heard
                self._say_run(Run(stamp_ns, self._digest))
                self._tell("tracking")
            u = controller.u
        self._due.append((stamp_ns + round(controller.lead * 1e9), u))
        self._on_due()

    def _say_run(self, run: Run) -> None:
        self._run = run
        self._announce.publish(String(data=files.encode(run.document()).decode()))

    def _on_due(self) -> None:
        """Publish every input that is due, and wait for the next; none that is long overdue.

        A response may be here before this node's clock shows its stamp.
        """
        self._next.cancel()
        most_ns = round(self._patient_for * 1e9)
        while self._due:
            stamp_ns, u = self._due[0]
            ahead = stamp_ns - max(self._stamped_ns, now_ns(self.get_clock()))
            if ahead > 0:
                arm(self._next, ahead)
                return
            if ahead < -most_ns:
                self._halt(f"a command is {-ahead * 1e-9:.3g} s late")
                return
            self._look_at_age()  # of the input until now
            if self._controller is None:
                return
            self._due.popleft()
            self._input, self._answered_ns = u, stamp_ns
            self._send(stamp_ns)
            self._look_at_age()

    def _look_at_age(self) -> None:
        """End the run if the input in force answers an older state than is proved; else look again
        when it will.
        """
        self._expiry.cancel()
        if not self._hold_ns or self._run is None or self._answered_ns < self._run.start_ns:
            return
        age_ns = now_ns(self.get_clock()) - self._answered_ns
        self._oldest_ns = max(self._oldest_ns, age_ns)
        if age_ns > self._hold_ns:
            self._halt(
                f"the input answers a state that is {age_ns * 1e-9:.3g} s old; proved for "
                f"{self._hold_ns * 1e-9:g} s"
            )
            return
        arm(self._expiry, self._hold_ns - age_ns + 1)

    def _on_margin(self, message: JointState) -> None:
        """The required monitor has judged a sample; one not of this run and of now is none.

        One of another funnel, or of no run, ends this one.
        """
        stamp_ns, monitor = stamp_ns_of(message), self.values.monitor
        if self._controller is None or not self._hears:
            return
        start_ns = 0 if self._run is None else self._run.start_ns
        if stamp_ns < start_ns or off_clock(
            stamp_ns, now_ns(self.get_clock()), self.values.monitor_patience
        ):
            return
        funnel, _, of_run = message.header.frame_id.partition(" ")
        if funnel != self._digest:
            judged = f"the funnel {funnel}" if funnel else "a funnel that it does not name"
            self._halt(f"{monitor} judges {judged}, not {self._digest}, which is tracked")
            return
        if of_run == UNANNOUNCED:
            self._halt(f"{monitor} judges no run: set its controller and nominal:=profile")
            return
        if self._run is None and of_run == WAITING:
            self._accompanied, self._judged = True, self._now
        if self._run is None or message.header.frame_id != self._run.name:
            return
        numbers = dict(zip(message.name, message.position, strict=False))
        margin, inside = (numbers.get(key, math.nan) for key in ("margin", "inside"))
        if margin < 0.0:
            self._halt(f"outside: {monitor} says margin {margin:.3g}")
        elif inside == 0.0:
            self._halt(f"assumption violated: {monitor} says so, and why on /diagnostics")
        elif inside == 1.0 and 0.0 <= margin <= 1.0:
            self._judged = self._now

    def _look(self) -> None:
        """Watch that responses come, commands go and the monitor judges."""
        if self._controller is None:
            return
        assert self._design is not None
        self._responses.look(self.values.response_type)
        if not self._hears:
            return
        now = self._now
        unsent = 2.0 * (self._patient_for + self._design.period)
        if now < self._heard:
            self._halt(f"this node's clock went back by {self._heard - now:.3g} s")
        elif now - self._heard > self._patient_for:
            self._halt("the response stopped coming")
        elif now - self._sent > unsent:
            self._halt(f"no command has gone out for {unsent:g} s")
        elif lacking := self._command.lacking() or self._responses.several:
            self._halt(lacking)
        elif self.values.require_monitor:
            self._look_at_monitor(now)

    def _look_at_monitor(self, now: float) -> None:
        """Watch that the one monitor judges."""
        name, patience = self.values.monitor, self.values.monitor_patience
        if now - self._judged > patience:
            self._halt(f"{name} has judged nothing for {patience:g} s")
        elif (count := self.count_publishers(self._margin.topic_name)) > 1:
            self._halt(f"{count} nodes publish {self._margin.topic_name}; stop all but one")

    def _on_step(self) -> None:
        """One step towards rest; the last says so. A base that has stopped by itself, because no
        command went out, is not moved again on the way.
        """
        assert self._design is not None
        self._input = (
            self._limits.stop_at
            if base_stopped(self._now - self._sent, self._design.period)
            else self._ramp.towards_stop(self._input, self._design.period)
        )
        # Later than the last response, which is not to be judged under it, in simulated time too.
        self._send(max(now_ns(self.get_clock()), self._stamped_ns + 1))
        if self._limits.at_rest(self._input):
            self._step.cancel()
            self._tell(f"idle; stopped: {self._stopping}")
            self._stopping = ""

    def _send(self, stamp_ns: int) -> None:
        self._sent, self._stamped_ns = self._now, max(self._stamped_ns, stamp_ns)
        self._commands.publish(self._command.make(stamp_ns, self._input))

    def _halt(self, reason: str) -> None:
        """End the run and ramp down, in real time and within `stop_within`."""
        if self._controller is None:
            return
        assert self._design is not None
        self._controller = None
        self._next.cancel()
        self._expiry.cancel()
        self._due.clear()
        self._stopping = reason
        if self._run is not None:
            self._say_run(replace(self._run, ended=reason, last_ns=self._last_ns))
            self._run = None
        if self.values.commissioning and reason not in ENDED:
            self._brake.call_async(Trigger.Request())
        away = np.abs(np.subtract(self._input, self._limits.stop_at))
        rate = np.maximum(self._limits.stop_rate, float(np.max(away)) / self.values.stop_within)
        self._ramp = replace(self._limits, stop_rate=rate)
        self._tell(f"stopping: {reason}")
        arm(self._step, round(self._design.period * 1e9))
        self._on_step()

    def _on_start(self) -> tuple[bool, str]:
        lacking = self._begin()
        return not lacking, lacking

    def _on_stop(self) -> tuple[bool, str]:
        said = "stopping" if self._controller else "not running"
        self._halt(ASKED[0])
        return True, said

    def _tell(self, text: str) -> None:
        self._text = text
        self.get_logger().info(text)
        self._report()

    def _report(self) -> None:
        level, text = DiagnosticStatus.OK, self._text
        ended = self._text.removeprefix("idle; stopped: ").removeprefix("stopping: ")
        if ended != self._text and ended not in ENDED:
            level = DiagnosticStatus.WARN if ended in ASKED else DiagnosticStatus.ERROR
        if self._design is None or self._funnel.refusal:
            text = "; ".join(part for part in (self._text, self._funnel.state) if part)
        if self._funnel.refusal:
            level = DiagnosticStatus.ERROR
        if named := self._others_here():
            level, text = max(level, DiagnosticStatus.WARN), f"{text}; {named}"
        if self.values.commissioning:
            level, text = max(level, DiagnosticStatus.WARN), f"COMMISSIONING, not proved: {text}"
        values = {
            "input": ", ".join(f"{u:.6g}" for u in np.atleast_1d(self._input)),
            "sample": str(self._controller.k) if self._controller else "",
            "oldest of the last second [ms]": f"{self._oldest_ns * 1e-6:.3f}",
            "funnel": self._funnel.digest,
            "design": self._funnel.state,
        }
        self._oldest_ns = 0
        self.report(level, text, values)

    def _others_here(self) -> str:
        """Who else commands the robot or has this node's name, and who cannot hear it."""
        said = [graph.namesakes(self)]
        if self._design is not None:
            said.append(graph.rivals(self, self._commands))
            if self._controller is not None:
                said.append(self._responses.unheard)
        return "; ".join(filter(None, said))


main = entry_point(TrackingController)

if __name__ == "__main__":
    main()
