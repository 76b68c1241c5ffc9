"""Where more knots are needed: where P(t), linear between knots, loses what it gains at them."""

import numpy as np

from nlsid_core.arrays import BoolArray, FloatArray
from nlsid_core.design.continuous.diagnosis import NoFunnel
from nlsid_core.design.continuous.setting import MOST_KNOTS, Setting
from nlsid_core.errors import Infeasible

NEARBY = 1 / 32  # of the motion: what is halved on either side of a refusal, doubled at each try
LOST = 0.2  # of log ρ on one interval, by the linear closed loop: more asks for a knot
MORE = 1 / 3  # of the knots, and that many more: what they are at most before anything is tried
FEW = 8
ENDS = 1e-9  # of an interval, where its own closed loop holds


class Unproved(Infeasible):
    """Nothing was found wrong at the knots around t, in s, but nothing proves it between them.

    intervals: (K-1,) True where that is so.
    """

    def __init__(self, said: str, t: float, intervals: BoolArray) -> None:
        super().__init__(said)
        self.t, self.intervals = t, intervals


def lost(setting: Setting) -> FloatArray:
    """(K-1,) by how much log ρ has to grow in time where P is linear between knots and V is not.

    Of the linear closed loop alone: for P(t) between the knots as at them there would be no loss.
    """
    policy, field, P = setting.policy, setting.steps.field, setting.P
    t, h = policy.t, np.diff(policy.t)
    found = np.zeros(len(h))
    for k in range(len(h)):
        for s in (0.0, 0.5, 1.0):
            when = float(t[k] + np.clip(s, ENDS, 1 - ENDS) * h[k])
            A, B = field.jacobians(when, policy.x(when), policy.u(when))
            here = (1 - s) * P[k] + s * P[k + 1]
            along = here @ (A - B @ policy.K(when))
            falls = -(h[k] * (along + along.T) + P[k + 1] - P[k])
            root = np.linalg.inv(np.linalg.cholesky(here))
            found[k] = max(found[k], -float(np.linalg.eigvalsh(root @ falls @ root.T)[0]))
    return found


def coarse(setting: Setting, most: int) -> BoolArray:
    """(K-1,) the intervals that lose more than LOST, those that lose most if more than `most`."""
    losses = lost(setting)
    return _first(losses > LOST, -losses, most - len(setting.policy.t))


def most_knots(count: int) -> int:
    """How many knots a motion of so many gets at most before anything is tried."""
    return min(MOST_KNOTS, int((1 + MORE) * count) + FEW)


def halved(setting: Setting, refusal: Infeasible, nearby: float) -> BoolArray | None:
    """(K-1,) the intervals to halve after a refusal; None if there are enough knots already.

    nearby: of the motion. All of them, the nearest to its time first; only those near it if V falls
    at its instant, and only those that are not proved if V falls at every knot.
    """
    t, said = setting.policy.t, refusal_time(refusal)
    room, when = MOST_KNOTS - len(t), 0.0 if said is None else said
    if room <= 0 or (said is None and room < len(t) - 1):
        return None
    chosen = np.ones(len(t) - 1, dtype=bool)
    if isinstance(refusal, Unproved):
        chosen = refusal.intervals
    elif isinstance(refusal, NoFunnel) and refusal.diagnosis.dominant == "knots":
        around = nearby * float(t[-1] - t[0])
        chosen = (t[1:] >= when - around) & (t[:-1] <= when + around)
    return _first(chosen, np.abs((t[1:] + t[:-1]) / 2 - when), room)


def refusal_time(refusal: Infeasible) -> float | None:
    """When in the motion something was refused; None if it says nothing about that."""
    return refusal.t if isinstance(refusal, NoFunnel | Unproved) else None


def _first(chosen: BoolArray, order: FloatArray, count: int) -> BoolArray:
    """Give at most `count` of the chosen ones, the first in this order."""
    sequence = np.argsort(np.where(chosen, order, np.inf), kind="stable")
    kept = np.zeros(len(chosen), dtype=bool)
    kept[sequence[: max(count, 0)]] = True
    return np.asarray(kept & chosen)
