"""ρ(t) by one backward sweep that expands the dynamics around what it finds.

The box on which a Taylor model is bounded has to hold the funnel, and what the model leaves out
makes the funnel smaller: so ρ and the box of every interval are chosen together.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.diagnosis import Diagnosis, NoFunnel, diagnosed
from nlsid_core.design.continuous.expansion import BACK, Expansion, NoExpansion
from nlsid_core.design.continuous.lstep import Section, section_at, sections
from nlsid_core.design.continuous.setting import Setting
from nlsid_core.design.continuous.shape import validity_caps
from nlsid_core.design.continuous.sweep import ACCEPT, LOWEST, Ends, Wanted, sweep_rho
from nlsid_core.dynamics.taylor import field_of
from nlsid_core.errors import Infeasible
from nlsid_core.progress import Progress, silent

NEAR = 0.05  # of ρ over the whole motion: what intervals may stay below the largest, together
STEP = 1.02  # of ρ, squared at each further step, while the largest is bracketed
FALL = 0.998  # of ρ, squared at each further try
MAX_TRIES = 10  # of exact L-steps a knot
MAX_BACK = 40  # how often ρ is lowered for the interval before
BETWEEN = np.linspace(
    0.125, 0.875, 7
)  # of an interval, where bounds are looked at, no program solved
STEEP = 0.01  # of (Δρ/ρ)² over the interval's length: left where 1/ρ is far from linear in time


class Swept(NamedTuple):
    """ρ (K,), the L-steps at the knots if they are at hand, and the setting of their field."""

    setting: Setting
    rho: FloatArray
    ends: list[Ends] | None


def wanted_of(
    setting: Setting, below: FloatArray | None = None, widths: FloatArray | None = None
) -> Wanted:
    """What ρ keeps to: below (K,), and where the dynamics are valid; with the first margin.

    widths: (K-1, m) that the applied input is off.
    """
    caps = validity_caps(setting.steps.field, setting.policy, setting.P, widths)
    caps = caps if below is None else np.minimum(caps, below)
    final = min(setting.rho_final, float(caps[-1]))
    return Wanted(setting.margin(final), final, caps)


def swept(
    setting: Setting, wanted: Wanted, progress: Progress = silent, *, most_back: int = MAX_BACK
) -> Swept:
    """The largest ρ(t), and what it was found with; see `sweep_rho` and `sweep_expanded`."""
    steps, policy = setting.steps, setting.policy
    if setting.expansion is not None:
        return sweep_expanded(setting, wanted, most_back=most_back, progress=progress)
    pairs = sections(steps, policy, setting.P)
    return Swept(setting, *sweep_rho(steps, pairs, wanted, progress))


def sweep_expanded(
    setting: Setting, wanted: Wanted, *, most_back: int = MAX_BACK, progress: Progress = silent
) -> Swept:
    """The largest ρ(t) backward from the end, each interval expanded around what it gives.

    The setting that is returned has their field.

    most_back: how often ρ at an interval's end is lowered for its start. Raises Infeasible naming
    the earliest time that was reached, and why it was not passed where least was missing.
    """
    steps, policy, P, expansion = setting.steps, setting.policy, setting.P, setting.expansion
    assert expansion is not None  # else there is one field for the whole motion
    K = len(P)
    rho = np.full(K, wanted.final)
    caps = np.array([wanted.cap(k) for k in range(K)])
    ends: dict[int, Ends] = {}
    k, back = K - 2, 0
    farthest, refusal, left = K, Infeasible(""), -np.inf
    while k >= 0:
        pair = (section_at(steps, policy, P, k, 0.0), section_at(steps, policy, P, k, 1.0))
        after = float(rho[k + 1])
        share = expansion.room(policy, P, k, after)
        if share == 1.0:
            step = _Interval(setting, expansion, k, pair, after, wanted.margin)
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
    return Swept(with_field(setting), rho, [ends[k] for k in range(K - 1)])


def with_field(setting: Setting) -> Setting:
    """The setting with the field of the cubics that its L-steps hold."""
    steps, policy = setting.steps, setting.policy
    field = field_of([steps.local[k] for k in range(len(policy.t) - 1)], policy.t)
    policy = replace(policy, vector_field=files.digest(field.document()))
    proving = steps.like(field, policy)
    proving.kappa = steps.kappa
    return replace(setting, steps=proving, policy=policy)


@dataclass(eq=False)
class _Interval:
    setting: Setting
    expansion: Expansion
    k: int
    pair: tuple[Section, Section]
    after: float
    margin: float

    def expand(self, rho: float) -> bool:
        """Take the cubics around the funnel with this ρ at the start; False if there are none."""
        setting, widths = self.setting, self.setting.steps.widths
        held = None if widths is None else widths[self.k]
        levels = rho, self.after
        try:
            cubic = self.expansion.around(setting.policy, setting.P, self.k, levels, held)
        except NoExpansion:
            return False
        self.setting.steps.local[self.k] = cubic
        self.setting.steps.bound_pushes(self.pair[1], self.after)
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
            self.setting.steps.predicted(start, rho, known.start, saturated=False),
            self.setting.steps.predicted(end, self.after, known.end, saturated=False),
        )

    def solved(self, rho: float, known: Ends | None) -> tuple[float, Ends]:
        """The slack at ρ, and the L-steps at both ends."""
        start, end = self.pair
        at_end = self.setting.steps.solve(end, self.after, None if known is None else known.end)
        at_start = self.setting.steps.solve(start, rho, at_end if known is None else known.start)
        left = self.slack(rho, min(s.m for s in at_start), min(s.m for s in at_end))
        return left, Ends(at_start, at_end)

    def between(self, rho: float, known: Ends) -> float:
        """An upper bound of what is left within the interval, from the duals at its ends."""
        h, least = self.pair[1].t - self.pair[0].t, np.inf
        for s in BETWEEN.tolist():
            section = section_at(self.setting.steps, self.setting.policy, self.setting.P, self.k, s)
            here = (1 - s) * rho + s * self.after
            duals = known.start if s < 0.5 else known.end
            phi = self.setting.steps.predicted(section, here, duals, saturated=False)
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
        setting = replace(self.setting, steps=self.setting.steps.as_it_is())
        kept = replace(self, setting=setting)
        raise NoFunnel(self.pair[0].t, partial(kept.diagnosis, known), left)

    def bracketed(self, rho: float, known: Ends, most: float) -> float:
        """The largest ρ ≤ most, nearly, at which the bound leaves the margin; or 0."""
        step, near = STEP, 1 + NEAR / len(self.setting.P)
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
        return diagnosed(self.setting.steps, self.pair, (rho, self.after), growth)
