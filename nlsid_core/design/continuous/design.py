"""`design_funnel`: dynamics and a nominal motion in; policy, funnel and its proof out."""

import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import ArrayLike, FloatArray
from nlsid_core.design.continuous.expansion import sweep_expanded
from nlsid_core.design.continuous.lstep import LSteps, sections
from nlsid_core.design.continuous.pieces import Proved, proof_of, prove_pieces, unsolved
from nlsid_core.design.continuous.setting import Goal, Setting, prepare
from nlsid_core.design.continuous.shape import enlarge_shape, refuse_shape
from nlsid_core.design.continuous.sweep import Ends, Progress, sweep_rho
from nlsid_core.designs import Design
from nlsid_core.dynamics import Nominal, VectorField
from nlsid_core.dynamics.taylor import field_of
from nlsid_core.errors import CertificateRejected, DataError, Infeasible
from nlsid_core.funnels.continuous import ContinuousFunnel, ellipsoid_inside
from nlsid_core.funnels.factor import refuse_unmonitorable
from nlsid_core.policies.continuous import ContinuousPolicy

RETRIES = 6
GROWTH = 4.0  # of the margin, where some piece is not proved
CAP_ROOM = 1 - 1e-6  # the checker decides in rationals what is rounded here
KIND = "continuous_funnel"


@dataclass(frozen=True, eq=False)
class ContinuousSearch:
    """What the search for a funnel leaves beside it.

    proved.margins: (pieces,) of -V̇ on the boundary, in 1/s, as found in floating point. first: a
    first guess to compare with, of which nothing is proved. history: (what, ∫ volume dt). seconds:
    wall clock of each stage.
    """

    goal: Goal
    proved: Proved
    first: ContinuousFunnel
    history: tuple[tuple[str, float], ...]
    seconds: dict[str, float]

    def __str__(self) -> str:
        return (
            f"{len(self.proved.pieces)} pieces proved, volume integral {self.history[-1][1]:.4g}, "
            f"{sum(self.seconds.values()):.2f} s"
        )


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
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> FunnelDesign:
    """The funnel that `ContinuousTracking` describes; its options are these.

    executor: shares the independent L-steps.
    Raises DataError on input that cannot be right, Infeasible if no funnel was found or proved.
    """
    started = time.perf_counter()
    setting = prepare(
        dynamics, nominal, goal=goal, policy=policy, Q=Q, R=R, gain=gain, limits=limits,
        uncertain=uncertain,
    )  # fmt: skip
    if shape == "P":
        refuse_shape(setting.steps)
    seconds = {"policy": time.perf_counter() - started}
    started = time.perf_counter()
    setting, funnel, proved, margin = _swept(setting, progress)
    history = [("rho", funnel.volume_integral())]
    seconds["rho"] = time.perf_counter() - started
    if shape == "P":
        started = time.perf_counter()
        funnel, proved, steps_taken = enlarge_shape(
            setting.steps, setting.policy, funnel, margin=margin, objective=objective,
            executor=executor, progress=progress,
        )  # fmt: skip
        history += steps_taken
        seconds["P"] = time.perf_counter() - started
    return decided(setting, funnel, proved, history=history, seconds=seconds)


def decided(
    setting: Setting,
    funnel: ContinuousFunnel,
    proved: Proved,
    *,
    history: list[tuple[str, float]],
    seconds: dict[str, float],
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
    found = ContinuousSearch(goal, proved, setting.first_guess(), tuple(history), seconds)
    try:
        design = Design.proved(
            setting.steps.field, policy, funnel, claim=claim, proof=proof, found=found
        )
    except CertificateRejected as refusal:
        raise Infeasible(f"the kernel refuses what was found: {refusal}") from refusal
    seconds["proof"] = time.perf_counter() - started
    return design


def validity_caps(field: VectorField, policy: ContinuousPolicy, P: FloatArray) -> FloatArray:
    """(K,) the largest ρ at each knot with which x and u stay where the dynamics are valid.

    Raises DataError if the nominal itself does not.
    """
    caps = np.full(len(P), np.inf)
    clipped = {int(i) + field.n: (low, high) for i, low, high in policy.limits.tolist()}
    for k in range(len(P) - 1):
        for entry, low, high in field.validity(field.span(float(policy.t[k]))):
            centre, rows = policy.entry(entry, k)
            least, most = clipped.get(entry, (-np.inf, np.inf))
            if most < low or high < least:
                raise DataError(
                    f"the limits [{least:g}, {most:g}] of input {entry - field.n} lie outside "
                    f"where its dynamics are valid, [{low:g}, {high:g}]"
                )
            # A limit within the bounds keeps its side by itself.
            room = min(
                np.inf if most <= high else high - float(np.max(centre)),
                np.inf if low <= least else float(np.min(centre)) - low,
            )
            if room <= 0:
                raise DataError(
                    f"the nominal leaves where its dynamics are valid: entry {entry} of (x, u) is "
                    f"{centre[0]:.4g} at {policy.t[k]:g} s, not well within [{low:g}, {high:g}]"
                )
            for knot in (k, k + 1):
                reach = np.einsum("ri,ij,rj->r", rows, np.linalg.inv(P[knot]), rows).max()
                caps[knot] = min(caps[knot], CAP_ROOM * room**2 / reach)
    return caps


def _swept(
    setting: Setting, progress: Progress | None
) -> tuple[Setting, ContinuousFunnel, Proved, float]:
    """ρ by the backward sweep, and its proof; with a larger margin where that fails.

    Of dynamics that are not polynomial the setting that is returned has the field that was proved.
    """
    steps, policy, P = setting.steps, setting.policy, setting.P
    if setting.expansion is not None:
        return proved_for(setting, setting.rho_final, partial(_expanded, setting, progress))
    pairs = sections(steps, policy, P)
    caps = validity_caps(steps.field, policy, P)
    rho_final = min(setting.rho_final, float(caps[-1]))

    def search(margin: float) -> tuple[Setting, FloatArray, list[Ends] | None]:
        found = sweep_rho(steps, pairs, margin=margin, rho_final=rho_final, caps=caps,
                          progress=progress)  # fmt: skip
        return setting, *found

    return proved_for(setting, rho_final, search)


def _expanded(
    setting: Setting, progress: Progress | None, margin: float
) -> tuple[Setting, FloatArray, list[Ends] | None]:
    """The sweep that expands the dynamics around what it finds; the setting has their field."""
    assert setting.expansion is not None
    steps, policy = setting.steps, setting.policy
    found = sweep_expanded(setting.expansion, steps, policy, setting.P, margin=margin,
                           rho_final=setting.rho_final, progress=progress)  # fmt: skip
    field = field_of(found.cubics, policy.t)
    policy = replace(policy, vector_field=files.digest(field.document()))
    proving = LSteps(field, policy, nonlinear=steps.nonlinear, pushed=steps.pushed)
    proving.kappa = steps.kappa
    return replace(setting, steps=proving, policy=policy), found.rho, found.ends


def proved_for(
    setting: Setting,
    rho_final: float,
    search: Callable[[float], tuple[Setting, FloatArray, list[Ends] | None]],
) -> tuple[Setting, ContinuousFunnel, Proved, float]:
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
    raise Infeasible(
        f"no proof from {unsolved(policy, proved.unproved)} although the L-steps at its "
        "knots hold: try more knots there"
    )
