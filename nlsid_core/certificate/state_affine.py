"""Claim: a state-affine model forgets its initial conditions, for every input, at a stated rate.

For one output, constant G_1 … G_n and quadratic q = G_0 on the box of clipped inputs:
  1. q(w) - ℓ - Σ a_i (w_i - lo_i)(hi_i - w_i) and h - q(w) - Σ b_i (w_i - lo_i)(hi_i - w_i) are
     nonnegative quadratics (their matrices are positive definite), a, b ≥ 0: hence ℓ ≤ q ≤ h.
  2. x⁺ = A(1/q) x with A(s) = S - s e₁[G_1 … G_n]; r²P - A(s)'PA(s) ≻ 0 at s = 1/ℓ and s = 1/h,
     hence for every s between: it is concave in s.
Two solutions with the same input differ by Δ⁺ = A(1/q(w))Δ, so V = Δ'PΔ shrinks by r² a sample.
Where G_0 … G_n are all constant, of one output or of several, P alone proves it, with A of the
block row -G_0⁻¹[G_1 … G_n].
Source: thesis Definition 2.3, (4.1); S-procedure for the box.
"""

from collections.abc import Mapping
from fractions import Fraction

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import exact, state_affine_matrix
from nlsid_core.certificate.state_affine_matrix import Box, window_box
from nlsid_core.certificate.verdict import Decision
from nlsid_core.errors import CertificateRejected
from nlsid_core.models.polynomials import Polynomials
from nlsid_core.models.state_affine import StateAffineModel


def decide(claim: Json, proof: Json, about: Mapping[str, Json]) -> Decision:
    """Decide `{rate}` for the bound model: one of three forms of proof.

    `{P}` where every coefficient of an output is constant; `{P, lower, upper, lower_box,
    upper_box}` as above; `{P, T, gram, multipliers}` for any model of the class, as in
    `state_affine_matrix`.
    """
    if set(about) != {"model"} or set(claim) != {"kind", "about", "rate"}:
        raise CertificateRejected("a state_affine_stability claim is about one file, the model")
    model = StateAffineModel.from_document(about["model"], source="model")
    rate = _json.number(claim, "rate", source="claim")
    if "T" in proof:
        state_affine_matrix.decide(model, rate, proof)
    elif set(proof) == {"P"}:
        states = len(model) * len(model.y)
        refusal = contracts_constant(
            model, rate, P=_json.array(proof, "P", (states, states), source="proof")
        )
        if refusal is not None:
            raise CertificateRejected(refusal)
    else:
        _decide_bounds(model, rate, proof)
    inputs = "every input (inputs are clipped to the model's range)"
    if model.on_out_of_range == "refuse":
        inputs = "every input in the model's range (others are refused)"
    return Decision(
        statement=(
            f"incremental stability: solutions with the same input approach each other at "
            f"{rate:.4f} a sample of {model.period:g} s or faster, for {inputs},"
        ),
        margin=1.0 - rate,
    )


def _decide_bounds(model: StateAffineModel, rate: float, proof: Json) -> None:
    n, n_w = len(model), len(model.window)
    refusal = contracts(
        model,
        rate,
        P=_json.array(proof, "P", (n, n), source="proof"),
        bounds=(
            _json.number(proof, "lower", source="proof"),
            _json.number(proof, "upper", source="proof"),
        ),
        multipliers=(
            _json.array(proof, "lower_box", (n_w,), source="proof"),
            _json.array(proof, "upper_box", (n_w,), source="proof"),
        ),
    )
    if refusal is not None:
        raise CertificateRejected(refusal)


def contracts(
    model: StateAffineModel,
    rate: float,
    *,
    P: FloatArray,
    bounds: tuple[float, float],
    multipliers: tuple[FloatArray, FloatArray],
) -> str | None:
    """None if the claim holds exactly, else what fails."""
    r = Fraction(rate)
    if not 0 < r < 1:
        return f"rate is {rate:g}; stability needs 0 < rate < 1"
    if len(model.y) != 1:
        return f"the model has {len(model.y)} outputs; this proof is for one"
    if any(g.exponents.any() for g in model.G[1:]):
        return "coefficients of lagged outputs depend on the input; this proof is for constants"
    lower, upper = map(Fraction, bounds)
    if not 0 < lower <= upper:
        return f"bounds {bounds} of the leading coefficient should be positive and in order"
    box = window_box(model)
    for sign, level, weights, name in (
        (1, lower, multipliers[0], "below"),
        (-1, -upper, multipliers[1], "above"),
    ):
        slack = slack_matrix(model.G[0], sign, level, [Fraction(float(v)) for v in weights], box)
        if min(weights, default=0.0) < 0 or not exact.is_positive_definite(slack):
            return f"the leading coefficient is not proved bounded from {name}"
    storage = exact.rational(P.tolist())
    if not exact.is_positive_definite(storage):
        return "P is not symmetric positive definite"
    supply = [[r**2 * entry for entry in row] for row in storage]
    for level in (lower, upper):
        A = state_matrix(model, 1 / level)
        decrease = exact.combine(supply, exact.congruence(A, storage), Fraction(-1))
        if not exact.is_positive_definite(decrease):
            return f"V = x'Px does not shrink by the stated rate {rate:.6g} at G_0 = {level}"
    return None


