"""Claim: an implicit model e(x⁺) = f(x, w) is well posed and forgets its initial conditions.

Proof: P ≻ 0 and a Gram matrix (with multipliers on a box) that shows
    y' [E + E' - P - δI, F'; F, P] y ≥ 0,   E = ∂e/∂x, F = ∂f/∂x, for every (x, w) and y,
and a second that shows E + E' - 2mI ⪰ 0 for every x, m the model's monotonicity: e is a bijection.
Then V = |e(x) - e(x̂)|²_{P⁻¹} falls by δ|x - x̂|² or more a sample: V⁺ = |f - f̂|²_{P⁻¹} ≤
2Δ'(e - ê) - |Δ|²_P - δ|Δ|², and 2Δ'z - |Δ|²_P ≤ |z|²_{P⁻¹}. On a box of states and inputs the
claim is about solutions that stay in it. Source: thesis Theorem 2.5, Lemma 2.13.
"""

from collections.abc import Mapping
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from nlsid_core import _json
from nlsid_core._types import Json
from nlsid_core.certificate import exact
from nlsid_core.certificate import polynomial_data as data
from nlsid_core.certificate.identity import Mode
from nlsid_core.certificate.nonnegative import prove_lower_bound, quadratic_form
from nlsid_core.certificate.verdict import Decision
from nlsid_core.errors import CertificateRejected
from nlsid_core.models.implicit import ImplicitModel
from nlsid_core.models.polynomials import Polynomials
from nlsid_core.polynomial import Polynomial, constant, jacobian, variables


def decide(claim: Json, proof: Json, about: Mapping[str, Json], mode: Mode) -> Decision:
    """Decide `{delta, box}` for the bound model with the proof's `{P, stable, monotone}`."""
    if set(about) != {"model"} or set(claim) != {"kind", "about", "delta", "box"}:
        raise CertificateRejected("an implicit_stability claim is about one file, the model")
    model = ImplicitModel.from_document(about["model"], source="model")
    n, names = len(model), variable_names(model)
    delta = _json.number(claim, "delta", source="claim")
    if delta <= 0.0:
        raise CertificateRejected(f"delta is {delta:g}; stability needs a positive one")
    P = exact.rational(_json.array(proof, "P", (n, n), source="proof").tolist())
    if not exact.is_positive_definite(P):
        raise CertificateRejected("P is not symmetric positive definite")
    ends = data.read_list(claim, "box", source="claim")
    domain: list[Polynomial] = []
    if ends:
        corners = _json.array(claim, "box", (len(names), 2), source="claim").tolist()
        domain = box(names, corners)
    margin = np.inf
    matrices: tuple[tuple[str, NDArray[np.object_], list[Polynomial]], ...] = (
        ("stable", stability_matrix(model, P, Fraction(delta)), domain),
        ("monotone", monotonicity_matrix(model), []),
    )
    for key, matrix, local in matrices:
        p = quadratic_form(matrix)
        part = _json.member(proof, key, dict, source="proof")
        data.only(part, {"gram", "multipliers"}, source=key)
        grams = [
            data.read_gram(entry, p.names, source=f"{key} multiplier")
            for entry in data.read_list(part, "multipliers", source=key)
        ]
        gram = data.read_gram(_json.member(part, "gram", dict, source=key), p.names, source=key)
        wide = [g.over(p.names) for g in local]
        margin = min(
            margin,
            prove_lower_bound(p, 0, gram, domain=wide, multipliers=grams, mode=mode),
        )
    where = "while both stay in the stated box of states and inputs" if ends else "for every input"
    return Decision(
        statement=(
            f"incremental stability of an implicit model with {n} states: the sum of squared "
            f"differences of two solutions with the same input is finite, {where},"
        ),
        margin=float(margin),
    )


def variable_names(model: ImplicitModel) -> tuple[str, ...]:
    """x0 … and w0 …, whatever the model calls its states and inputs."""
    n, m = len(model), len(model.inputs)
    return tuple(f"x{i}" for i in range(n)) + tuple(f"w{i}" for i in range(m))


def stability_matrix(model: ImplicitModel, P: exact.Matrix, delta: Fraction) -> NDArray[np.object_]:
    """[E + E' - P - δI, F'; F, P] in x and w, exactly."""
    n, names = len(model), variable_names(model)
    E = jacobian([p.over(names) for p in polynomials(model.e, names[:n])], names[:n])
    F = jacobian(polynomials(model.f, names), names[:n])
    matrix = np.empty((2 * n, 2 * n), dtype=object)
    for i in range(n):
        for j in range(n):
            fixed = constant(P[i][j], names=names)
            drop = constant(P[i][j] + (delta if i == j else 0), names=names)
            matrix[i, j] = E[i, j] + E[j, i] - drop
            matrix[n + i, j] = F[i, j]
            matrix[j, n + i] = F[i, j]
            matrix[n + i, n + j] = fixed
    return matrix


def monotonicity_matrix(model: ImplicitModel) -> NDArray[np.object_]:
    """E + E' - 2mI in x, exactly."""
    n = len(model)
    names = variable_names(model)[:n]
    E = jacobian(polynomials(model.e, names), names)
    twice = constant(2 * Fraction(model.monotonicity), names=names)
    none = constant(Fraction(0), names=names)
    return np.array(
        [[E[i, j] + E[j, i] - (twice if i == j else none) for j in range(n)] for i in range(n)],
        dtype=object,
    )


def polynomials(parts: Polynomials, names: tuple[str, ...]) -> list[Polynomial]:
    """The stored polynomials with exact coefficients."""
    return [
        Polynomial(parts.exponents, parts.coefficients[:, i], names).exact()
        for i in range(parts.coefficients.shape[1])
    ]


def box(names: tuple[str, ...], ends: list[list[float]]) -> list[Polynomial]:
    """(x - low)(high - x) of every variable, exactly."""
    parts = []
    for name, (low, high) in zip(names, ends, strict=True):
        if not low < high:
            raise CertificateRejected(f"the box of {name} is empty: {low:g} to {high:g}")
        (x,) = variables(name)
        parts.append((x.exact() - Fraction(low)) * (Fraction(high) - x.exact()))
    return [part.over(names) for part in parts]
