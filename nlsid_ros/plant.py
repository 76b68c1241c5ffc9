"""Node `plant`: a simulated robot to try the chain on without one, in real time.

Publishes the response, or the joint states, on an exact grid of stamps. A period is simulated when
it is over, under the command in force at its start, so that a controller that answers within a
period acts as if at once; a later command acts from the next sample on. `~/push` disturbs one input
by `push` for `push_duration`. Noise is reproducible by `seed`.
"""

from bisect import insort
from pathlib import Path
from typing import Any

import numpy as np

from bags.chain import plants
from bags.chain.joint_bags import COMMANDS, JOINTS, STATES
from bags.signals.expressions import Expression
from bags.signals.message_reader import SignalVector
from bags.signals.timing import seconds
from nlsid_core import files
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.dynamics import VectorField, vector_field
from nlsid_core.errors import BagError, DataError
from nlsid_core.models import DifferenceEquation
from nlsid_core.running.plants import FieldPlant, ModelPlant, Plant
from nlsid_ros import qos
from nlsid_ros.messages import SignalMessage, stamp_ns_of
from nlsid_ros.running import ManagedNode, Parameter
from nlsid_ros.starting import entry_point

MUJOCO = {f"mujoco_{name}": name for name in plants.FILES}
KINDS = ("model", *MUJOCO)
JUMP = 1.0  # s that the clock may be ahead or behind
FOR = "for kind model"
PATHS = "of a vector field: topic:field paths separated by commas, all on one topic"


class PlantNode(ManagedNode):
    """Steps a `Plant` in real time."""

    name = "plant"
    parameters = (
        Parameter("kind", "model", f"what is simulated: {', '.join(KINDS)}"),
        Parameter("model", "", "model.json or vector_field.json, for kind model"),
        Parameter(
            "state",
            "",
            "numbers separated by commas: the state of a vector field until the first command",
        ),
        Parameter("response", "", PATHS),
        Parameter("command", "", PATHS),
        Parameter("period", 0.01, "s between samples of a vector field", (1e-3, 1.0)),
        Parameter("response_type", "nav_msgs/msg/Odometry", FOR),
        Parameter("command_type", "geometry_msgs/msg/TwistStamped", FOR),
        Parameter(
            "noise",
            0.0,
            "standard deviation of the response; MuJoCo's sensors have their own",
            (0.0, 1e6),
        ),
        Parameter("seed", 1, "of the noise", (0, 2**31)),
        Parameter(
            "command_timeout",
            0.5,
            "s after which a command is no longer in force and the input is zero",
            (0.0, 3600.0),
        ),
        Parameter("push", 0.3, "size of a push of the first input, its unit", (-1e6, 1e6)),
        Parameter("push_duration", 0.3, "s of a push", (0.0, 60.0)),
    )

    def prepare(self) -> None:
        """Make the plant and its messages."""
        values = self.values
        self._rng = np.random.default_rng(values.seed)
        self._noise, types = values.noise, [values.response_type, values.command_type]
        match values.kind:
            case "model":
                signals = self._make_model()
            case kind if kind in MUJOCO:
                signals, types = self._make_robot(MUJOCO[kind]), [JOINTS, JOINTS]
            case kind:
                raise DataError(f"kind is '{kind}'; it should be one of {', '.join(KINDS)}")
        response, command = map(SignalVector.parse, signals)
        self._inputs = len(command.paths)
        self._response = SignalMessage(response, types[0])
        self._command = SignalMessage(command, types[1])

    def _make_model(self) -> tuple[list[str], list[str]]:
        """Simulate the model of a design, or its equations; the paths of response and command."""
        if not self.values.model:
            raise DataError("no model to simulate; set the parameter model")
        document = files.load_document(Path(self.values.model))
        if document.get("format") == vector_field.FORMAT:
            return self._make_field(document)
        model = DifferenceEquation.from_document(document, source=self.values.model)
        self._plant: Plant = ModelPlant(model)
        y, u = (Expression.parse(signal.path).path for signal in (model.y, model.u))
        return [str(y)], [str(u)]

    def _make_field(self, document: Json) -> tuple[list[str], list[str]]:
        """Simulate a vector field; the paths that the parameters say."""
        values = self.values
        try:
            x = np.array([float(part) for part in values.state.split(",")])
        except ValueError as error:
            raise DataError(f"state should be numbers, is '{values.state}'") from error
        field = VectorField.from_document(document, source=values.model)
        plant = FieldPlant(field, x, period=values.period, rng=self._rng)
        response, command = (
            [path.strip() for path in paths.split(",")]
            for paths in (values.response, values.command)
        )
        plant.refuse(len(response), len(command))
        self._plant = plant
        return response, command

    def _make_robot(self, name: str) -> tuple[list[str], list[str]]:
        """Simulate a robot in MuJoCo; the paths of its joints."""
        robot = plants.Plant(name, self._rng)
        self._plant, self._noise, joints = robot, 0.0, range(robot.joints)
        states = [f"{STATES}:{f}[{i}]" for f in ("position", "velocity") for i in joints]
        return states, [f"{COMMANDS}:effort[{i}]" for i in joints]

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
        self.serve("push", self._on_push)
        self._period_ns = round(self._plant.period * 1e9)
        self._begin(self.get_clock().now().nanoseconds)
        self.every(min(self._plant.period, 0.005) / 2, self._on_tick)

    def _begin(self, now_ns: int) -> None:
        """Samples from now on, without a command in force."""
        self._last_ns: int | None = None
        self._next_ns = now_ns
        self._push_from_ns = self._push_until_ns = 0
        self._commands: list[tuple[int, FloatArray]] = [(0, np.zeros(self._inputs))]

    def _on_command(self, message: Any) -> None:
        try:
            values = np.array([path.value(message) for path in self._command.path.paths])
        except BagError as error:
            self.get_logger().error(str(error))
            return
        if np.isfinite(values).all():
            insort(self._commands, (stamp_ns_of(message), values), key=lambda entry: entry[0])

    def _on_tick(self) -> None:
        """Every sample that is due; anew from now on if the clock jumped, as simulated time does
        when it begins.
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

    def _sample(self, stamp_ns: int) -> None:
        """Simulate the period that ends at this stamp, and measure."""
        if self._last_ns is not None:
            push = np.zeros(self._inputs)
            if self._push_from_ns <= self._last_ns < self._push_until_ns:
                push[0] = self.values.push
            self._plant.step(self._in_force(self._last_ns), push)
        y = self._plant.measure(self._in_force(stamp_ns))
        y = y + self._noise * self._rng.standard_normal(len(y))
        self._last_ns = stamp_ns
        self._publisher.publish(self._response.make(stamp_ns, y))

    def _in_force(self, stamp_ns: int) -> FloatArray:
        """The latest command stamped up to `stamp_ns`; those before it are forgotten.

        The watchdog that every base needs: a command that is not renewed ends.
        """
        while len(self._commands) > 1 and self._commands[1][0] <= stamp_ns:
            del self._commands[0]
        given_ns, values = self._commands[0]
        is_old = stamp_ns - given_ns > round(self.values.command_timeout * 1e9)
        return np.zeros(self._inputs) if is_old else values

    def _on_push(self) -> tuple[bool, str]:
        self._push_from_ns = self._next_ns
        self._push_until_ns = self._next_ns + round(self.values.push_duration * 1e9)
        return True, f"{self.values.push:g} for {self.values.push_duration:g} s"


main = entry_point(PlantNode)

if __name__ == "__main__":
    main()
