"""A stand-in for a car and for its funnel's publisher, which can do what robots do wrong."""

import time
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.designs.bundle import Bundle
from bags.designs.documents import FUNNEL
from nlsid_ros import qos
from nlsid_ros.messages import stamp_of
from tests.ros.processes import Bench, service

PERIOD_NS = 25_000_000
GOOD = list(range(10))


class Robot(Bench):
    """Stands in for a car and for the funnel's publisher, and hears what is said of it."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        super().__init__(stack)
        node = self.node
        self.bundle = Bundle.load(folder / FUNNEL)
        self.latched = node.create_publisher(String, "/funnel_publisher/design", qos.DOCUMENT)
        self.publish(self.bundle)
        self.odom = node.create_publisher(Odometry, "/odom", qos.STREAM)
        self.command = node.create_publisher(TwistStamped, "/cmd_vel", qos.STREAM)
        self.clock = node.create_publisher(Clock, "/clock", qos.STREAM)

    def watched(self, says: str = "no speed yet", /, **settings: object) -> None:
        """Start a monitor, which takes parameters, and wait until it says something."""
        self.start("funnel_monitor", **settings)
        self.hears(says)

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

    period_ns = PERIOD_NS

    def drive(
        self,
        samples: Iterable[int],
        *,
        speed: float = 0.0,
        since_ns: int = 10**18,
        slower: float = 1.0,
        frame: str = "",
        clock: bool = False,
    ) -> None:
        """Commands and states by index, a period apart in time whatever their stamps are.

        since_ns: the stamp of sample 0. slower: so many periods apart in time. clock: /clock has
        each stamp, too.
        """
        for k in samples:
            command, state = TwistStamped(), Odometry()
            for message in (command, state):
                message.header.stamp = stamp_of(since_ns + k * self.period_ns)
            state.header.frame_id, state.twist.twist.linear.x = frame, speed
            if clock:
                self.clock.publish(Clock(clock=state.header.stamp))
            self.command.publish(command)
            self.odom.publish(state)
            self.waits(slower * self.period_ns * 1e-9)

    def drive_now(self, samples: int, *, ahead: float = 0.0, **how: Any) -> None:
        """As `drive`, with stamps of now, or so many s later."""
        self.drive(range(samples), since_ns=time.time_ns() + round(ahead * 1e9), **how)
