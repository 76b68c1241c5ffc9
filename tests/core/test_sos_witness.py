"""Float Gram matrices become whole numbers that the kernel accepts, and rebuilds exactly."""

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from nlsid_core.errors import Infeasible
from nlsid_core.kernel import Rejected
from nlsid_core.kernel.files import Node
from nlsid_core.kernel.polynomials import Ring, at_width
from nlsid_core.kernel.positivity import positive, read_squares
from nlsid_core.polynomial import monomials
from nlsid_core.sos.witness import expanded, multiplier, witness

Coefficients = dict[tuple[int, ...], list[Fraction]]


def decide(c: Coefficients, squares: Any, *, strict: bool = True) -> None:
    """`positive` of Σ_j B_j(s) c_j(x), given by Bernstein control points."""
    count = len(squares["basis"][0])

    def build(ring: Ring, _: None) -> None:
        parts = [ring.bernstein(control) * ring.monomial(e) for e, control in c.items()]
        members = Node(squares, "c").members("basis columns squares")
        positive(ring.sum(parts), read_squares(members, ring), ring, "c", strict=strict)

    at_width(count, [None], build)


def of_grams(basis: Any, grams: Any) -> Coefficients:
    result: Coefficients = {}
    for j, Q in enumerate(grams):
        for a, row in zip(basis.tolist(), Q.tolist(), strict=True):
            for b, entry in zip(basis.tolist(), row, strict=True):
                key = tuple(i + k for i, k in zip(a, b, strict=True))
                result.setdefault(key, [Fraction(0)] * len(grams))[j] += Fraction(entry)
    return result


@pytest.mark.parametrize("seed", range(6))
def test_a_definite_gram_matrix_becomes_a_witness_whatever_its_units(seed: int) -> None:
    rng = np.random.default_rng(seed)
    basis = monomials(2, range(seed % 3 + 2))
    units = 10.0 ** rng.uniform(-8, 8) * np.prod(10.0 ** (rng.uniform(-4, 4, 2) * basis), axis=1)
    grams = []
    for _ in range(seed % 4 + 1):
        L = rng.normal(size=(len(basis), len(basis))) * 10.0 ** -rng.uniform(0, 2)
        grams.append((L @ L.T + 1e-4 * np.eye(len(basis))) * units[:, None] * units)
    c = of_grams(basis, grams)
    found = witness(basis, grams)
    decide(c, found)
    entries = [abs(int(e)) for f in found["squares"]["factors"] for row in f for e in row]
    assert max(entries) < 2 ** (found["squares"]["unit"] + 1)
    lower = {key: list(value) for key, value in c.items()}
    first = [Fraction(float(g[0, 0])) for g in grams]
    lower[0, 0] = [v - 4 * g for v, g in zip(lower[0, 0], first, strict=True)]
    with pytest.raises(Rejected):
        decide(lower, found)


def test_a_residual_is_shared_out_among_the_products_of_the_basis() -> None:
    basis = monomials(2, range(3))
    Q = np.eye(len(basis))
    extra: dict[tuple[int, ...], list[float]] = {(2, 2): [0.3], (1, 1): [-0.2], (0, 0): [0.1]}
    c = of_grams(basis, [Q])
    for key, value in extra.items():
        c[key] = [c.get(key, [Fraction(0)])[0] + Fraction(value[0])]
    decide(c, witness(basis, Q, residual=extra))
    with pytest.raises(Infeasible, match="no product"):
        witness(basis, Q, residual={(5, 0): [1.0]})


def test_what_is_not_definite_is_refused_with_its_eigenvalue() -> None:
    with pytest.raises(Infeasible, match="not positive definite"):
        witness([[0], [1]], np.array([[1.0, 1.0], [1.0, 1.0]]))
    with pytest.raises(Infeasible, match="not positive definite"):
        witness([[0], [1]], np.array([[1.0, 2.0], [2.0, 1.0]]))


def test_a_multiplier_is_the_gram_matrix_to_its_bits_and_what_expanded_says_exactly() -> None:
    rng = np.random.default_rng(0)
    basis = monomials(2, range(3))
    L = rng.normal(size=(len(basis), 2))
    Q = L @ L.T
    found = multiplier(basis, Q, bits=40)
    assert np.linalg.matrix_rank(Q) == 2
    for key, (value,) in expanded(found).items():
        assert abs(float(value) - float(of_grams(basis, [Q])[key][0])) < 1e-9
    decide(expanded(found), found, strict=False)
