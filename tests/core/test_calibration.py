"""Trials that design, trials that scale: the rule, its refusals, and how often the next exceeds."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov
from scipy.stats import binomtest

from bags.designs.provenance import of_funnel
from nlsid import Dataset, Fit, OutputTube
from nlsid_core.arrays import FloatArray
from nlsid_core.data.calibration import calibration_trials, windows
from nlsid_core.design import OutputTubeDesign, design_output_tube
from nlsid_core.design.riccati import solve_riccati
from nlsid_core.design.tube import energy, innovations
from nlsid_core.errors import DataError
from nlsid_core.funnels.tube import Tube
from nlsid_core.models import DifferenceEquation
from tests.conftest import synthetic_dataset

PROFILE = [(0.0, 0.0), (1.0, 0.0), (3.0, 0.5), (7.0, 0.5)]


def test_every_second_recording_scales_the_level(train: Dataset) -> None:
    split = calibration_trials(train, least=72)
    assert split.design.names == ("run_0", "run_2", "run_4")
    assert split.calibration.names == ("run_1", "run_3", "run_5")
    assert not split.cut
    assert split.measured_on[0] == ("run_1", train.trajectories[1].digest)


def test_pieces_of_one_recording_stay_together(train: Dataset) -> None:
    first, second = train.trajectories[0].digest, train.trajectories[1].digest
    pieces = Dataset(
        tuple(replace(t, digest=second if i in (1, 4) else first) for i, t in enumerate(train))
    )
    split = calibration_trials(pieces, least=72)
    assert split.calibration.names == ("run_1", "run_4")
    assert split.design.names == ("run_0", "run_2", "run_3", "run_5")


def test_named_calibration_trials_are_taken_as_they_are(train: Dataset) -> None:
    mine = train.select(["run_5", "run_1"])
    split = calibration_trials(train.without(mine.names), mine, least=72)
    assert split.calibration is mine
    with pytest.raises(DataError, match="run_5: this recording is for the design and for"):
        calibration_trials(train, mine, least=72)
    renamed = Dataset(tuple(replace(t, name="copy", digest="") for t in mine))
    blank = Dataset(tuple(replace(t, digest="") for t in train))
    with pytest.raises(DataError, match="copy: this recording"):
        calibration_trials(blank, renamed, least=72)


def test_one_recording_is_cut_into_windows(train: Dataset) -> None:
    one = Dataset(train.trajectories[:1])
    split = calibration_trials(one, least=26)  # of 80 samples: three, and two that are left over
    assert split.cut
    digest = one.trajectories[0].digest
    assert split.designed_on == (
        ("run_0[0:26]", f"{digest}[0:26]"),
        ("run_0[52:78]", f"{digest}[52:78]"),
    )
    assert split.measured_on == (("run_0[26:52]", f"{digest}[26:52]"),)
    np.testing.assert_array_equal(split.calibration.trajectories[0].y, one.trajectories[0].y[26:52])
    with pytest.raises(DataError, match="from which 1 windows of 41 samples can be cut"):
        calibration_trials(one, least=41)


def test_windows_of_two_pieces_of_one_recording_do_not_share_samples(train: Dataset) -> None:
    pieces = [replace(t, digest="sha256:0") for t in train.trajectories[:2]]
    assert [w.digest for w in windows(pieces, 40)] == [
        "sha256:0[0:40]",
        "sha256:0[40:80]",
        "sha256:0[80:120]",
        "sha256:0[120:160]",
    ]


def test_one_scale_holds_every_energy_of_the_calibration_trials_and_one_reaches_its_own(
    design: OutputTubeDesign, train: Dataset
) -> None:
    scaling, parts = calibration_trials(train, least=72).calibration, []
    for tube in design.funnel.tubes:
        parts.append(largest(design, tube, scaling) / tube.measured.largest)
        assert {name for name, _ in tube.measured.designed_on} == {"run_0", "run_2", "run_4"}
    assert max(parts) <= 1.0
    assert max(parts) == pytest.approx(1.0, rel=1e-11)


def largest(design: OutputTubeDesign, tube: Tube, trials: Dataset) -> float:
    """The largest E over these trials."""
    found = [innovations(design.model, tube.L[None], trial, 2)[:, 0] for trial in trials]
    return max(float(energy(e, tube)[: tube.samples].max()) for e in found)


def test_the_calibration_trials_do_not_choose_the_observer(
    design: OutputTubeDesign, train: Dataset
) -> None:
    """Calibration trials a hundred times noisier: the same L and P, another level."""
    split = calibration_trials(train, least=72)
    noise = np.random.default_rng(1)
    loud = Dataset(
        tuple(replace(t, y=t.y + 0.5 * noise.standard_normal(t.y.shape)) for t in split.calibration)
    )
    other = design_output_tube(
        OutputTube(
            design.model,
            split.design,
            profile=PROFILE,
            horizon=7.0,
            inlet=0.02,
            calibration=loud,
        )
    )
    np.testing.assert_array_equal(other.policy.L, design.policy.L)
    for louder, tube in zip(other.funnel.tubes, design.funnel.tubes, strict=True):
        np.testing.assert_array_equal(louder.P, tube.P)
        assert louder.measured.largest > 100 * tube.measured.largest


def worth(made: OutputTubeDesign) -> str:
    """What is said of the trials that the first tube was measured on."""
    found = of_funnel(made.model.document(), made.funnel.document())
    assert not found.wrong
    return found.said[0]


@pytest.mark.slow
def test_a_probability_is_said_of_trials_that_the_model_was_not_fitted_to(
    fit: Fit[DifferenceEquation], train: Dataset
) -> None:
    split = calibration_trials(train, least=72)
    apart = replace(fit.model, bags=split.designed_on, training="sha256:0")
    made = design_output_tube(
        OutputTube(apart, split.design, profile=PROFILE, horizon=7.0, calibration=split.calibration)
    )
    assert "with probability at most 1/4" in worth(made)
    known = replace(fit.model, bags=split.measured_on[:2], training="sha256:0")
    seen = design_output_tube(OutputTube(known, train, profile=PROFILE, horizon=7.0))
    assert "as the model was fitted to 2 of them" in worth(seen)
    long = Dataset(synthetic_dataset(0.01, trials=1, samples=400).trajectories)
    own = replace(fit.model, training="sha256:0")
    cut = design_output_tube(OutputTube(own, long, profile=PROFILE, horizon=7.0))
    said = worth(cut)
    assert "by the scale of 2 distinct windows" in said
    assert "windows of one recording are hardly exchangeable" in said


# -- how often the next trial exceeds the largest -----------------------------------------------

REPEATS = 4000
CONFIDENCE = 0.999  # of the interval around the frequency
RATIOS = (1e-3, 1e-1, 1.0, 10.0, 1e3)


@pytest.mark.slow
@pytest.mark.parametrize("scaling", [1, 4, 9])
def test_exchangeable_trials_exceed_the_largest_as_often_as_stated(
    fit: Fit[DifferenceEquation], scaling: int
) -> None:
    """The observer is chosen as the design does, on other trials: 1/(m + 1), neither more nor less.

    The energies are continuous, so that the largest of m + 1 is the last with this probability.
    """
    rng, model = np.random.default_rng(scaling), fit.model
    gains = np.array([kalman_gain(model, ratio) for ratio in RATIOS])
    reach = np.array([1.0 + solve_discrete_lyapunov(model.A, np.outer(L, L))[0, 0] for L in gains])
    found = energies(model, gains, rng, trials=REPEATS * (3 + scaling + 1))
    designing, measured, after = np.split(found.reshape(REPEATS, -1, len(gains)), [3, -1], axis=1)
    chosen = (designing.max(axis=1) * reach).argmin(axis=1)
    assert len(set(chosen.tolist())) > 1  # the choice depends on the trials
    row = np.arange(REPEATS)
    exceeded = int((after[row, 0, chosen] > measured[row, :, chosen].max(axis=1)).sum())
    low, high = binomtest(exceeded, REPEATS).proportion_ci(CONFIDENCE)
    assert low <= 1.0 / (scaling + 1) <= high


def test_trials_that_choose_the_observer_say_less_of_the_next_one(
    fit: Fit[DifferenceEquation],
) -> None:
    """What calibration on the trials of the design does: the next one exceeds more often."""
    rng, model, m = np.random.default_rng(0), fit.model, 2
    gains = rng.normal(size=(60, len(model))) * 0.3  # many observers to choose from
    gains = gains[
        [np.abs(np.linalg.eigvals(model.A - np.outer(L, model.C[0]))).max() < 1 for L in gains]
    ]
    found = energies(model, gains, rng, trials=REPEATS * (m + 1)).reshape(REPEATS, m + 1, -1)
    chosen = found[:, :m].max(axis=1).argmin(axis=1)
    row = np.arange(REPEATS)
    exceeded = int((found[row, m, chosen] > found[row, :m, chosen].max(axis=1)).sum())
    low, _ = binomtest(exceeded, REPEATS).proportion_ci(CONFIDENCE)
    assert low > 1.0 / (m + 1)


def kalman_gain(model: DifferenceEquation, noise_ratio: float) -> FloatArray:
    """L (n,) for noise_ratio, variance of a disturbance of the input over the measurement's."""
    A, B, C = model.A, model.B, model.C
    S = solve_riccati(A.T, C.T, noise_ratio * B @ B.T, np.eye(1))
    return np.asarray((A @ S @ C.T)[:, 0] / (1.0 + (C @ S @ C.T)[0, 0]))


def energies(
    model: DifferenceEquation, gains: FloatArray, rng: np.random.Generator, *, trials: int
) -> FloatArray:
    """Σ e² (trials, gains) of exchangeable trials.

    White noise in the equation and on the measurement, each of a random size.
    """
    n, samples = len(model), 30
    sizes = np.exp(rng.standard_normal((2, trials)))
    truth, x = np.zeros((trials, n)), np.zeros((trials, len(gains), n))
    total = np.zeros((trials, len(gains)))
    for _ in range(samples):
        y = truth[:, 0] + sizes[0] * rng.standard_normal(trials)
        e = y[:, None] - x[:, :, 0]
        total += e**2
        x = x @ model.A.T + gains * e[:, :, None]
        truth = truth @ model.A.T + (sizes[1] * rng.standard_normal(trials))[:, None] * model.B.T
    return total
