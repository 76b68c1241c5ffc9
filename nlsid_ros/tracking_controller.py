"""Node `tracking_controller`: runs the certified policy on the live state.

Of a difference equation sample k's input is known one period ahead; it is published when it comes
into force, stamped a quarter of a period before its sample is due, so that a sample off the grid by
that much is still paired with it. Of a state model it answers sample k, and carries its stamp.
`~/start` begins a run, `~/run` (latched) announces the stamp of its sample 0 and the funnel's
digest, and then that it has ended. Stale or impossible state, `~/stop`, a required monitor that
does not judge this run against this funnel, and the end of the plan ramp the input to `stop_at`.
With `commissioning` it runs a policy from files of which nothing is proved, and says so in every
status; `stop_service` then has to be there.
"""

import math
import sys
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.designs.design import AnyDesign
from bags.designs.documents import load_unproved
from bags.monitoring.announcement import UNANNOUNCED, WAITING, Run
from bags.signals.grid import seconds
from bags.signals.signal import SignalPath
from bags.signals.vector import SignalVector
from nlsid_core import files
from nlsid_core.errors import BagError, DataError, NlsidError
from nlsid_core.running.controller import Controller, Limits
from nlsid_ros import graph, qos
from nlsid_ros.diagnostics import name_of, status
from nlsid_ros.documents import (
    CHECKING,
    DesignSubscription,
    Unproved,
    declare_expected,
    declare_limits,
    declare_wiring,
)
from nlsid_ros.message_classes import installed_types, message_class
from nlsid_ros.messages import (
    OTHERS,
    ZERO,
    SignalMessage,
    base_stopped,
    frame_of,
    off_clock,
    other_fields,
    patience,
    stamp_ns_of,
)
from nlsid_ros.running import Arguments, ManagedNode, declare, declare_number, declare_text, run

NAME = "tracking_controller"
LAST_WORD = 1.0  # s for the last command to be received before the node goes
REPORT = 1.0  # s between diagnostics while nothing changes
BIG = 1e9
LOOK = 0.02  # s between looks at whether responses come, commands go and the monitor judges
ENDED = ("the plan is over", "the proof is over")  # as it should
ASKED = ("asked to by ~/stop", "the node stops")
LIMITS = [field.name for field in fields(Limits)]


