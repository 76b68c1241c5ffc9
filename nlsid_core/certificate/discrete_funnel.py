"""Claim: the funnel of an identified polynomial model holds under its disturbance assumption.

With x̄ = x̂ - x_k and d_k the observer's correction, x̄⁺ = f̄_k(x̄) + d_k exactly. In the norms |S_k ·|:
form `response`: ξ = x̄ - r, r⁺ = A_k r + d_k, |r| ≤ η. Where |ξ| ≤ s_k implies |f̄_k(ξ)| ≤ b_k,
    |ξ⁺| = |f̄_k(ξ + r) - A_k r| ≤ b_k + e_k(s_k, η) ≤ s_{k+1},
so |x̄_k| ≤ s_k + η at every sample. Form `peak`: b_k + η ≤ s_{k+1}, and |x̄_k| ≤ s_k. Forms `energy`
and `fading`: ξ⁺ = f̄_k(ξ) undisturbed, b_k ≤ s_{k+1}; w = x̄ - ξ obeys |w⁺| ≤ μ_k|w| + |d|, hence
|w⁺|² ≤ c/(c-1)·μ_k²|w|² + c|d|² ≤ λ|w|² + c|d|² where c μ_k² ≤ (c-1) λ, so that |w_k|² ≤ E_k ≤ η².
b_k is proved by an identity (`reach.prove_reach`), e_k and μ_k by the coefficients of f̄_k
(`reach.curvature`). Both chains, the tube from its start and the inlet to its goal, stay in the
box of the model's data, policy's inputs included, so the drives never saturate in the funnel.
Source: thesis Section 5.1 in discrete time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import polynomial_data as data
from nlsid_core.certificate import reach
from nlsid_core.certificate.identity import Mode
from nlsid_core.certificate.verdict import Decision
from nlsid_core.discrete_funnel import DiscreteFunnel, DisturbanceAssumption
from nlsid_core.errors import CertificateMismatch, CertificateRejected
from nlsid_core.models.measured_state import MeasuredState
from nlsid_core.models.state_map import StateModel
from nlsid_core.tracking_policy import TrackingPolicy

CHAINS = ("tube", "inlet")


@dataclass(frozen=True, eq=False)
class StepProof:
    """One step of one chain: reach b, Gram matrix Q and multiplier Σ of `reach.prove_reach`."""

    reach: float
    Q: FloatArray
    sigma: FloatArray

    def document(self) -> Json:
        """The JSON form: matrices as lower triangles, row by row."""
        return {
            "reach": self.reach,
            "Q": self.Q[np.tril_indices(len(self.Q))].tolist(),
            "sigma": self.sigma[np.tril_indices(len(self.sigma))].tolist(),
        }


def decide(claim: Json, proof: Json, about: Mapping[str, Json], mode: Mode) -> Decision:
    """Decide the funnel of the bound files."""
    if set(about) != {"model", "policy", "funnel"} or set(claim) != {"kind", "about"}:
        raise CertificateRejected("a discrete_funnel claim is about a model, a policy and a funnel")
    model = StateModel.from_document(about["model"], source="model")
    policy = TrackingPolicy.from_document(about["policy"], source="policy")
    funnel = DiscreteFunnel.from_document(about["funnel"], source="funnel")
    refuse_strangers(about, policy, funnel)
    refuse_misfits(model, policy, funnel)
    if funnel.roots is not None:
        raise CertificateRejected("an explicit model has no roots to bound")
    T, steps = _read_steps(proof, model, funnel)
    margin = prove_chains(model, policy, funnel, T, steps, mode=mode)
    return statement(model, funnel, margin)


def refuse_misfits(model: MeasuredState, policy: TrackingPolicy, funnel: DiscreteFunnel) -> None:
    """Refuse parts of different sizes, and an assumption that is none."""
    if policy.x.shape[1] != len(model) or policy.u.shape[1] != len(model.u):
        raise CertificateRejected("the policy has another number of states or inputs")
    if funnel.S.shape[1] != len(model) or len(funnel) != len(policy):
        raise CertificateRejected("the funnel has another number of states or steps")
    if policy.period != model.period:
        raise CertificateRejected("the policy has another sample time than the model")
    refuse_assumption(model, funnel.assumption)


def refuse_T(T: FloatArray) -> None:
    """Refuse a T that is not triangular and invertible."""
    if (np.tril(T, -1) != 0).any() or (np.diagonal(T, axis1=1, axis2=2) == 0).any():
        raise CertificateRejected("T should be upper triangular with a nonzero diagonal")


def prove_chains(
    model: StateModel,
    policy: TrackingPolicy,
    funnel: DiscreteFunnel,
    T: FloatArray,
    steps: Mapping[str, Sequence[StepProof]],
    *,
    mode: Mode = "exact",
) -> float:
    """Prove both chains on plain numbers; the least margin of a Gram matrix. Raises on refusal."""
    refuse_T(T)
    reach.refuse_size(model)
    margins = []
    form = funnel.assumption.form
    for k in range(len(funnel) + 1):
        refuse_box(model, policy, funnel, k)
    for k in range(len(funnel)):
        g = reach.closed_loop(
            model,
            x=policy.x[k],
            u=policy.u[k],
            K=policy.K[k],
            x_next=policy.x[k + 1],
            T=T[k],
            S_next=funnel.S[k + 1],
        )
        exact_T, exact_S = reach.rational(T[k]), reach.rational(funnel.S[k])
        kappa = reach.inflation(exact_S @ exact_T)
        unit = reach.rational(funnel.S[k + 1]) @ reach.rational(funnel.A[k]) @ exact_T
        curvature = (
            {} if form == "peak" else reach.curvature(g, unit if form == "response" else 0 * unit)
        )
        for chain, radii in zip(CHAINS, (funnel.tube, funnel.inlet), strict=True):
            step = steps[chain][k]
            try:
                radius = float(radii[k])
                inflated = reach.inflate(kappa, radius)
                margin = reach.prove_reach(
                    g, radius, inflated, step.reach, step.Q, step.sigma, mode=mode
                )
            except CertificateRejected as refusal:
                raise type(refusal)(f"{chain}, step {k}: {refusal}") from refusal
            margins.append(margin)
            added = disturbed(funnel.assumption, curvature, kappa, float(radii[k]))
            if step.reach < 0 or Fraction(step.reach) + added > Fraction(float(radii[k + 1])):
                raise CertificateRejected(
                    f"{chain}, step {k}: reach {step.reach:.6g} and disturbance {float(added):.3g} "
                    f"exceed the next radius {radii[k + 1]:.6g}"
                )
    return min(margins)


def disturbed(
    a: DisturbanceAssumption,
    curvature: Mapping[tuple[int, int], Fraction],
    kappa: Fraction,
    radius: float,
) -> Fraction:
    """What the disturbance adds to one step's reach from `radius`.

    Raises CertificateRejected if deviations do not shrink as `energy` and `fading` need.
    """
    if a.form == "peak":
        return Fraction(a.bound)
    if a.form == "response":
        return reach.response_error(curvature, kappa, radius, a.bound)
    mu, c = reach.stretch(curvature, kappa, radius, a.bound), Fraction(a.gain)
    if c * mu**2 > (c - 1) * Fraction(a.rate):
        raise CertificateRejected(
            f"deviations shrink by {float(mu):.6g} a step at radius {radius:.4g}, too little for "
            f"rate {a.rate:g} and gain {a.gain:g}"
        )
    return Fraction(0)


def refuse_assumption(model: MeasuredState, a: DisturbanceAssumption) -> None:
    """Refuse a bound smaller than what was measured, or measured on the data of the fit."""
    if not a.measured_on:
        raise CertificateRejected("the assumption was measured on no commissioning run")
    fitted = {digest: name for name, digest in model.bags}
    for name, digest in a.measured_on:
        if not digest or digest in fitted:
            raise CertificateRejected(
                f"commissioning run {name} is a recording the model was fitted on: its disturbance "
                "is too small; record the policy running"
            )
    if not 0 < a.rate <= 1 or (a.form == "energy" and a.rate != 1) or a.gain < 1:
        raise CertificateRejected(f"rate {a.rate:g} or gain {a.gain:g} is none of form {a.form}")
    if a.safety_factor < 1 or a.measured < 0:
        raise CertificateRejected(f"safety factor {a.safety_factor:g}, measured {a.measured:g}")
    if Fraction(a.bound) < Fraction(a.safety_factor) * Fraction(a.measured):
        raise CertificateRejected(
            f"assumed bound {a.bound:.9g} is below safety_factor x measured = "
            f"{a.safety_factor * a.measured:.9g}"
        )


def refuse_box(
    model: MeasuredState, policy: TrackingPolicy, funnel: DiscreteFunnel, k: int
) -> None:
    """Both chains within the box of the data at sample k, the policy's inputs included."""
    S = reach.rational(funnel.S[k])
    largest = max(Fraction(float(r[k])) for r in (funnel.tube, funnel.inlet))
    radius = largest + Fraction(funnel.margin)
    rows = [
        (unit, policy.x[k, i], model.x_range[i], model.x[i].name)
        for i, unit in enumerate(np.eye(len(model)))
    ]
    if k < len(policy):
        rows += [
            (policy.K[k, j], policy.u[k, j], model.u_range[j], model.u[j].name)
            for j in range(len(model.u))
        ]
    for row, centre, (lo, hi), name in rows:
        room = min(
            Fraction(float(hi)) - Fraction(float(centre)),
            Fraction(float(centre)) - Fraction(float(lo)),
        )
        if room < 0 or reach.reach_squared(S, reach.rational(row)) * radius**2 > room**2:
            raise CertificateRejected(
                f"at sample {k}, {name} can leave [{lo:g}, {hi:g}], the box of the model's data"
            )


