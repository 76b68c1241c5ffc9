"""Moments of repeated experiments, and the robust identification error through them."""

from dataclasses import replace

import numpy as np
import pytest

from nlsid import Dataset, Degrees
from nlsid import Polynomial as Equation
from nlsid_core.arrays import FloatArray
from nlsid_core.errors import DataError
from nlsid_core.identification.polynomial.moment_rie import (
    Layout,
    MomentFit,
    identify_from_repeats,
    minimise_moment_rie,
)
from nlsid_core.identification.polynomial.moments import (
    Moments,
    offsets_of,
    plain_moments,
    repeated_moments,
)
from nlsid_core.polynomial import Polynomial, variables
from tests.repeated import CLASS, NOISE, OFFSETS, pair, percent, run, total


@pytest.fixture(scope="module")
def fit() -> MomentFit:
    return identify_from_repeats(Dataset(pair(4000, 1)), CLASS)


# -- moments ---------------------------------------------------------------------------------


def test_moments_without_noise_are_the_averages_of_the_monomials() -> None:
    first, second = pair(400, 5, noise=0.0)
    M = repeated_moments([[first, second]], CLASS, OFFSETS).matrix()
    y, u = first.y[:, 0], first.u[:, 0]
    now = y[2:]
    rows = [now, now**2, now**3, np.ones_like(now), y[1:-1], y[:-2], u[2:]]
    Lambda = np.stack(rows)
    np.testing.assert_allclose(M, Lambda @ Lambda.T / len(now), atol=1e-12)
    plain = plain_moments([first], CLASS, OFFSETS)
    np.testing.assert_allclose(plain.matrix(), M, atol=1e-12)
    np.testing.assert_allclose(plain.noise()[1:], 0.0, atol=1e-12)


def test_the_bias_of_noise_is_removed_from_every_moment() -> None:
    noisy, clean = pair(30_000, 6, noise=0.3), pair(30_000, 6, noise=0.0)
    exact = plain_moments([clean[0]], CLASS, OFFSETS).matrix()
    unbiased = repeated_moments([noisy], CLASS, OFFSETS)
    biased = plain_moments(noisy, CLASS, OFFSETS).matrix()
    scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    assert np.abs((unbiased.matrix() - exact) / scale).max() < 0.03
    assert np.abs((biased - exact) / scale).max() > 0.3
    assert unbiased.noise()[2] == pytest.approx(0.09, rel=0.03)
    assert unbiased.noise()[4] == pytest.approx(3 * 0.09**2, rel=0.2)


def test_both_roles_count_the_same() -> None:
    first, second = pair(300, 7)
    one = repeated_moments([[first, second]], CLASS, OFFSETS).matrix()
    other = repeated_moments([[second, first]], CLASS, OFFSETS).matrix()
    np.testing.assert_allclose(one, other, atol=1e-12)


def test_moments_add_over_bags() -> None:
    groups = [pair(300, seed) for seed in (1, 2, 3)]
    together = repeated_moments(groups, CLASS, OFFSETS)
    apart = [repeated_moments([group], CLASS, OFFSETS) for group in groups]
    summed = apart[0] + apart[1] + apart[2]
    assert summed.count == together.count
    np.testing.assert_allclose(summed.matrix(), together.matrix(), atol=1e-12)


def test_three_repeats_use_every_pair() -> None:
    w = np.random.default_rng(0).uniform(-1, 1, 200)
    runs = [run(w, NOISE, seed) for seed in range(3)]
    assert repeated_moments([runs], CLASS, OFFSETS).count == 6 * 198


# -- the inequalities ------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [1, 3])
@pytest.mark.parametrize("n", [1, 3])
def test_the_gram_matrices_are_the_inequalities_of_the_thesis(n: int, degree: int) -> None:
    """(3.8) and (3.9), multiplied out from their definitions with random unknowns."""
    rng = np.random.default_rng(n + degree)
    layout = Layout(n, 1, degree)
    unknowns = rng.integers(-5, 6, layout.unknowns).astype(float)
    P, c, R = unknowns[layout.P], unknowns[layout.c], unknowns[layout.R]
    x, other = ([*variables([f"{letter}{k}" for k in range(n)])] for letter in "xz")
    y, v, w = variables("y v w")
    one = 0 * y + 1

    def e(s: Polynomial) -> Polynomial:
        return total(c[k] * s ** (k + 1) for k in range(degree))

    def f(state: list[Polynomial]) -> Polynomial:
        past = total(-k * s for k, s in zip(c[degree + 1 :], state, strict=False))
        return total([past, -c[degree] * one, -c[-1] * w])

    def storage(delta: list[Polynomial]) -> Polynomial:
        return form(P, delta)

    delta = [a - b for a, b in zip(x, other, strict=True)]
    d = v - y
    moved = [d, *delta[:-1]]
    slack = total(s * s for s in delta)
    p = 2 * d * (e(v) - e(y) - f(x) + f(other)) + storage(delta) - storage(moved) - 0.25 * slack
    cubic = degree == 3
    z8 = [*delta, d, (v + y) * d] if cubic else [*delta, d]
    rest = 0.5 * c[2] * d**4 if cubic else 0 * y
    assert_same(p, form(layout.stability(0.25).at(unknowns), z8) + rest)
    # Here the measured point is (other, y), the model's is (x, v).
    Lambda = [*([y, y**2, y**3] if cubic else [y]), one, *other, w]
    q = form(R, Lambda) - delta[0] ** 2 + storage(delta) - storage(moved) + 2 * d * (e(v) - f(x))
    z9 = [*Lambda, *delta, d, *([y * d, d**2] if cubic else [])]
    assert_same(q, form(layout.error_bound().at(unknowns), z9))


