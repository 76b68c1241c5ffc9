"""Simulated robots to try the chain on, in MuJoCo (extra `sim`): physics nobody here wrote.

`robots/` has a pendulum and a two-link arm, both driven by joint torques held for one sample.
Encoders add white noise to angles and rates.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from nlsid_core.arrays import ArrayLike, FloatArray
from nlsid_core.errors import DataError

PERIOD = 0.01  # s, what the drives and encoders of both robots run at
STEPS = 10  # physics steps a sample: 1 ms each
ANGLE_NOISE = 1e-3  # rad, standard deviation
RATE_NOISE = 1e-2  # rad/s, standard deviation
FILES: Final = {path.stem: path for path in sorted(Path(__file__).parent.glob("robots/*.xml"))}


class Plant:
    """A robot being simulated, by its name in FILES; one `step` is one sample.

    joints: how many it has; its state is [angles; rates].

    Raises DataError if there is no such robot, or MuJoCo is not installed.
    """

    period = PERIOD

    def __init__(self, robot: str, rng: np.random.Generator) -> None:
        if robot not in FILES:
            raise DataError(f"no simulated robot '{robot}'; there are: {', '.join(FILES)}")
        try:
            import mujoco
        except ImportError as error:
            raise DataError("simulated robots need MuJoCo: pip install 'nlsid[sim]'") from error
        self._rng = rng
        self._advance: Callable[[Any, Any, int], None] = mujoco.mj_step
        self._model: Any = mujoco.MjModel.from_xml_path(str(FILES[robot]))
        self._data: Any = mujoco.MjData(self._model)
        self.joints = int(self._model.nq)
        self.reset(np.zeros(2 * self.joints))

    @property
    def state(self) -> FloatArray:
        """(2n,) the true [angles in rad; rates in rad/s]."""
        return np.concatenate([self._data.qpos, self._data.qvel])

    def reset(self, state: ArrayLike) -> None:
        """Put the robot at `state` (2n,)."""
        values, n = np.asarray(state, dtype=np.float64), self.joints
        self._data.qpos[:], self._data.qvel[:] = values[:n], values[n:]
        self._data.qacc_warmstart[:] = 0.0  # so that a run depends on its start and seed only

    def measure(self, _torque: ArrayLike = 0.0, /) -> FloatArray:
        """(2n,) the state as the encoders see it, whatever the torque."""
        sizes = np.repeat([ANGLE_NOISE, RATE_NOISE], self.joints)
        return self.state + sizes * self._rng.standard_normal(2 * self.joints)

    def step(self, torque: ArrayLike, push: ArrayLike = 0.0, /) -> None:
        """Hold `torque` (n,), as far as the drives give it, for one sample; `push` in N·m is added.

        The drives' limits are the motors' in the robot's file.
        """
        self._data.ctrl[:] = torque
        self._data.qfrc_applied[:] = push
        self._advance(self._model, self._data, STEPS)
