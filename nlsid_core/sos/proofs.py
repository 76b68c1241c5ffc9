"""Proof documents of polynomial claims, from what a search found in floating point.

    φ·(p - bound) = v'Qv + Σ σ_k g_k + Σ μ_j h_j
holds up to a solver's tolerance. The multipliers are rounded first; what they leave of the identity
is computed in rationals and goes into Q, which is rounded last. The kernel decides the result.
Source of the formats: docs/certificate_polynomials.md.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nlsid_core.arrays import Json
from nlsid_core.errors import Infeasible
from nlsid_core.polynomial import Gram, Polynomial
from nlsid_core.polynomial.documents import write_number, write_polynomial
from nlsid_core.proofs import proof_document
from nlsid_core.sos.witness import MULTIPLIER_BITS, exact_witness, expanded, multiplier, witness

Terms = dict[tuple[int, ...], Fraction]


def bound_document(
    p: Polynomial,
    bound: float | Fraction,
    gram: Gram,
    *,
    domain: Sequence[Polynomial] = (),
    multipliers: Sequence[Gram] = (),
    equalities: Sequence[Polynomial] = (),
    equality_multipliers: Sequence[Polynomial] = (),
    factor: Gram | None = None,
) -> Json:
    """p ≥ bound on {domain ≥ 0, equalities = 0}; all in the variables of `gram`, in that order.

    factor: φ, with a positive definite Gram matrix and 1 in its basis. Raises Infeasible if the
    Gram matrices leave no room for rounding.
    """
    claim: Json = {
        "kind": "polynomial_bound",
        "about": {},
        "variables": list(p.names),
        "polynomial": write_polynomial(p),
        "bound": write_number(bound),
        **_domain(domain, equalities),
    }
    target = _minus(_terms(p), {(0,) * len(p.names): Fraction(bound)})
    return proof_document(
        claim,
        _identity(target, gram, domain, multipliers, equalities, equality_multipliers, factor),
    )


def matrix_document(
    matrix: ArrayLike,
    gram: Gram,
    *,
    names: Sequence[str],
    domain: Sequence[Polynomial] = (),
    multipliers: Sequence[Gram] = (),
    equalities: Sequence[Polynomial] = (),
    equality_multipliers: Sequence[Polynomial] = (),
) -> Json:
    """matrix(x) ⪰ 0 on the domain, x called `names`; the Gram matrices are in (x, y[0], …)."""
    rows: Any = np.asarray(matrix, dtype=object)
    claim: Json = {
        "kind": "polynomial_bound",
        "about": {},
        "variables": list(names),
        "matrix": [[write_polynomial(entry.over(names)) for entry in row] for row in rows],
        **_domain([g.over(names) for g in domain], [h.over(names) for h in equalities]),
    }
    form = quadratic_form(np.vectorize(lambda entry: entry.over(names), otypes=[object])(rows))
    wide, on = ([g.over(form.names) for g in part] for part in (domain, equalities))
    return proof_document(
        claim, _identity(_terms(form), gram, wide, multipliers, on, equality_multipliers, None)
    )


def attraction_document(
    field: Sequence[Polynomial],
    V: Polynomial,
    level: float | Fraction | None,
    *,
    positive: Gram,
    decrease: Gram,
    multiplier_gram: Gram | None = None,
) -> Json:
    """{V ≤ level} (everything, if level is None) is attracted by the origin of ẋ = field(x).

    positive, decrease: Gram matrices of V and of -V̇ - σ·(level - V), σ that of `multiplier_gram`.
    """
    claim: Json = {
        "kind": "region_of_attraction",
        "about": {},
        "variables": list(V.names),
        "field": [write_polynomial(f) for f in field],
        "V": write_polynomial(V),
    }
    rate = sum(
        (V.exact().derivative(x) * f.exact() for x, f in zip(V.names, field, strict=True)),
        Polynomial(np.zeros((0, len(V.names)), np.int64), np.zeros(0, object), V.names),
    )
    target = _terms(-rate)
    proof: Json = {"V": _main(_terms(V), positive)}
    if level is not None and multiplier_gram is not None:
        claim["level"] = write_number(level)
        proof["multiplier"] = multiplier(multiplier_gram.basis, _floats(multiplier_gram.Q))
        room = _minus({(0,) * len(V.names): Fraction(level)}, _terms(V))
        target = _minus(target, _times(_of(proof["multiplier"]), room))
    proof["decrease"] = _main(target, decrease)
    return proof_document(claim, proof)


def inequality(
    c: Polynomial,
    gram: Gram,
    *,
    domain: Sequence[Polynomial] = (),
    multipliers: Sequence[Gram] = (),
    bits: int = MULTIPLIER_BITS,
) -> Json:
    """The witness that c ≥ 0 on the domain: `{basis, columns, squares[, multipliers]}`."""
    return _on_domain(_terms(c), gram, domain, multipliers, bits)


def quadratic_form(matrix: NDArray[np.object_]) -> Polynomial:
    """y'M(x)y in the variables of M followed by y[0], y[1], …; exact, of M's upper half."""
    n, names = len(matrix), matrix[0, 0].names
    exponents, coefficients = [], []
    for i in range(n):
        for j in range(i, n):
            entry = matrix[i, j].exact()
            y = np.zeros((len(entry), n), dtype=np.int64)
            y[:, i] += 1
            y[:, j] += 1
            exponents.append(np.hstack([entry.exponents, y]))
            coefficients.append((1 if i == j else 2) * entry.coefficients)
    return Polynomial(
        np.concatenate(exponents),
        np.concatenate(coefficients),
        names + tuple(f"y[{i}]" for i in range(n)),
    )


def _identity(
    target: Terms,
    gram: Gram,
    domain: Sequence[Polynomial],
    multipliers: Sequence[Gram],
    equalities: Sequence[Polynomial],
    equality_multipliers: Sequence[Polynomial],
    factor: Gram | None,
) -> Json:
    proof: Json = {}
    if factor is not None:
        proof["factor"] = _factor(factor)
        target = _times(_terms(factor.polynomial()), target)
    if equalities:
        proof["equality_multipliers"] = [write_polynomial(m) for m in equality_multipliers]
    for m, h in zip(equality_multipliers, equalities, strict=True):
        target = _minus(target, _times(_terms(m), _terms(h)))
    return proof | _on_domain(target, gram, domain, multipliers, MULTIPLIER_BITS)


def _on_domain(
    target: Terms,
    gram: Gram,
    domain: Sequence[Polynomial],
    multipliers: Sequence[Gram],
    bits: int,
) -> Json:
    written = []
    for k, (part, g) in enumerate(zip(multipliers, domain, strict=True)):
        if not len(part) or not _floats(part.Q).any():
            continue
        sigma = multiplier(part.basis, _floats(part.Q), bits=bits)
        target_k = _times(_of(sigma), _terms(g))
        target = _minus(target, target_k)
        written.append({"of": k, **sigma})
    found = _main(target, gram)
    return found | ({"multipliers": written} if written else {})


def _main(target: Terms, gram: Gram) -> Json:
    """The witness of a Gram matrix, corrected to be that of `target`."""
    exact = Gram(gram.basis, np.vectorize(Fraction, otypes=[object])(gram.Q), gram.names)
    rest = _minus(target, _terms(exact.polynomial()))
    left = {key: value for key, value in rest.items() if value}
    if gram.Q.dtype == object and not left:
        return exact_witness(gram.basis, gram.Q)
    residual = {key: [_float(value)] for key, value in left.items()}
    return witness(gram.basis, _floats(gram.Q), residual=residual)


def _factor(gram: Gram) -> Json:
    """φ = u'Fu as a constant and a sum of squares, exactly: the constant is 1/(F⁻¹)₁₁."""
    at = [k for k, row in enumerate(gram.basis.tolist()) if not any(row)]
    if not at:
        raise Infeasible("the factor needs 1 in its basis to be positive everywhere")
    F = [[Fraction(entry) for entry in row] for row in gram.Q.tolist()]
    rest = [k for k in range(len(F)) if k != at[0]]
    constant = F[at[0]][at[0]]
    matrix = [[F[i][j] for j in [*rest, at[0]]] for i in [*rest, at[0]]]
    for k in range(len(rest)):  # eliminate all but the constant: what is left of it is φ's least
        pivot = matrix[k][k]
        if pivot <= 0:
            raise Infeasible("the factor's Gram matrix is not positive definite")
        for i in range(k + 1, len(matrix)):
            share = matrix[i][k] / pivot
            matrix[i] = [a - share * b for a, b in zip(matrix[i], matrix[k], strict=True)]
        constant = matrix[-1][-1]
    F[at[0]][at[0]] -= constant
    return {"constant": write_number(constant), **exact_witness(gram.basis, F)}


