"""A stand-in for a car and for its funnel's publisher, which can do what robots do wrong."""

import time
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.designs.bundle import Bundle
from bags.designs.documents import FUNNEL
from nlsid_ros import qos
from tests.ros.processes import SpinUntil, service

MONITOR = "nlsid_ros.funnel_monitor"
PERIOD_NS = 25_000_000
GOOD = list(range(10))


class Ear:
    """Hears what nodes say of themselves."""

    def __init__(self, node: Node, spin_until: SpinUntil) -> None:
        self.node, self.spin_until = node, spin_until
        self.said: dict[str, list[tuple[str, dict[str, str]]]] = {}
        self.levels: dict[str, bytes] = {}
        node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, qos.EVENTS)

    def _hear(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self.said.setdefault(status.name, []).append((status.message, values))
            self.levels[status.name] = status.level

    def has_said(self, text: str, node: str = "funnel_monitor") -> bool:
        """Whether `node` has said `text`."""
        return any(text in said for said, _ in self.said.get(node, []))


class Robot(Ear):
    """Stands in for a car and for the funnel's publisher, and hears what is said of it."""

    def __init__(self, node: Node, spin_until: SpinUntil, folder: Path) -> None:
        super().__init__(node, spin_until)
        self.bundle = Bundle.load(folder / FUNNEL)
        self.latched = node.create_publisher(String, "/funnel_publisher/design", qos.DOCUMENT)
        self.publish(self.bundle)
        self.odom = node.create_publisher(Odometry, "/odom", qos.STREAM)
        self.command = node.create_publisher(TwistStamped, "/cmd_vel", qos.STREAM)
        self.clock = node.create_publisher(Clock, "/clock", qos.STREAM)

    def publish(self, bundle: Bundle) -> None:
        """Publish a design, latched."""
        self.latched.publish(String(data=bundle.text()))

    def ready(self, monitors: int = 1) -> None:
        """Wait until the monitors listen."""
        self.spin_until(lambda: self.odom.get_subscription_count() >= monitors)
        self.spin_until(lambda: self.command.get_subscription_count() >= monitors)

    def restart(self) -> None:
        """Begin a new run, once the monitor listens to the car."""
        self.ready()
        self.begin()

    def begin(self) -> None:
        """Begin a new run."""
        restart = service(self.node, self.spin_until, "/funnel_monitor/restart")
        self.said.clear()
        self.spin_until(restart.call_async(Trigger.Request()).done)
        self.spin_until(lambda: self.has_said("restarted"))

    def drive(
        self,
        samples: list[int],
        *,
        speed: float = 0.0,
        odom: Publisher | None = None,
        shift_ns: int = 0,
        slower: float = 1.0,
        clock: bool = False,
    ) -> None:
        """Samples by index, at 40 Hz by their stamps whatever these are."""
        base = 10**18 + shift_ns
        for k in samples:
            command, state = TwistStamped(), Odometry()
            for message in (command, state):
                stamp = message.header.stamp
                stamp.sec, stamp.nanosec = divmod(base + k * PERIOD_NS, 10**9)
            state.twist.twist.linear.x = speed
            if clock:
                self.clock.publish(Clock(clock=state.header.stamp))
            self.command.publish(command)
            (odom or self.odom).publish(state)
            due = time.monotonic() + slower * PERIOD_NS * 1e-9
            self.spin_until(lambda due=due: time.monotonic() > due)  # type: ignore[misc]
