"""Claim: the tube of a funnel file holds for its model and policy under its energy assumption.

With x̄ = x̂ - x_k and the innovation e, the observer gives x̄⁺ = (A - κBK) x̄ + L e, where κ = 0
while the nominal inputs are played and κ = 1 while the policy drives. The proved inequality is
V(x̄⁺) ≤ V(x̄) + e², V = x̄'Px̄, as
    diag(P, 1) - [A - κBK, L]' P [A - κBK, L] ≻ 0   for κ = 0 and κ = 1,
hence for every κ in between (it is convex in κ), at every sample, around every trajectory of
the model. Summed: V(x̄_k) + e_k² ≤ V(x̄_0) + Σ e² ≤ inlet + budget ≤ level.
The stored nominal obeys the model up to rounding; what is left is bounded and added, exactly. The
output is within the stated half-width: y - y_k = (C - κDK)x̄ + e.
Source: thesis Section 5.1 in discrete time; energy form of a disturbance bound.
"""

from collections.abc import Mapping
from fractions import Fraction

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import exact
from nlsid_core.certificate.stability import input_matrix, state_matrix
from nlsid_core.certificate.verdict import Decision
from nlsid_core.errors import CertificateMismatch, CertificateRejected
from nlsid_core.funnel import Funnel
from nlsid_core.models import DifferenceEquation
from nlsid_core.policy import Policy


def decide(claim: Json, proof: Json, about: Mapping[str, Json]) -> Decision:
    """Decide the tube of the bound funnel; the proof states the `slack` by which V decreases."""
    if set(about) != {"model", "policy", "funnel"} or set(claim) != {"kind", "about"}:
        raise CertificateRejected("an energy_tube claim is about a model, a policy and a funnel")
    model = DifferenceEquation.from_document(about["model"], source="model")
    policy = Policy.from_document(about["policy"], source="policy")
    funnel = Funnel.from_document(about["funnel"], source="funnel")
    _refuse_strangers(about, policy, funnel)
    n = len(model)
    if len(policy.K) != n or funnel.P.shape != (n, n) or policy.period != model.period:
        raise CertificateRejected("model, policy and funnel differ in size or sample time")
    slack = _json.number(proof, "slack", source="proof")
    refusal = dissipates(model, policy.K, policy.L, funnel.P, slack)
    if refusal is not None:
        raise CertificateRejected(refusal)
    _refuse_level(model, policy, funnel)
    _refuse_half_width(model, policy, funnel)
    return _statement(model, policy, funnel, slack)


def dissipates(
    model: DifferenceEquation, K: FloatArray, L: FloatArray, P: FloatArray, slack: float
) -> str | None:
    """None if P ≻ 0 and V(x̄⁺) ≤ (1 - slack)(V(x̄) + e²) hold exactly, else what fails."""
    if not 0 < slack < 1:
        return f"slack is {slack:g}; it should be between 0 and 1"
    exact_P = exact.rational(P.tolist())
    if not exact.is_positive_definite(exact_P):
        return "P is not symmetric positive definite"
    A, B = state_matrix(model), input_matrix(model)
    gain, observer = exact.rational([K.tolist()]), exact.rational([[v] for v in L.tolist()])
    for engaged in (0, 1):
        closed = exact.combine(A, exact.product(B, gain), Fraction(-engaged))
        if not exact.is_positive_definite(_dissipation(closed, observer, exact_P, Fraction(slack))):
            mode = "with the policy engaged" if engaged else "with the nominal inputs played"
            return f"V grows by more than e² {mode}"
    return None


def _dissipation(
    closed: exact.Matrix, L: exact.Matrix, P: exact.Matrix, slack: Fraction
) -> exact.Matrix:
    """(1 - slack)·diag(P, 1) - [closed, L]'P[closed, L]."""
    n = len(P)
    F = [row + gain for row, gain in zip(closed, L, strict=True)]
    supply = [[*row, Fraction(0)] for row in P] + [[Fraction(0)] * n + [Fraction(1)]]
    scaled = [[(1 - slack) * entry for entry in row] for row in supply]
    return exact.combine(scaled, exact.congruence(F, P), Fraction(-1))


