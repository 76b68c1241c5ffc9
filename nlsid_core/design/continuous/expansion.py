"""Dynamics that are not polynomial, expanded anew on each interval around what the funnel needs.

The box on which a Taylor model is bounded has to hold the funnel, and what the model leaves out
makes the funnel smaller: so the sweep chooses ρ and the box of every interval together.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from traceback import extract_tb

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.diagnosis import Diagnosis, NoFunnel, diagnosed
from nlsid_core.design.continuous.lstep import LSteps, Section, section_at
from nlsid_core.design.continuous.sweep import ACCEPT, LOWEST, Ends
from nlsid_core.dynamics import Nominal
from nlsid_core.dynamics.taylor import Cubic, Rates, field_of
from nlsid_core.dynamics.vector_field import VectorField
from nlsid_core.errors import DataError, Infeasible
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.progress import Progress, silent

ROOM = 1 + 1e-6  # of the box over the funnel: the checker decides in rationals
NEAR = 0.05  # of ρ over the whole motion: what intervals may stay below the largest, together
STEP = 1.02  # of ρ, squared at each further step, while the largest is bracketed
FALL = 0.998  # of ρ, squared at each further try
MAX_TRIES = 10  # of exact L-steps a knot
BACK, MAX_BACK = 0.8, 40  # of ρ, where the interval before cannot take it; how often
BETWEEN = np.linspace(
    0.125, 0.875, 7
)  # of an interval, where bounds are looked at, no program solved
STEEP = 0.01  # of (Δρ/ρ)² over the interval's length: left where 1/ρ is far from linear in time
LINEAR = 1e-3  # of a box's size: there a cubic is as good as the derivative
HALVINGS = 6  # of an interval on which the motion's own box is too wide: then it is not the box
PACKAGE = Path(__file__).parents[2]  # lines of code outside are those of who wrote the equations


@dataclass(frozen=True, eq=False)
class Expansion:
    """rates along `nominal`: expands them on any interval and any box around the motion."""

    rates: Rates
    nominal: Nominal

    def on(self, k: int, reach: FloatArray, limits: FloatArray | None = None) -> Cubic:
        """The cubics on interval k for (x, u) within reach (n + m,) of the motion's range."""
        x, u = self.nominal.x.control[k], self.nominal.u.control[k]
        low = np.concatenate([x.min(axis=0), u.min(axis=0)]) - reach
        high = np.concatenate([x.max(axis=0), u.max(axis=0)]) + reach
        for i, least, most in [] if limits is None else limits.tolist():
            j = self.rates.n + int(i)
            low[j], high[j] = max(low[j], least), min(high[j], most)
        return self._expanded(low, high, k)

    def _expanded(self, low: FloatArray, high: FloatArray, k: int) -> Cubic:
        t = self.nominal.t
        try:
            return self.rates.on(low, high, (float(t[k]), float(t[k + 1])))
        except (DataError, OverflowError, ZeroDivisionError) as error:
            raise NoExpansion(self, low, high, k, error) from error

    def linear(self) -> VectorField:
        """The field to linearise: expanded close to the motion."""
        cubics = [self.on(k, self._near()) for k in range(len(self.nominal.t) - 1)]
        return field_of(cubics, self.nominal.t)

    def _near(self) -> FloatArray:
        """(n + m,) so far from the motion a cubic is as good as the derivative."""
        size = np.hstack([self.nominal.x.ends(), self.nominal.u.ends()])
        return np.asarray(LINEAR * np.maximum(np.ptp(size, axis=0), LINEAR))

    def refined(self, most: int) -> "Expansion":
        """Around the motion with knots, `most` in all, where it has no cubics as it is."""
        nominal = self.nominal
        for _ in range(HALVINGS):
            coarse = []
            for k in range(len(nominal.t) - 1):
                try:
                    Expansion(self.rates, nominal).on(k, self._near())
                    coarse.append(False)
                except NoExpansion:
                    coarse.append(True)
            if not any(coarse) or len(nominal.t) + sum(coarse) > most:
                break
            nominal = nominal.halved(coarse)
        return Expansion(self.rates, nominal)

    def nonlinear_states(self) -> tuple[int, ...]:
        """The states that enter nonlinearly on some interval."""
        reach = np.full(self.rates.n + self.rates.m, LINEAR**2)
        found = [set(self.on(k, reach).nonlinear_states()) for k in (0, len(self.nominal.t) - 2)]
        return tuple(sorted(set.union(*found)))

    def room(self, policy: ContinuousPolicy, P: FloatArray, k: int, after: float) -> float:
        """The share of ρ = `after` at the end of interval k with which there are cubics on it.

        1, or a power of BACK. Raises NoExpansion where the motion's own box is too wide.
        """
        share = 1.0
        while True:
            try:
                self.around(policy, P, k, (LOWEST * after, share * after))
                return share
            except NoExpansion:
                if share < LOWEST:
                    raise
                share *= BACK

    def around(
        self,
        policy: ContinuousPolicy,
        P: FloatArray,
        k: int,
        rho: tuple[float, float],
        held: FloatArray | None = None,
    ) -> Cubic:
        """The cubics on interval k on a box that holds the funnel with these ρ at its knots.

        held: (m,) by how much more the inputs may be off.
        """
        reach = np.zeros(self.rates.n + self.rates.m)
        for knot, level in zip((k, k + 1), rho, strict=True):
            inverse = level * np.linalg.inv(P[knot])
            states = np.diag(inverse)
            gains = policy.K.control[k]
            inputs = np.einsum("dij,jk,dik->di", gains, inverse, gains).max(axis=0, initial=0.0)
            reach = np.maximum(reach, np.concatenate([states, inputs]))
        reach = np.sqrt(reach)
        if held is not None:
            reach[self.rates.n :] += held
        return self.on(k, ROOM * reach, policy.limits)


