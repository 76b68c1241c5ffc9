"""Trials that scale a tube: the rule, its refusals, copies, and levels that follow the commands."""

from dataclasses import replace

import numpy as np
import pytest

from bags.designs.provenance import of_funnel
from nlsid import Dataset, Fit, Monitor, OutputTube, Status, Trajectory
from nlsid_core.arrays import FloatArray
from nlsid_core.data.calibration import calibration_trials, windows
from nlsid_core.data.shared import shared_stretch
from nlsid_core.design import OutputTubeDesign, design_output_tube
from nlsid_core.design.levels import candidates, followed
from nlsid_core.design.tube import energy, innovations
from nlsid_core.errors import DataError, DocumentError, ShapeError
from nlsid_core.funnels.level import CHANGE, VALUE, CommandLevel, LevelMeter, Term
from nlsid_core.funnels.tube import Tube
from nlsid_core.models import DifferenceEquation
from nlsid_core.running.stage import Stage
from tests.conftest import synthetic_dataset
from tests.core.kernel.tube_claims import MODELS, dataset, design
from tests.marks import slow_among

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


# -- Levels that follow the commands: g by its formula, narrower where it pays, exceeded rarely

TERMS = (
    Term(()),
    Term((0,), VALUE, 0.5, 2.0, 0.0),
    Term((0, 1), VALUE, 0.0, 3.0, 0.9),
    Term((1,), CHANGE, 0.0, 0.5, 0.7),
)
LEVEL = CommandLevel(TERMS, np.array([0.1, 2.0, 3.0, 5.0]))


def by_hand(u: FloatArray) -> FloatArray:
    """(N,): g of LEVEL as sums over the past."""
    found = []
    for k in range(len(u)):
        value = ((u[k, 0] - 0.5) / 2.0) ** 2
        product = sum(0.9 ** (k - i) * (u[i, 0] * u[i, 1] / 3.0) ** 2 for i in range(k + 1))
        change = sum(0.7 ** (k - i) * ((u[i, 1] - u[i - 1, 1]) / 0.5) ** 2 for i in range(1, k + 1))
        found.append(0.1 + 2.0 * value + 3.0 * product + 5.0 * change)
    return np.array(found)


def test_a_level_is_the_sum_that_its_page_states_and_online_it_is_the_same() -> None:
    u = np.random.default_rng(0).normal(size=(40, 2))
    assert LEVEL.along(u) == pytest.approx(by_hand(u), rel=1e-12)
    meter = LevelMeter(LEVEL)
    assert [meter.update(now) for now in u.tolist()] == LEVEL.along(u).tolist(), "bit for bit"
    meter.restart()
    assert meter.update(u[0].tolist()) == LEVEL.along(u)[0]
    assert CommandLevel.from_document(LEVEL.document(), source="x").document() == LEVEL.document()


def test_a_level_that_makes_no_sense_is_refused() -> None:
    for change in ({"scale": 0.0}, {"fading": 1.0}, {"fading": -0.1}, {"of": "square"}):
        with pytest.raises(DataError, match="does not make sense"):
            replace(TERMS[1], **change)
    with pytest.raises(DataError, match="not be negative"):
        CommandLevel(TERMS[:1], np.array([-1.0]))
    with pytest.raises(ShapeError):
        CommandLevel(TERMS, np.ones(2))
    with pytest.raises(DocumentError, match="whole numbers"):
        CommandLevel.from_document(
            {"terms": [TERMS[0].document() | {"inputs": [0.5]}], "weights": [[1.0]]}, source="x"
        )


def trials(count: int, seed: int, *, moved: float) -> tuple[list[FloatArray], list[FloatArray]]:
    """Squares of errors whose size is that of a fading sum of the command's changes, and noise."""
    energies: list[FloatArray] = []
    inputs: list[FloatArray] = []
    for k in range(count):
        rng = np.random.default_rng((seed, k))
        u = np.repeat(rng.uniform(-1.0, 1.0, (8, 1)), 25, axis=0)
        size = CommandLevel((Term((0,), CHANGE, 0.0, 1.0, 0.85),), np.ones(1)).along(u)
        room = 0.01 + moved * size
        energies.append(room * rng.uniform(0.0, 1.0, room.shape))
        inputs.append(u)
    return energies, inputs


def test_what_moves_with_the_commands_is_followed_and_what_does_not_is_not() -> None:
    energies, inputs = trials(12, 0, moved=1.0)
    level = followed(energies, inputs)
    assert level is not None
    g = np.concatenate([level.along(u) for u in inputs])
    E = np.concatenate(energies)
    scale = (E / g).max()
    assert np.mean(np.sqrt(g)) == pytest.approx(1.0, rel=0.01)
    assert np.sqrt(scale) < 0.5 * np.sqrt(E.max()), "half as wide on average as a constant"
    assert followed(*trials(12, 0, moved=0.0)) is None
    assert followed(*trials(3, 0, moved=1.0)) is None, "too few to tell"
    forced = followed(*trials(12, 0, moved=0.0), always=True)
    assert forced is not None
    assert (forced.weights >= 0.0).all()


def test_products_of_a_few_inputs_are_tried_and_of_many_are_not() -> None:
    u = np.random.default_rng(0).normal(size=(50, 2))
    assert any(term.inputs == (0, 1) for term in candidates([u]))
    assert not any(len(term.inputs) > 1 for term in candidates([np.tile(u, (1, 3))]))
    still = np.column_stack([u[:, :1], np.ones((50, 1))])
    assert not any(term.inputs == (1,) for term in candidates([still]))


