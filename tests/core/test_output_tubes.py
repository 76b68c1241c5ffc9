"""Running against tubes around a model's simulation: for ever, over gaps, several at once."""

import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binomtest

from nlsid import Dataset, Monitor, OutputTube, Status, Trajectory
from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.design import design_output_tube
from nlsid_core.design.tube import calibrated, energy, innovations
from nlsid_core.design.tube_program import finsler
from nlsid_core.errors import DataError
from nlsid_core.identification.prediction import history, simulate_trial
from nlsid_core.models import BlockCascade, DifferenceEquation
from nlsid_core.running.reading import Reading
from nlsid_core.running.stage import Stage
from nlsid_core.running.stepping import Stepper
from nlsid_core.running.tubes import BEYOND, WATCHED
from tests import implicit_models
from tests.core.kernel.tube_claims import LONG, MODELS, dataset, design, recorded
from tests.marks import slow_among

EVERY = pytest.mark.parametrize("name", slow_among(MODELS, LONG))


def run(monitor: Monitor, trial: Trajectory) -> list[Reading]:
    rows = zip(trial.t, trial.y, trial.u, strict=True)
    return [monitor.update(float(t), y, u) for t, y, u in rows]


def monitor_of(name: str) -> Monitor:
    made = design(name)
    return made.monitor()


def trial_of(name: str, samples: int = 300, seed: int = 300) -> Trajectory:
    return dataset(MODELS[name](), seed, 1, samples).trajectories[0]


@EVERY
def test_the_steps_of_every_class_are_those_of_its_simulation(name: str) -> None:
    model, trial = MODELS[name](), trial_of(name, 80)
    stepper = Stepper(model)
    lags = history(model) if isinstance(model, BlockCascade) else stepper.lags
    expected = simulate_trial(model, trial)
    y = expected if isinstance(model, BlockCascade) else trial.y
    lags = max(lags, stepper.lags)
    x = stepper.begin(y[:lags], trial.u[:lags])[None]
    for t in range(lags, len(trial)):
        found, x = stepper.advance(x, trial.u[t])
        assert found[0] == pytest.approx(expected[t], abs=1e-9)


@EVERY
def test_the_monitor_says_what_the_trials_energy_and_simulation_say(name: str) -> None:
    made, trial = design(name), trial_of(name)
    tube, settling = made.funnel.tubes[0], made.funnel.settling
    readings = run(monitor_of(name), trial)
    assert all(r.status is Status.UNKNOWN for r in readings[:settling])
    judged = readings[settling:]
    assert all(r.status is not Status.UNKNOWN for r in judged)
    e = innovations(made.model, tube.L[None], trial, settling)[:, 0]
    E = energy(e, tube)
    assert tube.peak is not None
    g: FloatArray = np.ones(len(E))
    if tube.follows is not None:
        g = tube.follows.along(trial.u)[settling:]
    peaks = ((e / tube.peak.at_most) ** 2).max(axis=1) / np.maximum(g, 1.0)
    expected = np.maximum(E / tube.level / g, peaks)
    used = np.array([r.assumption for r in judged])
    if len(made.funnel.tubes) == 1:
        assert used == pytest.approx(expected, rel=1e-6)
        assert (used >= expected * (1 - 1e-12)).all(), "rounded up"
    else:
        assert (used >= expected * (1 - 1e-9)).all(), "the most of several"
    for k, r in enumerate(judged):
        deviation = np.abs(np.array(r.nominal) - trial.y[settling + k])
        rooms = [1.0 if t.follows is None else float(np.sqrt(g[k])) for t in made.funnel.tubes]
        pairs = zip(made.funnel.tubes, rooms, strict=True)
        widths = np.min([t.half_widths * room for t, room in pairs], axis=0)
        assert 1.0 - r.margin >= (deviation / tube.half_widths).max() / np.sqrt(g[k]) * (1 - 1e-9)
        if tube.follows is not None:
            assert r.half_widths == pytest.approx(widths, rel=1e-8)
        assert (r.status is Status.OUTSIDE) == (r.margin < 0.0)
        assert (deviation <= widths).all() or r.status is not Status.INSIDE