class NoExpansion(Infeasible):
    """No cubics on a box: when, in which line of the equations, and which entries are too wide."""

    def __init__(
        self, expansion: Expansion, low: FloatArray, high: FloatArray, k: int, cause: Exception
    ) -> None:
        self.expansion, self.low, self.high, self.k, self.cause = expansion, low, high, k, cause

    def __str__(self) -> str:
        rates, t = self.expansion.rates, self.expansion.nominal.t
        frames = extract_tb(self.cause.__traceback__)
        own = [f for f in frames if PACKAGE not in Path(f.filename).parents and f.line]
        place = f", in `{own[-1].line}`" if own else ""
        wide = [
            f"{'x' if j < rates.n else 'u'}{j if j < rates.n else j - rates.n} in "
            f"[{self.low[j]:.3g}, {self.high[j]:.3g}]"
            for j in rates.expanded
            if self._narrower(j)
        ]
        if isinstance(self.cause.__cause__, TypeError):  # whatever the box is
            why = "whatever the state and the input are"
        elif not wide:
            why = "and no single state or input is the cause: the equations are not smooth there"
        else:
            why = f"because of {' or '.join(wide)}"
        return (
            f"the equations cannot be expanded between {t[self.k]:.6g} and {t[self.k + 1]:.6g} s: "
            f"{self.cause}{place}, {why}"
        )

    def _narrower(self, j: int) -> bool:
        """Whether the equations can be expanded where entry j of (x, u) is in its middle."""
        low, high = self.low.copy(), self.high.copy()
        low[j] = high[j] = (low[j] + high[j]) / 2
        t = self.expansion.nominal.t
        try:
            self.expansion.rates.on(low, high, (float(t[self.k]), float(t[self.k + 1])))
        except (DataError, OverflowError, ZeroDivisionError):
            return False
        return True


@dataclass(frozen=True, eq=False)
class Swept:
    """ρ (K,), the L-steps at the ends of every interval, and the cubics they were made with."""

    rho: FloatArray
    ends: list[Ends]
    cubics: list[Cubic]


def sweep_expanded(
    expansion: Expansion,
    steps: LSteps,
    policy: ContinuousPolicy,
    P: FloatArray,
    *,
    margin: float,
    rho_final: float,
    caps: FloatArray | None = None,
    most_back: int = MAX_BACK,
    progress: Progress = silent,
) -> Swept:
    """The largest ρ(t) backward from rho_final, each interval expanded around what it gives.

    margin: what (ρ̇ - Ẇ)/ρ keeps above zero, in 1/s. caps: (K,) that ρ keeps below. most_back: how
    often ρ at an interval's end is lowered for its start. Raises Infeasible naming the earliest
    time that was reached, and why it was not passed where least was missing.
    """
    K = len(P)
    rho, caps = np.full(K, rho_final), np.full(K, np.inf) if caps is None else caps.copy()
    ends: dict[int, Ends] = {}
    k, back = K - 2, 0
    farthest, refusal, left = K, Infeasible(""), -np.inf
    while k >= 0:
        pair = (section_at(steps, policy, P, k, 0.0), section_at(steps, policy, P, k, 1.0))
        after = float(rho[k + 1])
        share = expansion.room(policy, P, k, after)
        if share == 1.0:
            step = _Interval(expansion, steps, policy, P, k, pair, after, margin)
            ratio = rho[k + 1] / rho[k + 2] if k + 2 < K else 1.0
            try:
                rho[k], ends[k] = step.largest(ratio, ends.get(k + 1), float(caps[k]))
                progress(f"rho at {pair[0].t:.3g} s", 1 - k / (K - 1))
                k -= 1
                continue
            except NoFunnel as found:
                if k < farthest or (k == farthest and found.left > left):
                    farthest, refusal, left = k, found, found.left
                back += 1
                if back > most_back:
                    raise refusal from None
                share = BACK
        # What ρ_{k+1} leaves at the end of this interval is too much for its box or its feedback.
        caps[k + 1] = share * after
        if k == K - 2:
            rho[-1] = caps[-1]
        else:
            k += 1
    return Swept(rho, [ends[k] for k in range(K - 1)], [steps.local[k] for k in range(K - 1)])


