"""P(t) from the sets that a pushed linear closed loop reaches: ellipsoids that hold all of it.

For ẋ = Ax + Σ g_j w_j, |w_j| ≤ r_j, and any κ_j > 0 the ellipsoids {x : x'X⁻¹x ≤ 1} with
Ẋ = AX + XA' + Σ r_j(κ_j g_j g_j' + X/κ_j) hold every solution that starts in one of them: it is the
claim's own bound of a push. κ(t) and the start are those with which the end is small beside the
goal. What a held input is off in such an ellipsoid pushes too. Nothing here is trusted: the sweep
decides how much of it the dynamics keep.
Source: Kurzhanski and Vályi, Ellipsoidal Calculus for Estimation and Control, 1997, Section 2.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.held import Hold
from nlsid_core.design.continuous.setting import GOAL_ROOM, Setting

PARTS = 4  # of an interval, for the integration
SLACK = 0.24  # of log ρ over the motion: room for what is not linear
START = 0.1  # of the goal's size, that is due to where solutions start
SHARPNESS = 4  # p of the norm tr(M^p)^(1/p), minimised in the place of the largest eigenvalue
SPREAD = 0.1  # of the mean: what every direction of the start counts at least
ROUNDS, STEPS = 8, 6  # of what is lost between knots; of the norm's slope in each
FLOOR = 0.1  # of the goal over the motion: what nothing pushes would shrink, and its P turn fast
STAY = 8  # intervals: what shrinks faster turns P too fast between knots
FAR = 3.0  # times the goal: it does not come back from there
LOST = 1e6  # times the goal: beyond, numbers overflow


@dataclass(frozen=True, eq=False)
class Reached:
    """P (K, n, n), which shrinks and grows with ρ where the funnel should keep its size.

    size: of the end, over the goal's. tightness: (K-1, n_w) κ over 1/max|x̄'Pg|. coarse: (K-1,) True
    where much of the end's size is due to P being linear between knots.
    """

    P: FloatArray
    size: float
    tightness: FloatArray
    coarse: NDArray[np.bool_]


def reached(setting: Setting, floor: float, *, stay: bool = False) -> Reached | None:
    """The ellipsoids along the motion of a setting; None if w does more than push or it is LOST.

    floor: how much of the goal's ellipsoid is added over the motion, so that P does not turn fast.
    stay: whether the motion stands still at both ends for STAY intervals more, so that what is fast
    has settled, and starts no wider than the goal.
    """
    intervals, before = len(setting.policy.t) - 1, STAY if stay else 0
    loop = _Loop.of(setting, floor, before)
    if loop is None:
        return None
    own = loop.G.shape[2] - setting.steps.field.m
    moving = slice(before, before + intervals)
    lost = np.zeros(len(loop.h))
    slack = SLACK / float(loop.h[moving].sum())
    end, least = loop.goal, np.inf
    share = START * len(end)
    for _ in range(ROUNDS):
        for _ in range(STEPS):
            X, kappa = loop.forward(end, share, slack + lost, stay)
            size = loop.size(X[before + intervals])
            if size < LOST:
                end = (end + loop.weights(X[-1])) / 2
                grown = np.exp(loop.h @ ((loop.r / kappa).sum(axis=1) + slack + lost))
                share = START * np.trace(end @ X[-1]) / grown
                loop.r[:, own:] = loop.off(X[:-1], loop.r)
        if not size < LOST:
            if least == np.inf:  # nothing is lost between knots yet: more of them are no help
                return None
            break
        least = min(least, size)
        scale = np.linalg.det(X) ** (1 / X.shape[1])
        scale /= scale[before + intervals]
        P = scale[:, None, None] * np.linalg.inv(X)
        P = (P + P.transpose(0, 2, 1)) / 2
        if not size < FAR:
            break
        left = loop.margins(P, scale, kappa)[moving]
        lost[moving] = np.maximum(lost[moving] + slack - left, 0.0)
    along = np.einsum("kij,kil,klj->kj", loop.G, P[1:] / scale[1:, None, None], loop.G)
    tightness = np.ones((intervals, len(setting.steps.field.uncertain)))
    tightness[:, :own] = (kappa * np.sqrt(along))[moving, :own]
    coarse = (lost > slack) | (not size < FAR)  # but if nothing was lost, more knots are no help
    P = P[before : before + intervals + 1]
    return Reached(GOAL_ROOM * size**2 * P, size, tightness, coarse[moving] & (least < 1))


@dataclass(frozen=True, eq=False)
class _Loop:
    """h: (K-1,) s. across: (K-1, PARTS, n, n). ends: (K-1, 2, n, n) A at both ends of an interval.

    G: (K-1, n, n_w + m) what pushes: w, and what inputs are off. r: (K-1, n_w + m) how much; of
    inputs it is `off` (K-1, m) in ellipsoids (K-1, n, n) where r pushes. goal, floor (in 1/s):
    (n, n).
    """

    h: FloatArray
    across: FloatArray
    ends: FloatArray
    G: FloatArray
    r: FloatArray
    goal: FloatArray
    floor: FloatArray
    off: Callable[[FloatArray, FloatArray], FloatArray]

    @classmethod
    def of(cls, setting: Setting, floor: float, still: int) -> "_Loop | None":
        """The closed loop along the motion, linear; `still`: intervals more at each of its ends."""
        field, policy, expansion = setting.steps.field, setting.policy, setting.expansion
        t = policy.t
        own = len(field.uncertain) if expansion is None else len(expansion.rates.uncertain)
        found = [field.pushes(field.span(float(s))) for s in t[:-1]]
        pushes = [g[:, :own] for g in found if g is not None]
        if not (own or setting.hold) or len(pushes) < len(found):
            return None

        def closed(k: int, s: float) -> tuple[FloatArray, FloatArray]:
            when = float(t[k] + np.clip(s, 1e-9, 1 - 1e-9) * (t[k + 1] - t[k]))
            A, B = field.jacobians(when, policy.x(when), policy.u(when))
            return np.asarray(A - B @ policy.K(when)), B

        h, goal = np.diff(t), setting.goal.P
        order = np.clip(np.arange(-still, len(h) + still), 0, len(h) - 1)
        shares = [0.0, *((np.arange(PARTS) + 0.5) / PARTS), 1.0]
        along = [[closed(k, s) for s in shares] for k in range(len(h))]
        A = np.array([[found[0] for found in row] for row in along])
        across = expm(h[:, None, None, None] / PARTS * A[:, 1:-1])
        G = np.concatenate([np.array(pushes), [row[0][1] for row in along]], axis=2)[order]
        # What a held input is off: by how much it changes meanwhile, and by errors of the state.
        hold = setting.hold or Hold(0.0, np.zeros(field.n))
        K = policy.K.control.mean(axis=1)
        turning = (K @ A.mean(axis=1) + np.diff(policy.K.ends(), axis=0) / h[:, None, None])[order]
        plan = np.abs(policy.u.derivative().control).max(axis=1)[order]
        K, shaken = K[order], (np.abs(K) @ hold.error)[order]

        def off(X: FloatArray, r: FloatArray) -> FloatArray:
            moved = np.sqrt(np.einsum("kij,kjl,kil->ki", turning, X, turning))
            shoved = np.abs(K @ (G * r[:, None])).sum(axis=2)
            return np.asarray(hold.shortest * (plan + moved + shoved) + shaken)

        radius = np.append(np.ptp(field.uncertain[:own], axis=1) / 2, np.zeros(field.m))
        r = np.tile(radius, (len(order), 1))
        floors = floor / float(h.sum()) * np.linalg.inv(goal)
        ends = A[:, [0, -1]]
        return cls(h[order], across[order], ends[order], G, r, goal, floors, off)

    def size(self, X: FloatArray) -> float:
        """The smallest copy of the goal that holds {x'X⁻¹x ≤ 1}; inf if X overflows."""
        if not np.isfinite(X).all():
            return np.inf
        L = np.linalg.cholesky(self.goal)
        return float(np.sqrt(np.linalg.eigvalsh(L.T @ X @ L)[-1]))

    def weights(self, X: FloatArray) -> FloatArray:
        """(n, n) the slope of tr(M^p)^(1/p), M the end X beside the goal, to a factor."""
        L = np.linalg.cholesky(self.goal)
        values, vectors = np.linalg.eigh(L.T @ X @ L)
        turned = L @ vectors
        return np.asarray((turned * (values / values[-1]) ** (SHARPNESS - 1)) @ turned.T)

    def forward(
        self, end: FloatArray, share: float, slack: FloatArray, within: bool
    ) -> tuple[FloatArray, FloatArray]:
        """X (K, n, n) at the knots, for which tr(end X) is least at the end, and κ (K-1, n_w).

        With the adjoint Λ of `end`, r(κ g'Λg + tr(ΛX)/κ) is least at κ² = tr(ΛX)/g'Λg; and of all
        starts with the same tr(ΛX) that with X ∝ Λ⁻¹ is the largest. within: it is no wider than
        the goal.
        """
        adjoint = [end]
        for parts in self.across[::-1]:
            for F in parts[::-1]:
                end = F.T @ end @ F
            adjoint.append(end)
        n, step = len(self.goal), self.h / PARTS
        least = SPREAD / n * np.trace(np.linalg.solve(self.goal, end))
        X = share / n * np.linalg.inv(end + least * self.goal)
        X /= max(1.0, self.size(X)) ** 2 if within else 1.0
        knots, kappas = [X], []
        with np.errstate(over="ignore", invalid="ignore"):  # what explodes is not finite
            for k, parts in enumerate(self.across):
                G, kept, pushed = self.G[k], 0.0, 0.0
                for of_end in adjoint[-1 - k], adjoint[-2 - k]:  # with κ of the start, then of both
                    kept = kept + np.trace(of_end @ X)
                    pushed = pushed + np.einsum("ij,il,lj->j", G, of_end, G)
                    kappa = np.sqrt(kept / np.maximum(pushed, np.finfo(float).tiny))
                    growth = np.exp(step[k] * ((self.r[k] / kappa).sum() + slack[k]))
                    added = G * (step[k] * self.r[k] * kappa) @ G.T + step[k] * self.floor
                    X = knots[k]
                    for F in parts:
                        X = growth * F @ X @ F.T + added
                kappas.append(kappa)
                knots.append((X + X.T) / 2)
        return np.array(knots), np.array(kappas)

    def margins(self, P: FloatArray, scale: FloatArray, kappa: FloatArray) -> FloatArray:
        """(K-1,) what V falls by at least on its boundary, in 1/s, with P and ρ = scale linear."""
        least = np.full(len(self.h), np.inf)
        turning = np.diff(P, axis=0) / self.h[:, None, None]
        growth = np.diff(scale) / self.h
        for end in (0, 1):
            rho, here = scale[end : len(scale) - 1 + end], P[end : len(P) - 1 + end]
            PG = here @ self.G
            bound = PG @ ((self.r * kappa / rho[:, None])[..., None] * PG.transpose(0, 2, 1))
            along = here @ self.ends[:, end]
            falls = -(along + along.transpose(0, 2, 1) + turning + bound)
            inverse = np.linalg.inv(np.linalg.cholesky(here))
            values = np.linalg.eigvalsh(inverse @ falls @ inverse.transpose(0, 2, 1))[:, 0]
            taken = (self.r / kappa).sum(axis=1)
            least = np.minimum(least, values - taken + growth / rho)
        return least
