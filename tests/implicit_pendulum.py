"""A pendulum with a cubic in the place of the sine, in implicit form by the trapezoidal rule."""

import numpy as np

from nlsid_core.models import Signal
from nlsid_core.models.trapezoidal import TrapezoidalModel

PERIOD = 0.02
EXPONENTS = np.array([[1, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 1]])
PHYSICS = np.array([[-9.8], [9.8 / 6], [-0.5], [1.0]])


def truth() -> TrapezoidalModel:
    """A pendulum with a cubic in the place of the sine."""
    return TrapezoidalModel(
        exponents=EXPONENTS,
        coefficients=PHYSICS,
        period=PERIOD,
        x=(Signal("angle", "rad"), Signal("rate", "rad/s")),
        u=(Signal("torque", "N m"),),
        x_range=np.array([[-2.0, 2.0], [-9.0, 9.0]]),
        u_range=np.array([[-10.0, 10.0]]),
        noise=np.array([1e-3, 1e-2]),
        disturbance=np.array([1e-4, 1e-3]),
        bags=(("fit", f"sha256:{1:064x}"),),
    )
