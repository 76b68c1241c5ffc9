"""The tube holds in simulation when its assumption does; the monitor and its alarm say when not."""

import math
from dataclasses import replace

import numpy as np
import pytest

from nlsid import Dataset, Monitor, OutputTube, Status
from nlsid_core.design import OutputTubeDesign, design_output_tube
from nlsid_core.design.tube import energy, innovations
from nlsid_core.errors import CertificateMismatch
from nlsid_core.funnels.tube import Tube
from nlsid_core.running.alarm import State, state_of
from nlsid_core.running.comparison import Centre
from nlsid_core.running.reading import Reading
from nlsid_core.running.stage import Stage
from tests.conftest import PERIOD

ROUNDING = 1e-9  # relative: the monitor evaluates in floating point


def make_monitor(design: OutputTubeDesign, centre: Centre = Centre.COMMAND) -> Monitor:
    return design.monitor(centre=centre)


def run(design: OutputTubeDesign, y: np.ndarray, u: np.ndarray) -> list[Reading]:
    monitor = make_monitor(design)
    return [monitor.update(k * PERIOD, y[k], u[k]) for k in range(len(y))]


def excite(design: OutputTubeDesign, tube: Tube, e: np.ndarray, engaged: np.ndarray) -> list[float]:
    """The output error along the error dynamics, from a start on the inlet's boundary."""
    model, policy = design.model, design.policy
    assert policy is not None
    direction = np.ones(len(model))
    x = direction * math.sqrt(tube.inlet / (direction @ tube.P @ direction))
    values = []
    for innovation, kappa in zip(e, engaged, strict=True):
        values.append(abs((model.C[0] - kappa * model.D * policy.K) @ x + innovation))
        closed = model.A - kappa * model.B @ policy.K[None, :]
        x = closed @ x + policy.L * innovation
    return values


@pytest.mark.parametrize("i", [0, 1])
def test_no_disturbance_within_the_level_leaves_the_tube(design: OutputTubeDesign, i: int) -> None:
    rng, tube, samples = np.random.default_rng(3), design.funnel.tubes[i], 70
    for _ in range(300):
        e = rng.standard_normal(samples) * rng.random(samples) ** rng.integers(0, 40)
        e *= math.sqrt(tube.level / energy(e[:, None], tube).max())
        engaged = rng.random(samples) if rng.random() < 0.5 else np.zeros(samples)
        assert max(excite(design, tube, e, engaged)) <= tube.half_widths[0] * (1 + ROUNDING)


def test_the_worst_disturbance_nearly_reaches_the_boundary(
    design: OutputTubeDesign, train: Dataset
) -> None:
    prediction = design_output_tube(
        OutputTube(
            design.model, train, profile=[(0.0, 0.0), (7.0, 0.5)], horizon=7.0, lqr_weights=None
        )
    )
    model, tube, samples = prediction.model, prediction.funnel.tubes[1], 70
    L = tube.L[:, 0]
    response = [1.0] + [float((np.linalg.matrix_power(model.A, k) @ L)[0]) for k in range(samples)]
    worst = np.array(response[:samples][::-1])  # matched to the output at the last sample
    worst *= math.sqrt(tube.level / np.sum(worst**2))
    x = np.zeros(len(model))
    for innovation in worst:
        output = x[0] + innovation
        x = model.A @ x + L * innovation
    assert 0.97 < output / tube.half_widths[0] <= 1


def test_training_trials_are_inside_and_spend_at_most_the_measured_share(
    design: OutputTubeDesign, train: Dataset
) -> None:
    tube = design.funnel.tubes[0]
    measured_on = {name for name, _ in tube.measured.measured_on}
    shares = {}
    for trial in train:
        readings = run(design, trial.y[:, 0], trial.u[:, 0])
        judged = [r for r in readings if r.status is not Status.UNKNOWN]
        assert {r.status for r in judged} == {Status.INSIDE}
        shares[trial.name] = max(r.assumption for r in judged)
    largest = max(shares[name] for name in measured_on)
    assert largest <= 1 / tube.measured.safety_factor**2 + ROUNDING
    assert largest >= 0.99 / tube.measured.safety_factor**2