def refuse_strangers(
    about: Mapping[str, Json], policy: TrackingPolicy, funnel: DiscreteFunnel
) -> None:
    """Refuse a policy or funnel that names another model or policy than the bound one."""
    digests = {role: _json.digest(content) for role, content in about.items()}
    for owner, role, stated in (
        ("policy", "model", policy.model),
        ("funnel", "model", funnel.model),
        ("funnel", "policy", funnel.policy),
    ):
        if stated != digests[role]:
            raise CertificateMismatch(f"the {owner} was made for another {role}: {stated[:23]}...")


def _read_steps(
    proof: Json, model: StateModel, funnel: DiscreteFunnel
) -> tuple[FloatArray, dict[str, list[StepProof]]]:
    data.only(proof, {"T", *CHAINS}, source="proof")
    n, N = len(model), len(funnel)
    T = _json.array(proof, "T", (N, n, n), source="proof")
    steps: dict[str, list[StepProof]] = {}
    for chain in CHAINS:
        entries = _json.member(proof, chain, list, source="proof")
        if len(entries) != N or not all(isinstance(entry, dict) for entry in entries):
            raise CertificateRejected(f"proof: '{chain}' should have {N} steps")
        steps[chain] = []
        for k, entry in enumerate(entries):
            source = f"proof {chain} {k}"
            data.only(entry, {"reach", "Q", "sigma"}, source=source)
            steps[chain].append(
                StepProof(
                    reach=_json.number(entry, "reach", source=source),
                    Q=_symmetric(entry, "Q", source),
                    sigma=_symmetric(entry, "sigma", source),
                )
            )
    return T, steps


