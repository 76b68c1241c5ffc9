"""Proof documents of the polynomial claims: what `check` reads, made from plain numbers."""

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

from numpy.typing import ArrayLike

from nlsid_core._types import Json
from nlsid_core.certificate.check import proof_document
from nlsid_core.certificate.polynomial_data import write_gram, write_number, write_polynomial
from nlsid_core.polynomial import Gram, Polynomial


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
    """p ≥ bound on {domain ≥ 0, equalities = 0}; the arguments of `prove_lower_bound`."""
    claim: Json = {
        "kind": "polynomial_bound",
        "about": {},
        "variables": list(p.names),
        "polynomial": write_polynomial(p),
        "bound": write_number(bound),
        **_domain(domain, equalities),
    }
    return proof_document(claim, _identity(gram, multipliers, equality_multipliers, factor))


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
    rows: Any = matrix
    claim: Json = {
        "kind": "matrix_inequality",
        "about": {},
        "variables": list(names),
        "matrix": [[write_polynomial(entry.over(names)) for entry in row] for row in rows],
        **_domain([g.over(names) for g in domain], [h.over(names) for h in equalities]),
    }
    return proof_document(claim, _identity(gram, multipliers, equality_multipliers, None))


def attraction_document(
    field: Sequence[Polynomial],
    V: Polynomial,
    level: float | Fraction | None,
    *,
    positive: Gram,
    decrease: Gram,
    multiplier: Gram | None = None,
) -> Json:
    """{V ≤ level} is in the region of attraction; the arguments of `prove_attraction`."""
    claim: Json = {
        "kind": "region_of_attraction",
        "about": {},
        "variables": list(V.names),
        "field": [write_polynomial(f) for f in field],
        "V": write_polynomial(V),
        "level": None if level is None else write_number(level),
    }
    proof: Json = {"positive": write_gram(positive), "decrease": write_gram(decrease)}
    if multiplier is not None:
        proof["multiplier"] = write_gram(multiplier)
    return proof_document(claim, proof)


def _domain(domain: Sequence[Polynomial], equalities: Sequence[Polynomial]) -> Json:
    return {
        "domain": [write_polynomial(g) for g in domain],
        "equalities": [write_polynomial(h) for h in equalities],
    }


def _identity(
    gram: Gram,
    multipliers: Sequence[Gram],
    equality_multipliers: Sequence[Polynomial],
    factor: Gram | None,
) -> Json:
    proof: Json = {
        "gram": write_gram(gram),
        "multipliers": [write_gram(multiplier) for multiplier in multipliers],
        "equality_multipliers": [write_polynomial(p) for p in equality_multipliers],
    }
    if factor is not None:
        proof["factor"] = write_gram(factor)
    return proof
