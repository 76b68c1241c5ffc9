"""Moments of repeated experiments, and the robust identification error through them."""

from dataclasses import replace

import numpy as np
import pytest

from nlsid import Dataset, Degrees
from nlsid import Polynomial as Equation
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.errors import DataError
from nlsid_core.identification.polynomial.implicit_rie import ImplicitFit, minimise_implicit_rie
from nlsid_core.identification.polynomial.implicit_rows import build_implicit_rows
from nlsid_core.identification.polynomial.moments import repeated_moments, rows_without_bias
from nlsid_core.identification.polynomial.monotone_rie import CURVED, stability
from nlsid_core.polynomial import Polynomial, variables
from tests.repeated import CLASS, NOISE, pair, percent, run, total, without_bias


@pytest.fixture(scope="module")
def fit() -> ImplicitFit:
    return without_bias(*pair(4000, 1))


def averages(trial: Trajectory) -> FloatArray:
    """Of the products of the class's monomials, as they are measured."""
    y, u = trial.y[:, 0], trial.u[:, 0]
    now = y[2:]
    Lambda = np.stack([now, now**2, now**3, np.ones_like(now), y[1:-1], y[:-2], u[2:]])
    return np.asarray(Lambda @ Lambda.T / len(now))


# -- moments ---------------------------------------------------------------------------------


def test_moments_without_noise_are_the_averages_of_the_monomials() -> None:
    first, second = pair(400, 5, noise=0.0)
    moments = repeated_moments([[first, second]], CLASS)
    np.testing.assert_allclose(moments.matrix(), averages(first), atol=1e-12)
    np.testing.assert_allclose(moments.noise()[1:], 0.0, atol=1e-12)


def test_the_bias_of_noise_is_removed_from_every_moment() -> None:
    noisy, clean = pair(30_000, 6, noise=0.3), pair(30_000, 6, noise=0.0)
    exact, biased = averages(clean[0]), averages(noisy[0])
    unbiased = repeated_moments([noisy], CLASS)
    scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    assert np.abs((unbiased.matrix() - exact) / scale).max() < 0.03
    assert np.abs((biased - exact) / scale).max() > 0.3
    assert unbiased.noise()[2] == pytest.approx(0.09, rel=0.03)
    assert unbiased.noise()[4] == pytest.approx(3 * 0.09**2, rel=0.2)


def test_both_roles_count_the_same() -> None:
    first, second = pair(300, 7)
    one = repeated_moments([[first, second]], CLASS).matrix()
    other = repeated_moments([[second, first]], CLASS).matrix()
    np.testing.assert_allclose(one, other, atol=1e-12)


def test_moments_add_over_bags() -> None:
    groups = [pair(300, seed) for seed in (1, 2, 3)]
    together = repeated_moments(groups, CLASS)
    apart = [repeated_moments([group], CLASS) for group in groups]
    summed = apart[0] + apart[1] + apart[2]
    assert summed.count == together.count
    np.testing.assert_allclose(summed.matrix(), together.matrix(), atol=1e-12)


def test_three_repeats_use_every_pair() -> None:
    w = np.random.default_rng(0).uniform(-1, 1, 200)
    runs = [run(w, NOISE, seed) for seed in range(3)]
    assert repeated_moments([runs], CLASS).count == 6 * 198