def _symmetric(entry: Json, key: str, source: str) -> FloatArray:
    """A symmetric matrix from its lower triangle, row by row."""
    packed = _json.array(entry, key, (None,), source=source)
    n = int((np.sqrt(8 * len(packed) + 1) - 1) / 2 + 0.5)
    if n * (n + 1) // 2 != len(packed) or not n:
        raise CertificateRejected(f"{source}: {key} is not a triangle")
    matrix = np.zeros((n, n))
    matrix[np.tril_indices(n)] = packed
    return np.asarray(matrix + np.tril(matrix, -1).T)


def statement(model: MeasuredState, funnel: DiscreteFunnel, margin: float) -> Decision:
    """The claim in words, from the numbers that were checked."""
    a, N = funnel.assumption, len(funnel)
    widths = ", ".join(
        f"{signal.name} {width:.3g} {signal.unit}".rstrip()
        for signal, width in zip(model.x, funnel.half_widths[-1], strict=True)
    )
    letter = {"response": "|r|", "peak": "|d|"}.get(a.form, "sqrt(E)")
    return Decision(
        statement=(
            f"funnel: from its inlet the state estimate stays in the tube for "
            f"{N * model.period:g} s and ends within {widths} of the nominal,"
        ),
        margin=margin,
        assumptions=(
            f"disturbance {a.form} {letter} <= {a.bound:.4g} at every sample (largest of "
            f"{len(a.measured_on)} commissioning runs {a.measured:.4g}, safety factor "
            f"{a.safety_factor:g})",
        ),
    )
