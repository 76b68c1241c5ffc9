"""The V-step for P(t): what c is in D, and the optimum that another solver finds."""

from typing import Any

import cvxpy
import numpy as np
import pytest

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.design.continuous.graded import monomials_of
from nlsid_core.design.continuous.vstep import (
    Affine,
    Sample,
    affine_form,
    improve,
    squares_along,
)
from nlsid_core.errors import SolverError
from nlsid_core.polynomial.values import monomial_values

cp: Any = cvxpy  # its functions are not typed


def powers(n: int, degree: int) -> IntArray:
    return np.concatenate([monomials_of(n, q) for q in range(degree + 1)])


def triangle(D: FloatArray) -> FloatArray:
    return np.asarray(D[np.triu_indices(len(D))])


@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize("sign", [1, -1])
def test_c_is_what_the_derivative_of_w_says(n: int, sign: int) -> None:
    rng = np.random.default_rng(n)
    y, mu = rng.normal(size=(n, len(powers(n, 3)))), rng.normal(size=len(powers(n, 2)))
    across, rate = rng.normal(size=(n, n)), 3.0
    own, other = ((D + D.T) / 2 for D in rng.normal(size=(2, n, n)))
    form = affine_form(Sample(0, 1, rate, sign, y, across)).with_multiplier(mu, n)
    z = rng.normal(size=(20, n))
    P, P_other = np.eye(n) + own, across.T @ (np.eye(n) + other) @ across
    P_rate = sign * rate * (P_other - P)
    moved = monomial_values(powers(n, 3), z) @ y.T
    W_rate = 2 * np.einsum("ki,ij,kj->k", z, P, moved) + np.einsum("ki,ij,kj->k", z, P_rate, z)
    W = np.einsum("ki,ij,kj->k", z, P, z)
    expected = -W_rate + monomial_values(powers(n, 2), z) @ mu * (1 - W)
    c = form.constant + form.own @ triangle(own) + form.others @ triangle(other)
    np.testing.assert_allclose(monomial_values(powers(n, 4), z) @ c, expected, rtol=1e-10)


def test_what_bounds_pushes_is_taken_to_first_order_in_d() -> None:
    rng = np.random.default_rng(3)
    n, step = 3, 1e-6
    g, scale, z = rng.normal(size=(n, 2)), np.array([0.7, 0.2]), rng.normal(size=(20, n))
    D = (lambda A: (A + A.T) / 2)(rng.normal(size=(n, n)))

    def bound(part: float) -> FloatArray:
        return np.asarray(np.square(z @ (np.eye(n) + part * D) @ g) @ scale)

    slope = monomial_values(powers(n, 4), z) @ (squares_along(g, scale) @ triangle(D))
    np.testing.assert_allclose(slope, (bound(step) - bound(-step)) / (2 * step), rtol=1e-6)


def test_bounds_are_kept() -> None:
    samples = contracting(4)
    rows = np.array([[0.9, 0.0], [0.5, 0.7]])
    options: dict[str, Any] = {"weights": np.ones(3), "trust": 0.4}
    free = improve(samples, powers(2, 2), **options)
    kept = improve(samples, powers(2, 2), bounds=[rows, rows[:1], rows[:0]], **options)
    assert np.einsum("ri,ij,rj->r", rows, np.linalg.inv(np.eye(2) + free[0]), rows).max() > 1.01
    for k, count in enumerate((2, 1, 0)):
        reach = np.einsum("ri,ij,rj->r", rows, np.linalg.inv(np.eye(2) + kept[k]), rows)
        assert (reach[:count] <= 1).all()
    np.testing.assert_allclose(kept[2], free[2], atol=0.1)


def contracting(knots: int, margin: float = 0.05) -> list[Affine]:
    """x₁' = -x₁ + 0.3x₂ - 0.2x₁³, x₂' = -0.3x₁ - 2x₂ - 0.3x₂³: c(D = 0) is a sum of squares."""
    y, mu = np.zeros((2, len(powers(2, 3)))), np.zeros(len(powers(2, 2)))
    terms = {
        (0, 1, 0): -1.0,
        (0, 0, 1): 0.3,
        (0, 3, 0): -0.2,
        (1, 1, 0): -0.3,
        (1, 0, 1): -2.0,
        (1, 0, 3): -0.3,
    }
    for (row, *power), value in terms.items():
        y[row, np.flatnonzero((powers(2, 3) == power).all(axis=1))] = value
    mu[0] = 0.8
    samples = []
    for k in range(knots - 1):
        for sign, (own, other) in ((1, (k, k + 1)), (-1, (k + 1, k))):
            form = affine_form(Sample(own, other, 4.0, sign, y, np.eye(2)))
            form.constant[0] -= margin
            samples.append(form.with_multiplier(mu, 2))
    return samples


def by_cvxpy(samples: list[Affine], free: int, **of: Any) -> Any:
    """The same program in Gram matrices of all monomials up to degree 2; the optimal value."""
    basis, rows = powers(2, 2), powers(2, 4)
    D = [cp.Variable((2, 2), symmetric=True) for _ in range(free)]
    limits = [sign * d << of["trust"] * np.eye(2) for d in D for sign in (1, -1)]
    for form in samples:
        Q = cp.Variable((6, 6), PSD=True)
        c: Any = form.constant
        for knot, part in zip(form.knots, (form.own, form.others), strict=True):
            if knot < free:
                c = c + part @ cp.hstack([D[knot][0, 0], D[knot][0, 1], D[knot][1, 1]])
        for at, row in enumerate(rows):
            i, j = np.nonzero((basis[:, None] + basis[None] == row).all(axis=2))
            limits.append(cp.sum([Q[a, b] for a, b in zip(i, j, strict=True)]) == c[at])
    aim = [w * cp.trace(d) for w, d in zip(of["weights"], D, strict=True)]
    problem = cp.Problem(cp.Minimize(cp.sum(aim)), limits)
    problem.solve(solver=cp.CLARABEL)
    return problem.value


def test_the_optimum_is_that_of_a_general_solver() -> None:
    samples = contracting(4)
    options: dict[str, Any] = {"weights": np.array([1.0, 0.5, 0.8]), "trust": 0.4}
    D = improve(samples, powers(2, 2), **options)
    best = by_cvxpy(samples, 3, **options)
    assert np.abs(np.linalg.eigvalsh(D)).max() <= 0.4
    reached = options["weights"] @ np.trace(D, axis1=1, axis2=2)
    assert best - 1e-4 <= reached <= best + 0.02 * options["weights"].sum()


def test_margins_that_nothing_keeps_are_said() -> None:
    with pytest.raises(SolverError, match="keeps the margins"):
        improve(contracting(4, 50.0), powers(2, 2), weights=np.ones(3), trust=0.4)
