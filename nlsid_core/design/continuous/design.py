"""`design_funnel`: dynamics and a nominal motion in; policy, funnel and its proof out."""

import time
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import ArrayLike, FloatArray
from nlsid_core.design.continuous.cliques import CliqueSteps
from nlsid_core.design.continuous.diagnosis import NoFunnel
from nlsid_core.design.continuous.expansion import Expansion, sweep_expanded
from nlsid_core.design.continuous.finer import (
    NEARBY,
    Unproved,
    coarse,
    halved,
    most_knots,
    refusal_time,
)
from nlsid_core.design.continuous.held import LONGEST, Changes, Hold, fastest
from nlsid_core.design.continuous.held_sweep import (
    changes_by_size,
    held_sweep,
    widths_by_size,
    with_widths,
)
from nlsid_core.design.continuous.lstep import LSteps, sections
from nlsid_core.design.continuous.pieces import Proved, proof_of, prove_pieces, unsolved
from nlsid_core.design.continuous.reachable import reached
from nlsid_core.design.continuous.setting import MOST_KNOTS, Goal, Setting, final_level, prepare
from nlsid_core.design.continuous.shape import (
    enlarge_shape,
    refuse_shape,
    validity_caps,
)
from nlsid_core.design.continuous.sweep import Ends, sweep_rho
from nlsid_core.designs import Design
from nlsid_core.dynamics import Nominal, VectorField
from nlsid_core.dynamics.taylor import field_of
from nlsid_core.errors import CertificateRejected, DataError, Infeasible, SolverError
from nlsid_core.funnels.continuous import ContinuousFunnel, ellipsoid_inside
from nlsid_core.funnels.factor import refuse_unmonitorable
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.progress import Progress, silent
from nlsid_core.running.held import slowest

RETRIES = 6
HALVINGS = 6  # of intervals where P is far from linear
SCALES = (1.0, 0.5, 0.25, 0.1)  # of ρ without a hold, within which one with a hold is looked for
STEPS = (0, 2, 3, 4, 6, 10, 16)  # of the factor √2 below the longest hold, in a search for it
GROWTH = 4.0  # of the margin, where some piece is not proved
FINER = ("knots", "remainder")  # what is less where knots are closer
FACTORS = (0.25, 4.0)  # of the default R, which are tried before a refusal
GAIN_SECONDS = 20.0  # of processor time for each
KIND = "continuous_funnel"


@dataclass(frozen=True, eq=False)
class ContinuousSearch:
    """What the search for a funnel leaves beside it.

    proved.margins: (pieces,) of -V̇ on the boundary, in 1/s, as found in floating point. first: a
    first guess to compare with, of which nothing is proved. history: (what, ∫ volume dt). seconds:
    wall clock of each stage. cost: what a hold and measurement errors take, in words. tried: what
    was refused with other weights before, in words.
    """

    goal: Goal
    proved: Proved
    first: ContinuousFunnel
    history: tuple[tuple[str, float], ...]
    seconds: dict[str, float]
    cost: str = ""
    tried: str = ""

    def __str__(self) -> str:
        volume = (
            f"volume integral {self.history[-1][1]:.4g}, found and proved in "
            f"{sum(self.seconds.values()):.2f} s"
        )
        return "\n".join(row for row in (self.tried, self.cost, volume) if row)


_Found: TypeAlias = tuple[Setting, ContinuousFunnel, Proved, float]
FunnelDesign: TypeAlias = Design[VectorField, ContinuousPolicy, ContinuousFunnel, ContinuousSearch]