def _refuse_strangers(about: Mapping[str, Json], policy: Policy, funnel: Funnel) -> None:
    digests = {role: _json.digest(content) for role, content in about.items()}
    for owner, role, stated in (
        ("policy", "model", policy.model),
        ("funnel", "model", funnel.model),
        ("funnel", "policy", funnel.policy),
    ):
        if stated != digests[role]:
            raise CertificateMismatch(f"the {owner} was made for another {role}: {stated[:23]}...")


def _refuse_level(model: DifferenceEquation, policy: Policy, funnel: Funnel) -> None:
    """√level ≥ √(inlet + budget) + Σ_k |δ_k|_P, δ_k the nominal's departure from the model.

    (Σ|δ_k|_P)² ≤ N Σ|δ_k|²_P =: q by Cauchy-Schwarz, and √level ≥ √s + √q is decided without
    roots: level - s - q ≥ 0 and (level - s - q)² ≥ 4 s q.
    """
    assumption = funnel.assumption
    if not 0 < assumption.samples <= len(policy):
        raise CertificateRejected(
            f"the assumption covers {assumption.samples} samples, the nominal {len(policy)}"
        )
    if assumption.budget < 0 or funnel.inlet < 0:
        raise CertificateRejected("budget and inlet should not be negative")
    stated = assumption.safety_factor**2 * assumption.measured
    if assumption.safety_factor < 1 or assumption.measured < 0 or assumption.budget < stated:
        raise CertificateRejected(
            f"budget {assumption.budget:.9g} is below safety_factor² x measured = {stated:.9g}"
        )
    A, B, P = state_matrix(model), input_matrix(model), exact.rational(funnel.P.tolist())
    c = Fraction(float(model.c))
    offset = [Fraction(float(a)) * c for a in model.a]
    defect_energy = Fraction(0)
    states, inputs = exact.rational(policy.x.tolist()), [Fraction(float(u)) for u in policy.u]
    for k in range(len(policy) - 1):
        predicted = [
            sum((A[i][j] * states[k][j] for j in range(len(A))), Fraction(0))
            + B[i][0] * inputs[k]
            + offset[i]
            for i in range(len(A))
        ]
        delta = [[p - x] for p, x in zip(predicted, states[k + 1], strict=True)]
        defect_energy += exact.congruence(delta, P)[0][0]
    q = len(policy) * defect_energy
    s = Fraction(funnel.inlet) + Fraction(assumption.budget)
    room = Fraction(funnel.level) - s - q
    if room < 0 or room**2 < 4 * s * q:
        raise CertificateRejected(
            f"level {funnel.level:.9g} is below inlet + budget {float(s):.9g} "
            f"plus the nominal's departure from the model {float(q) ** 0.5:.3g}"
        )


def _refuse_half_width(model: DifferenceEquation, policy: Policy, funnel: Funnel) -> None:
    """y - y_k = cx̄ + e with c = C - κDK: |cx̄ + e|² ≤ level (1 + cP⁻¹c') ≤ half_width².

    Decided as [[P, c'], [c, half_width²/level - 1]] ≻ 0 for κ = 0 and 1 (convex in between).
    """
    P = exact.rational(funnel.P.tolist())
    room = Fraction(funnel.half_width) ** 2 / Fraction(funnel.level) - 1
    direct = Fraction(float(model.b[0]))
    for engaged in (0, 1):
        c = [-engaged * direct * Fraction(float(k)) for k in policy.K]
        c[0] += 1
        bordered = [[*row, entry] for row, entry in zip(P, c, strict=True)] + [[*c, room]]
        if not exact.is_positive_definite(bordered):
            raise CertificateRejected(
                f"the output can leave the stated half-width {funnel.half_width:g}"
            )


def _statement(model: DifferenceEquation, policy: Policy, funnel: Funnel, slack: float) -> Decision:
    a = funnel.assumption
    unit = model.y.unit
    modes = "policy engaged or not" if policy.K.any() else "prediction tube, no feedback"
    return Decision(
        statement=(
            f"tube: {model.y.name} stays within {funnel.half_width:g} {unit} of every "
            f"trajectory of the model for {a.samples * model.period:g} s ({modes})"
        ),
        margin=slack,
        assumptions=(
            f"innovation energy sum e^2 <= {a.budget:.4g} ({unit})^2 over {a.samples} samples "
            f"(largest of {len(a.measured_on)} recorded trials {a.measured:.4g}, safety factor "
            f"{a.safety_factor:g} in amplitude)",
        ),
    )
