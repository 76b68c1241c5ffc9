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

STEPS = 300  # of Runge-Kutta of order four, at least
MOST_SAMPLES = 2000  # of a held input: a shorter hold is simulated without one
ASCENTS = 3  # of the distance at the end: the first is at most a few percent short of the last
SCALES = np.concatenate([[0.0], np.geomspace(2.0**-8, 1.0, 9)])
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
        return bool(self.farthest[0] > 1)

    def __str__(self) -> str:
        held = f", with inputs held for {self.period:g} s," if self.period else ""
        if self.impossible:
            how = ", while w and the measurement's error switch between the ends of their bounds"
            return (
                f"No funnel of this policy can be proved: a simulated solution{held} starts on the "
                f"motion at {self.start:g} s and ends {self.farthest[0]:.3g} times as far from the "
                f"goal's centre as the goal reaches{how if self.pushed else ''}"
            )
        missed = np.flatnonzero(self.farthest > 1)
        said = "Of the solutions that were simulated none misses the goal"
        if len(missed):
            sizes = ", ".join(f"{width:.3g}" for width in SCALES[missed[0]] * self.widths)
            said = (
                f"A simulated solution{held} starts at {self.start:g} s within ({sizes}) of the "
                "motion and misses the goal, so that no funnel with this policy and P is that wide"
            )
        if self.pushed:
            said += (
                "; those that start on the motion end at most "
                f"{self.farthest[0]:.2g} times as far from the goal's centre as the goal reaches"
            )
        return said


def try_to_miss(setting: Setting) -> Tried:
    """Simulate the policy of a search that failed, against everything that its claim allows."""
    steps, policy, goal, hold = setting.steps, setting.policy, setting.goal, setting.hold
    field = steps.field
    true = field if setting.expansion is None else setting.expansion.rates
    low, high = true.uncertain.T
    error = np.zeros(field.n) if hold is None else hold.error
    start, end = float(policy.t[0]), float(policy.t[-1])
    period = 0.0 if hold is None or hold.longest else hold.period
    if period < (end - start) / MOST_SAMPLES:
        period = 0.0
    each = max(1, int(np.ceil(STEPS * period / (end - start))))  # steps a sample
    step = period / each if period else (end - start) / STEPS
    t = np.append(np.arange(start, end - step / 2, step), end)
    across, by_w, by_error = _linear(setting, true, t)
    inlet = np.linalg.inv(setting.P[0])
    axes = np.linalg.cholesky(goal.P).T  # rows: d'x at the end is what they make large
    D = np.tile(np.concatenate([axes, -axes]), (len(SCALES), 1))
    scale = np.repeat(SCALES, 2 * field.n)
    farthest = np.zeros(len(SCALES))

    def rate(s: float, X: FloatArray, W: FloatArray) -> FloatArray:
        U = held if period else policy(s, X + e)
        return true(s, X, U, W)

    for _ in range(ASCENTS):
        adjoint = np.empty((len(t), *D.shape))
        adjoint[-1] = D
        for k in range(len(t) - 2, -1, -1):
            adjoint[k] = adjoint[k + 1] @ across[k]
        first = adjoint[0] @ inlet
        size = np.sqrt(np.einsum("ni,ni->n", first, adjoint[0]))
        X = policy.x(start) + (scale / size)[:, None] * first
        lost = np.zeros(len(X), dtype=bool)
        for k, (s, h) in enumerate(zip(t[:-1].tolist(), np.diff(t).tolist(), strict=True)):
            W = np.where(adjoint[k] @ by_w[k] > 0, high, low)
            e = error * np.where(adjoint[k] @ by_error[k] > 0, 1.0, -1.0)
            if k % each == 0:
                held = policy(s, X + e)
            a = rate(s, X, W)
            b = rate(s + h / 2, X + h / 2 * a, W)
            c = rate(s + h / 2, X + h / 2 * b, W)
            X = X + h / 6 * (a + 2 * b + 2 * c + rate(s + h, X + h * c, W))
            gap = X - policy.x(s + h)
            lost |= ~(np.einsum("ni,ij,nj->n", gap, goal.P, gap) < LOST**2)
            X[lost] = policy.x(s + h)
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
    steps, policy = setting.steps, setting.policy
    identity, box = np.eye(steps.field.n), true.uncertain
    middle = box.mean(axis=1)
    lowest, highest = middle + np.diag(box[:, 0] - middle), middle + np.diag(box[:, 1] - middle)
    across, by_w, by_error = [], [], []
    for s, h in zip(((t[:-1] + t[1:]) / 2).tolist(), np.diff(t).tolist(), strict=True):
        x, u, K = policy.x(s), policy.u(s), policy.K(s)
        A, B = steps.field.jacobians(s, x, u)
        loop = h / 2 * (A - B @ K)
        across.append(np.linalg.solve(identity - loop, identity + loop))
        by_w.append((_at(true, s, x, u, highest) - _at(true, s, x, u, lowest)).T)
        by_error.append(-B @ K)
    return across, by_w, by_error


def _at(
    true: VectorField | Rates, s: float, x: FloatArray, u: FloatArray, w: FloatArray
) -> FloatArray:
    """(N, n) rates at one point for w (N, n_w)."""
    if not len(w):
        return np.zeros((0, len(x)))
    return true(s, np.tile(x, (len(w), 1)), np.tile(u, (len(w), 1)), w)
