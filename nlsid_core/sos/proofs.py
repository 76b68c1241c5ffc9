"""Witnesses of polynomial inequalities, from what a search found in floating point.

    c = v'Qv + Σ σ_k g_k
holds up to a solver's tolerance. The multipliers are rounded first; what they leave of the identity
is computed in rationals and goes into Q, which is rounded last. The kernel decides the result.
"""

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlsid_core.arrays import Json
from nlsid_core.errors import Infeasible
from nlsid_core.polynomial import Gram, Polynomial
from nlsid_core.sos.witness import expanded, multiplier, witness

Terms = dict[tuple[int, ...], Fraction]


def inequality(
    c: Polynomial,
    gram: Gram,
    *,
    domain: Sequence[Polynomial] = (),
    multipliers: Sequence[Gram] = (),
) -> Json:
    """The witness that c ≥ 0 on the domain: `{basis, columns, squares[, multipliers]}`."""
    target, written = _terms(c), []
    for k, (part, g) in enumerate(zip(multipliers, domain, strict=True)):
        if not len(part) or not _floats(part.Q).any():
            continue
        sigma = multiplier(part.basis, _floats(part.Q))
        exact = {key: control[0] for key, control in expanded(sigma).items()}
        target = _minus(target, _times(exact, _terms(g)))
        written.append({"of": k, **sigma})
    found = _main(target, gram)
    return found | ({"multipliers": written} if written else {})


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


def _main(target: Terms, gram: Gram) -> Json:
    """The witness of a Gram matrix, corrected to be that of `target`."""
    exact = Gram(gram.basis, np.vectorize(Fraction, otypes=[object])(gram.Q), gram.names)
    rest = _minus(target, _terms(exact.polynomial()))
    left = {key: value for key, value in rest.items() if value}
    residual = {key: [_float(value)] for key, value in left.items()}
    return witness(gram.basis, _floats(gram.Q), residual=residual)


def _terms(p: Polynomial) -> Terms:
    return {exponents: Fraction(c) for exponents, c in p.exact().terms()}


def _minus(a: Terms, b: Terms) -> Terms:
    return {key: a.get(key, Fraction(0)) - b.get(key, Fraction(0)) for key in {**a, **b}}


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
