"""The simulated vector field: it rests, then obeys its equations, whatever w is in its box."""

import numpy as np
import pytest

from nlsid_core.dynamics import VectorField
from nlsid_core.errors import DataError
from nlsid_core.running.plants import FAR, FieldPlant

PERIOD = 0.02  # s


def test_a_field_rests_until_its_first_input_and_then_solves_its_equations() -> None:
    """ẋ = -x + u from x = 1 with u = 3 is 3 - 2 exp(-t)."""
    field = VectorField.from_function(lambda x, u: [u[0] - x[0]], 1, 1)
    plant = FieldPlant(field, np.ones(1), period=PERIOD, rng=np.random.default_rng(0))
    for _ in range(5):
        plant.step(np.zeros(1), np.zeros(1))
    assert plant.measure(np.zeros(1)) == [1.0]
    for _ in range(50):
        plant.step(np.full(1, 2.5), np.full(1, 0.5))
    assert plant.measure(np.zeros(1)) == pytest.approx([3 - 2 * np.exp(-1.0)], abs=1e-9)


def test_equations_that_change_in_time_do_so_from_the_first_input_on() -> None:
    """ẋ = t: 0.5 after a second, whatever the wait."""
    field = VectorField.from_function(lambda t, u: [t + 0.0 * u[0]], 1, 1)
    plant = FieldPlant(field, np.zeros(1), period=PERIOD, rng=np.random.default_rng(0))
    plant.step(np.zeros(1), np.zeros(1))
    for _ in range(50):
        plant.step(np.ones(1), np.zeros(1))
    assert plant.measure(np.zeros(1)) == pytest.approx([0.5], abs=1e-9)


def test_equations_that_leave_every_number_begin_anew_and_rest() -> None:
    """ẋ = x + x³ + u, which is at infinity in finite time."""
    field = VectorField.from_function(lambda x, u: [x[0] + x[0] ** 3 + u[0]], 1, 1)
    plant = FieldPlant(field, np.full(1, 0.1), period=PERIOD, rng=np.random.default_rng(0))
    states = []
    for k in range(200):
        plant.step(np.full(1, float(k < 2)), np.zeros(1))
        states.append(float(plant.measure(np.zeros(1))[0]))
    assert 1.0 < max(states) < FAR
    assert states[-1] == 0.1


def test_w_is_drawn_from_its_box() -> None:
    field = VectorField.from_function(lambda u, w: [u[0] + w[0]], 1, 1, uncertain=[[-0.5, 1.0]])
    plant = FieldPlant(field, np.zeros(1), period=PERIOD, rng=np.random.default_rng(0))
    x = [0.0]
    for _ in range(400):
        plant.step(np.ones(1), np.zeros(1))
        x.append(float(plant.measure(np.zeros(1))[0]))
    w = np.diff(x) / PERIOD - 1.0
    assert -0.5 <= w.min() < -0.4
    assert 0.9 < w.max() <= 1.0 + 1e-9


def test_a_state_or_signals_that_do_not_fit_are_refused() -> None:
    field = VectorField.from_function(lambda x, u: [u[0] - x[0]], 1, 1)
    rng = np.random.default_rng(0)
    with pytest.raises(DataError, match="starts at so many numbers"):
        FieldPlant(field, np.zeros(2), period=PERIOD, rng=rng)
    with pytest.raises(DataError, match=r"1 states and 1 inputs .* through 2 and 1"):
        FieldPlant(field, np.zeros(1), period=PERIOD, rng=rng).refuse(2, 1)
