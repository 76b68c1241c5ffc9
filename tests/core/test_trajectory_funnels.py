"""Funnels around trajectories: nouns, lemmas, proofs for every t, and what is refused."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.thesis.alternation import alternate_rho, exponential_start
from benchmarks.thesis.soundness import Simulation, TrueDynamics
from examples import one_dimensional, pendulum
from examples.satellite_funnel import goal_matrix
from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.design import (
    ContinuousTracking,
    Goal,
    design_funnel,
    integrate_nominal,
)
from nlsid_core.design.continuous.lstep import LSteps
from nlsid_core.dynamics import (
    PiecewisePolynomial,
    VectorField,
    cubic_through,
    linear_through,
)
from nlsid_core.errors import DataError
from nlsid_core.funnels.continuous import ContinuousFunnel, ellipsoid_inside
from nlsid_core.kernel.continuous_funnel import inside
from nlsid_core.kernel.files import Rejected
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.proofs import check
from tests import funnel_problem
from tests.funnel_problem import hanging, satellite
from tests.verbs import nlsid


def test_a_satellite_funnel_is_proved_for_every_t(tmp_path: Path) -> None:
    *_, proof = satellite().save(tmp_path)
    assert check(proof).margin > 0
    funnel, policy = (
        ContinuousFunnel.from_document(files.load_document(tmp_path / "funnel.json")),
        ContinuousPolicy.from_document(files.load_document(tmp_path / "policy.json")),
    )
    assert (funnel.t0, funnel.tf) == (0.0, 5.0)
    assert funnel.nominal(2.5).shape == (6,)
    assert policy(1.0, np.zeros((7, 6))).shape == (7, 3)
    assert funnel.volume(5.0) == pytest.approx(6.883e-3, rel=1e-3)


@pytest.mark.slow
def test_no_start_on_the_boundary_leaves_and_larger_ones_do() -> None:
    parts = (satellite().model, satellite().policy, satellite().funnel)
    rng = np.random.default_rng(3)
    for knot in (0, 12):
        run = Simulation(*parts).boundary(starts=2000, rng=rng, knot=knot)
        assert run.violations == 0
        assert 0.9 < run.max_v <= 1
    assert Simulation(*parts).boundary(starts=500, rng=rng, scale=1.2).violations == 500
    assert Simulation(*parts).escape(goal_matrix(), starts=300, rng=rng) < 1.4


@pytest.mark.slow
def test_alternation_ends_where_the_sweep_does() -> None:
    field, nominal = hanging(21)
    design = design_funnel(ContinuousTracking(field, nominal, goal=20 * np.eye(2)))
    steps = LSteps(field, design.policy)
    start = exponential_start(steps, design.funnel.P)
    found = alternate_rho(steps, start, stop=0.002)
    assert found.volumes[0] < 0.8 * found.volumes[-1] < found.volumes[1]  # most in one step
    assert found.volumes[-1] == pytest.approx(design.funnel.volume_integral(), rel=0.01)


@pytest.mark.slow
def test_the_one_dimensional_example_comes_near_the_best_radius() -> None:
    t = np.linspace(-1, 1, 401)
    best = one_dimensional.true_sets(t)[1]
    for knots, ratio in ((40, 0.95), (160, 0.985)):
        found = one_dimensional.radius(one_dimensional.designed(knots).funnel, t)
        assert (found < best + 1e-9).all()
        assert (found / best).mean() >= ratio


def test_dynamics_that_change_at_a_knot_are_proved_piece_by_piece() -> None:
    plain, _ = hanging(21)

    def heavier(x: Any, u: Any) -> Any:
        return np.array([x[1], -2 * x[0] + x[0] ** 3 / 3 - x[1] / 5 + u[0]])

    second = VectorField.from_function(heavier, 2, 1)
    field = VectorField(plain.pieces + second.pieces, 2, 1, np.array([1.0]))
    nominal = integrate_nominal(field, lambda _: np.zeros(1), t=np.linspace(0, 2, 21), start=[0, 0])
    assert (
        np.min(
            design_funnel(
                ContinuousTracking(field, nominal, goal=20 * np.eye(2))
            ).found.proved.margins
        )
        > 0
    )


@pytest.mark.slow
def test_a_pendulum_with_its_true_sine_stays_within_its_torque_limits() -> None:
    found = pendulum.designed()
    for t in found.funnel.t:
        inputs = found.policy(float(t), found.funnel.outline(float(t), (0, 1)))
        assert np.abs(inputs).max() <= pendulum.TORQUE
    truth = TrueDynamics(pendulum.truth)
    rng = np.random.default_rng(6)
    run = Simulation(truth, found.policy, found.funnel).boundary(starts=3000, rng=rng)
    assert run.violations == 0


# -- containment -----------------------------------------------------------------------------


def decide_inside(
    centre: list[float], inner: FloatArray, other: list[float], outer: FloatArray, multiplier: float
) -> bool:
    """What the kernel says."""
    rational = [
        [[Fraction(e) for e in row] for row in np.atleast_2d(part).tolist()]
        for part in (centre, inner, other, outer)
    ]
    try:
        inside(
            rational[0][0],
            rational[1],
            rational[2][0],
            rational[3],
            Fraction(multiplier),
            "containment",
        )
    except Rejected:
        return False
    return True


def test_containment_is_decided_at_the_touching_ellipsoid() -> None:
    inner, outer = np.diag([4.0, 4.0]), np.eye(2)
    assert decide_inside([0.5, 0.0], inner, [0.0, 0.0], outer, 0.5)
    found = ellipsoid_inside([0.49, 0.0], inner, [0, 0], outer)
    assert found is not None
    assert decide_inside([0.49, 0.0], inner, [0, 0], outer, found)
    assert ellipsoid_inside([0.51, 0.0], inner, [0, 0], outer) is None
    for multiplier in np.linspace(0, 1, 101):
        assert not decide_inside([0.51, 0.0], inner, [0.0, 0.0], outer, multiplier)


def test_a_funnel_may_end_in_a_goal_around_another_point() -> None:
    field, nominal = hanging(9)
    goal = Goal(np.array([0.05, 0.0]), 20 * np.eye(2))
    assert (
        np.min(design_funnel(ContinuousTracking(field, nominal, goal=goal)).found.proved.margins)
        > 0
    )
    with pytest.raises(DataError, match="ends outside the goal"):
        design_funnel(
            ContinuousTracking(field, nominal, goal=Goal(np.array([0.5, 0.0]), 20 * np.eye(2)))
        )


# -- nouns -----------------------------------------------------------------------------------


def test_piecewise_polynomials_meet_their_samples() -> None:
    t = np.array([0.0, 0.5, 2.0])
    curve = cubic_through(t, t[:, None] ** 3, 3 * t[:, None] ** 2)
    times = np.linspace(0, 2, 11)
    assert curve(times)[:, 0] == pytest.approx(times**3)
    assert curve.derivative()(times)[:, 0] == pytest.approx(3 * times**2)
    assert linear_through(t, t**2).ends() == pytest.approx(t**2)
    with pytest.raises(DataError, match="does not increase after knot 1"):
        PiecewisePolynomial(np.array([0.0, 1.0, 1.0]), np.zeros((2, 2, 1)))


# -- command line ----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.pictures
def test_the_command_line_designs_draws_and_checks_a_funnel(tmp_path: Path) -> None:
    field, nominal = hanging(9)
    goal = Goal(np.zeros(2), 20 * np.eye(2))
    problem_file = tmp_path / "problem.json"
    asked = funnel_problem.document(field, nominal, goal, Q=np.eye(2), R=np.eye(1))
    files.write_document(problem_file, asked)
    made = nlsid("funnel", tmp_path, "--problem", problem_file)
    assert "pieces of time decided" in made
    assert "found and proved in" in made
    assert ContinuousFunnel.from_document(files.load_document(tmp_path / "funnel.json")).tf == 2.0
    assert (tmp_path / "funnel.png").is_file()
    assert "PROVED funnel" in nlsid("check", tmp_path / "funnel.proof.json")
    nlsid("funnel", tmp_path, status=None)
