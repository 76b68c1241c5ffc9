"""Scores, residual tests, and the detectors that a funnel is compared with, by what they are."""

import math
from dataclasses import replace

import numpy as np
import pytest

from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError, apart, percent
from nlsid_core.identification.validation import validate
from nlsid_core.models import DifferenceEquation, Signal
from nlsid_core.running.detectors import DETECTORS, DRIFT, Detector, Residuals, cusum
from tests.conftest import PERIOD, TRUE_A, TRUE_B, synthetic_dataset


def truth() -> DifferenceEquation:
    return DifferenceEquation(
        a=TRUE_A, b=TRUE_B, c=0.0, period=PERIOD, y=Signal("y"), u=Signal("u"), u_range=(0.0, 1.0)
    )


def equation_noise_dataset(seed: int, *, hidden: float = 0.0) -> Dataset:
    """The truth driven by white input and white equation noise, perhaps an unmodelled delay."""
    rng = np.random.default_rng(seed)
    N = 3000
    u, e = rng.uniform(0.0, 1.0, N), 0.01 * rng.standard_normal(N)
    y = np.zeros(N)
    for t in range(5, N):
        y[t] = TRUE_A @ y[t - 2 : t][::-1] + TRUE_B @ u[t - 2 : t + 1][::-1] + e[t]
        y[t] += hidden * u[t - 5]
    stamps = np.linspace(0.0, PERIOD * (N - 1), N)
    return Dataset((Trajectory(t=stamps, y=y, u=u, name="run"),))


def test_the_truth_leaves_a_white_independent_residual() -> None:
    verdicts = [validate(truth(), equation_noise_dataset(seed)) for seed in range(20)]
    assert sum(v.one_step.white for v in verdicts) >= 18  # 99 % tests: 0.2 failures are expected
    assert sum(v.one_step.independent for v in verdicts) >= 18
    assert "is white" in str(verdicts[0])


def test_a_missing_delay_shows_in_the_cross_correlation() -> None:
    found = validate(truth(), equation_noise_dataset(0, hidden=0.02))
    assert not found.one_step.independent
    crossed = abs(found.one_step.cross_correlation[0, 0])
    assert int(np.argmax(crossed)) - 20 == 5
    assert max(crossed) > found.one_step.cross_band[0, 0]
    assert "NOT independent" in str(found)


def test_output_noise_shows_as_a_residual_that_is_not_white() -> None:
    noisy = synthetic_dataset(0.05, trials=10, samples=400)
    found = validate(truth(), noisy)
    assert not found.one_step.white
    assert max(abs(found.one_step.autocorrelation[0])) > found.one_step.band


def test_trials_too_short_for_the_tests_are_refused() -> None:
    with pytest.raises(DataError, match="correlations need more than 4"):
        validate(truth(), Dataset((synthetic_dataset(0.0).trajectories[0].rows(slice(4)),)))


def test_a_diverging_model_scores_infinity_without_warnings() -> None:
    wild = replace(truth(), a=np.array([40.0, 0.0]))
    assert (
        validate(wild, synthetic_dataset(0.0, trials=1, samples=400)).simulation_percent == np.inf
    )


def test_numbers_that_are_compared_read_differently_where_they_are_different() -> None:
    for numbers, said in {
        (float(np.nextafter(-1.0, -2.0)), -1.0, 1.65): ("-1.0000000000000002", "-1.0", "1.65"),
        (-1.00000001, -1.0): ("-1.00000001", "-1"),
        (0.5, 0.5, 2.0): ("0.5", "0.5", "2"),
        (math.nan, 1.0): ("nan", "1"),
    }.items():
        assert apart(*numbers) == said


def test_an_error_beyond_all_sense_is_said_in_words() -> None:
    assert [percent(error) for error in (2.5, 999.994, 33153.18, math.inf, math.nan)] == [
        "2.50 %",
        "999.99 %",
        "diverges",
        "diverges",
        "diverges",
    ]


# -- The detectors that a funnel is compared with, against what they are by definition


def residuals(seed: int, samples: int = 60, outputs: int = 2) -> Residuals:
    rng = np.random.default_rng(seed)
    return Residuals(*rng.standard_normal((2, samples, outputs)))


def test_cusum_is_the_largest_sum_of_any_stretch_that_ends_now() -> None:
    """S_k = max over j <= k of Σ_{i=j..k} (±z_i - drift), or 0: by brute force."""
    z = 3.0 * residuals(0).innovation
    wanted = [
        max(
            max(0.0, float((sign * z[j : k + 1, i] - DRIFT).sum()))
            for sign in (-1, 1)
            for i in range(z.shape[1])
            for j in range(k + 1)
        )
        for k in range(len(z))
    ]
    np.testing.assert_allclose(cusum(z), wanted, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", DETECTORS)
def test_calibration_runs_do_not_alarm_and_one_larger_than_all_does(name: str) -> None:
    runs = [residuals(seed) for seed in range(5)]
    detector = Detector.calibrated(name, runs, 1.5)
    assert [detector.alarm(run) for run in runs] == [None] * 5
    exact = Detector.calibrated(name, runs, 1.0)
    peaks = [exact.statistic(run).max() for run in runs]
    assert exact.threshold == max(peaks)
    worst = runs[int(np.argmax(peaks))]
    above = Residuals(1.01 * worst.innovation, 1.01 * worst.error)
    k = exact.alarm(above)
    assert k is not None
    assert exact.statistic(above)[k] > exact.threshold
    assert (exact.statistic(above)[:k] <= exact.threshold).all()
    assert detector.alarm(above) is None


def test_each_detector_looks_at_its_own_part() -> None:
    run = residuals(7)
    quiet = Residuals(run.innovation, 100.0 * run.error)
    for name, wanted in (("CUSUM", None), ("3σ", None), ("box", 0)):
        assert Detector.calibrated(name, [run], 1.5).alarm(quiet) == wanted, name


@pytest.mark.parametrize("alarms", [0, 1, 3, 5, 9])
def test_a_threshold_is_raised_until_no_more_than_so_many_alarm(alarms: int) -> None:
    calm = residuals(0)
    loud = [
        Residuals(f * r.innovation, f * r.error)
        for f, r in ((4.0 + i, residuals(i)) for i in range(5))
    ]
    for name in DETECTORS:
        before = Detector.calibrated(name, [calm], 1.0)
        assert all(before.alarm(run) is not None for run in loud)
        after = before.quieter(loud, alarms)
        assert sum(after.alarm(run) is not None for run in loud) == min(alarms, 5)
        assert after.quieter(loud, 5).threshold == after.threshold, "never lowered"
