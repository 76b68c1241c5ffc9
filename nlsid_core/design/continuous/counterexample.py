"""Simulated solutions that try to miss the goal: what no funnel of this policy can contain.

Asked only when the search has failed. w, the measurement's error and the start are on the boundary
of what the claim allows, chosen by the adjoint of the linear closed loop; then the equations decide
as they are written. A solution that misses shows, up to the simulation's error, that the claim is
false. That none was found shows nothing.
"""

from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.setting import Setting
from nlsid_core.dynamics import Rates, VectorField

STEPS = 200  # of Runge-Kutta of order four, at least
MOST_SAMPLES = 2000  # of a held input: a shorter hold is simulated without one
ASCENTS = 3  # of the distance at the end: two are usual
SCALES = np.concatenate([[0.0], np.geomspace(2.0**-8, 1.0, 9)])
MISSED = 1.0001  # of the goal's size: nearer, the simulation's own error might decide
LOST = 1e6  # of the goal's size: what is as far from the motion does not come back


@dataclass(frozen=True, eq=False)
class Tried:
    """What simulated solutions did that start in scaled copies of {|x - x₀|²_{P(t₀)} ≤ 1}.

    start, end: s. period: s for which inputs were held; 0 if they were not. farthest: (scales,) the
    largest |x - centre|_P of the goal at the end, for each of `SCALES`; inf where a solution runs
    away. widths: (n,) half-widths of the copy of scale 1. pushed: True if there is a w or an error.
    """

    start: float
    end: float
    period: float
    farthest: FloatArray
    widths: FloatArray
    pushed: bool

    @property
    def impossible(self) -> bool:
        """True if a solution that starts on the motion itself misses the goal."""
        return bool(self.farthest[0] > MISSED)

    def __str__(self) -> str:
        held = f", with inputs held for {self.period:g} s," if self.period else ""
        far = f"{self.farthest[0]:.3g} times as far from the goal's centre as the goal reaches"
        if self.impossible:
            how = ", while w and the measurement's error switch between the ends of their bounds"
            return (
                f"No funnel of this policy can be proved: a simulated solution{held} starts on the "
                f"motion at {self.start:g} s and ends {far}{how if self.pushed else ''}"
            )
        missed = np.flatnonzero(self.farthest > MISSED)
        said = "Of the solutions that were simulated none misses the goal"
        if len(missed):
            sizes = ", ".join(f"{width:.3g}" for width in SCALES[missed[0]] * self.widths)
            said = (
                f"A simulated solution{held} starts at {self.start:g} s within ({sizes}) of the "
                "motion and misses the goal: no funnel of this shape begins as wide as that"
            )
        return f"{said}; those that start on the motion end at most {far}" if self.pushed else said


def try_to_miss(setting: Setting) -> Tried:
    """Simulate the policy of a search that failed, against everything that its claim allows."""
    policy, goal, hold, n = setting.policy, setting.goal, setting.hold, setting.steps.field.n
    true = setting.steps.field if setting.expansion is None else setting.expansion.rates
    low, high = true.uncertain.T
    error = np.zeros(n) if hold is None else hold.error
    start, end = float(policy.t[0]), float(policy.t[-1])
    period = 0.0 if hold is None or hold.longest else hold.period
    if period < (end - start) / MOST_SAMPLES:
        period = 0.0
    each = max(1, int(np.ceil(STEPS * period / (end - start))))  # steps a sample
    step = period / each if period else (end - start) / STEPS
    t = np.append(np.arange(start, end - step / 2, step), end)
    halves = np.interp(np.arange(2 * len(t) - 1) / 2, np.arange(len(t)), t).tolist()
    x0, u0, K = ([part(s) for s in halves] for part in (policy.x, policy.u, policy.K))
    across, by_w, by_error = _linear(setting, true, t)
    inlet = np.linalg.inv(setting.P[0])
    axes = np.linalg.cholesky(goal.P).T  # rows d: d'x at the end is made as large as can be
    D = np.tile(np.concatenate([axes, -axes]), (len(SCALES), 1))
    scale = np.repeat(SCALES, 2 * n)
    farthest = np.zeros(len(SCALES))

    def demanded(half: int, X: FloatArray) -> FloatArray:
        return policy.clipped(u0[half] - (X - x0[half]) @ K[half].T)

    def rate(half: int, X: FloatArray, W: FloatArray) -> FloatArray:
        return true(halves[half], X, held if period else demanded(half, X + e), W)

    for _ in range(ASCENTS):
        adjoint = np.empty((len(t), *D.shape))
        adjoint[-1] = D
        for k in range(len(t) - 2, -1, -1):
            adjoint[k] = adjoint[k + 1] @ across[k]
        first = adjoint[0] @ inlet
        size = np.sqrt(np.einsum("ni,ni->n", first, adjoint[0]))
        X = x0[0] + (scale / size)[:, None] * first
        lost = np.zeros(len(X), dtype=bool)
        for k, h in enumerate(np.diff(t).tolist()):
            W = np.where(adjoint[k] @ by_w[k] > 0, high, low)
            e = error * np.where(adjoint[k] @ by_error[k] > 0, 1.0, -1.0)
            if k % each == 0:
                held = demanded(2 * k, X + e)
            a = rate(2 * k, X, W)
            b = rate(2 * k + 1, X + h / 2 * a, W)
            c = rate(2 * k + 1, X + h / 2 * b, W)
            X = X + h / 6 * (a + 2 * b + 2 * c + rate(2 * k + 2, X + h * c, W))
            gap = X - x0[2 * k + 2]
            lost |= ~(np.einsum("ni,ij,nj->n", gap, goal.P, gap) < LOST**2)
            X[lost] = x0[2 * k + 2]
        gap = X - goal.centre
        distance = np.sqrt(np.einsum("ni,ij,nj->n", gap, goal.P, gap))
        distance[lost] = np.inf
        farthest = np.maximum(farthest, distance.reshape(len(SCALES), -1).max(axis=1))
        D = np.where((lost | (distance == 0))[:, None], D, gap @ goal.P)
    pushed = bool(len(low) or error.any())
    return Tried(start, end, period, farthest, np.sqrt(np.diag(inlet)), pushed)


def _linear(
    setting: Setting, true: VectorField | Rates, t: FloatArray
) -> tuple[list[FloatArray], list[FloatArray], list[FloatArray]]:
    """The linear closed loop along the motion: (n, n) across each step of t, and what pushes there.

    Pushes: (n, n_w) of w from one end of its box to the other, and (n, n) of the measured state.
    """
    field, policy = setting.steps.field, setting.policy
    identity, box = np.eye(field.n), true.uncertain
    middle = box.mean(axis=1)
    corners = middle + np.vstack([np.diag(end - middle) for end in box.T])
    across: list[FloatArray] = []
    by_w: list[FloatArray] = []
    by_error: list[FloatArray] = []
    for s, h in zip(((t[:-1] + t[1:]) / 2).tolist(), np.diff(t).tolist(), strict=True):
        x, u, K = policy.x(s), policy.u(s), policy.K(s)
        A, B = field.jacobians(s, x, u)
        loop = h / 2 * (A - B @ K)
        across.append(np.linalg.solve(identity - loop, identity + loop))
        by_error.append(-B @ K)
        by_w.append(np.zeros((field.n, 0)))
        if len(box):
            count = len(corners)
            ends = true(s, np.tile(x, (count, 1)), np.tile(u, (count, 1)), corners)
            by_w[-1] = (ends[len(box) :] - ends[: len(box)]).T
    return across, by_w, by_error
