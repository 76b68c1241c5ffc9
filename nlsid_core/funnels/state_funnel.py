"""`design_state_funnel`: inlet and tube around a motion of an identified polynomial model.

Backward, the inlet: the largest radius whose step, disturbance included, fits in the next. Forward,
the tube: where starts in the inlet get to. Every step of both is one semidefinite program.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Protocol, TypeAlias

import numpy as np

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import proof_document, reach
from nlsid_core.certificate.discrete_funnel import CHAINS, StepProof, disturbed, refuse_assumption
from nlsid_core.certificate.implicit_reach import ImplicitStepProof
from nlsid_core.discrete_funnel import DiscreteFunnel, DisturbanceAssumption
from nlsid_core.errors import CertificateRejected, DataError, Infeasible
from nlsid_core.funnels.implicit_funnel import ImplicitFunnelStep
from nlsid_core.funnels.motion import Feedback
from nlsid_core.funnels.reach import Step
from nlsid_core.models.measured_state import MeasuredState
from nlsid_core.models.state_map import StateModel
from nlsid_core.models.trapezoidal import TrapezoidalModel
from nlsid_core.tracking_monitor import disturbance_of
from nlsid_core.tracking_policy import TrackingPolicy
from nlsid_core.trajectory import Dataset

AIM = 1.0 - 5e-5  # of the next radius: where the search for a radius aims ...
CLOSE = 1.0 - 4e-4  # ... and from where it is content
ATTEMPTS = 8  # semidefinite programs a step; two or three are usual
UP = 1.0 + 1e-12  # a radius written down is above its value by more than rounding
BISECTIONS = 40
SMALLEST = 1e-3  # of the box: below it no radius is worth having
INSIDE_BOX = 1.0 - 1e-9  # of what the box of the data leaves

ROOTS = 3.0  # radii of the tube within which the roots of an implicit step are claimed

Progress = Callable[[str, float], None]
AnyProof: TypeAlias = StepProof | ImplicitStepProof


@dataclass(frozen=True, eq=False)
class FunnelDesign:
    """A funnel, its policy and model, and the proof: T and one step proof per sample and chain.

    T: (N, n, n); of an implicit model (N + 1, n, n).
    """

    model: MeasuredState
    policy: TrackingPolicy
    funnel: DiscreteFunnel
    T: FloatArray
    steps: Mapping[str, Sequence[AnyProof]]

    def proof_document(self, *, model: str, policy: str, funnel: str) -> Json:
        """The proof file's content; the arguments name the three files beside it."""
        about = {
            "model": {"file": model, "digest": _json.digest(self.model.document())},
            "policy": {"file": policy, "digest": _json.digest(self.policy.document())},
            "funnel": {"file": funnel, "digest": _json.digest(self.funnel.document())},
        }
        proof: Json = {"T": self.T.tolist()}
        for chain in CHAINS:
            proof[chain] = [step.document() for step in self.steps[chain]]
        implicit = isinstance(self.model, TrapezoidalModel)
        kind = "implicit_funnel" if implicit else "discrete_funnel"
        return proof_document({"kind": kind, "about": about}, proof)


@dataclass(frozen=True, eq=False)
class Frame:
    """Norms along a motion, before any radius: S and T = S⁻¹ (N + 1), the response's A, and caps.

    cap: (N + 1,) the largest radius in the box of the data, policy's inputs included.
    """

    S: FloatArray
    T: FloatArray
    A: FloatArray
    cap: FloatArray


def frame(model: MeasuredState, policy: TrackingPolicy, feedback: Feedback) -> Frame:
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