def test_the_monitor_spends_the_energy_the_design_measured(
    design: OutputTubeDesign, train: Dataset
) -> None:
    trial = train.trajectories[0]
    lags, tubes = design.funnel.settling, design.funnel.tubes
    e = innovations(design.model, tubes[0].L[None], trial, lags)[:, 0]
    readings = [r for r in run(design, trial.y[:, 0], trial.u[:, 0]) if not math.isnan(r.margin)]
    used = [energy(e, tube) / tube.level for tube in tubes]
    used[1][tubes[1].samples :] = 0.0  # it is over
    np.testing.assert_allclose([r.assumption for r in readings], np.maximum(*used), rtol=1e-8)


def test_a_closed_loop_run_of_the_policy_is_inside_the_profile_tube(
    design: OutputTubeDesign,
) -> None:
    model, policy = design.model, design.policy
    rng = np.random.default_rng(5)
    monitor = make_monitor(design, Centre.PROFILE)
    n = len(model)
    rest = policy.u[0]
    y_rest = (model.b.sum() * rest + model.c) / (1 - model.a.sum())
    for k in range(n):
        monitor.update(k * PERIOD, y_rest, rest)
    assert policy is not None
    plan, e = policy.plan(model), rng.standard_normal(len(policy))
    most = max(energy(e[:, None], tube).max() / tube.level for tube in design.funnel.tubes)
    e *= 0.9 / math.sqrt(most)
    x = model.state_after([y_rest] * n, [rest] * n)
    for k in range(len(policy)):
        u = plan(k, x)
        y = x[0] + model.D * u + model.c + e[k]
        reading = monitor.update((n + k) * PERIOD, y, u)
        if not model.u_range[0] <= u <= model.u_range[1]:
            assert reading.status is Status.ASSUMPTION_VIOLATED
            assert "outside the fitted range" in reading.reason
            return
        assert reading.status is Status.INSIDE, reading
        x = model.A @ x + model.B[:, 0] * u + model.offset + policy.L * e[k]
    over = monitor.update((n + len(policy)) * PERIOD, y, u)
    assert over.status is Status.UNKNOWN
    assert "the proof covers 70 samples; they are over" in over.reason


def test_a_command_that_is_not_the_policys_violates_the_assumption(
    design: OutputTubeDesign,
) -> None:
    model, policy = design.model, design.policy
    monitor = make_monitor(design, Centre.PROFILE)
    n, rest = len(model), policy.u[0]
    y_rest = (model.b.sum() * rest + model.c) / (1 - model.a.sum())
    for k in range(n):
        monitor.update(k * PERIOD, y_rest, rest)
    reading = monitor.update(n * PERIOD, y_rest, 0.5)
    assert reading.status is Status.ASSUMPTION_VIOLATED
    assert "is not the policy's" in reading.reason


def test_a_sensor_that_reads_60_percent_is_caught_and_named(
    design: OutputTubeDesign, train: Dataset
) -> None:
    for trial in train:
        readings = run(design, 0.6 * trial.y[:, 0], trial.u[:, 0])
        bad = next(r for r in readings if r.status in (Status.OUTSIDE, Status.ASSUMPTION_VIOLATED))
        assert "above the level" in bad.reason
        assert f"t = {bad.t:g} s" in bad.reason


def test_outside_always_comes_with_a_violated_assumption(
    design: OutputTubeDesign, train: Dataset
) -> None:
    trial = train.trajectories[0]
    for scale in np.linspace(0.0, 2.0, 21):
        for reading in run(design, scale * trial.y[:, 0], trial.u[:, 0]):
            if reading.status is Status.OUTSIDE:
                assert "although" not in reading.reason


