"""A process that publishes a car's state, then NaN, then nothing, and prints what is said of it."""

import sys
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from std_srvs.srv import Trigger

from nlsid_ros import qos
from nlsid_ros.live import _process

PERIOD_NS = 25_000_000


class Car(Node):
    """Stands still and says so, at 40 Hz."""

    def __init__(self) -> None:
        super().__init__("car")
        self.said: list[str] = []
        self.odom = self.create_publisher(Odometry, "/odom", qos.STREAM)
        self.command = self.create_publisher(TwistStamped, "/cmd_vel", qos.STREAM)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._hear, qos.EVENTS)
        self.restart = self.create_client(Trigger, "/funnel_monitor/restart")

    def _hear(self, message: DiagnosticArray) -> None:
        self.said += [s.message for s in message.status if s.name == "funnel_monitor"]

    def say(self, count: int, speed: float) -> None:
        """Publish `count` samples in real time."""
        base = time.time_ns() // PERIOD_NS * PERIOD_NS
        for k in range(count):
            stamp = base + k * PERIOD_NS
            command, odom = TwistStamped(), Odometry()
            for message in (command, odom):
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
            odom.twist.twist.linear.x = speed
            self.command.publish(command)
            self.odom.publish(odom)
            end = time.monotonic() + PERIOD_NS * 1e-9
            while time.monotonic() < end:
                rclpy.spin_once(self, timeout_sec=0.002)

    def until(self, text: str, seconds: float = 20.0) -> bool:
        """Whether the monitor says `text` within `seconds`."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            rclpy.spin_once(self, timeout_sec=0.05)
            if any(text in said for said in self.said):
                return True
        return False


def main() -> int:
    """Status 0 if the monitor said inside, then unknown for silence, then unknown for NaN."""
    rclpy.init()
    car = Car()
    with _process("funnel_publisher", funnel=sys.argv[1]), _process("funnel_monitor"):
        assert car.until(" yet"), car.said
        while car.odom.get_subscription_count() < 1 or car.command.get_subscription_count() < 1:
            rclpy.spin_once(car, timeout_sec=0.05)
        car.say(20, 0.0)
        silent = car.until("inside") and car.until("unknown: no speed for 0.1 s")
        car.restart.call_async(Trigger.Request())
        restarted = car.until("restarted")
        car.said.clear()
        car.say(10, 0.0)
        car.say(3, float("nan"))
        nan = car.until("unknown: speed is nan")
        still = not any("inside" in said for said in car.said[-1:])
    print("\n".join(car.said), silent, restarted, nan, still)
    print("unknown: no speed for 0.1 s" if silent else "never unknown")
    car.destroy_node()
    rclpy.shutdown()
    return 0 if silent and restarted and nan and still else 1


if __name__ == "__main__":
    sys.exit(main())
