"""Node `funnel_monitor`: holds the live state against the latched funnel.

Subscribes to the funnel, its model and its policy, and to the two signals by the model's own field
paths, on message stamps. Publishes ~/margin (sensor_msgs/JointState: stamped, named numbers) for
every sample, and /diagnostics at once when the status changes, otherwise once a second.
Missing, stale or NaN state is unknown (STALE), never inside. `~/restart` begins a new run.
"""

import sys
import time
from collections.abc import Iterable
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.message_types import is_stamped, standard_types
from bags.signals import SignalPath
from bags.watch import Stamped, Watch
from nlsid_core import _json
from nlsid_core._types import Json
from nlsid_core.errors import BagError, NlsidError
from nlsid_core.funnel import Funnel
from nlsid_core.models import DifferenceEquation
from nlsid_core.monitor import Monitor, Nominal, Reading, Status
from nlsid_core.policy import Policy
from nlsid_ros import qos
from nlsid_ros.diagnostics import status
from nlsid_ros.message_classes import message_class
from nlsid_ros.running import declare, run

NAME = "funnel_monitor"
TICK = 0.005  # s: how often waiting samples and staleness are looked at
DISCOVERY = 0.1  # s: how often the graph is asked for the signals' types
HEARTBEAT = 1.0  # s: diagnostics are repeated this often while nothing changes
LEVELS = {
    Status.INSIDE: DiagnosticStatus.OK,
    Status.ASSUMPTION_VIOLATED: DiagnosticStatus.ERROR,
    Status.OUTSIDE: DiagnosticStatus.ERROR,
    Status.UNKNOWN: DiagnosticStatus.STALE,
}