def _domain(domain: Sequence[Polynomial], equalities: Sequence[Polynomial]) -> Json:
    parts: Mapping[str, Sequence[Polynomial]] = {"domain": domain, "equalities": equalities}
    return {key: [write_polynomial(g) for g in part] for key, part in parts.items() if part}


def _of(squares: Json) -> Terms:
    return {key: control[0] for key, control in expanded(squares).items()}


def _terms(p: Polynomial) -> Terms:
    return {exponents: Fraction(c) for exponents, c in p.exact().terms()}


def _minus(a: Terms, b: Terms) -> Terms:
    result = dict(a)
    for key, value in b.items():
        result[key] = result.get(key, Fraction(0)) - value
    return result


def _times(a: Terms, b: Terms) -> Terms:
    result: Terms = {}
    for left, x in a.items():
        for right, y in b.items():
            key = tuple(i + j for i, j in zip(left, right, strict=True))
            result[key] = result.get(key, Fraction(0)) + x * y
    return result


def _floats(Q: NDArray[Any]) -> NDArray[np.float64]:
    return np.asarray(Q, dtype=np.float64)


def _float(value: Fraction) -> float:
    try:
        return float(value)
    except OverflowError as error:
        raise Infeasible("the identity is wrong by more than a float64 holds") from error