def form(Q: FloatArray, z: list[Polynomial]) -> Polynomial:
    k = range(len(z))
    return total(float(Q[i, j]) * z[i] * z[j] for i in k for j in k)


def assert_same(p: Polynomial, q: Polynomial) -> None:
    difference = (p - q).coefficients
    assert np.abs(difference).max(initial=0.0) < 1e-9


def test_sizes_are_those_of_the_structure() -> None:
    layout = Layout(22, 1, 3)
    assert (layout.stability(1e-3).order, layout.error_bound().order) == (24, 52)
    assert layout.unknowns == 664


# -- identification --------------------------------------------------------------------------


def test_without_bias_removal_the_model_is_far_worse(fit: MomentFit) -> None:
    runs = pair(4000, 1)
    moments = plain_moments(runs, CLASS, OFFSETS)
    naive = minimise_moment_rie(moments, CLASS, Dataset(runs), OFFSETS)
    assert percent(naive.model) > 3.0 * percent(fit.model)


@pytest.mark.parametrize("size", [1e-3, 1e4])
def test_the_unit_of_the_response_does_not_matter(fit: MomentFit, size: float) -> None:
    first, second = (replace(t, y=size * t.y) for t in pair(4000, 1))
    scaled = identify_from_repeats(Dataset((first, second)), CLASS)
    assert scaled.bound == pytest.approx(size**2 * fit.bound, rel=1e-3)
    w = np.random.default_rng(0).uniform(-2.0, 2.0, 300)
    simulated, own = scaled.model.simulate(w) / size, fit.model.simulate(w)
    assert np.abs(simulated - own)[10:].max() < 1e-3 * np.ptp(own)


def test_responses_without_a_common_signal_are_refused() -> None:
    w = np.random.default_rng(0).uniform(-1.0, 1.0, 300)
    first = run(w, NOISE, 1)
    opposite = replace(first, y=-first.y, name="opposite")
    offsets = offsets_of([first, opposite])
    moments = repeated_moments([[first, opposite]], CLASS, offsets)
    with pytest.raises(DataError, match="nothing in common"):
        minimise_moment_rie(moments, CLASS, Dataset((first,)), offsets)


@pytest.mark.slow
def test_the_error_falls_with_more_data() -> None:
    def mean_error(samples: int) -> float:
        fits = [
            identify_from_repeats(Dataset(pair(samples, seed, noise=0.2)), CLASS)
            for seed in range(4)
        ]
        return float(np.mean([percent(found.model) for found in fits]))

    errors = [mean_error(samples) for samples in (400, 4000, 20_000)]
    assert errors[2] < 0.5 * errors[1] < 0.3 * errors[0]


def test_the_bound_is_above_the_simulation_error_without_noise() -> None:
    trial = run(np.random.default_rng(4).uniform(-2, 2, 2000), 0.0, 4)
    small = Equation(1, (0,), Degrees(left=3), set="3.8")  # a model that cannot be exact
    moments = plain_moments([trial], small, OFFSETS)
    found = minimise_moment_rie(moments, small, Dataset((trial,)), OFFSETS)
    simulated = found.model.simulate(trial.u, trial.y[:1, 0])
    error = float(np.mean((simulated - trial.y[:, 0])[1:] ** 2))
    assert 0 < error <= found.bound


def test_moments_hold_their_class() -> None:
    moments = plain_moments(pair(100, 1), Equation(2, (0,), set="3.8"), OFFSETS)
    assert isinstance(moments, Moments)
    assert moments.degree == 1
    assert moments.matrix().shape == (5, 5)