@pytest.mark.parametrize(
    ("sample", "reason"),
    [
        ((10 * PERIOD, math.nan, 0.1), "speed is nan"),
        ((10 * PERIOD, math.inf, 0.1), "speed is inf"),
        ((10 * PERIOD, 0.1, math.nan), "no command"),
        ((math.nan, 0.1, 0.1), "stamp is nan"),
        ((11 * PERIOD, 0.1, 0.1), "of the run is missing"),
        ((10.4 * PERIOD, 0.1, 0.1), "from when the next one"),
        ((9 * PERIOD, 0.1, 0.1), "time went back"),
        ((5 * PERIOD, 0.1, 0.1), "time went back"),
    ],
)
def test_a_sample_that_cannot_be_judged_ends_a_run_around_the_plan(
    design: OutputTubeDesign, sample: tuple[float, float, float], reason: str
) -> None:
    policy = design.policy
    assert policy is not None
    y, u = policy.plan(design.model).y, policy.u
    y, u = np.concatenate([y[:1], y[:1], y]), np.concatenate([u[:1], u[:1], u])
    monitor = make_monitor(design, Centre.PROFILE)
    for k in range(10):
        last = monitor.update(k * PERIOD, y[k], u[k])
    assert last.status is Status.INSIDE
    for reading in (monitor.update(*sample), monitor.update(12 * PERIOD, y[12], u[12])):
        assert reading.status is Status.UNKNOWN
        assert math.isnan(reading.margin)
        assert reason in reading.reason
    monitor.restart()
    for k in range(10):
        last = monitor.update(k * PERIOD, y[k], u[k])
    assert last.status is Status.INSIDE


def test_a_missing_state_ends_a_run_around_the_plan(design: OutputTubeDesign) -> None:
    monitor = make_monitor(design, Centre.PROFILE)
    reading = monitor.missing(1.0, "no speed for 0.1 s")
    assert (reading.status, reading.reason) == (Status.UNKNOWN, "no speed for 0.1 s")
    assert monitor.update(2.0, 0.0, 0.0).status is Status.UNKNOWN


def test_around_the_simulation_the_tube_goes_on_after_the_plan(
    design: OutputTubeDesign, train: Dataset
) -> None:
    trial = train.trajectories[0]
    readings = run(design, trial.y[:, 0], trial.u[:, 0])
    assert len(readings) > design.funnel.settling + 70
    assert {r.status for r in readings[design.funnel.settling :]} == {Status.INSIDE}


def test_parts_that_do_not_belong_together_are_refused(
    design: OutputTubeDesign, train: Dataset
) -> None:
    other = design_output_tube(
        OutputTube(design.model, train, profile=[(0, 0), (7, 0.4)], horizon=7.0)
    )
    with pytest.raises(CertificateMismatch, match="another policy"):
        Monitor([Stage(design.model, other.policy, design.funnel)])
    for policy, what in ((design.policy, "policy"), (None, "funnel")):
        with pytest.raises(CertificateMismatch, match=f"the {what} was made for another model"):
            Monitor([Stage(replace(design.model, c=1.0), policy, design.funnel)])


# -- Alerts: a low margin warns, and what is outside is never anything else

ROWS = [
    (Status.INSIDE, 0.5, 0.0, State.INSIDE),
    (Status.INSIDE, 0.1, 0.0, State.INSIDE),
    (Status.INSIDE, 0.3, 0.3, State.INSIDE),
    (Status.INSIDE, 0.29, 0.3, State.WARNING),
    (Status.INSIDE, math.nan, 0.1, State.WARNING),
    (Status.INSIDE, math.nan, 0.0, State.INSIDE),
    *((Status.OUTSIDE, -0.1, margin, State.OUTSIDE) for margin in (0.0, 0.5, 1.0)),
    (Status.ASSUMPTION_VIOLATED, 0.1, 0.5, State.ASSUMPTION_VIOLATED),
    (Status.UNKNOWN, math.nan, 0.5, State.UNKNOWN),
]


@pytest.mark.parametrize(("status", "margin", "warning_margin", "said"), ROWS)
def test_only_a_sample_inside_is_ever_warned_of(
    status: Status, margin: float, warning_margin: float, said: State
) -> None:
    assert state_of(Reading(0.0, status, margin), warning_margin) is said