def design_funnel(
    dynamics: VectorField | Callable[..., Any],
    nominal: Nominal,
    *,
    goal: Goal | ArrayLike | None = None,
    policy: ContinuousPolicy | None = None,
    shape: str = "rho",
    objective: str = "volume",
    Q: ArrayLike | None = None,
    R: ArrayLike | None = None,
    gain: str = "constant",
    limits: ArrayLike | None = None,
    uncertain: ArrayLike | None = None,
    hold: float | Literal["largest"] | None = None,
    error: ArrayLike | None = None,
    executor: Executor | None = None,
    progress: Progress = silent,
) -> FunnelDesign:
    """The funnel that `ContinuousTracking` describes; its options are these.

    executor: shares the independent L-steps.
    Raises DataError on input that cannot be right, Infeasible if no funnel was found or proved.
    """
    started = time.perf_counter()
    prepared = partial(
        prepare, dynamics, goal=goal, policy=policy, Q=Q, R=R, gain=gain,
        limits=limits, uncertain=uncertain, hold=hold, error=error,
    )  # fmt: skip
    setting = prepared(nominal)
    if policy is None:
        setting = _with_knots(setting, prepared)
    if shape == "P":
        refuse_shape(setting.steps)
        if setting.hold is not None:
            raise DataError("V-steps search without hold or error: take shape rho")
    seconds = {"policy": time.perf_counter() - started}
    started = time.perf_counter()
    try:
        again = prepared if policy is None else None
        gains = () if policy is not None or R is not None or not setting.steps.field.m else FACTORS
        (setting, funnel, proved, margin), tried = _with_gains(setting, again, gains, progress)
    except Infeasible as refusal:
        raise Infeasible(f"{refusal}. {_in_use(setting)}") from refusal
    history = [("rho", funnel.volume_integral())]
    seconds["rho"] = time.perf_counter() - started
    if shape == "P":
        started = time.perf_counter()
        try:
            funnel, proved, steps_taken = enlarge_shape(
                setting.steps, setting.policy, funnel, margin=margin, objective=objective,
                executor=executor, progress=progress,
            )  # fmt: skip
            history += steps_taken
        except Infeasible as refusal:  # what is proved already stays
            history.append((f"shape rho kept: {refusal}", funnel.volume_integral()))
        seconds["P"] = time.perf_counter() - started
    return decided(setting, funnel, proved, history=history, seconds=seconds, tried=tried)


def decided(
    setting: Setting,
    funnel: ContinuousFunnel,
    proved: Proved,
    *,
    history: list[tuple[str, float]],
    seconds: dict[str, float],
    tried: str = "",
) -> FunnelDesign:
    """The design, once the kernel has decided its proof; Infeasible with its reason if not."""
    started = time.perf_counter()
    policy, goal = setting.policy, setting.goal
    end = funnel.x.ends()[-1]
    multiplier = ellipsoid_inside(end, funnel.shape(funnel.tf), goal.centre, goal.P)
    if multiplier is None:
        raise Infeasible("the funnel's end is not inside the goal")
    proof = proof_of(setting.steps, policy, funnel, proved) | {"goal_multiplier": multiplier}
    claim = {"kind": KIND, "goal": {"centre": goal.centre.tolist(), "P": goal.P.tolist()}}
    if setting.hold is not None:
        claim |= setting.hold.claim()
        proof |= setting.rate_proof(funnel, proved.pieces.basis)
    found = ContinuousSearch(
        goal, proved, setting.first_guess(), tuple(history), seconds, _cost(setting, funnel), tried
    )
    try:
        design = Design.proved(
            setting.steps.field, policy, funnel, claim=claim, proof=proof, found=found
        )
    except CertificateRejected as refusal:
        raise Infeasible(f"the kernel refuses what was found: {refusal}") from refusal
    seconds["proof"] = time.perf_counter() - started
    return design