@pytest.mark.parametrize("name", slow_among(["linear", "two_following"], {"two_following"}))
def test_one_large_innovation_is_named_though_its_energy_is_not_above_the_level(name: str) -> None:
    made, trial = design(name), trial_of(name)
    tube, k = made.funnel.tubes[0], made.funnel.settling + 40
    assert tube.peak is not None
    wide = replace(made.funnel, tubes=(replace(tube, level=100.0 * tube.level),), cusum=None)
    innovation = np.array(run(monitor_of(name), trial)[k].deviation[-len(tube.R) :])
    g = 1.0 if tube.follows is None else max(1.0, float(tube.follows.along(trial.u)[k]))
    most = tube.peak.at_most * np.sqrt(g)
    for part, status in ((0.99, Status.INSIDE), (1.01, Status.ASSUMPTION_VIOLATED)):
        y = trial.y.copy()
        y[k] += part * most - innovation
        reading = run(Monitor([Stage(made.model, None, wide)]), replace(trial, y=y))[k]
        assert reading.status is status
        assert ("one sample's innovation is" in reading.reason) == (part > 1.0)
        needed = tube.peak.direct.any()
        assert (f"assumed ({WATCHED})," in reading.reason) == (part > 1.0 and not needed)
        assert reading.assumption >= part**2 * (1.0 - 1e-6)


@pytest.mark.parametrize("name", ["linear", "two_outputs"])
def test_a_command_beyond_those_of_training_is_said_from_then_on(name: str) -> None:
    """Beside the verdict, which it does not change; larger, or changing faster."""
    made, trial = design(name), trial_of(name)
    assert made.funnel.commands is not None
    least, most, fastest = made.funnel.commands.T
    within = np.clip(trial.u, least, most)
    for k in range(1, len(within)):
        within[k] = np.clip(within[k], within[k - 1] - fastest, within[k - 1] + fastest)
    said = [BEYOND in r.assuming for r in run(made.monitor(), replace(trial, u=within))]
    assert not any(said)
    larger = within.copy()
    larger[100:, -1] = most[-1] + 0.02 * (most[-1] - least[-1])
    readings = run(made.monitor(), replace(trial, u=larger))
    assert [BEYOND in r.assuming for r in readings] == [False] * 100 + [True] * 200
    monitor, lost = made.monitor(), trial.y.copy()
    lost[95:105] = np.nan
    rows = zip(trial.t.tolist(), lost, larger, strict=True)
    *_, after = [monitor.update(*row) for row in rows]
    assert f"from t = {trial.t[100]:g} s on" in after.assuming, "of a sample without a measurement"
    known = replace(made.funnel, commands=None)
    plain = run(Monitor([Stage(made.model, None, known)]), replace(trial, u=larger))
    assert [r.status for r in plain] == [r.status for r in readings]
    faster = replace(made.funnel, commands=np.column_stack([least, most, 0.0 * fastest]))
    readings = run(Monitor([Stage(made.model, None, faster)]), replace(trial, u=within))
    assert "changed by" in readings[-1].assuming


def test_a_reason_has_units() -> None:
    made, trial = design("linear"), trial_of("linear")
    y = trial.y.copy()
    y[60:] += 3.0 * made.funnel.half_widths
    reasons = [r.reason for r in run(monitor_of("linear"), replace(trial, y=y))]
    energies = next(reason for reason in reasons if "above the level" in reason)
    number, squared = r"[-+.\de]+", re.escape(f" ({made.model.y.unit})²")
    assert re.search(f"energy {number}{squared} above the level {number}{squared} at t", energies)


@EVERY
def test_a_run_that_starts_at_a_wrong_measurement_is_inside_or_breaks_the_assumption(
    name: str,
) -> None:
    """The tube is around whatever start: what follows of a wrong one is innovation."""
    monitor, trial = monitor_of(name), trial_of(name)
    for times in (1.0, 10.0):
        y = trial.y.copy()
        y[monitor.lags - 1] += times * design(name).funnel.half_widths
        monitor.restart()
        readings = run(monitor, replace(trial, y=y))
        assert not [r.reason for r in readings if "although" in r.reason]
        assert {r.status for r in readings[-10:]} == {Status.INSIDE}, "a wrong start fades"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["linear", "following"])
