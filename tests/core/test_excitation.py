"""Excitation signals, and the simulated vector field that they drive."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlsid_core.data.excitation import Shape, chirp, multisine, prbs, steps
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import DataError
from nlsid_core.running.plants import FAR, FieldPlant

PERIOD = 0.01


def test_a_multisine_has_power_at_its_harmonics_and_nowhere_else() -> None:
    signal = multisine(1000, PERIOD, lowest=0.5, highest=5.0, rng=np.random.default_rng(1))
    power = np.abs(np.fft.rfft(signal)) ** 2
    inside = power[5:51]
    assert inside.min() > 0.99 * inside.max()
    assert power.sum() - inside.sum() < 1e-12 * power.sum()
    assert float(np.max(np.abs(signal))) == 1.0


def test_a_chirp_goes_from_the_lowest_to_the_highest_frequency() -> None:
    signal = chirp(10_000, 1e-3, lowest=1.0, highest=20.0)
    crossings = np.flatnonzero(np.diff(np.sign(signal)) > 0) * 1e-3
    frequencies = 1.0 / np.diff(crossings)
    assert frequencies[0] == pytest.approx(1.2, abs=0.2)
    assert frequencies[-1] == pytest.approx(19.5, abs=0.7)
    assert (np.diff(frequencies) > -1.0).all()


@pytest.mark.parametrize("order", [7, 9, 10, 11])
def test_a_prbs_has_the_autocorrelation_of_a_maximal_sequence(order: int) -> None:
    length = 2**order - 1
    signal = prbs(length, PERIOD, hold=PERIOD, order=order)
    correlation = np.fft.ifft(np.abs(np.fft.fft(signal)) ** 2).real
    assert correlation[0] == pytest.approx(length)
    np.testing.assert_allclose(correlation[1:], -1.0, atol=1e-6)


signals = st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=60).map(np.array)


@given(
    signals, st.floats(-2.0, 0.0), st.floats(0.1, 3.0), st.floats(0.5, 50.0), st.floats(0.0, 0.3)
)
def test_no_signal_leaves_the_limits_the_slew_rate_or_ends_away_from_rest(
    signal: np.ndarray, lowest: float, highest: float, slew: float, fade: float
) -> None:
    shape = Shape(lowest=lowest, highest=highest, slew=slew, fade=fade)
    inputs = shape(signal, PERIOD)
    assert lowest <= float(np.min(inputs))
    assert float(np.max(inputs)) <= highest
    changes = np.diff(np.concatenate([[0.0], inputs, [0.0]]))
    assert float(np.max(np.abs(changes))) <= slew * PERIOD * (1 + 1e-9)
    assert inputs[-1] == 0.0 or abs(inputs[-1]) <= slew * PERIOD


def test_the_same_seed_gives_the_same_experiment_and_another_one_another() -> None:
    first, again, other = (
        steps(100, PERIOD, hold=0.1, rng=np.random.default_rng(seed)) for seed in (1, 1, 2)
    )
    assert first.tolist() == again.tolist() != other.tolist()


@pytest.mark.parametrize(
    "limits", [(0.0, 0.0, 1.0), (1.0, 2.0, 1.0), (-1.0, 1.0, 0.0), (1.0, -1.0, 1.0)]
)
def test_limits_that_are_missing_or_make_no_sense_are_refused(
    limits: tuple[float, float, float],
) -> None:
    lowest, highest, slew = limits
    with pytest.raises(DataError, match="to what the robot may do"):
        Shape(lowest=lowest, highest=highest, slew=slew)


def test_frequencies_beyond_half_the_sample_rate_are_refused() -> None:
    with pytest.raises(DataError, match="half the sample rate"):
        chirp(100, PERIOD, lowest=1.0, highest=60.0)
    with pytest.raises(DataError, match="PRBS order 8"):
        prbs(100, PERIOD, hold=0.1, order=8)


# -- The simulated vector field: it rests, then obeys its equations, whatever w is in its box

STEP = 0.02  # s


def test_a_field_rests_until_its_first_input_and_then_solves_its_equations() -> None:
    """ẋ = -x + u from x = 1 with u = 3 is 3 - 2 exp(-t)."""
    field = VectorField.from_function(lambda x, u: [u[0] - x[0]], 1, 1)
    plant = FieldPlant(field, np.ones(1), period=STEP, rng=np.random.default_rng(0))
    for _ in range(5):
        plant.step(np.zeros(1), np.zeros(1))
    assert plant.measure(np.zeros(1)) == [1.0]
    for _ in range(50):
        plant.step(np.full(1, 2.5), np.full(1, 0.5))
    assert plant.measure(np.zeros(1)) == pytest.approx([3 - 2 * np.exp(-1.0)], abs=1e-9)


def test_equations_that_change_in_time_do_so_from_the_first_input_on() -> None:
    """ẋ = t: 0.5 after a second, whatever the wait."""
    field = VectorField.from_function(lambda t, u: [t + 0.0 * u[0]], 1, 1)
    plant = FieldPlant(field, np.zeros(1), period=STEP, rng=np.random.default_rng(0))
    plant.step(np.zeros(1), np.zeros(1))
    for _ in range(50):
        plant.step(np.ones(1), np.zeros(1))
    assert plant.measure(np.zeros(1)) == pytest.approx([0.5], abs=1e-9)


def test_equations_that_leave_every_number_begin_anew_and_rest() -> None:
    """ẋ = x + x³ + u, which is at infinity in finite time."""
    field = VectorField.from_function(lambda x, u: [x[0] + x[0] ** 3 + u[0]], 1, 1)
    plant = FieldPlant(field, np.full(1, 0.1), period=STEP, rng=np.random.default_rng(0))
    states = []
    for k in range(200):
        plant.step(np.full(1, float(k < 2)), np.zeros(1))
        states.append(float(plant.measure(np.zeros(1))[0]))
    assert 1.0 < max(states) < FAR
    assert states[-1] == 0.1


@pytest.mark.slow
def test_w_is_drawn_from_its_box() -> None:
    field = VectorField.from_function(lambda u, w: [u[0] + w[0]], 1, 1, uncertain=[[-0.5, 1.0]])
    plant = FieldPlant(field, np.zeros(1), period=STEP, rng=np.random.default_rng(0))
    x = [0.0]
    for _ in range(400):
        plant.step(np.ones(1), np.zeros(1))
        x.append(float(plant.measure(np.zeros(1))[0]))
    w = np.diff(x) / STEP - 1.0
    assert -0.5 <= w.min() < -0.4
    assert 0.9 < w.max() <= 1.0 + 1e-9


def test_a_state_or_signals_that_do_not_fit_are_refused() -> None:
    field = VectorField.from_function(lambda x, u: [u[0] - x[0]], 1, 1)
    rng = np.random.default_rng(0)
    with pytest.raises(DataError, match="starts at so many numbers"):
        FieldPlant(field, np.zeros(2), period=STEP, rng=rng)
    with pytest.raises(DataError, match=r"1 states and 1 inputs .* through 2 and 1"):
        FieldPlant(field, np.zeros(1), period=STEP, rng=rng).refuse(2, 1)