def _cost(setting: Setting, funnel: ContinuousFunnel) -> str:
    """Half-widths at the start with the hold and the errors of the state, and without them."""
    if setting.hold is None or setting.free is None:
        return ""
    part = float(np.sqrt(funnel.rho[0] / setting.free[0]))
    free = replace(funnel, rho=funnel.rho / part**2)
    held, unheld = (
        ", ".join(f"x{i} {width:.3g}" for i, width in enumerate(f.widths(funnel.t0).tolist()))
        for f in (funnel, free)
    )
    causes = [f"a hold of {setting.hold.period:g} s"] if setting.hold.period else []
    causes += ["the errors of the measured state"] if setting.hold.error.any() else []
    often = f"samples should come every {slowest(setting.hold.period):.12g} s or more often"
    return (
        f"with {' and '.join(causes)}, {part:.3g} of the half-widths are left at {funnel.t0:g} s: "
        f"{held}; without, {unheld} were found for this policy, not proved"
        + (f"; {often}" if setting.hold.period else "")
    )


def _in_use(setting: Setting) -> str:
    """The weights of a policy, which the advice of a refusal compares with."""
    named = zip("QR", setting.weights, strict=True)
    rows = [
        f"{name} is ({', '.join(f'{entry:.3g}' for entry in np.diag(M).tolist())})"
        for name, M in named
        if len(M)
    ]
    return f"The diagonal of {' and of '.join(rows)}"


def _with_gains(
    setting: Setting,
    again: Callable[..., Setting] | None,
    factors: tuple[float, ...],
    progress: Progress,
) -> tuple[_Found, str]:
    """`_tried`, and where that fails also with R times these factors, each for GAIN_SECONDS.

    Feedback that acts faster first where w is the cause, else feedback that acts slower. Returns
    what was tried before in words.
    """
    try:
        return _tried(setting, again, progress), ""
    except Infeasible as error:
        refusal = error
    said = [f"with R as it is by default {_reason(refusal)}"]
    if again is not None:
        nominal = Nominal(setting.policy.x, setting.policy.u)
        faster = isinstance(refusal, NoFunnel) and refusal.diagnosis.dominant == "disturbance"
        for factor in sorted(factors, reverse=not faster):
            try:
                other = again(nominal, R=factor * setting.weights[1])
                found = _found(other, _limited(progress))
            except Infeasible as error:
                said.append(f"with {factor:g} R {_reason(error)}")
            else:
                return found, f"found with {factor:g} R: {'; '.join(said)}"
    if len(said) == 1:
        raise refusal
    raise Infeasible(f"{refusal}. Tried as well: {'; '.join(said[1:])}") from refusal


def _reason(refusal: Infeasible) -> str:
    """A refusal in few words."""
    found = refusal if isinstance(refusal, NoFunnel) else refusal.__cause__
    if not isinstance(found, NoFunnel):
        return f"there is none ({refusal})"
    return f"there is none at {found.diagnosis.t:.3g} s, because of {found.diagnosis.cause}"


def _limited(progress: Progress) -> Progress:
    """Progress that ends a search after GAIN_SECONDS of processor time."""
    end = time.process_time() + GAIN_SECONDS

    def told(what: str, fraction: float) -> None:
        if time.process_time() > end:
            raise Infeasible(f"stopped at {what}, after {GAIN_SECONDS:g} s of processor time")
        progress(what, fraction)

    return told


def _with_knots(setting: Setting, again: Callable[[Nominal], Setting]) -> Setting:
    """The setting with more knots where P(t) is far from linear, such as near the goal."""
    most = most_knots(len(setting.policy.t))
    for _ in range(HALVINGS):
        chosen = coarse(setting, most)
        if not chosen.any():
            break
        setting = again(Nominal(setting.policy.x, setting.policy.u).halved(chosen))
    return setting


