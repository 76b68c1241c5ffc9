"""Node `tracking_controller`: runs the certified policy on the live state.

Of a difference equation sample k's input is known one period ahead; it is published when it comes
into force, stamped a quarter of a period before its sample is due, so that a sample off the grid by
that much is still paired with it. Of a state model it answers sample k, and carries its stamp.
`~/start` begins a run, `~/run` (latched) announces the stamp of its sample 0 and the funnel's
digest. Stale or impossible state, `~/stop`, and the end of the plan ramp the input to `stop_at`.
"""

import sys
import time
from collections.abc import Mapping
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.designs.design import AnyDesign
from bags.monitoring.announcement import Run
from bags.recordings.message_types import standard_types
from bags.signals.grid import seconds
from bags.signals.signal import SignalPath
from bags.signals.vector import SignalVector
from nlsid_core import files
from nlsid_core.errors import BagError, DataError, NlsidError
from nlsid_core.running.controller import Controller, Limits
from nlsid_ros import qos
from nlsid_ros.diagnostics import name_of, status
from nlsid_ros.documents import CHECKING, DesignSubscription, declare_expected, declare_wiring
from nlsid_ros.message_classes import message_class
from nlsid_ros.messages import SignalMessage, stamp_ns_of
from nlsid_ros.running import ManagedNode, declare, declare_number, declare_text, run

NAME = "tracking_controller"
LAST_WORD = 1.0  # s for the last command to be received before the node goes
REPORT = 1.0  # s between diagnostics while nothing changes
BIG = 1e9
LIMITS = [field.name for field in fields(Limits)]


