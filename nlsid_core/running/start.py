"""`Start`: where a run begins whose robot may be in motion, and when that has faded.

If the inputs before were in their range for ever, the model's own simulation is now somewhere about
its rest x* under the middle of the range. With D the most that one step moves it from there,
    |x - x*|_P <= D / (1 - √ρ),    V(x̄) <= ρ^k D² / (1 - √ρ)² after k steps under common inputs,
for P shrinks by √ρ a step. No claim rests on it: a tube holds from any start of its simulation. It
says when the simulation is that of the robot's past too, whatever this was.
Source: docs/theory.md, "A start in motion".
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import DataError
from nlsid_core.funnels.tube import TubeFunnel
from nlsid_core.models import DifferenceEquation, StableModel, StateAffineModel
from nlsid_core.running.stepping import Stepper

FADED = 0.01  # of the level: what V of the start may still be
AT_REST = 1e-9  # of itself: what is left of any start in x*
MOST_SAMPLES = 10**5


class Start(NamedTuple):
    """x (n,), and after how many samples what is not known of it has faded."""

    x: FloatArray
    samples: int


def start_in_motion(model: StableModel, funnels: Sequence[TubeFunnel]) -> Start:
    """x* and the samples until V is below FADED of every tube's level.

    D is exact where the next state is affine in the inputs, else it is taken at the ends of their
    range. Raises DataError if no range of the inputs is stated, or the tubes say not how fast.
    """
    stepper, ranges = Stepper(model), _input_range(model, funnels)
    tubes = [tube for funnel in funnels for tube in funnel.tubes if tube.rho < 1.0]
    slowest = max((tube.rho for tube in tubes), default=1.0)
    settled = math.ceil(math.log(AT_REST**2) / math.log(slowest)) if slowest < 1.0 else math.inf
    if settled > MOST_SAMPLES:
        raise DataError(
            f"how fast a start fades is not known, or it takes more than {MOST_SAMPLES} samples: "
            "leave the nominal at 'command', which begins at the measured start"
        )
    window = np.tile(ranges.mean(axis=1), (stepper.delays + 1, 1))
    lags = max(stepper.lags, 1)
    zero = np.zeros((lags, len(stepper.y)))
    rest = stepper.begin(zero, np.tile(window[0], (lags, 1)))
    for _ in range(int(settled)):
        rest = stepper.after(rest, window)
    samples = max(funnel.settling for funnel in funnels)
    for tube in tubes:
        moved = 0.0
        for place in np.ndindex(window.shape):
            ends = []
            for end in ranges[place[1]]:
                other = window.copy()
                other[place] = end
                ends.append(np.linalg.norm(tube.factor @ (stepper.after(rest, other) - rest)))
            moved += float(max(ends))
        most = (moved / (1.0 - math.sqrt(tube.rho))) ** 2
        if most > FADED * tube.level:
            needed = math.log(FADED * tube.level / most) / math.log(tube.rho)
            samples = max(samples, math.ceil(needed))
    return Start(rest, samples)


def _input_range(model: StableModel, funnels: Sequence[TubeFunnel]) -> FloatArray:
    """(n_u, 2)."""
    if isinstance(model, DifferenceEquation):
        return np.array([model.u_range])
    if isinstance(model, StateAffineModel):
        return model.u_range
    box = funnels[0].u_box
    if box is None:
        raise DataError(
            f"a {type(model).__name__} states no range of its inputs, so its start in motion is "
            "not bounded: leave the nominal at 'command', which begins at the measured start"
        )
    return box