def _tried(
    setting: Setting, again: Callable[[Nominal], Setting] | None, progress: Progress
) -> _Found:
    """ρ for the cost-to-go; where w stops that, for what the pushed linear loop reaches.

    Where one of `FINER` stops it, it is tried with more knots, see `halved`.
    """
    before, nearby = np.inf, NEARBY
    refusal = Infeasible("")
    for attempt in range(1 + HALVINGS):
        try:
            return _found(setting, progress)
        except Infeasible as error:
            found = error
        at = refusal_time(found)
        t = -np.inf if at is None else at  # the sweep goes back in time; the rest comes after it
        if t <= before:  # this one came at least as far
            refusal = found
        nearby = 2 * nearby if t >= before else NEARBY
        before = min(t, before)
        term = found.diagnosis.dominant if isinstance(found, NoFunnel) else "knots"
        pushed = _pushed(setting, again) if term == "disturbance" else None
        if pushed is not None:
            with suppress(Infeasible):
                return _found(pushed, progress)
        chosen = halved(setting, found, nearby) if term in FINER else None
        if again is None or chosen is None or attempt == HALVINGS:
            break
        setting = again(Nominal(setting.policy.x, setting.policy.u).halved(chosen))
    raise refusal


def _pushed(setting: Setting, again: Callable[[Nominal], Setting] | None) -> Setting | None:
    """The setting with P(t) of what a pushed linear loop reaches; None if that misses the goal.

    again: the same problem around a motion with more knots, if it can have more.
    """
    for _ in range(HALVINGS):
        found, policy, steps = reached(setting), setting.policy, setting.steps
        if found is None:
            return None
        if found.size < 1:
            steps.tightness = found.tightness
            rho, _ = final_level(steps, policy, found.P, setting.goal, setting.expansion)
            return replace(setting, P=found.P, rho_final=rho)
        more = int(found.coarse.sum())
        if again is None or not more or len(policy.t) + more > MOST_KNOTS:
            return None
        setting = again(Nominal(policy.x, policy.u).halved(found.coarse))
    return None


def _found(setting: Setting, progress: Progress) -> _Found:
    """ρ by the backward sweep, and its proof; where inputs are held, for bounds of their change.

    Those hold in a funnel found without a hold, or in a part of it: below, ρ is found with it.
    """
    expansion = setting.expansion
    if setting.hold is None or expansion is not None:
        first = _unheld(setting, progress)
        if setting.hold is None:
            return first
        setting, free = replace(first[0], expansion=None, needed=first[3]), first[1].rho
    else:
        free = _free(setting, progress)
    setting, hold = replace(setting, free=free), setting.hold
    assert hold is not None
    span = float(setting.policy.t[-1] - setting.policy.t[0])
    if hold.shortest > span:
        raise DataError(f"the hold of {hold.shortest:g} s is longer than the motion of {span:g} s")

    changes = changes_by_size(setting, expansion) if hold.period else {}

    def held(period: float) -> _Found:
        return _held(setting, expansion, replace(hold, period=period), changes, progress)

    if not hold.longest:
        return held(hold.period)
    return _longest(held)


def _longest(held: Callable[[float], _Found]) -> _Found:
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
    setting: Setting, expansion: Expansion | None, hold: Hold, changes: dict[float, Changes],
    progress: Progress,
) -> _Found:  # fmt: skip
    """The funnel for one hold, in one that a sweep expects within scaled copies of the free one.

    changes: of the free funnel by size; empty without a hold.
    """
    policy, free, t = setting.policy, setting.free, setting.policy.t
    assert free is not None
    reached = float(t[0] + t[-1]) / 2 if hold.longest else np.inf  # else a shorter hold is tried
    table = widths_by_size(changes, setting, hold)
    widths = table[-1]
    for scale in SCALES:
        try:
            rho, field = held_sweep(setting, expansion, table, scale * free, progress)
            policy = replace(policy, vector_field=files.digest(field.document()))
            outer = ContinuousFunnel(policy.x, setting.P, rho, policy.vector_field, "")
            steps = with_widths(replace(setting, policy=policy), field)
            rates: FloatArray = np.zeros(widths.shape)
            widths = hold.widths(policy, rates)
            if hold.period:
                rates, widths = fastest(Changes.of(steps, policy, outer), policy, hold)
            steps.widths = widths
            caps = validity_caps(field, policy, setting.P, widths)
            held = replace(setting, steps=steps, policy=policy, hold=hold, rates=rates)
            return _swept(held, np.minimum(caps, rho), progress)
        except (Infeasible, DataError) as error:
            refusal = error
        if isinstance(refusal, NoFunnel):
            if refusal.diagnosis.t >= reached:  # a smaller copy gets no farther back in time
                break
            reached = refusal.diagnosis.t
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


