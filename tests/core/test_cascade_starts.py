"""How the trials of a block cascade begin: at rest, or in motion."""

import numpy as np
import pytest

from nlsid_core.data.trajectory import Dataset
from nlsid_core.identification import FilterMapFilter, Network
from nlsid_core.identification.network.cascade import identify_block_cascade
from nlsid_core.identification.network.cascade_fit import Parameters, Trial, sensitivities, simulate
from nlsid_core.models import BlockCascade
from tests.cascades import in_motion, truth, two_phases, wiener


@pytest.mark.parametrize("model", [truth(), two_phases(), wiener()])
def test_the_fit_simulates_as_the_model_does(model: BlockCascade) -> None:
    u, y = np.random.default_rng(1).standard_normal((2, 300))
    p = Parameters(model.a1, model.b1, model.f, model.a2, model.b2)
    for from_rest, start in ((True, None), (False, y[: len(model.a2)])):
        fast = simulate(p, Trial(u, y, 0, from_rest))
        np.testing.assert_allclose(model.simulate(u, start), fast, atol=1e-12)


@pytest.mark.parametrize("model", [truth(), two_phases(), wiener()])
def test_a_simulation_in_motion_goes_on_where_a_held_input_has_led(model: BlockCascade) -> None:
    u = 2.0 * np.random.default_rng(2).standard_normal(100)
    before = 3000
    outputs = model.simulate(np.concatenate([np.full(before, u[0]), u]))[before:]
    n = len(model.a2)
    np.testing.assert_allclose(model.simulate(u, outputs[:n]), outputs, atol=1e-12)
    if n:  # the second filter's state is measured, not that of the held input
        other = model.simulate(u, outputs[:n] + 1.0)
        later = np.arange(n - 1, len(u))
        np.testing.assert_allclose((other - outputs)[later], 0.7 ** (later - n + 1), atol=1e-12)


@pytest.mark.parametrize("from_rest", [True, False])
@pytest.mark.parametrize("model", [two_phases(), wiener()])
def test_sensitivities_are_the_derivatives_of_the_output(
    model: BlockCascade, from_rest: bool
) -> None:
    rng = np.random.default_rng(2)
    p = Parameters(model.a1, model.b1, model.f, model.a2, model.b2)
    trial = Trial(2.0 * rng.standard_normal(200), rng.standard_normal(200), 0, from_rest)
    J, size, step = sensitivities(trial, p), p.vector().size, 1e-6
    for k in range(size):
        up, down = (simulate(p.moved(sign * step * np.eye(size)[k]), trial) for sign in (1, -1))
        slope = (up - down) / (2 * step)
        np.testing.assert_allclose(J[k], slope, atol=1e-7 * (1.0 + np.abs(slope).max()))


@pytest.mark.slow
def test_trials_that_begin_in_motion_are_identified_to_the_noise() -> None:
    train = Dataset(tuple(in_motion(150, seed) for seed in range(8)))
    validation = Dataset(tuple(in_motion(150, seed) for seed in (20, 21)))
    rms = {}
    for begin in ("measured", "rest"):
        *_, steps = identify_block_cascade(
            train,
            validation,
            Network(
                FilterMapFilter((2, 1), phases=(1,), intervals=(8,), starts=4, begin=begin), seed=3
            ),
        )
        rms[begin] = min(step.value for step in steps)
    assert rms["measured"] < 0.004
    assert rms["rest"] > 5 * rms["measured"]
