"""Simulation error: its derivatives, and the last step that keeps the certificate."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks.recorded import heat_exchanger, single
from nlsid import Dataset, Degrees, Polynomial, Rse, Sem, Trajectory, identify
from nlsid_core.arrays import FloatArray
from nlsid_core.errors import SolverError
from nlsid_core.identification import Search, prove_stability, simulation_percent, trail, validate
from nlsid_core.identification.methods import newton, rse
from nlsid_core.identification.methods.rse import Bound, robust_simulation_error
from nlsid_core.identification.methods.simulation_error import SimulationError
from nlsid_core.identification.polynomial.certified import (
    certified_simulation_error,
    descend_certified,
)
from nlsid_core.identification.polynomial.explicit import equation_error, minimise_simulation_error
from nlsid_core.identification.polynomial.rows import build_state_affine_rows
from nlsid_core.identification.starts import companion, reduced, reflected
from nlsid_core.identification.trail import tried
from nlsid_core.models import DifferenceEquation
from tests.conftest import synthetic_dataset
from tests.decided import checked
from tests.marks import slow_among
from tests.state_affine_rows import EXACT, near_identity, problem

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def largest(values: FloatArray) -> float:
    return float(np.max(np.abs(values)))


@pytest.mark.parametrize("outputs", [1, 2])
def test_the_simulation_error_of_the_rows_is_that_of_the_model(outputs: int) -> None:
    stacked = problem(outputs=outputs)
    rows = stacked.rows
    theta = near_identity(rows, 4, 0.05)
    objective = SimulationError(rows)
    point = objective.at(theta)
    model = stacked.model(theta, point.p)
    errors = np.concatenate(
        [
            ((model.simulate(trial.u, trial.y[: len(model)]) - trial.y) / model.y_scale)[
                len(model) :
            ]
            for trial in stacked.dataset
        ]
    ).ravel()
    assert pytest.approx(errors @ errors, rel=1e-9) == point.J
    assert pytest.approx(point.J, rel=1e-9) == Bound(rows, theta).at(theta).J
    gradient, hessian = objective.derivatives(point)
    step = 1e-6
    for i, unit in enumerate(np.eye(len(theta))):
        slope = (objective.at(theta + step * unit).J - objective.at(theta - step * unit).J) / (
            2 * step
        )
        assert gradient[i] == pytest.approx(slope, rel=1e-5, abs=1e-5 * largest(gradient))
    assert np.linalg.eigvalsh(hessian)[0] >= -EXACT * largest(hessian)


def test_iterates_never_go_up_and_end_at_the_simulation_error() -> None:
    rows = problem(trials=2, samples=120).rows
    iterates = list(robust_simulation_error(rows, iterations=8))
    bounds = [iterate.J for iterate in iterates]
    assert len(bounds) > 2
    assert bounds == sorted(bounds, reverse=True)
    at_last = SimulationError(rows).at(iterates[-1].theta).J
    assert at_last <= bounds[-1] * (1 + EXACT)


@pytest.mark.slow
def test_the_last_step_of_a_linear_model_keeps_its_proof_and_never_goes_up() -> None:
    dataset = synthetic_dataset(0.4)
    regression = build_state_affine_rows(dataset, Polynomial(3))
    start = equation_error(regression)
    assert isinstance(start, DifferenceEquation)
    assert prove_stability(start) is not None
    found = minimise_simulation_error(regression, np.r_[1.0, -start.a], stable=True)
    assert prove_stability(found) is not None
    assert simulation_percent(found, dataset) < 0.999 * simulation_percent(start, dataset)
    fit = identify(dataset, Polynomial(3))
    again = minimise_simulation_error(regression, np.r_[1.0, -fit.model.a], stable=True)
    assert simulation_percent(again, dataset) <= simulation_percent(fit.model, dataset) * (1 + 1e-9)


def test_the_last_step_on_the_heat_exchanger_keeps_the_certificate(tmp_path: Path) -> None:
    folder = DATA / "exchanger"
    if not folder.is_dir():
        pytest.skip("no heat exchanger recording beside the repository")
    flow, temperature = heat_exchanger(folder)
    train = single("exchanger", flow[:800], temperature[:800], 1.0)
    stacked = build_state_affine_rows(
        train, Polynomial(2, degrees=Degrees(inputs=3, leading=2), input_range=((0.1, 0.7),))
    )
    first = next(certified_simulation_error(stacked))
    model = stacked.model(first.point.theta, first.point.p)
    proof = prove_stability(model)
    assert proof is not None
    found = descend_certified(stacked, model, proof)
    assert "every input" in checked(found, tmp_path)
    before, after = (simulation_percent(m, train) for m in (model, found))
    assert after < 0.8 * before


def two_resonances(seed: int, *, noise: float) -> Dataset:
    """1024 samples at 500 Hz of two lightly damped modes under steps, as of a flexible arm."""
    rng = np.random.default_rng(seed)
    poles = [r * np.exp(s * 1j * a) for r, a in ((0.995, 0.06), (0.98, 0.6)) for s in (1, -1)]
    b = np.concatenate([[0.0], 0.1 * rng.normal(size=4)])
    u = np.repeat(rng.normal(size=128), 8)
    y = lfilter(b, np.poly(poles).real, u)
    y += noise * np.std(y) * rng.normal(size=len(u))
    return Dataset((Trajectory(t=np.arange(len(u)) * 0.002, y=y, u=u, name="arm"),))


@pytest.mark.parametrize(
    ("seed", "noise", "lags", "stuck", "reached"),
    slow_among(
        [
            (3, 0.02, 2, 90.0, 6.5),
            (4, 0.1, 2, 90.0, 18.0),
            (8, 0.1, 2, 35.0, 18.0),
            (1, 0.1, 4, 20.0, 18.0),
        ],
        {8, 1},
    ),
)
def test_where_iterates_from_the_identity_stop_far_off_other_starts_reach_the_minimum(
    seed: int, noise: float, lags: int, stuck: float, reached: float
) -> None:
    data = two_resonances(seed, noise=noise)
    regression = build_state_affine_rows(data, Polynomial(lags))
    *_, last = robust_simulation_error(regression.rows)
    assert simulation_percent(regression.model(last.theta, last.p), data) > stuck
    fit = identify(data, Polynomial(lags), method=Sem(certified=True))
    errors = {one.method.name: simulation_percent(one.model, data) for one in fit.candidates}
    assert errors["rse"] < reached
    assert errors["sem_certified"] <= errors["sem"] * (1 + 1e-3) < reached
    assert errors["sem_certified"] <= errors["rse"] * (1 + 1e-9)
    assert all(candidate.proof is not None for candidate in fit.candidates)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3])
def test_three_resonances_from_rest_are_found_to_the_noise_where_the_identity_is_not(
    seed: int,
) -> None:
    """10 % noise, which no simulation is far below; none in the samples that a simulation begins
    with, which three slow modes would carry through the whole trial.
    """
    rng = np.random.default_rng(seed)
    modes = ((0.995, 0.06), (0.99, 0.3), (0.98, 0.6))
    poles = [r * np.exp(s * 1j * angle) for r, angle in modes for s in (1, -1)]
    moving = np.arange(1024) >= 8
    u = np.repeat(rng.normal(size=128), 8) * moving
    y = lfilter(np.concatenate([[0.0], 0.1 * rng.normal(size=6)]), np.poly(poles).real, u)
    y += 0.1 * np.std(y) * rng.normal(size=len(u)) * moving
    data = Dataset((Trajectory(t=0.002 * np.arange(len(u)), y=y, u=u, name="arm"),))
    regression = build_state_affine_rows(data, Polynomial(6))
    *_, stuck = robust_simulation_error(regression.rows)
    assert simulation_percent(regression.model(stuck.theta, stuck.p), data) > 15.0
    fit = identify(data, Polynomial(6), method=Sem(certified=True))
    assert 9.0 < fit.errors["train"]["sem_certified"] < 10.3
    assert fit.proof.rate <= fit.max_rate


def beside_another_output(data: Dataset) -> Dataset:
    """The data's output, and one sample later half of it with some noise, as two outputs."""
    (trial,), rng = data, np.random.default_rng(0)
    other = 0.5 * np.roll(trial.y, 1) + 0.01 * np.std(trial.y) * rng.normal(size=trial.y.shape)
    y = np.hstack([trial.y, other])
    return Dataset((Trajectory(t=trial.t, y=y, u=trial.u, name="two"),))