def _free(setting: Setting, progress: Progress) -> FloatArray:
    """ρ (K,) as it is found if nothing is held."""
    steps, policy, P = setting.steps, setting.policy, setting.P
    caps = validity_caps(steps.field, policy, P)
    rho_final = min(setting.rho_final, float(caps[-1]))
    rho, _ = sweep_rho(
        steps, sections(steps, policy, P), margin=setting.margin(rho_final),
        rho_final=rho_final, caps=caps, progress=progress,
    )  # fmt: skip
    return rho


def _unheld(setting: Setting, progress: Progress) -> _Found:
    """The funnel if nothing is held."""
    if setting.expansion is not None:
        return proved_for(setting, setting.rho_final, partial(_expanded, setting, progress))
    caps = validity_caps(setting.steps.field, setting.policy, setting.P)
    cliques = CliqueSteps.of(setting.steps)
    if cliques is not None:
        with suppress(Infeasible, SolverError):  # then with every product
            _, funnel, proved, margin = _swept(replace(setting, steps=cliques), caps, progress)
            return setting, funnel, proved, margin
    return _swept(setting, caps, progress)


def _swept(setting: Setting, caps: FloatArray, progress: Progress) -> _Found:
    """ρ by the backward sweep, and its proof; with a larger margin where that fails."""
    steps, policy, P = setting.steps, setting.policy, setting.P
    pairs = sections(steps, policy, P)
    rho_final = min(setting.rho_final, float(caps[-1]))

    def search(margin: float) -> tuple[Setting, FloatArray, list[Ends] | None]:
        found = sweep_rho(steps, pairs, margin=margin, rho_final=rho_final, caps=caps,
                          expected=setting.rates is not None, progress=progress)  # fmt: skip
        return setting, *found

    return proved_for(setting, rho_final, search)


def _expanded(
    setting: Setting, progress: Progress, margin: float
) -> tuple[Setting, FloatArray, list[Ends] | None]:
    """The sweep that expands the dynamics around what it finds; the setting has their field."""
    assert setting.expansion is not None
    steps, policy = setting.steps, setting.policy
    found = sweep_expanded(setting.expansion, steps, policy, setting.P, margin=margin,
                           rho_final=setting.rho_final, progress=progress)  # fmt: skip
    field = field_of(found.cubics, policy.t)
    policy = replace(policy, vector_field=files.digest(field.document()))
    proving = LSteps(field, policy, nonlinear=steps.nonlinear, pushed=steps.pushed,
                     tightness=steps.tightness)  # fmt: skip
    proving.kappa = steps.kappa
    return replace(setting, steps=proving, policy=policy), found.rho, found.ends


def proved_for(
    setting: Setting,
    rho_final: float,
    search: Callable[[float], tuple[Setting, FloatArray, list[Ends] | None]],
) -> _Found:
    """The ρ that `search` finds for a margin, and its proof; margins grow until there is one."""
    margin = setting.margin(rho_final)
    proved: Proved | None = None
    for _ in range(RETRIES):
        setting, rho, ends = search(margin)
        steps, policy = setting.steps, setting.policy
        digest = files.digest(policy.document())
        funnel = ContinuousFunnel(policy.x, setting.P, rho, policy.vector_field, digest)
        refuse_unmonitorable(funnel)
        proved = prove_pieces(steps, policy, funnel, ends)
        if not proved.unproved:
            return setting, funnel, proved, margin
        margin *= GROWTH
    assert proved is not None
    raise Unproved(
        f"no proof from {unsolved(policy, proved.unproved)} although the L-steps at its "
        "knots hold: try more knots there",
        float(policy.t[proved.unproved[-1].interval]),
    )
