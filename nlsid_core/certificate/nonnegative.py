"""Claims: a polynomial is at least a bound, or a symmetric matrix is ⪰ 0, on a domain.

With the domain {x : g_i(x) ≥ 0, h_j(x) = 0}, the proof is the identity
    φ·(p - bound) = v'Qv + Σ σ_i g_i + Σ μ_j h_j,    Q ⪰ 0, σ_i = w_i'S_i w_i with S_i ⪰ 0,
φ = 1, or φ = u'Fu with F ≻ 0 and 1 among u, so that φ > 0 everywhere.
A matrix M is ⪰ 0 where the polynomial y'M(x)y is ≥ 0 for every y: the same identity in (x, y).
Source: Putinar 1993; Scherer and Hol 2006 for matrices; Reznick 1995 for φ.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from itertools import product as pairs_of

import numpy as np
from numpy.typing import NDArray

from nlsid_core import _json
from nlsid_core._types import Json
from nlsid_core.certificate import polynomial_data as data
from nlsid_core.certificate.identity import Mode, Product, decide_gram, decide_identity, one
from nlsid_core.certificate.verdict import Decision
from nlsid_core.errors import CertificateRejected
from nlsid_core.polynomial import Gram, Polynomial

PROOF_MEMBERS = {"gram", "multipliers", "equality_multipliers", "factor"}


def prove_lower_bound(
    p: Polynomial,
    bound: float | Fraction,
    gram: Gram,
    *,
    domain: Sequence[Polynomial] = (),
    multipliers: Sequence[Gram] = (),
    equalities: Sequence[Polynomial] = (),
    equality_multipliers: Sequence[Polynomial] = (),
    factor: Gram | None = None,
    mode: Mode = "exact",
) -> float:
    """Prove p ≥ bound on {domain ≥ 0, equalities = 0}, without any file; returns the margin.

    All arguments are in the variables of `gram`, in that order. Raises CertificateRejected with
    the reason, Undecided if this mode cannot tell.
    """
    if len(domain) != len(multipliers) or len(equalities) != len(equality_multipliers):
        raise CertificateRejected(
            f"{len(domain)} domain polynomials with {len(multipliers)} multipliers, "
            f"{len(equalities)} equations with {len(equality_multipliers)}"
        )
    for multiplier in multipliers:
        decide_gram(multiplier, strict=False, mode=mode)
    if factor is not None:
        if not (factor.basis == 0).all(axis=1).any():
            raise CertificateRejected("the factor needs 1 in its basis to be positive everywhere")
        decide_gram(factor, strict=True, mode=mode)
    unit = one(gram.names)
    scale = unit if factor is None else factor
    target = [Product(scale, p), Product(scale, one(gram.names, bound), sign=-1)]
    target += [Product(s, g, sign=-1) for s, g in zip(multipliers, domain, strict=True)]
    target += [
        Product(m, h, sign=-1) for m, h in zip(equality_multipliers, equalities, strict=True)
    ]
    return decide_identity(target, gram, strict=False, mode=mode)


def decide_lower_bound(claim: Json, proof: Json, about: Mapping[str, Json], mode: Mode) -> Decision:
    """Decide `polynomial` ≥ `bound` on `domain` and `equalities`."""
    _refuse_files(about)
    data.only(
        claim,
        {"kind", "about", "variables", "polynomial", "bound", "domain", "equalities"},
        source="claim",
    )
    names = data.read_names(claim, source="claim")
    p = _polynomial(claim, "polynomial", names)
    value = _json.member(claim, "bound", (float, int, str), source="claim")
    bound = data.read_number(value, source="claim bound")
    domain, equalities = _domain(claim, names)
    margin = _prove(p, bound, proof, names, domain, equalities, mode)
    text = f"polynomial bound: {p} >= {_text(bound)} for all real {', '.join(names)}"
    return Decision(statement=text + _where(domain, equalities) + ",", margin=margin)


def decide_matrix(claim: Json, proof: Json, about: Mapping[str, Json], mode: Mode) -> Decision:
    """Decide `matrix` ⪰ 0 on `domain` and `equalities`."""
    _refuse_files(about)
    data.only(
        claim, {"kind", "about", "variables", "matrix", "domain", "equalities"}, source="claim"
    )
    names = data.read_names(claim, source="claim")
    rows = _json.member(claim, "matrix", list, source="claim")
    if not rows or any(not isinstance(row, list) or len(row) != len(rows) for row in rows):
        raise CertificateRejected("the matrix of the claim is not square")
    matrix = np.empty((len(rows), len(rows)), dtype=object)
    for i, j in pairs_of(range(len(rows)), repeat=2):
        matrix[i, j] = data.read_polynomial(rows[i][j], names, source=f"matrix[{i}][{j}]")
    domain, equalities = _domain(claim, names)
    p = quadratic_form(matrix)
    wide = [[g.over(p.names) for g in part] for part in (domain, equalities)]
    margin = _prove(p, 0.0, proof, p.names, wide[0], wide[1], mode)
    text = f"matrix inequality: {matrix.tolist()} is positive semidefinite for all real "
    return Decision(
        statement=text + ", ".join(names) + _where(domain, equalities) + ",", margin=margin
    )


def quadratic_form(matrix: NDArray[np.object_]) -> Polynomial:
    """y'M(x)y in the variables of M followed by y[0], y[1], …; exact.

    Raises CertificateRejected if M is not symmetric.
    """
    n, names = len(matrix), matrix[0, 0].names
    exponents, coefficients = [], []
    for i, j in pairs_of(range(n), repeat=2):
        if matrix[i, j] != matrix[j, i]:
            raise CertificateRejected(f"the matrix is not symmetric at [{i}][{j}]")
        entry = matrix[i, j].exact()
        y = np.zeros((len(entry), n), dtype=np.int64)
        y[:, i] += 1
        y[:, j] += 1
        exponents.append(np.hstack([entry.exponents, y]))
        coefficients.append(entry.coefficients)
    return Polynomial(
        np.concatenate(exponents),
        np.concatenate(coefficients),
        names + tuple(f"y[{i}]" for i in range(n)),
    )


def _prove(
    p: Polynomial,
    bound: float | Fraction,
    proof: Json,
    names: Sequence[str],
    domain: Sequence[Polynomial],
    equalities: Sequence[Polynomial],
    mode: Mode,
) -> float:
    data.only(proof, PROOF_MEMBERS, source="proof")
    gram = data.read_gram(_json.member(proof, "gram", dict, source="proof"), names, source="gram")
    factor = proof.get("factor")
    return prove_lower_bound(
        p,
        bound,
        gram,
        domain=domain,
        multipliers=[
            data.read_gram(entry, names, source=f"multiplier {i}")
            for i, entry in enumerate(data.read_list(proof, "multipliers", source="proof"))
        ],
        equalities=equalities,
        equality_multipliers=[
            data.read_polynomial(entry, names, source=f"equality multiplier {i}")
            for i, entry in enumerate(data.read_list(proof, "equality_multipliers", source="proof"))
        ],
        factor=None if factor is None else data.read_gram(factor, names, source="factor"),
        mode=mode,
    )


def _domain(claim: Json, names: Sequence[str]) -> tuple[list[Polynomial], list[Polynomial]]:
    domain, equalities = (
        [
            data.read_polynomial(entry, names, source=f"claim {key} {i}")
            for i, entry in enumerate(data.read_list(claim, key, source="claim"))
        ]
        for key in ("domain", "equalities")
    )
    return domain, equalities


def _polynomial(claim: Json, key: str, names: Sequence[str]) -> Polynomial:
    return data.read_polynomial(
        _json.member(claim, key, dict, source="claim"), names, source=f"claim {key}"
    )


def _refuse_files(about: Mapping[str, Json]) -> None:
    if about:
        raise CertificateRejected(f"this claim is about no file; it names {', '.join(about)}")


def _text(value: float | Fraction) -> str:
    return str(value).removesuffix(".0")


def _where(domain: Sequence[Polynomial], equalities: Sequence[Polynomial]) -> str:
    conditions = [f"{g} >= 0" for g in domain] + [f"{h} = 0" for h in equalities]
    return f" with {' and '.join(conditions)}" if conditions else ""