@pytest.mark.parametrize("name", slow_among(["following", "two_following"], {"two_following"}))
def test_an_assumption_that_follows_is_kept_by_the_calibration_trials_and_broken_by_more(
    name: str,
) -> None:
    made = design(name)
    for seed, noise, kept in ((100, 0.0, True), (100, 2.0, False)):
        monitor, trial = made.monitor(), dataset(MODELS[name](), seed, 1)
        recorded = trial.trajectories[0]
        rng = np.random.default_rng(0)
        spread = noise * np.ptp(recorded.y, axis=0)
        recorded = replace(recorded, y=recorded.y + spread * rng.normal(size=recorded.y.shape))
        rows = zip(recorded.t.tolist(), recorded.y, recorded.u, strict=True)
        said = [monitor.update(t, y, u) for t, y, u in rows]
        bad = [r for r in said if r.status not in (Status.INSIDE, Status.UNKNOWN)]
        assert bool(bad) != kept


def test_a_level_that_overflows_starts_a_new_run_and_is_never_inside() -> None:
    """v² is infinite in float64, and would be for ever where it fades."""
    made = design("following")
    recorded = dataset(MODELS["following"](), 100, 1).trajectories[0]
    fading = CommandLevel((Term((0,), scale=1e-160, fading=0.9),), np.array([1e-300]))
    tubes = tuple(replace(tube, follows=fading) for tube in made.funnel.tubes)
    monitor = Monitor([Stage(made.model, None, replace(made.funnel, tubes=tubes))])
    rows = zip(recorded.t.tolist(), recorded.y + 100.0, recorded.u + 1.0, strict=True)
    said = [monitor.update(t, y, u) for t, y, u in rows]
    assert {reading.status for reading in said} == {Status.UNKNOWN}
    assert any("the level that follows the commands is not finite" in r.reason for r in said)


def test_a_shift_that_breaks_no_assumption_raises_the_alarm_and_only_that() -> None:
    """A bias of a deviation: CUSUM adds it up; its first alarm is a function of what came."""
    made = design("linear")
    cusum = made.funnel.cusum
    assert cusum is not None
    recorded = dataset(MODELS["linear"](), 500, 1, 2000).trajectories[0]
    biased = replace(recorded, y=recorded.y + 0.7 * cusum.deviation)
    lasting = replace(made.funnel, tubes=made.funnel.tubes[:1])
    clean, alarmed = (
        [monitor.update(t, y, u) for t, y, u in zip(r.t.tolist(), r.y, r.u, strict=True)]
        for monitor, r in (
            (Monitor([Stage(made.model, None, lasting)]), recorded),
            (Monitor([Stage(made.model, None, lasting)]), biased),
        )
    )
    assert not any(r.alarm for r in clean)
    first = next(r for r in alarmed if r.alarm)
    assert first.alarm.startswith("cusum alarm: ")
    assert "nothing is proved" in first.alarm
    assert first.status is Status.INSIDE
    assert "outside" not in first.alarm


# -- Copies of a recording under other stamps and names; rest and new trials are none


def trial(seed: int, name: str, *, start: float = 0.0, step: float = 0.0) -> Trajectory:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=20), 15)
    y = np.cumsum(0.2 * u) + rng.normal(size=300)
    y[100:160], u[100:160] = 0.0, 0.0  # at rest
    if step:
        y = step * np.round(y / step)
    return Trajectory(
        t=start + 0.5 * np.arange(300), y=y, u=u, name=name, digest=f"sha256:{name:0>64}"
    )


@pytest.mark.parametrize("step", [0.0, 0.5])
def test_a_copy_with_other_stamps_is_found_with_its_times(step: float) -> None:
    train = [trial(1, "a", step=step), trial(2, "b", step=step)]
    copy = replace(train[1].rows(slice(40, 290), "c"), t=7.0 + 0.5 * np.arange(250))
    copy = replace(copy, y=copy.y * (1.0 + 1e-15), digest="")
    found = shared_stretch(train, [trial(3, "d", step=step), copy])
    assert found is not None
    assert (found.name, found.other) == ("c", "b")
    assert found.start - 7.0 == found.other_start - 20.0
    with pytest.raises(DataError, match=r"c has .* samples from .* the same as those of b from"):
        calibration_trials(Dataset(tuple(train)), Dataset((copy,)), least=72)


def test_two_copies_among_the_calibration_trials_are_found() -> None:
    twins = (trial(3, "c"), trial(3, "d", start=10.0))
    with pytest.raises(DataError, match=r"d has .* those of c"):
        calibration_trials(Dataset((trial(1, "a"),)), Dataset(twins), least=72)
    assert shared_stretch(twins, [trial(4, "e")]) is None  # both train: nothing is measured on them


def test_rest_and_other_trials_of_the_same_commands_are_no_copies() -> None:
    first, other = trial(1, "a"), trial(2, "b")
    repeat = replace(first, y=first.y + 1e-3 * np.random.default_rng(0).normal(size=(300, 1)))
    short = first.rows(slice(0, 30), "s")
    still = replace(first, y=np.zeros((300, 1)), name="still")
    twin = replace(still, name="still too")
    assert shared_stretch([first, still], [other, replace(repeat, name="r"), short, twin]) is None