def test_nothing_ends_a_run_and_200_000_samples_take_no_more_memory(name: str) -> None:
    monitor, trial = monitor_of(name), trial_of(name, 1000)
    rows = list(zip(trial.t.tolist(), trial.y, trial.u, strict=True))
    blocks = np.zeros(200)
    for lap in range(200):
        for t, y, u in rows:
            assert monitor.update(t + lap * 25.0, y, u).status is not Status.UNKNOWN or lap == 0
        blocks[lap] = sys.getallocatedblocks()
    assert blocks[-1] - blocks[10] < 200


def with_a_gap(kind: str) -> tuple[Monitor, dict[int, Reading]]:
    """Readings of samples 0 … 199, of which 52 to 54 have no output, no input, or never came."""
    trial, monitor, readings = trial_of("linear", 200), monitor_of("linear"), {}
    for k, (t, y, u) in enumerate(zip(trial.t, trial.y, trial.u, strict=True)):
        if not 52 <= k < 55:
            readings[k] = monitor.update(float(t), y, u)
        elif kind == "no output":
            readings[k] = monitor.update(float(t), np.array([np.nan]), u)
        elif kind == "no input":
            readings[k] = monitor.update(float(t), y, None)
    return monitor, readings


def test_a_missing_output_is_a_step_without_injection_and_nothing_is_claimed_of_it() -> None:
    _, readings = with_a_gap("no output")
    for k in (52, 53, 54):
        assert readings[k].status is Status.UNKNOWN
        assert "nothing is claimed" in readings[k].reason
    assert all(readings[k].status is Status.INSIDE for k in range(55, 200))
    whole = run(monitor_of("linear"), trial_of("linear", 200))
    assert whole[60].nominal == readings[60].nominal, "the simulation goes on"


@pytest.mark.parametrize("kind", ["no input", "absent"])
def test_where_an_input_is_not_known_a_new_run_starts(kind: str) -> None:
    """The claim is about a simulation under the same inputs, and there is none without them."""
    monitor, readings = with_a_gap(kind)
    start = 55 + monitor.lags
    assert all(readings[k].reason.startswith("waiting for") for k in range(55, start))
    assert all(readings[k].status is Status.INSIDE for k in range(start, 200))
    trial, fresh = trial_of("linear", 200), monitor_of("linear")
    for k in range(55, 200):
        again = fresh.update(float(trial.t[k]), trial.y[k], trial.u[k])
        assert (again.nominal, again.margin) == (readings[k].nominal, readings[k].margin) or (
            again.status is readings[k].status is Status.UNKNOWN
        )


def test_a_stamp_years_ahead_is_answered_at_once_and_starts_a_new_run() -> None:
    trial, monitor = trial_of("linear", 60), monitor_of("linear")
    rows = list(zip(trial.t, trial.y, trial.u, strict=True))
    for t, y, u in rows[:30]:
        monitor.update(float(t), y, u)
    later = [monitor.update(float(t) + 1.8e9, y, u) for t, y, u in rows[30:]]
    assert later[0].status is Status.UNKNOWN
    assert later[-1].status is Status.INSIDE
    assert "stamp is" in monitor.update(1.7e308, rows[0][1], rows[0][2]).reason


def test_a_caller_may_fill_the_same_arrays_again() -> None:
    for name in ("linear", "implicit_ray"):
        trial, monitor = trial_of(name, 100), monitor_of(name)
        y_same, u_same = np.empty_like(trial.y[0]), np.empty_like(trial.u[0])
        said = []
        for t, y, u in zip(trial.t, trial.y, trial.u, strict=True):
            y_same[:], u_same[:] = y, u
            said.append(monitor.update(float(t), y_same, u_same))
        assert [r.margin for r in said[5:]] == [r.margin for r in run(monitor_of(name), trial)[5:]]


