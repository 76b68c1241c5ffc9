"""A second, slower opinion on polynomial claims, in Fractions and dictionaries.

Written without the checker's code: polynomials are {exponent: Fraction}, definiteness is plain
rational LDL'. Whatever the checker calls PROVED has to hold here as well.
"""

from fractions import Fraction
from typing import Any, TypeAlias

Poly: TypeAlias = dict[tuple[int, ...], Fraction]


def agrees(document: dict[str, Any]) -> bool:
    """True if the identity and every definiteness of the proof hold exactly."""
    claim, proof = document["claim"], document["proof"]
    kind = claim["kind"]
    if kind == "region_of_attraction":
        return _attraction(claim, proof)
    n = len(claim["variables"])
    if kind == "matrix_inequality":
        p, pad = _form(claim["matrix"]), len(claim["matrix"])
        bound = Fraction(0)
    else:
        p, pad, bound = _poly(claim["polynomial"]), 0, _number(claim["bound"])
    wide = n + pad
    factor: Poly = {(0,) * wide: Fraction(1)}
    if proof.get("factor") is not None:
        if not _definite(proof["factor"], strict=True):
            return False
        if [0] * wide not in proof["factor"]["basis"]:
            return False
        factor = _gram(proof["factor"])
    total = _times(factor, _plus(p, {(0,) * wide: -bound}))
    domain, multipliers = claim.get("domain", []), proof.get("multipliers", [])
    equations, free = claim.get("equalities", []), proof.get("equality_multipliers", [])
    if len(domain) != len(multipliers) or len(equations) != len(free):
        return False
    for g, sigma in zip(domain, multipliers, strict=True):
        if not _definite(sigma, strict=False):
            return False
        total = _plus(total, _times(_pad(_poly(g), pad), _gram(sigma)), -1)
    for h, mu in zip(equations, free, strict=True):
        total = _plus(total, _times(_pad(_poly(h), pad), _poly(mu)), -1)
    return _absorbed(total, proof["gram"], strict=False)


def _attraction(claim: dict[str, Any], proof: dict[str, Any]) -> bool:
    V, n = _poly(claim["V"]), len(claim["variables"])
    field = [_poly(f) for f in claim["field"]]
    zero = (0,) * n
    if len(field) != n or any(f.get(zero) for f in field):
        return False
    rate: Poly = {}
    for j, f in enumerate(field):
        gradient = {(*e[:j], e[j] - 1, *e[j + 1 :]): c * e[j] for e, c in V.items() if e[j]}
        rate = _plus(rate, _times(gradient, f), -1)
    if claim.get("level") is not None:
        level, sigma = _number(claim["level"]), proof["multiplier"]
        if level <= 0 or not _definite(sigma, strict=False):
            return False
        rate = _plus(rate, _times(_gram(sigma), _plus({zero: level}, V, -1)), -1)
    for key in ("positive", "decrease"):
        basis = proof[key]["basis"]
        pure = {j for e in basis for j in range(n) if e[j] == sum(e) > 0}
        if [0] * n in basis or len(pure) < n:
            return False
    return _absorbed(V, proof["positive"], strict=True) and _absorbed(
        rate, proof["decrease"], strict=True
    )


def _absorbed(target: Poly, gram: dict[str, Any], *, strict: bool) -> bool:
    basis = [tuple(row) for row in gram["basis"]]
    Q = [[_number(entry) for entry in row] for row in gram["Q"]]
    if len(set(basis)) < len(basis):
        return False
    for exponent, r in _plus(target, _gram(gram), -1).items():
        if not r:
            continue
        homes = [
            (i, j)
            for i, a in enumerate(basis)
            for j, b in enumerate(basis)
            if i <= j and tuple(x + y for x, y in zip(a, b, strict=True)) == exponent
        ]
        if not homes:
            return False
        i, j = homes[0]
        Q[i][j] += r / 2
        Q[j][i] += r / 2
    return _ldl(Q, strict=strict)


def _definite(gram: dict[str, Any], *, strict: bool) -> bool:
    return _ldl([[_number(entry) for entry in row] for row in gram["Q"]], strict=strict)


def _ldl(Q: list[list[Fraction]], *, strict: bool) -> bool:
    Q = [row[:] for row in Q]
    if any(Q[i][j] != Q[j][i] for i in range(len(Q)) for j in range(len(Q))):
        return False
    while Q:
        k = next((i for i in range(len(Q)) if Q[i][i]), 0)
        pivot = Q[k][k]
        if pivot < 0 or (strict and any(Q[i][i] <= 0 for i in range(len(Q)))):
            return False
        if pivot == 0:
            return not strict and not any(any(row) for row in Q)
        head = Q[k]
        Q = [
            [row[j] - row[k] * head[j] / pivot for j in range(len(Q)) if j != k]
            for i, row in enumerate(Q)
            if i != k
        ]
    return True


def _gram(gram: dict[str, Any]) -> Poly:
    total: Poly = {}
    for a, row in zip(gram["basis"], gram["Q"], strict=True):
        for b, entry in zip(gram["basis"], row, strict=True):
            key = tuple(x + y for x, y in zip(a, b, strict=True))
            total[key] = total.get(key, Fraction(0)) + _number(entry)
    return total


def _form(matrix: list[list[Any]]) -> Poly:
    size = len(matrix)
    total: Poly = {}
    for i, row in enumerate(matrix):
        for j, entry in enumerate(row):
            y = [int(k == i) + int(k == j) for k in range(size)]
            part = {(*e, *y): c for e, c in _poly(entry).items()}
            total = _plus(total, part)
    return total


def _poly(document: dict[str, Any]) -> Poly:
    total: Poly = {}
    for e, c in zip(document["exponents"], document["coefficients"], strict=True):
        total[tuple(e)] = total.get(tuple(e), Fraction(0)) + _number(c)
    return total


def _pad(p: Poly, size: int) -> Poly:
    return {(*e, *[0] * size): c for e, c in p.items()}


def _plus(a: Poly, b: Poly, scale: int = 1) -> Poly:
    total = dict(a)
    for e, c in b.items():
        total[e] = total.get(e, Fraction(0)) + scale * c
    return total


def _times(a: Poly, b: Poly) -> Poly:
    total: Poly = {}
    for e, c in a.items():
        for f, d in b.items():
            key = tuple(x + y for x, y in zip(e, f, strict=True))
            total[key] = total.get(key, Fraction(0)) + c * d
    return total


def _number(value: Any) -> Fraction:
    return Fraction(value)