def design_state_funnel(
    model: MeasuredState,
    policy: TrackingPolicy,
    feedback: Feedback,
    *,
    assumption: DisturbanceAssumption,
    goal: float | None = None,
    start: float | None = None,
    progress: Progress = lambda _what, _done: None,
) -> FunnelDesign:
    """The largest inlet that reaches the goal, and the tube from it, under `assumption`.

    goal, start: radii at the end and at the start; default the largest the box allows, and the
    inlet's. Raises CertificateRejected if the assumption is not one a checker would accept,
    Infeasible if the disturbance leaves no inlet, DataError if `start` is beyond the inlet.
    """
    refuse_assumption(model, assumption)
    norms = frame(model, policy, feedback)
    cap = norms.cap - assumption.widens
    if np.min(cap) <= 0:
        k = int(np.argmin(cap))
        raise Infeasible(
            f"at sample {k} the disturbance alone ({assumption.bound:.3g}) fills the box of the "
            f"data ({norms.cap[k]:.3g}); record more widely, or disturb less"
        )
    steps = _steps(model, policy, norms, assumption)
    for k, step in enumerate(steps):
        cap[k] = step.largest(float(cap[k]))
    inlet, inlet_proof = _inlet(steps, cap, goal, progress)
    implicit = isinstance(model, TrapezoidalModel)
    roots = ROOTS * (inlet + assumption.widens)
    first = float(inlet[0]) if start is None else start
    if not 0 < first <= inlet[0]:
        raise DataError(
            f"start {first:.4g} should be positive and at most the inlet {inlet[0]:.4g}"
        )
    tube, tube_proof = _tube(steps, first, roots, progress)
    funnel = DiscreteFunnel(
        S=norms.S,
        A=norms.A,
        tube=tube,
        inlet=inlet,
        assumption=assumption,
        model=policy.model,
        policy=_json.digest(policy.document()),
        roots=roots if implicit else None,
    )
    T = norms.T if implicit else norms.T[:-1]
    return FunnelDesign(model, policy, funnel, T, {"tube": tube_proof, "inlet": inlet_proof})


def assume(
    model: MeasuredState,
    policy: TrackingPolicy,
    feedback: Feedback,
    runs: Dataset,
    *,
    form: str = "response",
    safety_factor: float = 1.5,
    rate: float = 1.0,
) -> DisturbanceAssumption:
    """The bound that commissioning runs of the policy give: safety_factor times their largest.

    rate: by which `fading` forgets a sample, below 1.

    Raises DataError if a run is shorter than the policy, CertificateRejected if one of them is a
    recording the model was fitted on.
    """
    norms = frame(model, policy, feedback)
    gain = _gain(norms, rate) if form in ("energy", "fading") else 1.0
    options = {"S": norms.S, "A": norms.A, "form": form, "rate": rate, "gain": gain}
    measured = max(
        float(np.max(disturbance_of(model, policy, run, **options)))  # type: ignore[arg-type]
        for run in runs
    )
    assumption = DisturbanceAssumption(
        form=form,
        bound=float(np.nextafter(safety_factor * measured, np.inf)),
        measured=measured,
        safety_factor=safety_factor,
        measured_on=tuple((run.name, run.digest) for run in runs),
        rate=rate,
        gain=gain,
    )
    refuse_assumption(model, assumption)
    return assumption


def undisturbed(assumption: DisturbanceAssumption) -> DisturbanceAssumption:
    """The same with nothing to disturb, to compare with."""
    return replace(assumption, bound=0.0, measured=0.0)


