"""Levels that follow the commands: g by its formula, narrower where it pays, exceeded rarely."""

from dataclasses import replace

import numpy as np
import pytest

from nlsid import Monitor, Status
from nlsid_core.arrays import FloatArray
from nlsid_core.design.levels import candidates, followed
from nlsid_core.errors import DataError, DocumentError, ShapeError
from nlsid_core.funnels.level import CHANGE, VALUE, CommandLevel, LevelMeter, Term
from nlsid_core.running.stage import Stage
from tests.core.kernel.tube_claims import MODELS, dataset, design
from tests.marks import slow_among

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
