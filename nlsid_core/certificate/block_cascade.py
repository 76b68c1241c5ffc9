"""Claim: a block cascade forgets its initial conditions, for every input, at a stated rate.

Two solutions with the same input differ by (Δ₁, Δ₂), the filters' states. f is linear beyond its
knots and every slope of it is a convex combination of (c_{j+1} - c_j)/spacing, so
    Δ₁⁺ = A₁ Δ₁,   Δ₂⁺ = A₂ Δ₂ + Σ_j s_j g_j C_j Δ₁,   s_j in [lower, upper] of these slopes.
Proof, with V = Δ₁'P₁Δ₁ + weight·Δ₂'P₂Δ₂:
  1. both denominators have all roots inside the unit circle (Schur-Cohn recursion);
  2. P₁, P₂ ≻ 0, weight > 0; r²P - A(s)'PA(s) ≻ 0 at the 2^M vertices of s, hence in between: it is
     concave in s. V shrinks by r² or more a sample.
Source: thesis Definition 2.3; Schur 1917, Cohn 1922 for the recursion.
"""

from collections.abc import Mapping
from fractions import Fraction
from itertools import pairwise, product

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import exact
from nlsid_core.certificate.verdict import Decision
from nlsid_core.errors import CertificateRejected
from nlsid_core.models import BlockCascade, Spline

MAX_STATES = 60  # of both filters: beyond it deciding 2^M matrices takes minutes


def decide(claim: Json, proof: Json, about: Mapping[str, Json]) -> Decision:
    """Decide `{rate}` for the bound model with `{P1, P2, weight, slopes}`."""
    if set(about) != {"model"} or set(claim) != {"kind", "about", "rate"}:
        raise CertificateRejected("a block_cascade_stability claim is about one file, the model")
    if set(proof) != {"P1", "P2", "weight", "slopes"}:
        raise CertificateRejected("a block_cascade_stability proof is P1, P2, weight and slopes")
    model = BlockCascade.from_document(about["model"], source="model")
    rate = _json.number(claim, "rate", source="claim")
    n1, n2 = states(model)
    lower, upper = map(float, _json.array(proof, "slopes", (2,), source="proof"))
    refusal = contracts(
        model,
        rate,
        P=(
            _json.array(proof, "P1", (n1, n1), source="proof"),
            _json.array(proof, "P2", (n2, n2), source="proof"),
        ),
        weight=_json.number(proof, "weight", source="proof"),
        slopes=(lower, upper),
    )
    if refusal is not None:
        raise CertificateRejected(refusal)
    return Decision(
        statement=(
            f"incremental stability: solutions with the same input approach each other at "
            f"{rate:.4f} a sample of {model.period:g} s or faster, for every input (slopes of the "
            f"nonlinearity are in [{lower:.4g}, {upper:.4g}] everywhere),"
        ),
        margin=1.0 - rate,
    )


def contracts(
    model: BlockCascade,
    rate: float,
    *,
    P: tuple[FloatArray, FloatArray],
    weight: float,
    slopes: tuple[float, float],
) -> str | None:
    """None if the claim holds exactly, else what fails."""
    r = Fraction(rate)
    if not 0 < r < 1:
        return f"rate is {rate:g}; stability needs 0 < rate < 1"
    if sum(states(model)) > MAX_STATES:
        return f"the filters have {sum(states(model))} states; this proof is for {MAX_STATES}"
    for a, name in ((model.a1, "first"), (model.a2, "second")):
        if not is_schur(a):
            return f"a pole of the {name} filter is not inside the unit circle"
    least, most = slope_range(model.f)
    lower, upper = map(Fraction, slopes)
    if not lower <= least <= most <= upper:
        return (
            f"slopes of the nonlinearity reach from {float(least):.6g} to {float(most):.6g}, the "
            f"proof says {slopes[0]:.6g} to {slopes[1]:.6g}"
        )
    P1, P2 = (exact.rational(block.tolist()) for block in P)
    if not exact.is_positive_definite(P1) or not exact.is_positive_definite(P2):
        return "P1 or P2 is not symmetric positive definite"
    if weight <= 0:
        return f"weight is {weight:g}; it should be positive"
    storage = _block_diagonal(P1, [[Fraction(weight) * entry for entry in row] for row in P2])
    supply = [[r**2 * entry for entry in row] for row in storage]
    for s in product(sorted({lower, upper}), repeat=model.phases):
        A = state_matrix(model, s)
        decrease = exact.combine(supply, exact.congruence(A, storage), Fraction(-1))
        if not exact.is_positive_definite(decrease):
            where = ", ".join(f"{float(slope):.4g}" for slope in s)
            return f"V does not shrink by the stated rate {rate:.6g} a sample at slopes {where}"
    return None


