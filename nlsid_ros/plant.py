"""Node `plant`: a simulated robot to try the chain on without one.

Publishes the response on an exact grid of stamps and applies each command from its stamp on.
`~/push` disturbs the input by `push` for `push_duration`. Noise is reproducible by `seed`.
"""

import sys
from bisect import insort
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from std_srvs.srv import Trigger

from bags.monitoring.documents import load_model
from bags.signals.signal import SignalPath
from nlsid_core.errors import BagError, DataError, NlsidError
from nlsid_core.plants import ModelPlant, Pendulum, Plant
from nlsid_ros import qos
from nlsid_ros.messages import SignalMessage, stamp_ns_of
from nlsid_ros.running import ManagedNode, declare, declare_number, declare_text, run

NAME = "plant"
SPEED, COMMAND = "/odom:twist.twist.linear.x", "/cmd_vel:twist.linear.x"


class PlantNode(ManagedNode):
    """Steps a `Plant` in real time."""

    def __init__(self) -> None:
        super().__init__(NAME)
        number = partial(declare_number, self)
        self._kind = declare_text(self, "kind", "model", "what is simulated: model or pendulum")
        self._model = declare_text(self, "model", "", "model.json, for kind model")
        self._period = number("period", 0.01, "s, of the pendulum's samples", between=(1e-3, 1.0))
        self._paths = [
            declare_text(self, "response", SPEED, "signal published (pendulum)"),
            declare_text(self, "excitation", COMMAND, "signal obeyed (pendulum)"),
        ]
        self._types = [
            declare_text(self, "response_type", "nav_msgs/msg/Odometry", "its message type"),
            declare_text(
                self, "command_type", "geometry_msgs/msg/TwistStamped", "its message type"
            ),
        ]
        self._noise = number("noise", 0.0, "standard deviation, response", between=(0.0, 1e6))
        self._delay = number("delay", 0.0, "s from stamp to publication", between=(0.0, 10.0))
        self._push = number("push", 0.3, "size of a push, input's unit", between=(-1e6, 1e6))
        self._push_duration = number("push_duration", 0.3, "s of a push", between=(0.0, 60.0))
        seed: Any = declare(self, "seed", 1, "of the noise", between=(0, 2**31))
        self._rng = np.random.default_rng(seed)

    def prepare(self) -> None:
        """Make the plant and its messages."""
        if self._kind == "model":
            if not self._model:
                raise DataError("no model to simulate; set the parameter model")
            model = load_model(Path(self._model))
            self._paths = [model.y.path, model.u.path]
            self._plant: Plant = ModelPlant(model)
        elif self._kind == "pendulum":
            self._plant = Pendulum(self._period)
        else:
            raise DataError(f"kind is '{self._kind}'; it should be model or pendulum")
        response, command = (SignalPath.parse(path) for path in self._paths)
        self._response = SignalMessage(response, self._types[0])
        self._command = SignalMessage(command, self._types[1])

    def start(self) -> None:
        """Begin at the next sample."""
        self._publisher = self.create_publisher(
            self._response.kind, self._response.path.topic, qos.STREAM
        )
        self._commands: list[tuple[int, float]] = [(0, 0.0)]  # by stamp, the one in force first
        self.create_subscription(
            self._command.kind, self._command.path.topic, self._on_command, qos.STREAM
        )
        self.create_service(Trigger, "~/push", self._on_push)
        self._period_ns = round(self._plant.period * 1e9)
        self._next_ns = self.get_clock().now().nanoseconds
        self._pushed_until_ns = 0
        self._sent: list[tuple[int, Any]] = []
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(min(self._plant.period, 0.005), self._on_tick, clock=steady)

    def _on_command(self, message: Any) -> None:
        try:
            value = self._command.path.value(message)
        except BagError as error:
            self.get_logger().error(str(error))
            return
        if np.isfinite(value):
            insort(self._commands, (stamp_ns_of(message), value))

    def _on_tick(self) -> None:
        """Every sample that is due, and every message whose delay is over."""
        now_ns = self.get_clock().now().nanoseconds
        while self._next_ns <= now_ns:
            self._sample(self._next_ns)
            self._next_ns += self._period_ns
        while self._sent and self._sent[0][0] <= now_ns:
            self._publisher.publish(self._sent.pop(0)[1])

    def _sample(self, stamp_ns: int) -> None:
        while len(self._commands) > 1 and self._commands[1][0] <= stamp_ns:
            del self._commands[0]
        u = self._commands[0][1]
        y = self._plant.measure(u) + self._noise * float(self._rng.standard_normal())
        self._plant.step(u, self._push if stamp_ns < self._pushed_until_ns else 0.0)
        due_ns = stamp_ns + round(self._delay * 1e9)
        self._sent.append((due_ns, self._response.make(stamp_ns, y)))

    def _on_push(self, _request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        self._pushed_until_ns = self._next_ns + round(self._push_duration * 1e9)
        answer.success, answer.message = True, f"{self._push:g} for {self._push_duration:g} s"
        return answer


def main(args: list[str] | None = None) -> None:
    """Entry point of `ros2 run nlsid plant`."""
    try:
        run(PlantNode, args)
    except (NlsidError, OSError) as error:
        sys.exit(f"{NAME}: {error}")


if __name__ == "__main__":
    main()
