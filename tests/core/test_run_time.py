"""Run time keeps the promise: each robot here is truly outside, or its numbers are none.

The truth is computed beside the monitor: in fractions, or from the plan the robot does not follow.
"""

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bags.monitoring.watch import Watch
from nlsid import Dataset, Design, Monitor, OutputTube, Status
from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.design import OutputTubeDesign, design_output_tube
from nlsid_core.errors import DataError
from nlsid_core.funnels import (
    DisturbanceAssumption,
    Measured,
    SampledFunnel,
    Tube,
    TubeFunnel,
    factor,
)
from nlsid_core.funnels.factor import factor_of, refuse_unmonitorable
from nlsid_core.models import DifferenceEquation, Signal, StateModel
from nlsid_core.policies import SampledPolicy, TubePolicy
from nlsid_core.running.comparison import Centre
from nlsid_core.running.controller import Controller, Limits
from nlsid_core.running.grid import Grid
from nlsid_core.running.stage import Stage
from tests.tracked import PERIOD, STEPS, designed, run

WIDE = Limits(lowest=-1e300, highest=1e300, stop_rate=1.0)


def overflowing() -> tuple[StateModel, SampledPolicy, SampledFunnel]:
    """x⁺ = x²⁰⁰ - x²⁰¹ + u, from 1e3 inf - inf; a tube that is wide only at first."""
    model = StateModel(
        exponents=np.array([[0, 1], [200, 0], [201, 0]]),
        coefficients=np.array([[1.0], [1.0], [-1.0]]),
        period=0.1,
        x=(Signal("x", "m"),),
        u=(Signal("u", "N"),),
        x_range=np.array([[-1.0, 1.0]]),
        u_range=np.array([[-1.0, 1.0]]),
        noise=np.array([1.0]),
        disturbance=np.array([1.0]),
    )
    digest = files.digest(model.document())
    policy = SampledPolicy(
        x=np.zeros((4, 1)),
        u=np.zeros((3, 1)),
        K=np.zeros((3, 1, 1)),
        L=np.ones((1, 1)),
        period=0.1,
        model=digest,
    )
    policy = replace(policy, K=np.full((3, 1, 1), 1e-3))
    radii = np.array([1e4, 1.0, 1.0, 1.0])
    funnel = SampledFunnel(
        S=np.ones((4, 1, 1)),
        A=np.zeros((3, 1, 1)),
        tube=radii,
        inlet=radii,
        half_widths=radii[:, None],
        assumption=DisturbanceAssumption(1e-3, 1e-4, 1.5, (("run", "sha256:0"),)),
        model=digest,
        policy=files.digest(policy.document()),
    )
    return model, policy, funnel


def test_an_estimate_that_is_no_number_is_outside_and_ends_the_run() -> None:
    """The robot stands at 50 m, the tube ends at 1 m; NaN is not greater than 1."""
    model, policy, funnel = overflowing()
    monitor = Monitor([Stage(model, policy, funnel)])
    first = monitor.update(0.0, [1e3], policy(0, np.array([1e3])))
    assert first.status is Status.INSIDE
    with np.errstate(over="ignore", invalid="ignore"):
        assert np.isnan(model(np.array([1e3]), np.zeros(1))).all()
        reading = monitor.update(0.1, [50.0], [0.0])
    assert reading.status is Status.OUTSIDE
    assert reading.margin == -math.inf
    later = monitor.update(0.2, [0.0], [0.0])
    assert later.status is Status.UNKNOWN
    assert "not finite" in later.reason


def test_a_controller_never_sends_an_input_that_is_no_number() -> None:
    model, policy, funnel = overflowing()
    controller = Controller(Stage(model, policy, funnel), WIDE, 1.0)
    before = controller.update(0.0, np.array([1.0]))
    assert np.isfinite(before).all()
    controller._observer.begin([np.array([1e3])], [])
    with np.errstate(over="ignore", invalid="ignore"):
        sent = controller.update(0.1, np.array([0.5]))
    np.testing.assert_array_equal(sent, before)
    assert "is not proved" in controller.ended


POWERS = np.array([[2.0**60, 2.0**60], [2.0**60, 2.0**60 + 2.0**8]])
F = np.array([[2.0**26 - 5, 2.0**26 - 27], [0.0, 1.0]])
STEEP = F.T @ F  # integers below 2^53: exact
LEVEL = 1e-4


