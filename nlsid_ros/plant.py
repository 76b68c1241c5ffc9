"""Node `plant`: a simulated robot to try the chain on without one, in real time.

Publishes the response, or the joint states, on an exact grid of stamps. A period is simulated when
it is over, under the command in force at its start, so that a controller that answers within a
period acts as if at once; a later command acts from the next sample on. `~/push` disturbs one input
by `push` for `push_duration`. Noise is reproducible by `seed`.
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

from bags.chain import plants
from bags.chain.joint_bags import COMMANDS, JOINTS, STATES
from bags.designs.documents import load_model
from bags.signals.expressions import Expression
from bags.signals.grid import seconds
from bags.signals.signal import SignalPath
from bags.signals.vector import SignalVector
from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import BagError, DataError, NlsidError
from nlsid_core.running.plants import FieldPlant, ModelPlant, Pendulum, Plant, Satellite
from nlsid_ros import qos
from nlsid_ros.messages import SignalMessage, stamp_ns_of
from nlsid_ros.running import Arguments, ManagedNode, declare, declare_number, declare_text, run

NAME = "plant"
MUJOCO = {f"mujoco_{name}": robot for name, robot in plants.ROBOTS.items()}
KINDS = ("model", "vector_field", "pendulum", "satellite", *MUJOCO)
JUMP = 1.0  # s that the clock may be ahead or behind
FOR = "for kinds model and vector_field"


class PlantNode(ManagedNode):
    """Steps a `Plant` in real time."""

    def __init__(self, arguments: Arguments = None) -> None:
        super().__init__(NAME, arguments)

    def read_parameters(self) -> None:
        """Declare them; take the values that they have now."""
        number = partial(declare_number, self)
        self._kind = declare_text(self, "kind", "model", f"what is simulated: {', '.join(KINDS)}")
        what = "model.json, for kind model; vector_field.json, for kind vector_field"
        self._model = declare_text(self, "model", "", what)
        what = "numbers separated by commas: the state of a vector field until the first command"
        self._state = declare_text(self, "state", "", what)
        what = "of a vector field: topic:field paths separated by commas, all on one topic"
        self._paths = [declare_text(self, name, "", what) for name in ("response", "command")]
        self._period = number(
            "period",
            0.01,
            "s between samples (vector_field, pendulum, satellite)",
            between=(1e-3, 1.0),
        )
        self._types = [
            declare_text(self, "response_type", "nav_msgs/msg/Odometry", FOR),
            declare_text(self, "command_type", "geometry_msgs/msg/TwistStamped", FOR),
        ]
        self._noise = number(
            "noise",
            0.0,
            "standard deviation of the response or positions; MuJoCo's sensors have their own",
            between=(0.0, 1e6),
        )
        self._rate_noise = number(
            "rate_noise", 0.0, "standard deviation of the rates", between=(0.0, 1e6)
        )
        self._mass_scale = number(
            "mass_scale", 1.0, "of every mass and inertia (MuJoCo)", between=(0.1, 10.0)
        )
        self._delay = number("delay", 0.0, "s from stamp to publication", between=(0.0, 10.0))
        what = "s after which a command is no longer in force and the input is zero"
        self._command_timeout = number("command_timeout", 0.5, what, between=(0.0, 3600.0))
        self._push = number("push", 0.3, "size of a push, input's unit", between=(-1e6, 1e6))
        self._push_duration = number("push_duration", 0.3, "s of a push", between=(0.0, 60.0))
        pushed: Any = declare(self, "push_input", 0, "index of the input pushed", between=(0, 100))
        seed: Any = declare(self, "seed", 1, "of the noise", between=(0, 2**31))
        self._pushed, self._rng = pushed, np.random.default_rng(seed)

    def prepare(self) -> None:
        """Make the plant and its messages."""
        self._plant = self._make()
        response: SignalPath | SignalVector
        command: SignalPath | SignalVector
        if self._kind == "model":
            model = load_model(Path(self._model))
            response = Expression.parse(model.y.path).path
            command = Expression.parse(model.u.path).path
            inputs, spread = 1, [self._noise]
        elif isinstance(self._plant, FieldPlant):
            response, command = (
                SignalVector.parse(path.strip() for path in paths.split(","))
                for paths in self._paths
            )
            inputs, spread = self._plant.inputs, [self._noise] * len(response.paths)
            self._plant.refuse(len(response.paths), len(command.paths))
        else:
            inputs = len(self._plant.measure(np.zeros(1))) // 2
            joints = range(inputs)
            fields = [f"{STATES}:{f}[{i}]" for f in ("position", "velocity") for i in joints]
            response = SignalVector.parse(fields)
            command = SignalVector.parse(f"{COMMANDS}:effort[{i}]" for i in joints)
            self._types = [JOINTS, JOINTS]
            spread = [0.0] * (2 * inputs)
            if self._kind not in MUJOCO:
                spread = [self._noise] * inputs + [self._rate_noise] * inputs
        if self._pushed >= inputs:
            raise DataError(f"push_input is {self._pushed}; {self._kind} has {inputs} inputs")
        self._inputs, self._spread = inputs, np.array(spread)
        self._response = SignalMessage(response, self._types[0])
        self._command = SignalMessage(command, self._types[1])

    def _make(self) -> Plant:
        if self._kind == "model":
            if not self._model:
                raise DataError("no model to simulate; set the parameter model")
            return ModelPlant(load_model(Path(self._model)))
        if self._kind == "vector_field":
            try:
                x = np.array([float(part) for part in self._state.split(",")])
            except ValueError as error:
                raise DataError(f"state should be numbers, is '{self._state}'") from error
            field = VectorField.from_document(files.load_document(self._model), source=self._model)
            return FieldPlant(field, x, period=self._period, rng=self._rng)
        if self._kind == "pendulum":
            return Pendulum(self._period)
        if self._kind == "satellite":
            return Satellite(self._period)
        if self._kind in MUJOCO:
            return plants.Plant(MUJOCO[self._kind], self._rng, mass_scale=self._mass_scale)
        raise DataError(f"kind is '{self._kind}'; it should be one of {', '.join(KINDS)}")

    def start(self) -> None:
        """Begin at the next sample."""
        self._publisher = self.create_publisher(
            self._response.kind, self.signal_topic(self._response.path.topic), qos.STREAM
        )
        self.create_subscription(
            self._command.kind,
            self.signal_topic(self._command.path.topic),
            self._on_command,
            qos.STREAM,
        )
        self.create_service(Trigger, "~/push", self._on_push)
        self._period_ns = round(self._plant.period * 1e9)
        self._begin(self.get_clock().now().nanoseconds)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(min(self._plant.period, 0.005) / 2, self._on_tick, clock=steady)

    def _begin(self, now_ns: int) -> None:
        """Samples from now on, without a command in force."""
        self._last_ns: int | None = None
        self._next_ns = now_ns
        self._push_from_ns = self._push_until_ns = 0
        self._commands: list[tuple[int, FloatArray]] = [(0, np.zeros(self._inputs))]
        self._sent: list[tuple[int, Any]] = []

    def _on_command(self, message: Any) -> None:
        try:
            values = np.atleast_1d(self._command.path.value(message))
        except BagError as error:
            self.get_logger().error(str(error))
            return
        if np.isfinite(values).all():
            insort(self._commands, (stamp_ns_of(message), values), key=lambda entry: entry[0])

    def _on_tick(self) -> None:
        """Every sample that is due, and every message whose delay is over; anew from now on if the
        clock jumped, as simulated time does when it begins.
        """
        now_ns = self.get_clock().now().nanoseconds
        if abs(now_ns - self._next_ns) > round(JUMP * 1e9) + self._period_ns:
            self.get_logger().warning(
                f"this node's clock jumped by {seconds(now_ns, self._next_ns):.3g} s: begun anew"
            )
            self._begin(now_ns)
        while self._next_ns <= now_ns:
            self._sample(self._next_ns)
            self._next_ns += self._period_ns
        while self._sent and self._sent[0][0] <= now_ns:
            self._publisher.publish(self._sent.pop(0)[1])

    def _sample(self, stamp_ns: int) -> None:
        """Simulate the period that ends at this stamp, and measure."""
        if self._last_ns is not None:
            push = np.zeros(self._inputs)
            if self._push_from_ns <= self._last_ns < self._push_until_ns:
                push[self._pushed] = self._push
            self._plant.step(self._in_force(self._last_ns), push)
        noise = self._spread * self._rng.standard_normal(len(self._spread))
        y = self._plant.measure(self._in_force(stamp_ns)) + noise
        self._last_ns = stamp_ns
        due_ns = stamp_ns + round(self._delay * 1e9)
        self._sent.append((due_ns, self._response.make(stamp_ns, y)))

    def _in_force(self, stamp_ns: int) -> FloatArray:
        """The latest command stamped up to `stamp_ns`; those before it are forgotten.

        The watchdog that every base needs: a command that is not renewed ends.
        """
        while len(self._commands) > 1 and self._commands[1][0] <= stamp_ns:
            del self._commands[0]
        given_ns, values = self._commands[0]
        is_old = stamp_ns - given_ns > round(self._command_timeout * 1e9)
        return np.zeros(self._inputs) if is_old else values

    def _on_push(self, _request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        self._push_from_ns = self._next_ns
        self._push_until_ns = self._next_ns + round(self._push_duration * 1e9)
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