@dataclass(frozen=True, eq=False)
class _DisturbedStep:
    """One step: its semidefinite program, and what the disturbance adds to its reach."""

    step: Step
    curvature: dict[tuple[int, int], Fraction]
    inflation: Fraction
    assumption: DisturbanceAssumption

    @classmethod
    def at(
        cls,
        model: StateModel,
        policy: TrackingPolicy,
        norms: Frame,
        k: int,
        assumption: DisturbanceAssumption,
    ) -> "_DisturbedStep":
        g = reach.closed_loop(
            model,
            x=policy.x[k],
            u=policy.u[k],
            K=policy.K[k],
            x_next=policy.x[k + 1],
            T=norms.T[k],
            S_next=norms.S[k + 1],
        )
        exact_T = reach.rational(norms.T[k])
        curvature = {}
        if assumption.form != "peak":
            unit = reach.rational(norms.S[k + 1]) @ reach.rational(norms.A[k]) @ exact_T
            curvature = reach.curvature(g, unit if assumption.form == "response" else 0 * unit)
        kappa = reach.inflation(reach.rational(norms.S[k]) @ exact_T)
        return cls(Step(g), curvature, kappa, assumption)

    def from_radius(self, radius: float, _roots: float) -> tuple[StepProof, float]:
        """The proof of one step from `radius`, and the radius it needs next."""
        proof = self.step.reach(reach.inflate(self.inflation, radius))
        added = disturbed(self.assumption, self.curvature, self.inflation, radius)
        return proof, float(Fraction(proof.reach) + added) * UP

    def largest(self, cap: float) -> float:
        """The largest radius up to `cap` at which the form's own condition holds."""
        low, high = 0.0, cap
        radius = cap  # usually there is nothing to search for
        for _ in range(BISECTIONS):
            try:
                disturbed(self.assumption, self.curvature, self.inflation, radius)
            except CertificateRejected as refusal:
                if radius < SMALLEST * cap:
                    raise Infeasible(f"{refusal}; use the form response") from refusal
                high = radius
            else:
                low = radius
            if low == cap:
                break
            radius = (low + high) / 2
        return low


class FunnelStep(Protocol):
    """One step of either kind of model."""

    assumption: DisturbanceAssumption

    def from_radius(self, radius: float, roots: float, /) -> tuple[AnyProof, float]:
        """The proof from `radius`, next rates within `roots`, and the radius it needs next."""

    def largest(self, cap: float) -> float:
        """The largest radius up to `cap` at which the form's own condition holds."""


def _steps(
    model: MeasuredState, policy: TrackingPolicy, norms: Frame, a: DisturbanceAssumption
) -> list[Any]:
    if isinstance(model, TrapezoidalModel):
        return [
            ImplicitFunnelStep.at(model, policy, k, S=norms.S, T=norms.T, A=norms.A, assumption=a)
            for k in range(len(policy))
        ]
    return [_DisturbedStep.at(model, policy, norms, k, a) for k in range(len(policy))]


def _inlet(
    steps: list[FunnelStep], cap: FloatArray, goal: float | None, progress: Progress
) -> tuple[FloatArray, list[AnyProof]]:
    """Backward: at each sample the largest radius whose step fits in the next one."""
    N = len(steps)
    radii, proofs = np.empty(N + 1), []
    radii[N] = cap[N] if goal is None else min(goal, float(cap[N]))
    growth = 1.0
    for k in range(N - 1, -1, -1):
        target = float(radii[k + 1])
        radius = min(target * growth, float(cap[k]))
        roots = ROOTS * (target + steps[k].assumption.widens)
        best: tuple[float, AnyProof] | None = None
        for _ in range(ATTEMPTS):
            proof, needed = steps[k].from_radius(radius, roots)
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
    steps: list[FunnelStep], start: float, roots: FloatArray, progress: Progress
) -> tuple[FloatArray, list[AnyProof]]:
    """Forward: what each step needs is the next radius."""
    radii, proofs = [start], []
    for k, step in enumerate(steps):
        proof, needed = step.from_radius(radii[-1], float(roots[k + 1]))
        radii.append(needed)
        proofs.append(proof)
        progress("tube", (k + 1) / len(steps))
    return np.array(radii), proofs


def _gain(norms: Frame, rate: float) -> float:
    """c of E⁺ = rate·E + c|d|², with half of what the linear part leaves kept for curvature."""
    linear = max(
        float(np.linalg.norm(S @ A @ T, 2))
        for S, A, T in zip(norms.S[1:], norms.A, norms.T[:-1], strict=True)
    )
    mu = (linear + np.sqrt(rate)) / 2
    if linear >= np.sqrt(rate):
        raise Infeasible(
            f"the loop shrinks deviations by {linear:.4g} a sample; a rate of {rate:g} forgets "
            f"faster; use one above {linear**2:.4g}"
        )
    return float(rate / (rate - mu**2))


def _room(centre: FloatArray, ranges: FloatArray) -> FloatArray:
    return np.minimum(ranges[:, 1] - centre, centre - ranges[:, 0])