def steep() -> tuple[DifferenceEquation, TubeFunnel]:
    """A tube that starts in |F x̄|² ≤ 1e-4 with P = F'F of condition 2^54."""
    model = DifferenceEquation(
        a=np.array([0.5, 0.25]),
        b=np.zeros(3),
        c=0.0,
        period=0.1,
        y=Signal("y", "m"),
        u=Signal("u", "N"),
        u_range=(-1.0, 1.0),
    )
    tube = Tube(
        rho=1.0,
        L=np.zeros((2, 1)),
        P=STEEP,
        R=np.eye(1),
        tau=np.ones(1),
        half_widths=np.ones(1),
        level=1.0,
        measured=Measured(0.1, 1.5, (), (("trial", "sha256:0"),)),
        samples=5,
        inlet=LEVEL,
    )
    return model, TubeFunnel((tube,), settling=2, model=files.digest(model.document()))


def rounded(P: FloatArray, x: FloatArray) -> float:
    """x'Px in float64, each product and each sum rounded: no two machines differ."""
    rows = [sum(p * v for p, v in zip(row, x.tolist(), strict=True)) for row in P.tolist()]
    return float(sum(v * row for v, row in zip(x.tolist(), rows, strict=True)))


def value(P: FloatArray, x: FloatArray) -> Fraction:
    """x'Px in fractions."""
    exact = [Fraction(v) for v in x.tolist()]
    rows = [[Fraction(v) for v in row] for row in P.tolist()]
    return sum(
        (
            a * p * b
            for a, row in zip(exact, rows, strict=True)
            for p, b in zip(row, exact, strict=True)
        ),
        Fraction(0),
    )


def test_a_robot_outside_by_thousands_of_levels_is_outside_however_steep_the_tube_is() -> None:
    """In float64 x'Px cancels to less than the level; in fractions it is thousands of levels."""
    model, funnel = steep()
    rng = np.random.default_rng(0)
    hidden = None
    while hidden is None:
        b = float(rng.uniform(0.9, 1.1))
        x_bar = np.array([-b * F[0, 1] / F[0, 0], b])
        in_float = rounded(STEEP, x_bar)
        if 0.0 <= in_float <= LEVEL and value(STEEP, x_bar) > 5000 * Fraction(LEVEL):
            hidden = x_bar
    start = model.state_after([0.0, 0.0], [0.0, 0.0])
    policy = TubePolicy(
        start=start - hidden,
        u=np.zeros(5),
        K=np.zeros(2),
        L=np.zeros(2),
        period=0.1,
        model=funnel.model,
    )
    deviation = start - policy.start
    assert rounded(STEEP, deviation) <= LEVEL, "what a comparison of x'Px would see"
    assert value(STEEP, deviation) > 5000 * Fraction(LEVEL)
    funnel = replace(funnel, policy=files.digest(policy.document()))
    monitor = Monitor([Stage(model, policy, funnel)], centre=Centre.PROFILE)
    for k in (-2, -1):
        monitor.update(k * 0.1, 0.0, 0.0)
    reading = monitor.update(0.0, float(start[0]), 0.0)
    assert reading.status in (Status.ASSUMPTION_VIOLATED, Status.OUTSIDE)
    assert "started outside" in reading.reason


def test_a_disturbance_above_its_bound_by_less_than_rounding_is_not_kept() -> None:
    """0.1 y is the bound in float64 and above it in fractions, for every other y."""
    model, policy, funnel = overflowing()
    rng = np.random.default_rng(0)
    S = 0.1
    y = next(
        y
        for y in rng.uniform(0.9, 1.1, 100).tolist()
        if Fraction(S) * Fraction(y) > Fraction(S * y)
    )
    assumed = DisturbanceAssumption(S * y, 0.0, 1.5, ())
    for bound, status in ((S * y, Status.ASSUMPTION_VIOLATED), (S * y * 1.0001, Status.INSIDE)):
        narrow = replace(funnel, S=np.full((4, 1, 1), S), assumption=replace(assumed, bound=bound))
        monitor = Monitor([Stage(model, policy, narrow)])
        monitor.update(0.0, [0.0], [0.0])
        assert monitor.update(0.1, [y], policy(1, np.array([y]))).status is status


