"""One setting in, its funnel out: ρ by the backward sweep, and a proof of it for every t.

Nothing is tried here but what the setting says; `attempts` says which settings.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.diagnosis import NoFunnel
from nlsid_core.design.continuous.expansion import Expansion
from nlsid_core.design.continuous.finer import Unproved
from nlsid_core.design.continuous.held import LONGEST, Changes, Hold, fastest
from nlsid_core.design.continuous.held_sweep import (
    changes_by_size,
    held_sweep,
    widths_by_size,
    with_widths,
)
from nlsid_core.design.continuous.pieces import Proved, prove_pieces, unsolved
from nlsid_core.design.continuous.setting import Setting
from nlsid_core.design.continuous.sweep import Swept, Wanted, swept, wanted_of
from nlsid_core.errors import DataError, Infeasible
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.funnels.factor import refuse_unmonitorable
from nlsid_core.progress import Progress

LARGER = 16.0  # times the margin where a piece is not proved
SWEEPS = 3  # the second and the third with larger margins where pieces are not proved
SCALES = (1.0, 0.5, 0.25, 0.1)  # of ρ without a hold, within which one with a hold is looked for
STEPS = (0, 2, 3, 4, 6, 10, 16)  # of the factor √2 below the longest hold, in a search for it


class Found(NamedTuple):
    """A funnel that is proved for every t, what it was found for, and the first margin in 1/s."""

    setting: Setting
    funnel: ContinuousFunnel
    proved: Proved
    margin: float


def search(setting: Setting, progress: Progress) -> Found:
    """ρ by the backward sweep, and its proof; where inputs are held, for bounds of their change.

    Those hold in a funnel found without a hold, or in a part of it: below, ρ is found with it.
    """
    expansion, hold = setting.expansion, setting.hold
    if hold is None:
        return _proved(setting, wanted_of(setting), progress)
    free = expected(setting, progress)
    hold = replace(hold, free=free.rho)
    setting = replace(free.setting, expansion=None, hold=hold)
    span = float(setting.policy.t[-1] - setting.policy.t[0])
    if hold.shortest > span:
        raise DataError(f"the hold of {hold.shortest:g} s is longer than the motion of {span:g} s")

    changes = changes_by_size(setting, expansion) if hold.period else {}

    def held(period: float) -> Found:
        return _held(setting, expansion, replace(hold, period=period), changes, progress)

    return _longest(held) if hold.longest else held(hold.period)


def _longest(held: Callable[[float], Found]) -> Found:
    """What `held` finds for the longest period, to a factor √2, that it finds anything for.

    It is looked for in larger and larger steps, and then between the last two.
    """
    shorter = -1
    for step in STEPS:
        try:
            found = held(LONGEST / 2 ** (step / 2))
        except Infeasible as error:
            refusal, shorter = error, step
            continue
        for between in range(shorter + 1, step):
            with suppress(Infeasible):
                return held(LONGEST / 2 ** (between / 2))
        return found
    raise refusal


def _held(
    setting: Setting,
    expansion: Expansion | None,
    hold: Hold,
    changes: dict[float, Changes],
    progress: Progress,
) -> Found:
    """The funnel for one hold, in one that a sweep expects within scaled copies of the free one.

    changes: of the free funnel by size; empty without a hold.
    """
    policy, free, t = setting.policy, hold.free, setting.policy.t
    reached = float(t[0] + t[-1]) / 2 if hold.longest else np.inf  # else a shorter hold is tried
    table = widths_by_size(changes, setting, hold)
    widths = table[-1]
    for scale in SCALES:
        try:
            rho, field = held_sweep(setting, expansion, table, scale * free, progress)
            steps = with_widths(setting, field)
            policy = steps.policy
            outer = ContinuousFunnel(policy.x, setting.P, rho, policy.vector_field, "")
            rates: FloatArray = np.zeros(widths.shape)
            widths = hold.widths(policy, rates)
            if hold.period:
                rates, widths = fastest(Changes.of(steps, outer), policy, hold)
            steps.widths = widths
            bounded = replace(hold, rates=rates)
            held = replace(setting, steps=steps, hold=bounded)
            wanted = replace(wanted_of(held, rho, widths), expected=hold.period > 0)
            return _proved(held, wanted, progress)
        except (Infeasible, DataError) as error:
            refusal = error
        if isinstance(refusal, NoFunnel):
            if refusal.t >= reached:  # a smaller copy gets no farther back in time
                break
            reached = refusal.t
    k, i = np.unravel_index(np.argmax(widths), widths.shape)
    off = f"input {i} is then off by up to {widths[k, i]:.3g} at {policy.t[k]:.3g} s"
    if not hold.period:
        raise Infeasible(
            f"no funnel in which the state may be wrong by {hold.error.tolist()}, not even without "
            f"a hold: {off}. Take smaller errors, a larger goal, or a larger R ({refusal})"
        ) from refusal
    plan = (
        hold.period
        * np.abs(np.diff(policy.u.control, axis=1)).sum(axis=1)
        / np.diff(policy.t)[:, None]
    )
    shorter = "" if hold.longest else "a shorter hold (hold='largest' looks for one), "
    raise Infeasible(
        f"no funnel in which the input may be {hold.period:g} s old and the state wrong by "
        f"{hold.error.tolist()}: {off}, of which {plan[k, i]:.3g} is the plan's own change. Take "
        f"{shorter}a smoother plan, a larger goal, or Q and R that decay faster ({refusal})"
    ) from refusal


def expected(setting: Setting, progress: Progress) -> Swept:
    """ρ (K,) as the sweep finds it if nothing is held; nothing is proved."""
    return swept(setting, wanted_of(setting), progress)


def _proved(setting: Setting, wanted: Wanted, progress: Progress) -> Found:
    """ρ by the backward sweep, and its proof; with larger margins where there is none.

    What is proved stays as long as its interval does.
    """
    intervals, margin = range(len(setting.P) - 1), float(wanted.margins[0])
    again, kept, refusal = None, None, Infeasible("")
    for _ in range(SWEEPS):
        try:
            made = swept(setting, wanted, progress, again=again)
        except NoFunnel as found:
            refusal = found if kept is None else refusal
            break
        if again is not None and kept is not None:
            kept = kept.on([k for k in intervals if made.ends[k] is again.ends[k]])
        steps, policy = made.setting.steps, made.setting.policy
        digest = files.digest(policy.document())
        funnel = ContinuousFunnel(policy.x, setting.P, made.rho, policy.vector_field, digest)
        refuse_unmonitorable(funnel)
        shown = prove_pieces(steps, funnel, made.ends, kept=kept)
        if not shown.unproved:
            return Found(made.setting, funnel, shown, margin)
        left = np.isin(intervals, [part.interval for part in shown.unproved])
        refusal = Unproved(
            f"no proof from {unsolved(policy, shown.unproved)} although the L-steps at its "
            "knots hold: try more knots there",
            float(policy.t[int(np.flatnonzero(left)[-1])]),
            left,
        )
        kept, margins = shown, np.where(left, LARGER, 1.0) * wanted.margins
        wanted = replace(wanted, margins=margins)
        again = made._replace(last=int(np.flatnonzero(left)[-1]))
    raise refusal