@dataclass(eq=False)
class _Interval:
    expansion: Expansion
    steps: LSteps
    policy: ContinuousPolicy
    P: FloatArray
    k: int
    pair: tuple[Section, Section]
    after: float
    margin: float

    def expand(self, rho: float) -> bool:
        """Take the cubics around the funnel with this ρ at the start; False if there are none."""
        try:
            held = None if self.steps.widths is None else self.steps.widths[self.k]
            cubic = self.expansion.around(self.policy, self.P, self.k, (rho, self.after), held)
        except NoExpansion:
            return False
        self.steps.local[self.k] = cubic
        self.steps.bound_pushes(self.pair[1], self.after)
        return True

    def slack(self, rho: float, at_start: float, at_end: float) -> float:
        """What both ends leave of the margin, in 1/s, for φ there."""
        h = self.pair[1].t - self.pair[0].t
        growth = (self.after - rho) / h
        steep = STEEP * h * (growth / min(rho, self.after)) ** 2
        return min(at_start + growth / rho, at_end + growth / self.after) - self.margin - steep

    def predicted(self, rho: float, known: Ends) -> float:
        """An upper bound of the slack at ρ; no program solved. -inf if nothing can be expanded."""
        if not self.expand(rho):
            return -np.inf
        start, end = self.pair
        return self.slack(
            rho,
            self.steps.predicted(start, rho, known.start, saturated=False),
            self.steps.predicted(end, self.after, known.end, saturated=False),
        )

    def solved(self, rho: float, known: Ends | None) -> tuple[float, Ends]:
        """The slack at ρ, and the L-steps at both ends."""
        start, end = self.pair
        at_end = self.steps.solve(end, self.after, None if known is None else known.end)
        at_start = self.steps.solve(start, rho, at_end if known is None else known.start)
        left = self.slack(rho, min(s.m for s in at_start), min(s.m for s in at_end))
        return left, Ends(at_start, at_end)

    def between(self, rho: float, known: Ends) -> float:
        """An upper bound of what is left within the interval, from the duals at its ends."""
        h, least = self.pair[1].t - self.pair[0].t, np.inf
        for s in BETWEEN.tolist():
            section = section_at(self.steps, self.policy, self.P, self.k, s)
            here = (1 - s) * rho + s * self.after
            duals = known.start if s < 0.5 else known.end
            phi = self.steps.predicted(section, here, duals, saturated=False)
            least = min(least, phi + (self.after - rho) / h / here)
        return least

    def largest(self, ratio: float, known: Ends | None, cap: float) -> tuple[float, Ends]:
        """The largest ρ ≤ cap at the start, nearly, and its L-steps.

        Where a bound from the last programs promises what the next do not keep, ρ falls anyway.
        """
        rho, most, fall = min(self.after * ratio, cap), cap, FALL
        left = -np.inf
        for _ in range(MAX_TRIES):
            if known is not None:
                rho = self.bracketed(min(rho, most), known, most)
            if rho <= LOWEST * self.after:
                break
            if not self.expand(rho):
                rho, most = rho / 2, rho / 2
                continue
            left, known = self.solved(rho, known)
            if left >= -ACCEPT * self.margin and self.between(rho, known) > ACCEPT * self.margin:
                return rho, known
            most, fall = rho * fall, fall * fall
            rho = most
        kept = replace(self, steps=self.steps.as_it_is())
        raise NoFunnel(self.pair[0].t, partial(kept.diagnosis, known), left)

    def bracketed(self, rho: float, known: Ends, most: float) -> float:
        """The largest ρ ≤ most, nearly, at which the bound leaves the margin; or 0."""
        step, near = STEP, 1 + NEAR / len(self.P)
        if self.predicted(rho, known) >= 0:
            low = rho
            while low < most:
                rho = min(low * step, most)
                if self.predicted(rho, known) < 0:
                    break
                low, step = rho, min(step * step, 10.0)
            high = rho
        else:
            high, low = rho, rho / step
            while self.predicted(low, known) < 0:
                if low <= LOWEST * self.after:
                    return 0.0
                step = min(step * step, 10.0)
                high, low = low, low / step
        while high / low > near:
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if self.predicted(middle, known) >= 0 else (low, middle)
        return low

    def diagnosis(self, known: Ends | None) -> Diagnosis:
        """What takes the margin away at this interval, at the ρ where least is missing."""
        levels = self.after * np.geomspace(1e-3, 2.0, 12)
        values = [-np.inf if known is None else self.predicted(r, known) for r in levels.tolist()]
        rho = float(levels[int(np.argmax(values))])
        self.expand(rho)
        growth = (self.after - rho) / (self.pair[1].t - self.pair[0].t)
        return diagnosed(self.steps, self.pair, (rho, self.after), growth)