@settings(max_examples=200, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), steepness=st.floats(0.0, 6.0), radius=st.floats(0.99, 1.01))
def test_a_size_is_never_below_the_true_one_and_hardly_above(
    seed: int, steepness: float, radius: float
) -> None:
    """size² against x'Px/level in fractions, near the boundary of random ellipsoids."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    G = np.triu(rng.standard_normal((n, n))) * 10 ** rng.uniform(-steepness, steepness, (n, 1))
    G[np.arange(n), np.arange(n)] += 0.1 * np.sign(np.diag(G))
    z = rng.standard_normal(n)
    x = radius * np.linalg.solve(G, z / np.linalg.norm(z))
    radii = np.ones(2)
    sampled = SampledFunnel(
        S=np.array([G, G]),
        A=np.zeros((1, n, n)),
        tube=radii,
        inlet=radii,
        half_widths=np.ones((2, n)),
        assumption=DisturbanceAssumption(0.0, 0.0, 1.5, ()),
        model="",
        policy="",
    )
    exact = [
        sum((Fraction(a) * Fraction(b) for a, b in zip(row, x.tolist(), strict=True)), Fraction(0))
        for row in G.tolist()
    ]
    truth = sum((v * v for v in exact), Fraction(0))
    size = Fraction(sampled.size(0, x))
    assert truth <= size**2 <= truth * Fraction(1 + 3 * factor.MOST_ROUNDING)
    P = G.T @ G
    P = (P + P.T) / 2
    try:
        tube = replace(steep()[1].tubes[0], P=P, L=np.zeros((n, 1)), inlet=1.0)
        size = Fraction(tube.start_size(x))
    except DataError:
        return  # P = F'F, rounded, is not definite, or too steep
    truth = value(P, x)
    assert truth <= size**2 <= truth * Fraction(1 + 3 * factor.MOST_ROUNDING)


def test_a_factor_is_exact_where_float64_has_no_digit_left() -> None:
    np.testing.assert_array_equal(factor_of(POWERS), [[2.0**30, 2.0**30], [0.0, 2.0**4]])
    with pytest.raises(DataError, match="not positive definite"):
        factor_of(np.array([[1.0, 1.0], [1.0, 1.0]]))


def test_what_float64_cannot_hold_is_refused_by_the_monitor_and_at_design(
    design: OutputTubeDesign, train: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, policy, funnel = overflowing()
    S = np.array([[1.0, 1e14], [0.0, 1.0]])
    far = SampledFunnel(
        S=np.array([S, S]),
        A=np.zeros((1, 2, 2)),
        tube=np.ones(2),
        inlet=np.ones(2),
        half_widths=np.ones((2, 2)),
        assumption=funnel.assumption,
        model="",
        policy="",
    )
    with pytest.raises(DataError, match="too ill-conditioned to be monitored in float64"):
        refuse_unmonitorable(far)
    monkeypatch.setattr(factor, "MOST_ROUNDING", 1e-20)
    with pytest.raises(DataError, match="too ill-conditioned"):
        Monitor([Stage(model, policy, funnel)])
    with pytest.raises(DataError, match="too ill-conditioned"):
        design_output_tube(
            OutputTube(design.model, train, profile=[(0.0, 0.0), (7.0, 0.5)], horizon=7.0)
        )


def test_a_lost_first_message_does_not_shift_the_plan() -> None:
    """A robot one sample behind its plan, seen from sample 1 on: it looks like one in time."""
    made = designed()
    S, plan, radius = made.funnel.S, made.policy.x, made.funnel.radius
    states = [plan[0]]
    for k in range(1, STEPS):  # a third of the tube behind where the plan was a sample ago
        step = plan[k - 1] - plan[k]
        states.append(plan[k - 1] + 0.35 * radius[k] * step / np.linalg.norm(S[k] @ step))
    away = [np.linalg.norm(S[k] @ (states[k] - plan[k])) / radius[k] for k in range(1, STEPS)]
    assert max(away) > 1.0, "it is truly outside"
    watch = Watch(Design(made.model, made.policy, made.funnel), announced=True)
    start_ns, period_ns = 10**12, round(PERIOD * 1e9)
    said = watch.begin(start_ns)
    for k in range(1, STEPS):
        said += watch.response(start_ns + k * period_ns, states[k])
        said += watch.excitation(start_ns + k * period_ns, made.policy.u[k - 1])
    assert len(said) == STEPS - 1
    assert {entry.reading.status for entry in said} == {Status.UNKNOWN}
    assert "sample 0 of the run is missing: sample 1 is next" in said[0].reading.reason


def test_a_quarter_of_a_period_late_each_time_is_not_on_the_grid() -> None:
    """Each stamp is within the tolerance of the one before; the plan ends 6 samples early."""
    made, recorded = designed(), run()
    monitor = made.monitor()
    said = [
        monitor.update(1.249 * k * PERIOD, y, u)
        for k, (y, u) in enumerate(zip(recorded.y, recorded.u, strict=True))
    ]
    assert [r.status for r in said[:3]] == [Status.INSIDE, Status.INSIDE, Status.UNKNOWN]
    assert "+0.5 periods" in said[2].reason
    assert {r.status for r in said[2:]} == {Status.UNKNOWN}


def test_a_controller_holds_stamps_against_its_start_too() -> None:
    made, recorded = designed(), run()
    limits = Limits(lowest=-9.0, highest=9.0, stop_rate=50.0)
    controller = made.controller(limits, 1.0)
    for k in range(3):
        controller.update(1.249 * k * PERIOD, recorded.y[k])
    assert "from when the next one" in controller.ended


def test_stamps_that_scatter_without_drifting_stay_on_the_grid() -> None:
    made, recorded = designed(), run()
    monitor, rng = made.monitor(), np.random.default_rng(0)
    for k, (y, u) in enumerate(zip(recorded.y, recorded.u, strict=True)):
        jitter = 0.2 * rng.uniform(-1.0, 1.0) if k else 0.0
        assert monitor.update((k + jitter) * PERIOD, y, u).status is Status.INSIDE


@given(st.lists(st.floats(-0.24, 0.24), min_size=1, max_size=30), st.floats(-1e6, 1e6))
def test_a_grid_takes_every_sample_within_the_tolerance_of_its_announced_start(
    jitter: list[float], start: float
) -> None:
    grid = Grid(0.5, first=-2)
    grid.begin(start)
    for k, off in enumerate(jitter, start=-2):
        assert grid.take(start + (k + off) * 0.5) == ""
    assert grid.k == len(jitter) - 2


def wide_start(funnel: TubeFunnel) -> TubeFunnel:
    """The funnel with inlets as large as the levels."""
    return replace(funnel, tubes=tuple(replace(t, inlet=t.level) for t in funnel.tubes))


def test_a_controller_stops_where_the_proof_ends_though_the_plan_goes_on(
    design: OutputTubeDesign,
) -> None:
    samples = 20
    energy = replace(design.funnel.tubes[1], samples=samples, inlet=design.funnel.tubes[1].level)
    funnel = replace(design.funnel, tubes=(energy,))
    assert design.policy is not None
    assert len(design.policy) > samples
    limits = Limits(lowest=-1.0, highest=1.0, stop_rate=1.0)
    controller = Controller(Stage(design.model, design.policy, funnel), limits, 30.0)
    model, n = design.model, len(design.model)
    plan = design.policy.plan(model)
    y_rest = plan.y[0]
    for i in range(n):
        controller.update(i * model.period, y_rest)
    assert controller.k == 0
    for k in range(samples):
        assert not controller.ended
        controller.update((n + k) * model.period, plan.y[k])
    assert controller.ended == "the proof is over"


def test_an_input_is_never_beyond_the_range_of_the_model_and_what_is_sent_is_proved(
    design: OutputTubeDesign,
) -> None:
    """A robot that falls behind: the policy asks for more than the model was fitted on."""
    model, policy = design.model, design.policy
    assert policy is not None
    plan, (lowest, highest) = policy.plan(model), model.u_range
    funnel = wide_start(design.funnel)
    controller = Controller(Stage(model, policy, funnel), WIDE, 30.0)
    n = len(model)
    y_rest = plan.y[0]
    sent, asked = [], []
    for i in range(n + len(policy)):
        controller.update(i * model.period, y_rest if i < n else y_rest - 6.0)  # pushed back
        if controller.ended:
            break
        sent.append(controller.u)
        if controller.k >= 0:
            k = controller.k
            asked.append(plan(k, controller._observer._x))
            low, high = sorted((float(policy.u[k]), asked[-1]))
            assert low <= controller.u <= high, "between the plan's input and the policy's"
    assert max(asked) > highest
    assert max(sent) == highest
    assert min(sent) >= lowest


def test_a_command_between_the_plans_and_the_policys_is_one_the_proof_covers(
    design: OutputTubeDesign,
) -> None:
    model, policy = design.model, design.policy
    assert policy is not None
    plan, funnel, n = policy.plan(model), wide_start(design.funnel), len(model)
    y_rest = plan.y[0]
    for part, kept in ((0.0, True), (0.4, True), (1.0, True), (1.2, False), (-0.2, False)):
        monitor = Monitor([Stage(model, policy, funnel)], centre=Centre.PROFILE)
        for k in range(n):
            monitor.update((k - n) * model.period, y_rest - 0.01, float(policy.u[0]))
        x = model.state_after([y_rest - 0.01] * n, [float(policy.u[0])] * n)
        u = float(policy.u[0]) + part * (plan(0, x) - float(policy.u[0]))
        reading = monitor.update(0.0, y_rest - 0.01, u)
        assert (reading.status is Status.INSIDE) == kept, (part, reading.reason)


def test_time_to_exit_is_when_a_steadily_falling_margin_reaches_zero() -> None:
    made = designed()
    monitor = made.monitor()
    direction = np.linalg.solve(made.funnel.S[0], [1.0, 0.0])
    said = []
    for k in range(9):
        S = np.linalg.solve(made.funnel.S[k], [1.0, 0.0])
        assert np.isfinite(direction).all()
        x = made.policy.x[k] + 0.1 * k * made.funnel.radius[k] * S
        monitor._comparison._observer.x = None  # type: ignore[union-attr]
        said.append(monitor.update(k * PERIOD, x, made.policy(k, x)))
    for k in range(1, 9):
        assert said[k].time_to_exit == pytest.approx((10 - k) * PERIOD, rel=1e-6)
    assert said[0].time_to_exit == math.inf