@pytest.mark.parametrize("outputs", slow_among([1, 2], {2}))
def test_state_affine_models_of_one_and_several_outputs_have_other_starts_too(outputs: int) -> None:
    one = two_resonances(4, noise=0.1)
    data, lags, least = (one, 2, 17.3) if outputs == 1 else (beside_another_output(one), 1, 11.0)
    model_class = Polynomial(lags)
    stacked = build_state_affine_rows(data, model_class)
    *_, stuck = robust_simulation_error(stacked.rows)
    assert simulation_percent(stacked.model(stuck.theta, stuck.p), data) > 90.0
    fit = identify(data, model_class, method=Rse(), search=Search(comparators=()))
    assert fit.errors["train"]["rse"] < least
    assert fit.proof.rate < 1.0


@pytest.mark.slow
def test_a_large_problem_has_fewer_bounds_from_every_start(monkeypatch: pytest.MonkeyPatch) -> None:
    data = two_resonances(1, noise=0.1)
    whole = identify(data, Polynomial(4), method=Rse(), search=Search(comparators=()))
    monkeypatch.setattr(rse, "WORK", 1.0)
    short = identify(data, Polynomial(4), method=Rse(), search=Search(comparators=()))
    assert len(whole.history.steps) > trail.FEWEST_BOUNDS == len(short.history.steps)
    longer, shorter = (simulation_percent(fit.model, data) for fit in (whole, short))
    assert longer < shorter < 18.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3])