class TrackingController(ManagedNode):
    """Samples in, inputs out; between runs it is silent, so that others may drive."""

    def __init__(self) -> None:
        super().__init__(NAME)
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
            declare(self, "start_at_once", False, "begin a run as soon as there is a funnel")
        )
        number("stale_after", 0.1, "s without a response: stop", between=(0.001, 60.0))
        number("settling", 5.0, "s to wait for a state in the inlet", between=(0.0, 600.0))
        number("lowest", 0.0, "least input", between=(-BIG, BIG))
        number("highest", 0.0, "greatest input; must be set", between=(-BIG, BIG))
        number("stop_at", 0.0, "input of a robot at rest", between=(-BIG, BIG))
        number("stop_rate", 1.0, "fastest change while stopping, 1/s", between=(1e-6, BIG))
        self._wiring = declare_wiring(self)
        self._expected = declare_expected(self)
        self._controller: Controller | None = None
        self._stopping = ""
        self.tune(self.tunable())

    def tune(self, values: Mapping[str, Any]) -> None:
        """Take limits and patience between runs; DataError in the middle of one."""
        if self._controller is not None or self._stopping:
            raise DataError("a run is on; stop it first")
        limits = Limits(**{name: values[name] for name in LIMITS})
        if limits.lowest == limits.highest:
            raise DataError("no room between lowest and highest; set the limits of the input")
        self._limits, self._settling = limits, values["settling"]
        self._stale_after = values["stale_after"]

    def start(self) -> None:
        """Listen for the funnel; it names the signals."""
        self._design: AnyDesign | None = None
        self._controller = None
        self._command: SignalMessage | None = None
        self._input: Any = self._limits.stop_at  # as the command takes it: one number or several
        self._first_ns: int | None = None
        self._due_ns = 0
        self._stopping = ""
        self._text = ""
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", qos.EVENTS)
        self._announce = self.create_publisher(String, "~/run", qos.DOCUMENT)
        self.create_service(Trigger, "~/start", self._on_start)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self._funnel = DesignSubscription(
            self,
            self._source,
            self._on_design,
            self._report,
            wiring=self._wiring,
            expected=self._expected,
        )
        self._due = self.create_timer(1.0, self._on_due)
        self._due.cancel()
        wall = Clock(clock_type=ClockType.STEADY_TIME)
        self._stale = self.create_timer(
            self._stale_after, lambda: self._halt("the response stopped coming"), clock=wall
        )
        self._stale.cancel()
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
            self._step_down()
            time.sleep(period)
        self._commands.wait_for_all_acked(Duration(seconds=LAST_WORD))

    def _on_design(self, design: AnyDesign, digest: str) -> None:
        """Take a design, but never in the middle of a run: stop that first."""
        response, command = design.response, design.command
        response.check(self._response_type, standard_types())
        message = SignalMessage(command, self._command_type)
        if self._controller is not None or self._stopping:
            self._halt("the design was replaced")
        if self._design is None:
            self._command = message
            self._commands = self.create_publisher(message.kind, message.path.topic, qos.STREAM)
            self.create_subscription(
                message_class(self._response_type),
                response.topic,
                partial(self._on_response, response),
                qos.SENSOR,
            )
        elif (response, command) != (self._design.response, self._design.command):
            raise DataError("it is about other signals; deactivate and activate again")
        self._design, self._digest = design, digest
        self._tell("idle")
        if self._start_at_once:
            self._begin()

    def _begin(self) -> str:
        """Begin a run; why not, empty if it began."""
        if self._design is None:
            return f"there is no design yet: {self._funnel.state}"
        if self._funnel.refusal or self._funnel.state == CHECKING:
            return self._funnel.state
        if self._controller is not None or self._stopping:
            return "a run is on"
        try:
            self._controller = self._design.controller(self._limits, self._settling)
        except NlsidError as error:
            self._tell(f"idle; not started: {error}")
            return str(error)
        self._first_ns = None
        self._stale.timer_period_ns = round(self._stale_after * 1e9)
        self._tell("waiting for the response")
        return ""

    def _on_response(self, path: SignalPath | SignalVector, message: Any) -> None:
        """Decode, ask the core for the next input, and set it down for when it is due."""
        controller = self._controller
        if controller is None:
            return
        stamp_ns = stamp_ns_of(message)
        if self._first_ns is None:  # its input is not ours; the next sample's is
            self._first_ns = stamp_ns
        else:
            waiting = controller.k < 1
            try:
                value = path.value(message)
            except BagError as error:
                self._halt(str(error))
                return
            controller.update(seconds(stamp_ns, self._first_ns), value)
            if controller.ended:
                self._halt(controller.ended)
                return
            if waiting and controller.k >= 1:
                announced = Run(stamp_ns, self._digest).document()
                self._announce.publish(String(data=files.encode(announced).decode()))
                self._tell("tracking")
        self._stale.reset()
        self._schedule(stamp_ns + round(controller.lead * 1e9))

    def _schedule(self, due_ns: int) -> None:
        """Publish at `due_ns`, at once if that has passed."""
        self._due_ns = due_ns
        ahead = due_ns - self.get_clock().now().nanoseconds
        if ahead <= 0:
            self._on_due()
        else:
            self._due.timer_period_ns = ahead
            self._due.reset()

    def _on_due(self) -> None:
        self._due.cancel()
        if self._controller is not None:
            self._input = self._controller.u
            self._send(self._due_ns)
        elif self._stopping:
            self._step_down()
            if self._limits.at_rest(self._input):
                self._tell(f"idle; stopped: {self._stopping}")
                self._stopping = ""
            else:
                assert self._design is not None
                self._schedule(self._due_ns + round(self._design.period * 1e9))

    def _step_down(self) -> None:
        assert self._design is not None
        self._input = self._limits.towards_stop(self._input, self._design.period)
        self._send(self.get_clock().now().nanoseconds)

    def _send(self, stamp_ns: int) -> None:
        assert self._command is not None
        self._commands.publish(self._command.make(stamp_ns, self._input))

    def _halt(self, reason: str) -> None:
        """End the run and ramp down."""
        self._stale.cancel()
        if self._controller is None:
            return
        self._controller = None
        self._stopping = reason
        self._tell(f"stopping: {reason}")
        self._schedule(self.get_clock().now().nanoseconds)

    def _on_start(self, _request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        answer.message = self._begin()
        answer.success = not answer.message
        return answer

    def _on_stop(self, _request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        answer.success, answer.message = True, "stopping" if self._controller else "not running"
        self._halt("asked to")
        return answer

    def _tell(self, text: str) -> None:
        self._text = text
        self.get_logger().info(text)
        self._report()

    def _report(self) -> None:
        level, text = DiagnosticStatus.OK, self._text
        if self._stopping or "stopped" in self._text:
            level = DiagnosticStatus.WARN
        if self._design is None or self._funnel.refusal:
            text = "; ".join(part for part in (self._text, self._funnel.state) if part)
        if self._funnel.refusal:
            level = DiagnosticStatus.ERROR
        values = {
            "input": ", ".join(f"{u:.6g}" for u in np.atleast_1d(self._input)),
            "sample": str(self._controller.k) if self._controller else "",
            "funnel": self._funnel.digest,
            "design": self._funnel.state,
        }
        now = self.get_clock().now().to_msg()
        self._diagnostics.publish(status(now, name_of(self), level, text, values))


def main(args: list[str] | None = None) -> None:
    """Entry point of `ros2 run nlsid tracking_controller`."""
    try:
        run(TrackingController, args)
    except NlsidError as error:
        sys.exit(f"{NAME}: {error}")


if __name__ == "__main__":
    main()