def test_an_output_that_is_absurd_is_outside() -> None:
    trial, monitor = trial_of("linear", 60), monitor_of("linear")
    readings = [
        monitor.update(float(t), y * 0 + 1e200 if k == 40 else y, u)
        for k, (t, y, u) in enumerate(zip(trial.t, trial.y, trial.u, strict=True))
    ]
    assert readings[39].status is Status.INSIDE
    assert readings[40].status is Status.OUTSIDE
    assert not readings[40].margin >= 0.0


def test_inputs_that_leave_the_box_while_a_run_starts_are_not_taken() -> None:
    trial, monitor = trial_of("implicit_box", 60), monitor_of("implicit_box")
    first = [
        monitor.update(float(t), y, np.array([40.0]) if k == 0 else u)
        for k, (t, y, u) in enumerate(zip(trial.t, trial.y, trial.u, strict=True))
    ]
    assert "outside the box" in first[0].reason
    judged = [k for k, reading in enumerate(first) if reading.status is Status.INSIDE]
    assert judged[0] == monitor.lags + 1


def test_a_drifting_clock_stays_on_the_grid_and_a_shifted_one_starts_a_new_run() -> None:
    trial = trial_of("linear", 2000)
    drifting = replace(trial, t=trial.t * 1.001)
    assert sum(r.status is Status.UNKNOWN for r in run(monitor_of("linear"), drifting)) == 3
    for slower in (1.024, 0.985):  # every stamp is within the tolerance of the one expected
        readings = run(monitor_of("linear"), replace(trial, t=trial.t * slower))
        assert readings[20].status is Status.INSIDE
        assert {r.status for r in readings[500:]} == {Status.UNKNOWN}
        assert f"samples come every {slower * 0.025:.3g}" in readings[-1].reason
    monitor = monitor_of("linear")
    shifted = [float(t) + (0.4 * 0.025 if k >= 100 else 0.0) for k, t in enumerate(trial.t)]
    readings = [monitor.update(t, y, u) for t, y, u in zip(shifted, trial.y, trial.u, strict=True)]
    assert "off the grid" in readings[100].reason
    assert [r.status is Status.UNKNOWN for r in readings[99:106]] == [0, 1, 1, 1, 1, 0, 0]
    again = monitor.update(shifted[-1], trial.y[-1], trial.u[-1])
    assert again.status is Status.UNKNOWN
    assert "second time" in again.reason


def test_where_float64_has_no_digits_for_a_tube_nothing_is_judged_and_none_is_designed() -> None:
    """y ≈ 1.4e12, where numbers are 2.4e-4 apart, with a half-width of a few of these."""
    model = MODELS["linear"]()
    assert isinstance(model, DifferenceEquation)
    far = replace(model, c=model.c + 1.4e12 * (1.0 - float(model.a.sum())))
    noise = 1.4e12 + 2e-3 * np.sin(np.arange(200.0))[:, None]
    trials = dataset(model, 0, 6, 200)
    quiet = [replace(trial, y=simulate_trial(model, trial) + noise) for trial in trials]
    with pytest.raises(DataError, match="cannot be monitored in float64: rounding can hide"):
        design_output_tube(OutputTube(far, Dataset(tuple(quiet))))
    made = design("linear")
    tubes = [replace(tube, half_widths=1e-3 * tube.half_widths) for tube in made.funnel.tubes]
    elsewhere = replace(made.funnel, model=files.digest(far.document()), tubes=tuple(tubes))
    for trial in quiet[:2]:
        readings = run(Monitor([Stage(far, None, elsewhere)]), trial)
        assert {reading.status for reading in readings} == {Status.UNKNOWN}
        assert "float64 cannot tell where the simulation is" in readings[-1].reason


def test_an_input_that_the_model_refuses_or_a_box_that_is_left_is_not_judged() -> None:
    monitor, trial = monitor_of("implicit_box"), trial_of("implicit_box", 100)
    readings = [
        monitor.update(float(t), y, np.array([40.0]) if k == 50 else u)
        for k, (t, y, u) in enumerate(zip(trial.t, trial.y, trial.u, strict=True))
    ]
    assert readings[49].status is Status.INSIDE
    assert "outside the box" in readings[50].reason
    assert readings[50].status is readings[51].status is Status.UNKNOWN
    assert readings[60].status is Status.INSIDE