class FunnelMonitor(Node):
    """Reads stamped signals, asks the core's Monitor, publishes what it says."""

    def __init__(self) -> None:
        super().__init__(NAME)
        source = declare(self, "source", "/funnel_publisher", "node that publishes the funnel")
        self._nominal = Nominal(
            str(declare(self, "nominal", "command", "what the tube is around: command or profile"))
        )
        self._stale_after = float(
            declare(self, "stale_after", 0.1, "s without a response: unknown", between=(0.001, 60))  # type: ignore[arg-type]
        )
        self._command_wait = float(
            declare(
                self, "command_wait", 0.02, "s a response waits for its command", between=(0, 1)
            )  # type: ignore[arg-type]
        )
        self._documents: dict[str, Json] = {}
        self._watch: Watch | None = None
        self._last_arrival = 0.0
        self._reading = Reading(0.0, Status.UNKNOWN, reason="waiting for the funnel")
        self._said_at = -HEARTBEAT
        self._margin = self.create_publisher(JointState, "~/margin", qos.STREAM)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", qos.EVENTS)
        for role in ("model", "policy", "funnel"):
            self.create_subscription(
                String, f"{source}/{role}", partial(self._on_document, role), qos.DOCUMENT
            )
        self.create_service(Trigger, "~/restart", self._on_restart)
        self._discovery = self.create_timer(DISCOVERY, self._connect)
        self.create_timer(TICK, self._on_tick)
        self._waiting: dict[str, SignalPath] = {}

    def _on_document(self, role: str, message: String) -> None:
        """Take a latched document; start once all three are there and belong together."""
        try:
            self._documents[role] = _json.parse_document(message.data, source=role)
            if len(self._documents) < 3:
                return
            model = DifferenceEquation.from_document(self._documents["model"])
            policy = Policy.from_document(self._documents["policy"])
            funnel = Funnel.from_document(self._documents["funnel"])
            self._watch = Watch(Monitor(model, policy, funnel, nominal=self._nominal))
        except NlsidError as error:
            self.get_logger().error(f"funnel not used: {error}")
            self._reading = Reading(0.0, Status.UNKNOWN, reason=f"funnel not used: {error}")
            return
        self._waiting = {
            "response": SignalPath.parse(model.y.path),
            "excitation": SignalPath.parse(model.u.path),
        }
        self._reading = Reading(0.0, Status.UNKNOWN, reason=f"no {model.y.name} yet")
        self.get_logger().info(f"watching {model.y.path} and {model.u.path}")

    def _connect(self) -> None:
        """Subscribe to signals whose topic has appeared, once its type is known to carry them."""
        types = dict(self.get_topic_names_and_types())
        for role, path in list(self._waiting.items()):
            found = types.get(path.topic)
            if not found:
                continue
            del self._waiting[role]
            try:
                path.check(found[0], standard_types())
                if not is_stamped(found[0], standard_types()):
                    raise BagError(f"{path.topic}: {found[0]} has no header stamp")
            except BagError as error:
                self._reading = Reading(0.0, Status.UNKNOWN, reason=str(error))
                self.get_logger().error(str(error))
                return
            callback = partial(self._on_signal, role, path)
            publishers = self.get_publishers_info_by_topic(path.topic)
            profile = qos.subscription_to([p.qos_profile.reliability for p in publishers])
            self.create_subscription(message_class(found[0]), path.topic, callback, profile)

    def _on_signal(self, role: str, path: SignalPath, message: Any) -> None:
        """Decode stamp and value, and judge whatever samples are complete."""
        if self._watch is None:
            return
        stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        value = path.value(message)
        if role == "excitation":
            self._publish(self._watch.excitation(stamp_ns, value))
        else:
            self._last_arrival = time.monotonic()
            self._publish(self._watch.response(stamp_ns, value))

    def _on_tick(self) -> None:
        """Let go of samples whose command does not come, notice stale state, keep a heartbeat."""
        silent = time.monotonic() - self._last_arrival
        watch = self._watch
        if watch is not None and watch.origin_ns is not None:
            if silent > self._command_wait:
                self._publish(watch.flush())
            if silent > self._stale_after:
                name = watch.monitor.model.y.name
                for _, reading in watch.missing(f"no {name} for {self._stale_after:g} s"):
                    self._say(reading)
        if time.monotonic() - self._said_at >= HEARTBEAT:
            self._say(self._reading)

    def _publish(self, stamped: Iterable[Stamped]) -> None:
        """Diagnostics first: an alarm should not wait behind a number."""
        for stamp_ns, reading in stamped:
            self._say(reading)
            self._publish_margin(stamp_ns, reading)

    def _publish_margin(self, stamp_ns: int, reading: Reading) -> None:
        message = JointState()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        values = {
            "margin": reading.margin,
            "budget_spent": reading.budget_spent,
            "nominal": reading.nominal,
            "measured": reading.measured,
        }
        message.name = list(values)
        message.position = list(values.values())
        self._margin.publish(message)

    def _say(self, reading: Reading, *, at_once: bool = False) -> None:
        """Publish diagnostics if the status changed or the heartbeat is due."""
        now = time.monotonic()
        changed = reading.status is not self._reading.status
        self._reading = reading
        if not (changed or at_once) and now - self._said_at < HEARTBEAT:
            return
        self._said_at = now
        values = {
            "margin": f"{reading.margin:.6g}",
            "worst axis": reading.worst_axis,
            "budget spent": f"{reading.budget_spent:.6g}",
            "time in run [s]": f"{reading.t:.9g}",
            "late commands": str(self._watch.pairing.late if self._watch else 0),
        }
        text = reading.status.value + (f": {reading.reason}" if reading.reason else "")
        stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(status(stamp, NAME, LEVELS[reading.status], text, values))

    def _on_restart(self, _request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Begin a new run: forget stamps, lags and budget."""
        answer.success = self._watch is not None
        answer.message = "new run" if answer.success else "there is no funnel yet"
        if self._watch is not None:
            self._watch.restart()
            self._say(Reading(0.0, Status.UNKNOWN, reason="restarted"), at_once=True)
        return answer


def main(args: list[str] | None = None) -> None:
    """Entry point of `ros2 run nlsid funnel_monitor`."""
    try:
        run(FunnelMonitor, args)
    except NlsidError as error:
        sys.exit(f"{NAME}: {error}")


if __name__ == "__main__":
    main()