def test_among_poles_at_the_slowest_rate_the_last_step_is_not_above_the_iterates(seed: int) -> None:
    """The truth forgets more slowly than a trial can tell: the limit on the rate is active."""
    rng = np.random.default_rng(seed)
    poles = [r * np.exp(s * 1j * a) for r, a in ((0.9995, 0.3), (0.99, 0.9)) for s in (1, -1)]
    u = rng.standard_normal(600)
    y = lfilter([0.0, 0.1, 0.2, 0.1], np.poly(poles).real, u)
    y += 0.1 * np.std(y) * rng.standard_normal(600)
    data = Dataset((Trajectory(t=0.1 * np.arange(600), y=y, u=u),))
    fit = identify(data, Polynomial(4), method=Sem(10, certified=True))
    errors = {one.method.name: simulation_percent(one.model, data) for one in fit.candidates}
    assert errors["sem_certified"] <= errors["rse"] * (1 + 1e-9)
    assert errors["rse"] < 20.0
    assert fit["rse"].proof is not None


def test_reflected_poles_of_several_outputs_are_inside_and_the_others_stay() -> None:
    rng = np.random.default_rng(0)
    a = rng.standard_normal((3, 2, 2))
    a[2, 1] = a[2, 0]  # a pole at 0
    theta = np.concatenate([np.eye(2)[None], -a]).ravel()
    before = np.linalg.eigvals(companion(a))
    found = reflected(theta, 0.9, 2).reshape(4, 2, 2)
    after = np.linalg.eigvals(companion(-found[1:]))
    wanted = np.where(np.abs(before) > 1.0, 1.0 / before.conj(), before)
    wanted *= np.minimum(1.0, 0.9 / np.maximum(np.abs(wanted), 1e-12))
    assert np.sum(np.abs(before) > 1.0) == 3
    assert np.sort(np.abs(after)) == pytest.approx(np.sort(np.abs(wanted)), abs=1e-6)
    inside = np.concatenate([np.eye(2)[None], -0.1 * a]).ravel()
    assert reflected(inside, 0.9, 2) is inside


def test_a_longer_model_is_reduced_to_the_poles_it_has() -> None:
    """Extra poles that zeros cancel do not show in the impulse response."""
    data = two_resonances(0, noise=0.0)
    short: Any = equation_error(build_state_affine_rows(data, Polynomial(4)))
    extra = np.poly([0.7, -0.6]).real
    a = -np.convolve(np.concatenate([[1.0], -short.a]), extra)[1:]
    found = reduced(a[:, None, None], np.convolve(short.b, extra)[:, None, None], 4)
    poles = np.linalg.eigvals(companion(found))
    assert np.sort_complex(poles) == pytest.approx(
        np.sort_complex(np.roots(np.concatenate([[1.0], -short.a]))), abs=1e-6
    )


def test_clipped_samples_and_the_error_in_the_signals_unit_are_said() -> None:
    stacked = problem(model_class=Polynomial(1, input_range=((-0.5, 0.5),)))
    *_, last = robust_simulation_error(stacked.rows, iterations=3)
    model = stacked.model(last.theta, last.p)
    scores = validate(model, stacked.dataset)
    u = np.concatenate([trial.u for trial in stacked.dataset])
    assert scores.clipped_percent > 1
    assert scores.clipped_percent == pytest.approx(100 * np.mean(np.abs(u) > 0.5))
    assert "which the model clips" in str(scores)
    ((_, rms, _),) = scores.output_rms
    left = [
        (model.simulate(trial.u, trial.y[: len(model)]) - trial.y)[len(model) :]
        for trial in stacked.dataset
    ]
    assert rms == pytest.approx(np.sqrt(np.mean(np.square(np.concatenate(left)))))
    spread = np.std(np.concatenate([trial.y[len(model) :] for trial in stacked.dataset]))
    assert f" of the {spread:.3g} " in str(scores)
    assert scores.simulation_percent == pytest.approx(100 * rms / spread)


def test_a_start_whose_simulation_overflows_leaves_the_other_starts_to_betried() -> None:
    """A pole at 1.3 over 2000 samples: its errors are beyond all numbers, and no traceback."""
    rng, N = np.random.default_rng(0), 2000
    walk = np.cumsum(rng.standard_normal((N, 1)), axis=0)
    trial = Trajectory(t=np.arange(N) * 1.0, y=walk, u=rng.standard_normal((N, 1)))
    rows = build_state_affine_rows(Dataset((trial,)), Polynomial(2)).rows
    starts = [np.array([1.0, -2.2, 1.17]), np.array([1.0, -1.4, 0.45])]
    error = SimulationError(rows)
    found = [tried(start.copy, lambda theta: error.at(theta).J) for start in starts]
    assert found[0] is None
    assert found[1] is not None


def test_a_parameter_whose_curvature_is_lost_in_rounding_keeps_its_place() -> None:
    """On a matrix that is not finite LAPACK's least squares may never return."""
    hessian = np.array([[2.0, 1e-17], [1e-17, -1e-17]])
    step = newton._newton_step(np.array([1.0, 1e-17]), hessian)
    assert step[0] == pytest.approx(-0.5)
    assert abs(step[1]) < 1.0
    with pytest.raises(SolverError, match="beyond all numbers"):
        newton._newton_step(np.array([1e300, 0.0]), np.array([[1e-300, 1e300], [1e300, 1e-300]]))
