"""Coloured noise: the estimate of its covariance, and the fit that is weighted by its inverse."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import cholesky, toeplitz
from scipy.optimize import least_squares
from scipy.signal import lfilter

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import OptionError, SolverError
from nlsid_core.identification import LeastSquares, LinearClass, Rse, StateAffineClass, identify
from nlsid_core.identification.methods.banded import sparse
from nlsid_core.identification.methods.rse import robust_simulation_error
from nlsid_core.identification.noise import Noise
from nlsid_core.identification.polynomial.linear import build_regression

TRUE = np.array([1.5, -0.7, 0.0, 1.0, 0.5])  # a_1, a_2, b_0, b_1, b_2
RSE = Rse(iterations=20)


def recorded(seed: int, *, pole: float, samples: int = 1500, name: str = "run") -> Trajectory:
    """A damped system, its output with noise of a first-order lag, 30 % of its spread."""
    rng = np.random.default_rng(seed)
    u = lfilter([1.0], [1.0, -0.5], rng.standard_normal(samples))
    y = lfilter(TRUE[2:], np.r_[1.0, -TRUE[:2]], u)
    noise = lfilter([1.0], [1.0, -pole], rng.standard_normal(samples + 500))[500:]
    noise *= 0.3 * y.std() / noise.std()
    return Trajectory(t=1.0 * np.arange(samples), y=y + noise, u=u, name=name)


def fitted(train: Dataset, noise_lags: int, *, validation: Dataset | None = None) -> FloatArray:
    model_class = LinearClass(2, noise_lags=noise_lags)
    found = identify(train, model_class, method=RSE, comparators=(), validation=validation)
    model = found.model
    return np.concatenate([model.a, model.b])


def test_a_covariance_is_toeplitz_in_each_trial_and_each_output_and_zero_between() -> None:
    first, second = np.array([1.0, 0.5, 0.2]), np.array([1.0, -0.4, 0.1])
    noise = Noise(np.array([first, second]))
    found = sparse(noise.covariance(np.array([0.0, 1.0, 2.0, 3.0, 0.0, 1.0]))).toarray()
    wanted = np.zeros((12, 12))
    for output, values in enumerate((first, second)):
        whole = toeplitz(np.r_[values, 0.0])
        rows = np.arange(4) * 2 + output
        wanted[np.ix_(rows, rows)] = whole
        wanted[np.ix_(rows[:2] + 8, rows[:2] + 8)] = whole[:2, :2]
    np.testing.assert_array_equal(found, wanted)


def test_the_correlation_of_a_residual_is_that_of_its_noise_and_gives_a_definite_covariance() -> (
    None
):
    rng = np.random.default_rng(1)
    runs = [lfilter([1.0], [1.0, -0.8], rng.standard_normal((20_000, 1)), axis=0) for _ in range(3)]
    lags = 40
    found = Noise.of(runs, lags).correlation[0]
    near = np.arange(6)  # under Parzen's window, 1 - 6 x² + ... there
    x = near / (lags + 1)
    np.testing.assert_allclose(found[near], 0.8**near * (1 - 6 * x**2 * (1 - x)), atol=0.03)
    short = Noise.of([run[:60] for run in runs], lags)  # few samples, and still definite
    covariance = sparse(short.covariance(np.arange(200.0))).toarray()
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    with pytest.raises(SolverError, match="residual of an output is zero"):
        Noise.of([np.zeros((50, 1))], 5)


def test_more_noise_lags_than_a_trial_has_samples_are_taken_from_the_others_or_are_zero() -> None:
    long, short = np.random.default_rng(2).standard_normal((2, 300, 1))
    found = Noise.of([long, short[:6]], 40).correlation[0]
    products = [(r[k:] * r[: len(r) - k]).sum() for r, k in ((long, 20), (long, 0))]
    x = 20 / 41
    wanted = 0.999 * (1 - 6 * x**2 * (1 - x)) * products[0] / (products[1] + (short[:6] ** 2).sum())
    assert found[20] == pytest.approx(wanted, abs=1e-12)
    trials = Dataset((recorded(7, pole=0.9, samples=80),))
    assert np.isfinite(fitted(trials, 200)).all()


def test_the_robust_error_with_a_noise_is_least_squares_of_the_whitened_simulation_error() -> None:
    """By a minimiser and a dense factor that know nothing of bands or bounds."""
    trial = recorded(3, pole=0.9, samples=300)
    regression = build_regression(Dataset((trial,)), 2)
    noise = Noise(np.array([0.7 ** np.arange(20.0) * (1 - np.arange(20.0) / 20)]))
    *_, last = robust_simulation_error(replace(regression, noise=noise).rows, iterations=40)
    found = regression.model(last.theta, last.p)
    y, u = trial.y[:, 0], trial.u[:, 0]
    root = cholesky(toeplitz(np.r_[noise.correlation[0], np.zeros(278)]), lower=True)

    def whitened(p: FloatArray) -> FloatArray:
        a, b, c = p[:2], p[2:5], p[5]
        simulated = y.copy()
        for t in range(2, 300):
            simulated[t] = a @ simulated[t - 2 : t][::-1] + b @ u[t - 2 : t + 1][::-1] + c
        return np.linalg.solve(root, (y - simulated)[2:])

    start = np.r_[TRUE, 0.0]
    wanted = least_squares(whitened, start, xtol=1e-12, ftol=1e-12, gtol=1e-12).x
    np.testing.assert_allclose(np.r_[found.a, found.b, found.c], wanted, atol=2e-4)


@pytest.mark.slow
def test_both_classes_fit_the_same_with_validation_trials_and_with_some_held_out() -> None:
    runs = [recorded(seed, pole=0.95, name=f"run {seed}") for seed in range(3)]
    train, validation = Dataset(tuple(runs[:2])), Dataset((runs[2],))
    coloured = fitted(train, 10)
    np.testing.assert_array_equal(fitted(train, 10, validation=validation), coloured)
    assert np.linalg.norm(coloured - TRUE) < 0.8 * np.linalg.norm(fitted(train, 0) - TRUE)
    model_class = StateAffineClass(2, noise_lags=10)
    found = identify(train, model_class, method=RSE, comparators=()).model
    left = np.array([float(g.coefficients[0, 0, 0]) for g in found.G])
    np.testing.assert_allclose(-left[1:] / left[0], coloured[:2], atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("pole", "gain"), [(0.95, 3.0), (0.8, 1.8), (0.0, 0.95)])
def test_coefficients_are_as_good_as_those_of_maximum_likelihood(pole: float, gain: float) -> None:
    """Which is Box and Jenkins's model with the noise's true structure, begun at the truth.

    Root mean squares of 10 runs: 0.155 white, 0.042 coloured, 0.045 Box and Jenkins at pole 0.95.
    """
    errors: dict[str, list[float]] = {"white": [], "coloured": [], "likelihood": []}
    for seed in range(10):
        trial = recorded(seed, pole=pole)
        y, u = trial.y[:, 0], trial.u[:, 0]

        def innovations(p: FloatArray, y: FloatArray = y, u: FloatArray = u) -> FloatArray:
            left = y - lfilter(p[2:5], np.r_[1.0, -p[:2]], u)
            return np.asarray(lfilter([1.0, -p[5]], [1.0], left)[5:])

        likely = least_squares(innovations, np.r_[TRUE, 0.5], x_scale="jac").x[:5]
        train = Dataset((trial,))
        found = {"likelihood": likely, "white": fitted(train, 0), "coloured": fitted(train, 10)}
        for name, coefficients in found.items():
            errors[name].append(float(np.linalg.norm(coefficients - TRUE)))
    rms = {name: float(np.sqrt(np.mean(np.square(off)))) for name, off in errors.items()}
    assert rms["coloured"] < rms["white"] / gain
    assert rms["coloured"] < 1.05 * rms["likelihood"]


def test_what_a_poor_model_leaves_is_not_taken_for_noise() -> None:
    rng = np.random.default_rng(0)
    u = rng.standard_normal(1500)
    poles = [0.9 * np.exp(0.3j), 0.9 * np.exp(-0.3j), 0.7, 0.95]
    y = lfilter([0.0, 1.0], np.poly(poles).real, u)
    train = Dataset((Trajectory(t=1.0 * np.arange(1500), y=y, u=u, name="run"),))
    found = identify(train, LinearClass(2, noise_lags=20), method=RSE, comparators=())
    assert len(found.history.steps) == 1
    np.testing.assert_array_equal(np.r_[found.model.a, found.model.b], fitted(train, 0))


def test_a_method_that_takes_no_weights_is_refused_with_noise_lags() -> None:
    train = Dataset((recorded(0, pole=0.5, samples=200),))
    with pytest.raises(OptionError, match="0 with the method least_squares"):
        identify(train, LinearClass(2, noise_lags=5), method=LeastSquares())
    with pytest.raises(OptionError, match="noise_lags"):
        LinearClass(2, noise_lags=-1)