# -- the inequalities ------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [1, 3])
@pytest.mark.parametrize("n", [1, 3])
def test_the_gram_matrix_is_the_inequality_of_the_thesis(n: int, degree: int) -> None:
    """(3.8) with Q and σ, multiplied out from its definition with random unknowns."""
    rng = np.random.default_rng(n + degree)
    trial, equation = pair(100, 1)[0], Equation(n, (0,), Degrees(left=degree), set="3.8")
    rows = build_implicit_rows(Dataset((trial,)), equation)
    entries = n * (n + 1) // 2
    c_at = entries + np.arange(degree + 1 + n + 1)  # of e, 1, past outputs and the input
    G = stability(rows, 1.0, c_at, c_at[degree + 1 : degree + 1 + n])
    unknowns = rng.integers(-5, 6, len(G) - 1).astype(float)
    P = np.zeros((n, n))
    P[np.triu_indices(n)] = unknowns[:entries]
    P, c, weight = P + np.triu(P, 1).T, unknowns[c_at], unknowns[c_at[-1] + 1]
    x, other = ([*variables([f"{letter}{k}" for k in range(n)])] for letter in "xz")
    y, v = variables("y v")

    def e(s: Polynomial) -> Polynomial:
        return total(c[k] * s ** (k + 1) for k in range(degree))

    def f(state: list[Polynomial]) -> Polynomial:
        return total(-k * s for k, s in zip(c[degree + 1 :], state, strict=False))

    delta = [a - b for a, b in zip(x, other, strict=True)]
    d = v - y
    storage, moved = form(P, delta), form(P, [d, *delta[:-1]])
    kept = form(rows.weight, delta) + weight * d * d
    if degree == 3:
        kept = kept + CURVED * ((v + y) * d) ** 2
    p = 2 * d * (e(v) - e(y) - f(x) + f(other)) + storage - moved - kept
    z = [*delta, d, (v + y) * d] if degree == 3 else [*delta, d]
    rest = 0.5 * c[2] * d**4 if degree == 3 else 0 * y
    assert_same(p, form(G[0] + np.tensordot(unknowns, G[1:], 1), z) + rest)


def form(Q: FloatArray, z: list[Polynomial]) -> Polynomial:
    k = range(len(z))
    return total(float(Q[i, j]) * z[i] * z[j] for i in k for j in k)


def assert_same(p: Polynomial, q: Polynomial) -> None:
    difference = (p - q).coefficients
    assert np.abs(difference).max(initial=0.0) < 1e-9


# -- identification --------------------------------------------------------------------------


def test_without_bias_removal_the_model_is_far_worse(fit: ImplicitFit) -> None:
    naive = minimise_implicit_rie(build_implicit_rows(Dataset(pair(4000, 1)), CLASS))
    assert percent(naive.model) > 3.0 * percent(fit.model)


@pytest.mark.parametrize("size", [1e-3, 1e4])
def test_the_unit_of_the_response_does_not_matter(fit: ImplicitFit, size: float) -> None:
    scaled = without_bias(*(replace(t, y=size * t.y) for t in pair(4000, 1)))
    assert scaled.bound == pytest.approx(fit.bound, rel=1e-3)
    w = np.random.default_rng(0).uniform(-2.0, 2.0, 300)
    simulated, own = scaled.model.simulate(w) / size, fit.model.simulate(w)
    assert np.abs(simulated - own)[10:].max() < 1e-3 * np.ptp(own)


def test_responses_without_a_common_signal_are_refused() -> None:
    w = np.random.default_rng(0).uniform(-1.0, 1.0, 300)
    first = run(w, NOISE, 1)
    opposite = replace(first, y=-first.y, name="opposite")
    with pytest.raises(DataError, match="nothing in common"):
        rows_without_bias(Dataset((first, opposite)), CLASS, accept_untested_repeats=True)


@pytest.mark.slow
def test_the_error_falls_with_more_data() -> None:
    errors = [
        np.mean([percent(without_bias(*pair(n, seed, noise=0.2)).model) for seed in range(4)])
        for n in (400, 4000, 20_000)
    ]
    assert errors[2] < 0.5 * errors[1] < 0.3 * errors[0]


def test_the_bound_is_above_the_simulation_error_without_noise() -> None:
    trial = run(np.random.default_rng(4).uniform(-2, 2, 2000), 0.0, 4)
    small = Equation(1, (0,), Degrees(left=3), set="3.8")  # a model that cannot be exact
    rows = build_implicit_rows(Dataset((trial,)), small)
    found = minimise_implicit_rie(rows)
    simulated = found.model.simulate(trial.u, trial.y[:1, 0])
    error = float(np.mean((simulated - trial.y[:, 0])[1:] ** 2))
    assert 0 < error <= found.bound * rows.y_scale[1][0] ** 2
