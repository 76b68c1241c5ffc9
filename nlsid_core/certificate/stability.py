"""Claim: a difference equation forgets its initial conditions, for every input, at a stated rate.

Proof: P ≻ 0 with r²P - A'PA ≻ 0. Two solutions with the same input differ by Δ⁺ = AΔ, so
V(Δ) = Δ'PΔ shrinks by r² or more a sample, and Σ|Δ|² < ∞ (ℓ2-incremental stability).
Source: thesis Definition 2.3 and (2.19).
"""

from collections.abc import Mapping
from fractions import Fraction

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import exact
from nlsid_core.certificate.verdict import Decision
from nlsid_core.errors import CertificateRejected
from nlsid_core.models import DifferenceEquation


def decide(claim: Json, proof: Json, about: Mapping[str, Json]) -> Decision:
    """Decide `{rate}` for the bound model with the proof's `{P}`."""
    if set(about) != {"model"}:
        raise CertificateRejected("an incremental_stability claim is about one file, the model")
    model = DifferenceEquation.from_document(about["model"], source="model")
    n = len(model)
    rate = _json.number(claim, "rate", source="claim")
    refusal = contracts(model, _json.array(proof, "P", (n, n), source="proof"), rate)
    if refusal is not None:
        raise CertificateRejected(refusal)
    return Decision(
        statement=(
            f"incremental stability: solutions with the same input approach each other at "
            f"{rate:.4f} a sample of {model.period:g} s or faster, for every input,"
        ),
        margin=1.0 - rate,
    )


def contracts(model: DifferenceEquation, P: FloatArray, rate: float) -> str | None:
    """None if P ≻ 0 and r²P - A'PA ≻ 0 hold exactly with 0 < r < 1, else what fails."""
    r = Fraction(rate)
    if not 0 < r < 1:
        return f"rate is {rate:g}; stability needs 0 < rate < 1"
    exact_P, A = exact.rational(P.tolist()), state_matrix(model)
    if not exact.is_positive_definite(exact_P):
        return "P is not symmetric positive definite"
    supply = [[r**2 * entry for entry in row] for row in exact_P]
    if not exact.is_positive_definite(
        exact.combine(supply, exact.congruence(A, exact_P), Fraction(-1))
    ):
        return f"V = x'Px does not shrink by the stated rate {rate:.6g} a sample"
    return None


def state_matrix(model: DifferenceEquation) -> exact.Matrix:
    """A of the observer form, exactly: first column a, ones above the diagonal."""
    n = len(model)
    return [
        [Fraction(float(model.a[i])) if j == 0 else Fraction(int(j == i + 1)) for j in range(n)]
        for i in range(n)
    ]


def input_matrix(model: DifferenceEquation) -> exact.Matrix:
    """B of the observer form, exactly: b_i + a_i b_0 (no rounding)."""
    direct = Fraction(float(model.b[0]))
    return [
        [Fraction(float(b)) + Fraction(float(a)) * direct]
        for a, b in zip(model.a, model.b[1:], strict=True)
    ]
