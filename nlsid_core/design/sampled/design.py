"""`design_state_funnel`: inlet and tube around a motion of an identified polynomial model.

Backward, the inlet: the largest radius whose step, disturbance included, fits in the next. Forward,
the tube: where starts in the inlet get to. Every step of both is one semidefinite program.
"""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.design.problems import SampledTracking
from nlsid_core.design.sampled.closed_loop import Frame, half_widths
from nlsid_core.design.sampled.explicit import ExplicitStep
from nlsid_core.design.sampled.motion import Feedback
from nlsid_core.designs import Design
from nlsid_core.errors import CertificateRejected, Infeasible
from nlsid_core.funnels.factor import refuse_coarse, refuse_unmonitorable
from nlsid_core.funnels.sampled import DisturbanceAssumption, SampledFunnel
from nlsid_core.models.state_map import StateModel
from nlsid_core.policies.sampled import SampledPolicy
from nlsid_core.progress import Progress, silent
from nlsid_core.running.assumption import DisturbanceMeter, disturbance_of

AIM = 1.0 - 5e-5  # of the next radius: where the search for a radius aims ...
CLOSE = 1.0 - 4e-4  # ... and from where it is content
ATTEMPTS = 8  # semidefinite programs a step; two or three are usual
INSIDE_BOX = 1.0 - 1e-9  # of what the box of the data leaves

TrackingDesign: TypeAlias = Design[StateModel, SampledPolicy, SampledFunnel, None]


def frame(model: StateModel, policy: SampledPolicy, feedback: Feedback) -> Frame:
    """The norms |S x̄|, S'S the LQR cost, and how far the box of the data lets them grow."""
    S = np.array([np.linalg.cholesky(P).T for P in feedback.P])
    T = np.array([np.triu(np.linalg.inv(s)) for s in S])
    A, cap = [], []
    for k in range(len(policy) + 1):
        rows = [np.eye(len(model))]
        room = [_room(policy.x[k], model.x_range)]
        if k < len(policy):
            a, b = model.linearised(policy.x[k], policy.u[k])
            A.append(a - b @ policy.K[k])
            rows.append(policy.K[k])
            room.append(_room(policy.u[k], model.u_range))
        size = np.linalg.norm(np.vstack(rows) @ T[k], axis=1)
        cap.append(float((np.concatenate(room) / size).min()) * INSIDE_BOX)
    if min(cap) <= 0:
        raise Infeasible("the motion touches the box of the model's data; keep more in reserve")
    return Frame(S, T, np.array(A), np.array(cap))


def design_state_funnel(problem: SampledTracking, *, progress: Progress = silent) -> TrackingDesign:
    """The largest inlet that reaches the goal, and the tube from it.

    Raises CertificateRejected if the assumption is not one a checker would accept,
    Infeasible if the disturbance leaves no inlet.
    """
    model, policy, assumption = problem.model, problem.policy, problem.assumption
    refuse_assumption(model, assumption)
    norms = frame(model, policy, problem.feedback)
    cap = norms.cap - assumption.bound
    if np.min(cap) <= 0:
        k = int(np.argmin(cap))
        raise Infeasible(
            f"at sample {k} the disturbance alone ({assumption.bound:.3g}) fills the box of the "
            f"data ({norms.cap[k]:.3g}); record more widely, or disturb less"
        )
    samples = range(len(policy))
    steps = [ExplicitStep.at(model, policy, norms, k, assumption) for k in samples]
    inlet, to_goal = _inlet(steps, cap, problem.goal, progress)
    tube, along = _tube(steps, float(inlet[0]), progress)
    funnel = SampledFunnel(
        S=norms.S,
        A=norms.A,
        tube=tube,
        inlet=inlet,
        half_widths=half_widths(norms.S, tube, assumption.bound),
        assumption=assumption,
        model=policy.model,
        policy=files.digest(policy.document()),
    )
    refuse_unmonitorable(funnel)
    refuse_coarse(np.spacing(np.abs(policy.x)), funnel.half_widths, "the motion")
    entries = [
        step.stated() | {"tube": step.proof(a), "inlet": step.proof(b)}
        for step, a, b in zip(steps, along, to_goal, strict=True)
    ]
    proof = steps[0].bases() | {"steps": entries}
    claim = {"kind": "sampled_funnel"}
    return Design.proved(model, policy, funnel, claim=claim, proof=proof, found=None)


def assume(
    model: StateModel,
    policy: SampledPolicy,
    feedback: Feedback,
    runs: Dataset,
    *,
    safety_factor: float = 1.5,
) -> DisturbanceAssumption:
    """The bound that commissioning runs of the policy give: safety_factor times their largest.

    Raises DataError if a run is shorter than the policy, CertificateRejected if one of them is a
    recording the model was fitted on.
    """
    norms = frame(model, policy, feedback)
    meter = DisturbanceMeter(norms.S, norms.A)
    measured = max(float(np.max(disturbance_of(model, policy, run, meter))) for run in runs)
    assumption = DisturbanceAssumption(
        bound=float(np.nextafter(safety_factor * measured, np.inf)),
        measured=measured,
        safety_factor=safety_factor,
        measured_on=tuple((run.name, run.digest) for run in runs),
    )
    refuse_assumption(model, assumption)
    return assumption


def _inlet(
    steps: Sequence[ExplicitStep], cap: FloatArray, goal: float | None, progress: Progress
) -> tuple[FloatArray, list[Any]]:
    """Backward: at each sample the largest radius whose step fits in the next one."""
    N = len(steps)
    radii, proofs = np.empty(N + 1), []
    radii[N] = cap[N] if goal is None else min(goal, float(cap[N]))
    growth = 1.0
    for k in range(N - 1, -1, -1):
        target = float(radii[k + 1])
        radius = min(target * growth, float(cap[k]))
        best: tuple[float, Any] | None = None
        for _ in range(ATTEMPTS):
            proof, needed = steps[k].from_radius(radius)
            if needed <= target:
                if best is None or radius > best[0]:
                    best = (radius, proof)
                if needed >= CLOSE * target or radius >= cap[k]:
                    break
            radius = min(radius * AIM * target / needed, float(cap[k]))
        if best is None:
            raise Infeasible(
                f"at sample {k} no radius fits in the next, {target:.3g}: the disturbance "
                f"({steps[k].assumption.bound:.3g}) or the curvature is too large for this goal"
            )
        radii[k], growth = best[0], max(1e-3, best[0] / target)
        proofs.append(best[1])
        progress("inlet", (N - k) / N)
    return radii, proofs[::-1]


def _tube(
    steps: Sequence[ExplicitStep], start: float, progress: Progress
) -> tuple[FloatArray, list[Any]]:
    """Forward: what each step needs is the next radius."""
    radii, proofs = [start], []
    for k, step in enumerate(steps):
        proof, needed = step.from_radius(radii[-1])
        radii.append(needed)
        proofs.append(proof)
        progress("tube", (k + 1) / len(steps))
    return np.array(radii), proofs


def refuse_assumption(model: StateModel, a: DisturbanceAssumption) -> None:
    """Refuse an assumption that the kernel would refuse, before any work."""
    fitted = {digest for _, digest in model.bags}
    if not a.measured_on:
        raise CertificateRejected("the assumption was measured on no commissioning run")
    for name, digest in a.measured_on:
        if not digest or digest in fitted:
            raise CertificateRejected(
                f"commissioning run {name} is a recording the model was fitted on: its disturbance "
                "is too small; record the policy running"
            )


def _room(centre: FloatArray, ranges: FloatArray) -> FloatArray:
    return np.minimum(ranges[:, 1] - centre, centre - ranges[:, 0])
