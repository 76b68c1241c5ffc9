"""Proof of `state_affine_stability` for several outputs and input-dependent lagged coefficients.

With x = [ȳ(t-1); …; ȳ(t-n)], x⁺ = [ν; S x] and a constant multiplier T,
    [T G_0 + G_0'T' - P₁₁, T g - P₁₂S; ·, r²P - S'P₂₂S] ⪰ 0,   g = [G_1 … G_n](w), P ≻ 0,
for every window w in the box of clipped inputs. Two solutions with the same input differ by (ν, Δ)
with G_0 ν + g Δ = 0; then 2ν'T(G_0 ν + gΔ) = 0 leaves |[ν; SΔ]|²_P ≤ r²|Δ|²_P. At Δ = 0 it says
that G_0 is invertible. Source: thesis Lemma 2.11 for constant M, (4.1); S-procedure for the box.
"""

from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import conditions, exact
from nlsid_core.certificate import polynomial_data as data
from nlsid_core.certificate.conditions import Inequality
from nlsid_core.certificate.identity import Mode
from nlsid_core.certificate.nonnegative import prove_lower_bound, quadratic_form
from nlsid_core.errors import CertificateRejected
from nlsid_core.models.state_affine import StateAffineModel
from nlsid_core.polynomial import Gram, Polynomial

Box = list[tuple[Fraction, Fraction]]


def decide(model: StateAffineModel, rate: float, proof: Json) -> float:
    """The margin of the proof `{P, T, gram, multipliers}`, exactly."""
    data.only(proof, {"P", "T", "gram", "multipliers"}, source="proof")
    n_y, size = len(model.y), len(model) * len(model.y)
    P = _json.array(proof, "P", (size, size), source="proof")
    T = _json.array(proof, "T", (n_y, n_y), source="proof")
    names = form(inequality(model, rate, P=constants(P), T=constants(T)), model).names
    gram = data.read_gram(_json.member(proof, "gram", dict, source="proof"), names, source="gram")
    given = data.read_list(proof, "multipliers", source="proof")
    multipliers = [data.read_gram(m, names, source=f"multiplier {i}") for i, m in enumerate(given)]
    return prove(model, rate, P=P, T=T, gram=gram, multipliers=multipliers)


def prove(
    model: StateAffineModel, rate: float, *, P: FloatArray, T: FloatArray, gram: Gram,
    multipliers: list[Gram], mode: Mode = "exact",
) -> float:  # fmt: skip
    """The margin of the inequality; raises CertificateRejected with what fails."""
    if not 0.0 < rate < 1.0:
        raise CertificateRejected(f"rate is {rate:g}; stability needs 0 < rate < 1")
    if not exact.is_positive_definite(exact.rational(P.tolist())):
        raise CertificateRejected("P is not symmetric positive definite")
    part = inequality(model, rate, P=constants(P), T=constants(T))
    p = form(part, model)
    domain = [g.over(p.names).exact() for g in part.domain]
    return prove_lower_bound(p, 0, gram, domain=domain, multipliers=multipliers, mode=mode)


def inequality(
    model: StateAffineModel, rate: float, *, P: NDArray[np.object_], T: NDArray[np.object_]
) -> Inequality:
    """The condition above, in w on its box; exact, or linear in unknown P and T."""
    n_y, names = len(model.y), window_names(model)
    blocks = []
    for G in model.G:
        block = np.empty((n_y, n_y), dtype=object)
        for a in range(n_y):
            for b in range(n_y):
                block[a, b] = Polynomial(G.exponents, G.coefficients[:, a, b], names).exact()
        blocks.append(T @ block)
    lead, lags = blocks[0], np.concatenate(blocks[1:], axis=1)
    size = lags.shape[1]
    S = np.eye(size - n_y, size, dtype=np.int64).astype(object)
    top = lead + lead.T - P[:n_y, :n_y]
    side = lags - P[:n_y, n_y:] @ S if size > n_y else lags
    corner = Fraction(rate) ** 2 * P
    if size > n_y:
        corner = corner - S.T @ P[n_y:, n_y:] @ S
    matrix = conditions.filled(np.block([[top, side], [side.T, corner]]))
    domain = tuple(g.exact() for g in conditions.box(names, window_box(model)))
    return Inequality(matrix, domain).relevant()


def form(part: Inequality, model: StateAffineModel) -> Polynomial:
    """y'My in the entries of w that occur, and y."""
    used = part.variables(window_names(model))
    wide = [[entry.over(used) for entry in row] for row in part.matrix]
    return quadratic_form(np.array(wide, dtype=object))


def constants(values: FloatArray) -> NDArray[np.object_]:
    """A matrix of numbers, exactly."""
    return conditions.constants(values.tolist())


def window_names(model: StateAffineModel) -> tuple[str, ...]:
    """w0 …, one for each entry of the window."""
    return tuple(f"w{i}" for i in range(len(model.window)))


def window_box(model: StateAffineModel) -> Box:
    """Exact range of each entry of w: the clipped inputs, normalised without rounding."""
    box = []
    for i, _ in model.window:
        offset, scale = (Fraction(float(v[i])) for v in (model.u_offset, model.u_scale))
        low, high = ((Fraction(float(end)) - offset) / scale for end in model.u_range[i])
        box.append((low, high))
    return box