@EVERY
def test_a_stuck_sensor_is_caught(name: str) -> None:
    trial = trial_of(name, 300)
    stuck = trial.y.copy()
    stuck[100:] = stuck[100] + 0.8 * np.ptp(trial.y, axis=0)
    readings = run(monitor_of(name), replace(trial, y=stuck))
    bad = [r for r in readings[100:] if r.status in (Status.OUTSIDE, Status.ASSUMPTION_VIOLATED)]
    assert bad
    assert "innovation energy" in bad[0].reason
    assert "what runs is not" not in bad[0].reason


def test_an_energy_is_over_and_the_fading_tube_lasts() -> None:
    made, trial = design("linear"), trial_of("linear", 100)
    lasting, ending = (replace(made.funnel, tubes=(tube,)) for tube in made.funnel.tubes)
    assert all(
        r.status is Status.INSIDE
        for r in run(Monitor([Stage(made.model, None, lasting)]), trial)[3:]
    )
    readings = run(Monitor([Stage(made.model, None, ending)]), trial)
    assert readings[42].status is Status.INSIDE
    assert readings[43].status is Status.UNKNOWN
    assert "covers 40 samples" in readings[43].reason


# -- design ----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("name", "rank"), [("linear", 1), ("linear", 3), ("two_following", 1)])
def test_a_next_trial_sets_off_any_alarm_as_rarely_as_the_rank_bound_says(
    name: str, rank: int
) -> None:
    """300 splits, each of 9 trials that scale a funnel at factor 1 and one that runs against it."""
    made, splits, alarmed = design(name), 300, 0
    plain = replace(made.funnel.tubes[0].measured, safety_factor=1.0, rank=rank)
    tubes = tuple(replace(tube, measured=plain) for tube in made.funnel.tubes)
    before = dataset(made.model, 0, 3, 60)
    trials = dataset(made.model, 1000, 10 * splits, 60).trajectories
    for k in range(splits):
        *scaling, last = trials[10 * k : 10 * k + 10]
        funnel = calibrated(
            replace(made.funnel, tubes=tubes), made.model, before, Dataset(tuple(scaling))
        )
        said = run(Monitor([Stage(made.model, None, funnel)]), last)
        bad = {r.status for r in said} - {Status.INSIDE, Status.UNKNOWN}
        alarmed += bool(bad) or any(r.alarm for r in said)
    low, _ = binomtest(alarmed, splits).proportion_ci(0.95)
    assert low <= rank / 10
    assert alarmed, "a bound that nothing comes near would be met by levels that are never reached"


@pytest.mark.slow
def test_two_slow_coupled_outputs_have_a_tube() -> None:
    """With the multipliers as unknowns the solver makes them 10^4 times too large to be decided."""
    model = recorded(implicit_models.linear(np.array([[0.93, 0.02], [0.04, 0.95]])), (0, 1))
    made = design_output_tube(
        OutputTube(model, dataset(model, 0, 3, 300), dataset(model, 100, 3, 300))
    )
    assert (made.funnel.half_widths < 2.0).all()


@pytest.mark.parametrize("room", [1.0, 1e-3, 1e-6])
def test_the_multiplier_of_one_increment_matrix_keeps_the_room_on_its_null_space(
    room: float,
) -> None:
    # A multiple of E' would have to be near 1/room to keep half of it.
    rng = np.random.default_rng(4)
    E = rng.standard_normal((3, 9))
    Z = np.linalg.svd(E)[2][3:].T
    M = rng.standard_normal((9, 9))
    M = M + M.T
    M = M + Z @ (room * np.eye(6) - Z.T @ M @ Z) @ Z.T
    N = finsler(M, E)
    whole = M + N @ E + (N @ E).T
    assert np.linalg.eigvalsh(M)[0] < -0.1
    assert np.linalg.eigvalsh(whole)[0] == pytest.approx(min(room, 1.0), abs=1e-12)
    assert np.abs(N).max() < 100.0
