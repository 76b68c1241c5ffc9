"""Simulated robots to try the chain on, in MuJoCo (extra `sim`): physics nobody here wrote.

A pendulum with viscous damping and dry friction, and a two-link arm hanging in gravity, both
driven by joint torques held for one sample. Encoders add white noise to angles and rates.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from nlsid_core.arrays import ArrayLike, FloatArray
from nlsid_core.errors import DataError

PERIOD = 0.01  # s, what the drives and encoders of both robots run at
STEPS = 10  # physics steps a sample: 1 ms each
ANGLE_NOISE = 1e-3  # rad, standard deviation
RATE_NOISE = 1e-2  # rad/s, standard deviation

_LINK = (
    '<joint name="j{i}" type="hinge" axis="0 1 0" damping="{damping}" frictionloss="{friction}"/>'
    '<inertial pos="0 0 -{centre}" mass="{mass}" diaginertia="{spin} {spin} {spin}"/>'
)


@dataclass(frozen=True)
class Link:
    """One link: kg, m to its centre of mass and to the next joint, N·m·s/rad, N·m."""

    mass: float
    centre: float
    length: float
    damping: float
    friction: float


@dataclass(frozen=True)
class Robot:
    """A chain of links hanging from a hinge; torque limits in N·m, one per joint."""

    name: str
    links: tuple[Link, ...]
    torque: tuple[float, ...]

    @property
    def joints(self) -> int:
        """How many joints it has; its state is [angles; rates]."""
        return len(self.links)

    def mjcf(self) -> str:
        """The MuJoCo model."""
        body = ""
        for i, link in reversed(list(enumerate(self.links))):
            offset = self.links[i - 1].length if i else 0.0
            inner = _LINK.format(
                i=i,
                damping=link.damping,
                friction=link.friction,
                centre=link.centre,
                mass=link.mass,
                spin=link.mass * link.length**2 / 100.0,
            )
            body = f'<body pos="0 0 {-offset}">{inner}{body}</body>'
        motors = "".join(f'<motor joint="j{i}"/>' for i in range(self.joints))
        return (
            f'<mujoco><option timestep="{PERIOD / STEPS}" integrator="implicitfast"/>'
            f"<worldbody>{body}</worldbody><actuator>{motors}</actuator></mujoco>"
        )


PENDULUM = Robot("pendulum", (Link(1.0, 1.0, 1.0, 0.5, 0.02),), (20.0,))
ARM = Robot(
    "arm",
    (Link(2.0, 0.25, 0.5, 1.0, 0.02), Link(1.0, 0.25, 0.5, 0.5, 0.01)),
    (20.0, 10.0),
)
ROBOTS: Final[Mapping[str, Robot]] = {robot.name: robot for robot in (PENDULUM, ARM)}


class Plant:
    """A robot being simulated; one `step` is one sample.

    Raises DataError if MuJoCo is not installed.
    """

    period = PERIOD

    def __init__(self, robot: Robot, rng: np.random.Generator) -> None:
        try:
            import mujoco
        except ImportError as error:
            raise DataError("simulated robots need MuJoCo: pip install 'nlsid[sim]'") from error
        self.robot, self._rng = robot, rng
        self._advance: Callable[[Any, Any, int], None] = mujoco.mj_step
        self._model: Any = mujoco.MjModel.from_xml_string(robot.mjcf())
        self._data: Any = mujoco.MjData(self._model)
        self.reset(np.zeros(2 * robot.joints))

    @property
    def state(self) -> FloatArray:
        """(2n,) the true [angles in rad; rates in rad/s]."""
        return np.concatenate([self._data.qpos, self._data.qvel])

    def reset(self, state: ArrayLike) -> None:
        """Put the robot at `state` (2n,)."""
        values, n = np.asarray(state, dtype=np.float64), self.robot.joints
        self._data.qpos[:], self._data.qvel[:] = values[:n], values[n:]
        self._data.qacc_warmstart[:] = 0.0  # so that a run depends on its start and seed only

    def measure(self, _torque: ArrayLike = 0.0, /) -> FloatArray:
        """(2n,) the state as the encoders see it, whatever the torque."""
        n = self.robot.joints
        return self.state + np.repeat([ANGLE_NOISE, RATE_NOISE], n) * self._rng.standard_normal(
            2 * n
        )

    def step(self, torque: ArrayLike, push: ArrayLike = 0.0, /) -> None:
        """Hold `torque` (n,), cut to the drives' limits, for one sample; `push` in N·m is added."""
        limit = np.array(self.robot.torque)
        self._data.ctrl[:] = np.clip(torque, -limit, limit)
        self._data.qfrc_applied[:] = push
        self._advance(self._model, self._data, STEPS)