def is_schur(a: FloatArray) -> bool:
    """True if all roots of zⁿ - a[0] zⁿ⁻¹ - … - a[n-1] are inside the unit circle, exactly.

    Schur-Cohn: p is so if, and only if, |p₀| < |p_n| and (p - (p₀/p_n) p*)/z is so, p* reversed.
    """
    p = [Fraction(1), *(-Fraction(float(entry)) for entry in a)]  # highest power first
    while len(p) > 1:
        k = p[-1] / p[0]
        if abs(k) >= 1:
            return False
        p = [entry - k * mirrored for entry, mirrored in zip(p, reversed(p), strict=True)][:-1]
    return True


def slope_range(f: Spline) -> tuple[Fraction, Fraction]:
    """The least and greatest (c_{j+1} - c_j)/spacing: no slope of f is outside."""
    c, h = [Fraction(float(entry)) for entry in f.coefficients], Fraction(f.spacing)
    slopes = [(after - before) / h for before, after in pairwise(c)]
    return min(slopes), max(slopes)


def states(model: BlockCascade) -> tuple[int, int]:
    """How many past v the first filter holds, and the order of the second."""
    n1 = max(len(model.a1), model.b1.shape[1] - 1)
    return n1, max(len(model.a2), model.b2.shape[1] - 1)


def state_matrix(model: BlockCascade, slopes: tuple[Fraction, ...]) -> exact.Matrix:
    """A(s) of [v(t-1) … v(t-n₁); observer form of the second filter], exactly."""
    n1, n2 = states(model)
    a1, a2 = _padded(model.a1, n1), _padded(model.a2, n2)
    A = [[Fraction(0)] * (n1 + n2) for _ in range(n1 + n2)]
    for k in range(n1):
        A[0][k] = a1[k]
        if k:
            A[k][k - 1] = Fraction(1)
    for i in range(n2):
        A[n1 + i][n1] = a2[i]
        if i:
            A[n1 + i - 1][n1 + i] = Fraction(1)
    for s, first, second in zip(slopes, model.b1, model.b2, strict=True):
        # x = b1[0] v(t) + …, v(t) = u + a1·past: C = b1[0] a1 + b1[1:]; the same way for g.
        direct1, direct2 = Fraction(float(first[0])), Fraction(float(second[0]))
        C = [direct1 * a + b for a, b in zip(a1, _padded(first[1:], n1), strict=True)]
        g = [direct2 * a + b for a, b in zip(a2, _padded(second[1:], n2), strict=True)]
        for i in range(n2):
            for k in range(n1):
                A[n1 + i][k] += s * g[i] * C[k]
    return A


def _padded(values: FloatArray, size: int) -> list[Fraction]:
    exact_values = [Fraction(float(value)) for value in values]
    return exact_values + [Fraction(0)] * (size - len(exact_values))


def _block_diagonal(P: exact.Matrix, Q: exact.Matrix) -> exact.Matrix:
    zero = Fraction(0)
    return [[*row, *[zero] * len(Q)] for row in P] + [[*[zero] * len(P), *row] for row in Q]
