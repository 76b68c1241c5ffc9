"""Claim: a block cascade forgets its initial conditions, for every input, at a stated rate.

Two solutions with the same input differ by d = [d₁; d₂],
    d₁⁺ = A₁d₁,   d₂⁺ = A₂d₂ + Σ_j β_j s_j C_j d₁,
where s_j is a mean slope of the spline between the two intermediate signals: a convex combination
of the slopes (c_{i+1} - c_i)/step. The matrix is affine in s, so
    r²P - A(s)'PA(s) ≻ 0 at every vertex of [least slope, largest slope]^M
proves V = d'Pd shrinks by r² a sample (it is concave in s). P ≻ 0 with r < 1 also proves that both
denominators are stable (the blocks of A(s) on the diagonal).
Source: thesis Definition 2.3; composition of Section 2.4's storage functions.
"""

from collections.abc import Mapping
from fractions import Fraction
from itertools import pairwise, product

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import exact
from nlsid_core.certificate.verdict import Decision
from nlsid_core.errors import CertificateRejected
from nlsid_core.models.block_cascade import BlockCascade

MAX_PHASES = 6  # 2^M vertices


def decide(claim: Json, proof: Json, about: Mapping[str, Json]) -> Decision:
    """Decide `{rate}` for the bound model with the proof's `{P}`."""
    if set(about) != {"model"} or set(claim) != {"kind", "about", "rate"}:
        raise CertificateRejected("a cascade_stability claim is about one file, the model")
    model = BlockCascade.from_document(about["model"], source="model")
    rate = _json.number(claim, "rate", source="claim")
    n = len(model.A1) + len(model.A2)
    refusal = contracts(model, _json.array(proof, "P", (n, n), source="proof"), rate)
    if refusal is not None:
        raise CertificateRejected(refusal)
    low, high = slope_range(model)
    return Decision(
        statement=(
            f"incremental stability: solutions with the same input approach each other at "
            f"{rate:.4f} a sample of {model.period:g} s or faster, for every input (slopes of the "
            f"nonlinearity between {float(low):.4g} and {float(high):.4g}),"
        ),
        margin=1.0 - rate,
    )


def contracts(model: BlockCascade, P: FloatArray, rate: float) -> str | None:
    """None if P ≻ 0 and r²P - A(s)'PA(s) ≻ 0 at every vertex hold exactly, else what fails."""
    r = Fraction(rate)
    if not 0 < r < 1:
        return f"rate is {rate:g}; stability needs 0 < rate < 1"
    if model.phases > MAX_PHASES:
        return f"{model.phases} phases; at most {MAX_PHASES} are decided"
    storage = exact.rational(P.tolist())
    if not exact.is_positive_definite(storage):
        return "P is not symmetric positive definite"
    supply = [[r**2 * entry for entry in row] for row in storage]
    for slopes in product(slope_range(model), repeat=model.phases):
        A = state_matrix(model, slopes)
        decrease = exact.combine(supply, exact.congruence(A, storage), Fraction(-1))
        if not exact.is_positive_definite(decrease):
            vertex = ", ".join(f"{float(s):.4g}" for s in slopes)
            return f"V = x'Px does not shrink by the stated rate {rate:.6g} at slopes {vertex}"
    return None


def slope_range(model: BlockCascade) -> tuple[Fraction, Fraction]:
    """Exact least and largest slope of the spline's control polygon."""
    c, step = [Fraction(float(v)) for v in model.f.c], Fraction(model.f.step)
    slopes = [(after - before) / step for before, after in pairwise(c)]
    return min(slopes), max(slopes)


def state_matrix(model: BlockCascade, slopes: tuple[Fraction, ...]) -> exact.Matrix:
    """A(s), exactly: d₁ = lags of u/A1, d₂ = observer form of the second filter."""
    a1, a2 = ([Fraction(float(v)) for v in A] for A in (model.A1, model.A2))
    n1, n2 = len(a1), len(a2)
    A = [[Fraction(0)] * (n1 + n2) for _ in range(n1 + n2)]
    for k in range(n1):
        A[0][k] = -a1[k]
    for i in range(1, n1):
        A[i][i - 1] = Fraction(1)
    for i in range(n2):
        A[n1 + i][n1] -= a2[i]
        if i + 1 < n2:
            A[n1 + i][n1 + i + 1] += 1
    for slope, B1, B2 in zip(slopes, model.B1, model.B2, strict=True):
        b1, b2 = ([Fraction(float(v)) for v in B] for B in (B1, B2))
        for i in range(n2):
            entry = slope * (b2[i + 1] - a2[i] * b2[0])
            for k in range(n1):
                A[n1 + i][k] += entry * (b1[k + 1] - b1[0] * a1[k])
    return A
