"""The detectors that a funnel is compared with, against what they are by definition."""

import numpy as np
import pytest

from nlsid_core.running.detectors import DETECTORS, DRIFT, Detector, Residuals, cusum


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
        found = Detector.calibrated(name, [run], 1.5).alarm(quiet)
        assert (found is None) == (wanted is None), name


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
