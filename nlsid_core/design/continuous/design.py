"""`design_funnel`: a problem in; policy, funnel and its proof out."""

import time
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from nlsid_core.design.continuous.attempts import attempts, first_found, widened, with_knots
from nlsid_core.design.continuous.pieces import Proved, proof_of
from nlsid_core.design.continuous.problem import ContinuousTracking, Goal
from nlsid_core.design.continuous.setting import Setting
from nlsid_core.design.continuous.shape import enlarge_shape
from nlsid_core.designs import Design
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import CertificateRejected, DataError, Infeasible
from nlsid_core.funnels.continuous import ContinuousFunnel, ellipsoid_inside
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.progress import Progress, silent
from nlsid_core.running.held import slowest

KIND = "continuous_funnel"


@dataclass(frozen=True, eq=False)
class ContinuousSearch:
    """What the search for a funnel leaves beside it.

    proved.margins: (pieces,) of -V̇ on the boundary, in 1/s, as found in floating point. history:
    (what, ∫ volume dt). seconds: wall clock of each stage. cost: what a hold and measurement errors
    take, in words. tried: what was refused with other weights before, in words.
    """

    goal: Goal
    proved: Proved
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


FunnelDesign: TypeAlias = Design[VectorField, ContinuousPolicy, ContinuousFunnel, ContinuousSearch]


def design_funnel(problem: ContinuousTracking, *, progress: Progress = silent) -> FunnelDesign:
    """The funnel that the problem describes.

    Raises DataError on input that cannot be right,
    Infeasible if no funnel was found or proved: it says what each attempt gave.
    """
    started = time.perf_counter()
    setting = with_knots(problem)
    if problem.shape == "P" and setting.hold is not None:
        raise DataError("V-steps search without hold or error: take shape rho")
    seconds = {"policy": time.perf_counter() - started}
    started = time.perf_counter()
    try:
        found, tried = first_found(attempts(problem, setting), progress)
    except Infeasible as refusal:
        raise Infeasible(f"{refusal}. {_in_use(setting)}") from refusal
    setting, funnel, proved, margin = widened(problem, found, progress)
    history = [("rho", funnel.volume_integral())]
    seconds["rho"] = time.perf_counter() - started
    if problem.shape == "P":
        started = time.perf_counter()
        try:
            funnel, proved, steps_taken = enlarge_shape(setting, funnel, margin, progress)
            history += steps_taken
        except Infeasible as refusal:  # what is proved already stays
            history.append((f"shape rho kept: {refusal}", funnel.volume_integral()))
        seconds["P"] = time.perf_counter() - started
    search = ContinuousSearch(
        setting.goal,
        proved,
        tuple(history),
        seconds,
        _cost(setting, funnel),
        tried,
    )
    return decided(setting, funnel, search)


def decided(setting: Setting, funnel: ContinuousFunnel, found: ContinuousSearch) -> FunnelDesign:
    """The design, once the kernel has decided its proof; Infeasible with its reason if not."""
    started = time.perf_counter()
    policy, goal, proved = setting.policy, setting.goal, found.proved
    end = funnel.x.ends()[-1]
    multiplier = ellipsoid_inside(end, funnel.shape(funnel.tf), goal.centre, goal.P)
    if multiplier is None:
        raise Infeasible("the funnel's end is not inside the goal")
    proof = proof_of(setting.steps, funnel, proved) | {"goal_multiplier": multiplier}
    claim = {"kind": KIND, "goal": {"centre": goal.centre.tolist(), "P": goal.P.tolist()}}
    if setting.hold is not None:
        claim |= setting.hold.claim()
        proof |= setting.rate_proof(funnel, proved.pieces.basis)
    try:
        design = Design.proved(
            setting.steps.field, policy, funnel, claim=claim, proof=proof, found=found
        )
    except CertificateRejected as refusal:
        raise Infeasible(f"the kernel refuses what was found: {refusal}") from refusal
    found.seconds["proof"] = time.perf_counter() - started
    return design


def _cost(setting: Setting, funnel: ContinuousFunnel) -> str:
    """Half-widths at the start with the hold and the errors of the state, and without them."""
    if setting.hold is None:
        return ""
    part = float(np.sqrt(funnel.rho[0] / setting.hold.free[0]))
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
    """The weights of a policy, which the advice of a refusal compares with; what it cannot move."""
    named = zip("QR", setting.weights, strict=True)
    rows = [
        f"{name} is ({', '.join(f'{entry:.3g}' for entry in np.diag(M).tolist())})"
        for name, M in named
        if len(M)
    ]
    field, policy = setting.steps.field, setting.policy
    slopes = [field.jacobians(t, policy.x(t), policy.u(t)) for t in policy.t.tolist()]
    A, B = (sum(np.abs(part) for part in parts) for parts in zip(*slopes, strict=True))
    moved = np.any(B, axis=1)
    for _ in moved:
        moved = moved | (A @ moved > 0)
    fixed = ", ".join(f"x{i}" for i in np.flatnonzero(~moved).tolist() if moved.any())
    said = f". No input moves {fixed}, through no other state either: uncontrollable"
    return f"The diagonal of {' and of '.join(rows)}{said if fixed else ''}"
