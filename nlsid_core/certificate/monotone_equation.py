"""Claim: a monotone equation is well posed and forgets its initial conditions at a stated rate.

Two solutions with the same input differ by Δ = (ȳ - ȳ')(t-1 … t-n), d = ȳ(t) - ȳ'(t); with their
sum s = ȳ(t) + ȳ'(t), V(Δ) = Δ'PΔ and Δ⁺ = [d; Δ_1 … Δ_{n-1}],
    2d(e(ȳ) - e(ȳ') - Σ a_k Δ_k) + r²V(Δ) - V(Δ⁺) = [Δ; d; sd]' G [Δ; d; sd] + ½ e₃ d⁴.
The bracket on the left is zero along solutions; with G ≻ 0 and e₃ ≥ 0, V shrinks by r² a sample.
If e is linear, sd is left out.
Source: thesis Lemma 2.10 and (3.8), δ|Δ|² replaced by (1 - r²)V.
"""

from collections.abc import Mapping
from fractions import Fraction

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import exact
from nlsid_core.certificate.verdict import Decision
from nlsid_core.errors import CertificateRejected
from nlsid_core.models import MonotoneEquation

MAX_LAGS = 100  # beyond it deciding takes minutes


def decide(claim: Json, proof: Json, about: Mapping[str, Json]) -> Decision:
    """Decide `{rate}` for the bound model with the proof's `{P}`."""
    if set(about) != {"model"} or set(claim) != {"kind", "about", "rate"} or set(proof) != {"P"}:
        raise CertificateRejected(
            "a monotone_equation_stability claim states a rate about one file, the model; its "
            "proof is P"
        )
    model = MonotoneEquation.from_document(about["model"], source="model")
    n = len(model)
    rate = _json.number(claim, "rate", source="claim")
    refusal = contracts(model, _json.array(proof, "P", (n, n), source="proof"), rate)
    if refusal is not None:
        raise CertificateRejected(refusal)
    return Decision(
        statement=(
            f"incremental stability: the next output is unique, and solutions with the same input "
            f"approach each other at {rate:.4f} a sample of {model.period:g} s or faster, for "
            "every input,"
        ),
        margin=1.0 - rate,
    )


def contracts(model: MonotoneEquation, P: FloatArray, rate: float) -> str | None:
    """None if the claim holds exactly, else what fails."""
    r = Fraction(rate)
    if not 0 < r < 1:
        return f"rate is {rate:g}; stability needs 0 < rate < 1"
    if len(model) > MAX_LAGS:
        return f"{len(model)} lags; this checker decides {MAX_LAGS}"
    if model.e[2] < 0:
        return "the cubic coefficient of e is negative"
    storage = exact.rational(P.tolist())
    if not exact.is_positive_definite(storage):
        return "P is not symmetric positive definite"
    if not exact.is_positive_definite(dissipation(model, storage, r)):
        return f"V = x'Px does not shrink by the stated rate {rate:.6g} a sample"
    return None


def dissipation(model: MonotoneEquation, P: exact.Matrix, rate: Fraction) -> exact.Matrix:
    """G in [Δ; d; sd], or in [Δ; d] if e is linear."""
    n = len(model)
    first, second, third = (Fraction(float(entry)) for entry in model.e)
    size = n + 1 if second == third == 0 else n + 2
    G = [[Fraction(0)] * size for _ in range(size)]
    place = [n, *range(n - 1)]  # Δ⁺ = [d; Δ_1 … Δ_{n-1}]
    for k in range(n):
        for j in range(n):
            G[k][j] += rate**2 * P[k][j]
            G[place[k]][place[j]] -= P[k][j]
        G[k][n] -= Fraction(float(model.a[k]))
        G[n][k] -= Fraction(float(model.a[k]))
    G[n][n] += 2 * first
    if size == n + 2:
        G[n][n + 1] = G[n + 1][n] = second
        G[n + 1][n + 1] = 3 * third / 2
    return G