class TrackingController(ManagedNode):
    """Samples in, inputs out; between runs it is silent, so that others may drive."""

    def __init__(self, arguments: Arguments = None) -> None:
        super().__init__(NAME, arguments)

    def read_parameters(self) -> None:
        """Declare them; take the values that they have now."""
        number = partial(declare_number, self, tunable=True)
        self._source = declare_text(
            self, "source", "funnel_publisher", "node that publishes the funnel"
        )
        self._response_type = declare_text(
            self, "response_type", "nav_msgs/msg/Odometry", "type of the response's topic"
        )
        self._command_type = declare_text(
            self, "command_type", "geometry_msgs/msg/TwistStamped", "type of the commands published"
        )
        self._start_at_once = bool(
            declare(self, "start_at_once", False, "begin a run as soon as there is a design")
        )
        what = (
            "s without a response, or from its stamp to this node's clock: stop; "
            "0: 4 periods, at least 0.1"
        )
        number("stale_after", 0.0, what, between=(0.0, 60.0))
        number("settling", 5.0, "s to wait for a state in the inlet", between=(0.0, 600.0))
        limit = partial(declare, self, tunable=True, several=True)
        limit("lowest", 0.0, "least input, or a list for each input", between=(-BIG, BIG))
        limit("highest", 0.0, "greatest input, or a list; must be set", between=(-BIG, BIG))
        limit("stop_at", 0.0, "input of a robot at rest, or a list", between=(-BIG, BIG))
        what = "fastest change while stopping, 1/s, or a list"
        limit("stop_rate", 1.0, what, between=(1e-6, BIG))
        what = f"fields of the commands that are not the input: {OTHERS}"
        self._others = declare_text(self, "others", ZERO, what)
        other_fields(self._command_type, self._others)
        what = "s until a robot that is stopped is at rest, faster than stop_rate if need be"
        number("stop_within", 5.0, what, between=(0.01, 60.0))
        what = (
            "folder of model.json (vector_field.json) and policy.json that are NOT proved: run them"
        )
        self._commissioning = declare_text(self, "commissioning", "", what)
        what = (
            "std_srvs/Trigger that stops the robot if a run of commissioning ends early; mandatory"
        )
        self._stop_service = declare_text(self, "stop_service", "", what)
        if self._commissioning and not self._stop_service:
            raise DataError("commissioning runs what is not proved: set stop_service")
        self._watched = bool(
            declare(self, "require_monitor", False, "track only while the monitor judges")
        )
        self._monitor = declare_text(self, "monitor", "funnel_monitor", "node required")
        what = "s without a verdict of the required monitor: stop"
        number("monitor_patience", 1.0, what, between=(0.01, 60.0))
        what = "frame_id that the response must have; empty: that of the first"
        self._frame = declare_text(self, "response_frame", "", what)
        self._wiring = declare_wiring(self)
        self._expected = declare_expected(self)
        declare_limits(self)  # which the subscription reads
        self._controller: Controller | None = None
        self._stopping = ""
        self.tune(self.tunable())

    def tune(self, values: Mapping[str, Any]) -> None:
        """Take limits and patience between runs; DataError in the middle of one."""
        if self._controller is not None or self._stopping:
            raise DataError("a run is on; stop it first")
        limits = Limits(**{name: values[name] for name in LIMITS})
        if np.any(np.equal(limits.lowest, limits.highest)):
            raise DataError("no room between lowest and highest; set the limits of the input")
        self._limits, self._settling = limits, values["settling"]
        self._stale_after, self._stop_within = values["stale_after"], values["stop_within"]
        self._monitor_patience = values["monitor_patience"]

    @property
    def _patient_for(self) -> float:
        """s without a response."""
        return patience(self._stale_after, self._design.period if self._design else 0.0)

    def start(self) -> None:
        """Listen for the funnel; it names the signals."""
        self._design: AnyDesign | None = None
        self._controller = None
        self._command: SignalMessage | None = None
        self._input: Any = self._limits.stop_at  # as the command takes it: one number or several
        self._first_ns: int | None = None
        self._run: Run | None = None  # as it was announced
        self._last_ns = 0  # the stamp of the last response under the policy's own input
        self._stamped_ns = 0  # the newest stamp of a response or command
        self._began = math.inf  # when a run did, s of the wall's time
        self._sent = -math.inf  # when the last command went out, s of the wall's time
        self._due: deque[tuple[int, Any]] = deque()  # (stamp ns, input) to be published
        self._ramp = self._limits
        self._stopping = ""
        self._text = ""
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", qos.EVENTS)
        self._announce = self.create_publisher(String, "~/run", qos.DOCUMENT)
        self.create_service(Trigger, "~/start", self._on_start)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self._funnel: DesignSubscription | Unproved = Unproved()
        if self._commissioning:
            self._brake = self.create_client(Trigger, self._stop_service)
            unproved: Any = load_unproved(self._commissioning, wiring=self._wiring)
            self._on_design(unproved, unproved.digest)
        else:
            self._funnel = DesignSubscription(
                self,
                self._source,
                self._on_design,
                self._report,
                wiring=self._wiring,
                expected=self._expected,
            )
        if self._watched:
            self._margin = self.create_subscription(
                JointState, f"{self._monitor}/margin", self._on_margin, qos.STREAM
            )
        self._next = self.create_timer(1.0, self._on_due)
        self._next.cancel()
        wall = Clock(clock_type=ClockType.STEADY_TIME)
        self._step = self.create_timer(1.0, self._on_step, clock=wall)
        self._step.cancel()
        self.create_timer(LOOK, self._look, clock=wall)
        self.create_timer(REPORT, self._report, clock=wall)

    def stop(self) -> None:
        """Ramp down before going, in real time."""
        self._funnel.close()
        if self._controller is None and not self._stopping:
            return
        assert self._design is not None
        period = self._design.period
        self._halt("the node stops")
        while not self._limits.at_rest(self._input):
            self._on_step()
            time.sleep(period)
        self._commands.wait_for_all_acked(Duration(seconds=LAST_WORD))

    def _on_design(self, design: AnyDesign, digest: str) -> None:
        """Take a design, but never in the middle of a run: stop that first."""
        response, command = design.response, design.command
        response.check(self._response_type, installed_types(self._response_type))
        message = SignalMessage(command, self._command_type, self._others)
        if self._controller is not None or self._stopping:
            self._halt("the design was replaced")
        if self._design is None:
            self._command = message
            message.listen(self)
            self._commands = self.create_publisher(
                message.kind, self.signal_topic(message.path.topic), qos.command(design.period)
            )
            self._responses = self.create_subscription(
                message_class(self._response_type),
                self.signal_topic(response.topic),
                partial(self._on_response, response),
                qos.SENSOR,
            )
        elif (response, command) != (self._design.response, self._design.command):
            raise DataError("it is about other signals; deactivate and activate again")
        self._design, self._digest = design, digest
        self._say_run(Run(0, digest, ended="the controller has another design, or began anew"))
        self._run = None
        self._tell("idle")
        if self._start_at_once:
            self._begin()

    def _begin(self) -> str:
        """Begin a run; why not, empty if it began."""
        if self._design is None:
            return f"there is no design yet: {self._funnel.state}"
        if self._funnel.refusal or self._funnel.state.startswith(CHECKING):
            return self._funnel.state
        if self._controller is not None or self._stopping:
            return "a run is on"
        assert self._command is not None
        if lacking := self._command.lacking() or self._doubt():
            return lacking
        if self._commissioning and not self._brake.service_is_ready():
            return f"{self._stop_service} is not there: nothing unproved runs without it"
        try:
            self._controller = self._design.controller(self._limits, self._settling)
        except NlsidError as error:
            self._tell(f"idle; not started: {error}")
            return str(error)
        if self._watched and (count := self.count_publishers(self._margin.topic_name)) != 1:
            self._controller = None
            judging = f"{count} nodes publish" if count else "nobody publishes"
            return f"require_monitor is set and {judging} {self._margin.topic_name}"
        self._first_ns, self._run, self._stage = None, None, 1
        self._stamped_ns, self._hears, self._accompanied = 0, False, not self._watched
        self._began = time.monotonic()
        self._tell("waiting for the response")
        return ""

    def _on_response(self, path: SignalPath | SignalVector, message: Any) -> None:
        """Decode, ask the core for the next input, and set it down for when it is due."""
        controller = self._controller
        if controller is None:
            return
        stamp_ns = stamp_ns_of(message)
        self._heard = time.monotonic()
        if not self._hears:
            self._hears, self._frame_heard = True, self._frame or frame_of(message)
            self._judged = self._sent = self._heard
        if reason := self._distrust(stamp_ns, message):
            self._halt(reason)
            return
        self._stamped_ns = max(self._stamped_ns, stamp_ns)
        u = controller.u
        if not self._accompanied:
            u = self._limits.stop_at  # until the required monitor is heard
        elif self._first_ns is None:
            self._first_ns = stamp_ns  # its input is not ours; the next sample's is
        else:
            waiting = controller.k < 1
            try:
                value = path.value(message)
            except BagError as error:
                self._halt(str(error))
                return
            controller.update(seconds(stamp_ns, self._first_ns), value)
            if controller.lead or not controller.ended:
                self._last_ns = stamp_ns
            if controller.ended:
                self._halt(controller.ended)
                return
            if waiting and controller.k >= 1:
                self._judged = self._heard
                self._say_run(Run(stamp_ns, self._digest))
                self._tell(self._tracking(controller))
            elif controller.stage != self._stage:
                self._tell(self._tracking(controller))
            u = controller.u
        self._due.append((stamp_ns + round(controller.lead * 1e9), u))
        self._on_due()

    def _doubt(self) -> str:
        """Why nobody knows whose responses come; empty if it is known."""
        return graph.several(self._responses.topic_name, self._responders())

    def _responders(self) -> list[TopicEndpointInfo]:
        """Who publishes responses."""
        publishers = self.get_publishers_info_by_topic(self._responses.topic_name)
        return [each for each in publishers if each.topic_type == self._response_type]

    def _say_run(self, run: Run) -> None:
        self._run = run
        self._announce.publish(String(data=files.encode(run.document()).decode()))

    def _tracking(self, controller: Controller) -> str:
        """What is being done, and of a composition in which stage."""
        self._stage = controller.stage
        many = controller.stages > 1
        return f"tracking, stage {self._stage} of {controller.stages}" if many else "tracking"

    def _distrust(self, stamp_ns: int, message: Any) -> str:
        """Why a response is not to be acted on though its number could be; empty if it is."""
        if (frame := frame_of(message)) != self._frame_heard:
            return f"the response is in frame '{frame}', not in '{self._frame_heard}'"
        return off_clock(stamp_ns, self.get_clock(), self._patient_for)

    def _on_due(self) -> None:
        """Publish every input that is due, and wait for the next; none that is long overdue."""
        self._next.cancel()
        most_ns = round(self._patient_for * 1e9)
        while self._due:
            stamp_ns, u = self._due[0]
            ahead = stamp_ns - self.get_clock().now().nanoseconds
            if ahead > 0:
                self._next.timer_period_ns = ahead
                self._next.reset()
                return
            if ahead < -most_ns:
                self._halt(f"a command is {-ahead * 1e-9:.3g} s late")
                return
            self._due.popleft()
            self._input = u
            self._send(stamp_ns)

    def _on_margin(self, message: JointState) -> None:
        """The required monitor has judged a sample; one not of this run and of now is none.

        One of another funnel, or of no run, ends this one.
        """
        stamp_ns = stamp_ns_of(message)
        if self._controller is None or not self._hears:
            return
        start_ns = 0 if self._run is None else self._run.start_ns
        if stamp_ns < start_ns or off_clock(stamp_ns, self.get_clock(), self._monitor_patience):
            return
        funnel, _, of_run = message.header.frame_id.partition(" ")
        if funnel != self._digest:
            judged = f"the funnel {funnel}" if funnel else "a funnel that it does not name"
            self._halt(f"{self._monitor} judges {judged}, not {self._digest}, which is tracked")
            return
        if of_run == UNANNOUNCED:
            self._halt(f"{self._monitor} judges no run: set its controller and nominal:=profile")
            return
        if self._run is None and of_run == WAITING:
            self._accompanied, self._judged = True, time.monotonic()
        if self._run is None or message.header.frame_id != self._run.name:
            return
        numbers = dict(zip(message.name, message.position, strict=False))
        margin, assumption = (numbers.get(key, math.nan) for key in ("margin", "assumption"))
        if margin < 0.0:
            self._halt(f"outside: {self._monitor} says margin {margin:.3g}")
        elif assumption > 1.0:
            self._halt(f"assumption violated: {self._monitor} says {assumption:.3g} of it is used")
        elif 0.0 <= margin <= 1.0:
            self._judged = time.monotonic()

    def _look(self) -> None:
        """Watch on the wall's clock that responses come, commands go and the monitor judges."""
        if self._controller is None or not self._hears:
            return
        assert self._design is not None
        assert self._command is not None
        now = time.monotonic()
        unsent = 2.0 * (self._patient_for + self._design.period)
        if now - self._heard > self._patient_for:
            self._halt("the response stopped coming")
        elif now - self._sent > unsent:
            self._halt(f"no command has gone out for {unsent:g} s")
        elif lacking := self._command.lacking() or self._doubt():
            self._halt(lacking)
        elif self._watched and now - self._judged > self._monitor_patience:
            self._halt(f"{self._monitor} has judged nothing for {self._monitor_patience:g} s")
        elif self._watched and (count := self.count_publishers(self._margin.topic_name)) > 1:
            self._halt(f"{count} nodes publish {self._margin.topic_name}; stop all but one")

    def _on_step(self) -> None:
        """One step towards rest; the last says so. A base that has stopped by itself, because no
        command went out, is not moved again on the way.
        """
        assert self._design is not None
        self._input = (
            self._limits.stop_at
            if base_stopped(self._sent, self._design.period)
            else self._ramp.towards_stop(self._input, self._design.period)
        )
        # Later than the last response, which is not to be judged under it, in simulated time too.
        self._send(max(self.get_clock().now().nanoseconds, self._stamped_ns + 1))
        if self._limits.at_rest(self._input):
            self._step.cancel()
            self._tell(f"idle; stopped: {self._stopping}")
            self._stopping = ""

    def _send(self, stamp_ns: int) -> None:
        assert self._command is not None
        self._sent, self._stamped_ns = time.monotonic(), max(self._stamped_ns, stamp_ns)
        self._commands.publish(self._command.make(stamp_ns, self._input))

    def _halt(self, reason: str) -> None:
        """End the run and ramp down, in real time and within `stop_within`."""
        if self._controller is None:
            return
        assert self._design is not None
        self._controller = None
        self._next.cancel()
        self._due.clear()
        self._stopping = reason
        if self._run is not None:
            self._say_run(replace(self._run, ended=reason, last_ns=self._last_ns))
            self._run = None
        if self._commissioning and reason not in ENDED:
            self._brake.call_async(Trigger.Request())
        away = np.abs(np.subtract(self._input, self._limits.stop_at))
        rate = np.maximum(self._limits.stop_rate, float(np.max(away)) / self._stop_within)
        self._ramp = replace(self._limits, stop_rate=rate)
        self._tell(f"stopping: {reason}")
        self._step.timer_period_ns = round(self._design.period * 1e9)
        self._step.reset()
        self._on_step()

    def _on_start(self, _request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        answer.message = self._begin()
        answer.success = not answer.message
        return answer

    def _on_stop(self, _request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        answer.success, answer.message = True, "stopping" if self._controller else "not running"
        self._halt(ASKED[0])
        return answer

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
        if self._commissioning:
            level, text = max(level, DiagnosticStatus.WARN), f"COMMISSIONING, not proved: {text}"
        values = {
            "input": ", ".join(f"{u:.6g}" for u in np.atleast_1d(self._input)),
            "sample": str(self._controller.k) if self._controller else "",
            "funnel": self._funnel.digest,
            "design": self._funnel.state,
        }
        now = self.get_clock().now().to_msg()
        self._diagnostics.publish(status(now, name_of(self), level, text, values))

    def _others_here(self) -> str:
        """Who else commands the robot or has this node's name, and who cannot hear it."""
        said = [graph.namesakes(self)]
        if self._design is not None:
            said.append(graph.rivals(self, self._commands))
        waiting = time.monotonic() - self._began if self._controller is not None else 0.0
        if self._first_ns is None and waiting > graph.SILENT:
            said.append(graph.unheard(self._responses.topic_name, self._responders()))
        return "; ".join(filter(None, said))


def main(args: list[str] | None = None) -> None:
    """Entry point of `ros2 run nlsid tracking_controller`."""
    try:
        run(TrackingController, args)
    except NlsidError as error:
        sys.exit(f"{NAME}: {error}")


if __name__ == "__main__":
    main()
