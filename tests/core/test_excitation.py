"""Excitation signals excite what they should, and never ask more than they may."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nlsid_core.data.excitation import Shape, chirp, multisine, prbs, steps
from nlsid_core.errors import DataError

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
