"""Claim: a difference equation forgets its initial conditions, for every input, at a stated rate.

Proof: P ≻ 0 with r²P - A'PA ≻ 0. Two solutions with the same input differ by Δ⁺ = AΔ, so
V(Δ) = Δ'PΔ shrinks by r² or more a sample, and Σ|Δ|² < ∞ (ℓ2-incremental stability).
Source: thesis Definition 2.3 and (2.19).
"""

from collections.abc import Mapping
from fractions import Fraction

from nlsid_core import _json
from nlsid_core._types import Json
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
    rate = Fraction(_json.number(claim, "rate", source="claim"))
    if not 0 < rate < 1:
        raise CertificateRejected(f"rate is {float(rate):g}; stability needs 0 < rate < 1")
    P = exact.rational(_json.array(proof, "P", (n, n), source="proof").tolist())
    A = state_matrix(model)
    if not exact.is_positive_definite(P):
        raise CertificateRejected("P is not symmetric positive definite")
    decrease = exact.combine(
        [[rate**2 * p for p in row] for row in P], exact.congruence(A, P), Fraction(-1)
    )
    if not exact.is_positive_definite(decrease):
        raise CertificateRejected(
            f"V does not shrink by the stated rate {float(rate):.6g} a sample"
        )
    return Decision(
        statement=(
            f"incremental stability: solutions with the same input approach each other at "
            f"{float(rate):.4f} a sample of {model.period:g} s or faster, for every input,"
        ),
        margin=float(1 - rate),
    )


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