def contracts_constant(model: StateAffineModel, rate: float, *, P: FloatArray) -> str | None:
    """None if the claim holds exactly for constant G_0 … G_n of any number of outputs."""
    r = Fraction(rate)
    if not 0 < r < 1:
        return f"rate is {rate:g}; stability needs 0 < rate < 1"
    if any(g.exponents.any() for g in model.G):
        return "coefficients of the outputs depend on the input; this proof is for constants"
    A = block_matrix(model)
    if A is None:
        return "the leading coefficient G_0 is singular"
    storage = exact.rational(P.tolist())
    if not exact.is_positive_definite(storage):
        return "P is not symmetric positive definite"
    supply = [[r**2 * entry for entry in row] for row in storage]
    decrease = exact.combine(supply, exact.congruence(A, storage), Fraction(-1))
    if not exact.is_positive_definite(decrease):
        return f"V = x'Px does not shrink by the stated rate {rate:.6g}"
    return None


def block_matrix(model: StateAffineModel) -> exact.Matrix | None:
    """A of x = [ȳ(t-1); …; ȳ(t-n)] for constant coefficients; None if G_0 is singular.

    Gauss-Jordan elimination on [G_0, G_1 … G_n] without rounding.
    """
    m, n = len(model.y), len(model)
    constants = [
        [[sum(map(Fraction, g.coefficients[:, a, b].tolist()), Fraction(0)) for b in range(m)]
         for a in range(m)]
        for g in model.G
    ]  # fmt: skip
    rows = [[entry for g in constants for entry in g[a]] for a in range(m)]
    for k in range(m):
        pivot = next((i for i in range(k, m) if rows[i][k] != 0), None)
        if pivot is None:
            return None
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [entry / rows[k][k] for entry in rows[k]]
        for i in range(m):
            if i != k:
                factor = rows[i][k]
                rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    shifts = [[Fraction(int(j == i)) for j in range(n * m)] for i in range((n - 1) * m)]
    return [[-entry for entry in row[m:]] for row in rows] + shifts


def slack_matrix(
    q: Polynomials, sign: int, level: Fraction, weights: list[Fraction], box: Box
) -> exact.Matrix:
    """The matrix in [1; w] of sign·q(w) - level - Σ weight_i (w_i - lo_i)(hi_i - w_i).

    Raises CertificateRejected if q is not quadratic.
    """
    size = len(box) + 1
    M = [[Fraction(0)] * size for _ in range(size)]
    for powers, coefficient in zip(q.exponents, q.coefficients, strict=True):
        used = [i + 1 for i, power in enumerate(powers) for _ in range(int(power))]
        if len(used) > 2:
            raise CertificateRejected("the leading coefficient should be at most quadratic")
        i, j = [0] * (2 - len(used)) + used
        half = sign * Fraction(float(coefficient[0, 0])) / 2
        M[i][j] += half
        M[j][i] += half
    M[0][0] -= level
    for i, (weight, (low, high)) in enumerate(zip(weights, box, strict=True), 1):
        M[0][0] += weight * low * high
        M[i][i] += weight
        M[0][i] -= weight * (low + high) / 2
        M[i][0] -= weight * (low + high) / 2
    return M


def state_matrix(model: StateAffineModel, s: Fraction) -> exact.Matrix:
    """A(s) of x = [ȳ(t-1); …; ȳ(t-n)], s = 1/G_0."""
    n = len(model)
    constants = [
        sum((Fraction(float(c[0, 0])) for c in g.coefficients), Fraction(0)) for g in model.G[1:]
    ]
    shifts = [[Fraction(int(j == i)) for j in range(n)] for i in range(n - 1)]
    return [[-s * g for g in constants], *shifts]
