"""Funnels of policies whose inputs saturate: proved mode by mode, simulated, and forged."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.thesis.soundness import Simulation, TrueDynamics
from examples import torque_limited_pendulum as pendulum
from nlsid_core import files as documents
from nlsid_core import proofs
from nlsid_core.design import (
    ContinuousTracking,
    FunnelDesign,
    Goal,
    design_funnel,
    integrate_nominal,
)
from nlsid_core.dynamics import Nominal, VectorField, constant_on
from nlsid_core.errors import DataError
from nlsid_core.policies.continuous import ContinuousPolicy
from tests import funnel_problem
from tests.core.kernel import refusals
from tests.edits import Edit, changed, put, scaled
from tests.funnel_files import POLICY, PROOF, Files, bind, files_of, forged_by
from tests.verbs import nlsid

LIMIT = 9.0
GOAL = np.diag([100.0, 10.0])


def still(field: VectorField, knots: int, seconds: float) -> Nominal:
    """Rest at the origin."""
    t = np.linspace(0, seconds, knots)
    return integrate_nominal(field, lambda _: np.zeros(field.m), t=t, start=np.zeros(field.n))


@pytest.fixture(scope="module")
def design() -> FunnelDesign:
    """The pendulum with less torque, for the last 0.5 s."""
    field, _ = pendulum.problem()
    weights: Any = {"Q": pendulum.Q, "R": pendulum.R}
    limits = [[0, -LIMIT, LIMIT]]
    return design_funnel(
        ContinuousTracking(field, still(field, 13, 0.5), goal=GOAL, limits=limits, **weights)
    )


@pytest.fixture(scope="module")
def files(design: FunnelDesign) -> Files:
    """Its four documents."""
    return files_of(design)


def demand(found: FunnelDesign, t: float) -> float:
    """The largest |u₀ - Kx̄| on the funnel's boundary."""
    edge = found.funnel.outline(t, (0, 1))
    asked = found.policy.u(t) - (edge - found.policy.x(t)) @ found.policy.K(t).T
    return float(np.abs(asked).max())


def test_a_funnel_in_which_the_input_saturates_is_proved_and_says_so(
    design: FunnelDesign, tmp_path: Path
) -> None:
    assert demand(design, 0.0) > 1.2 * LIMIT
    proof = design.save(tmp_path)[-1]
    exact = proofs.check(proof)
    assert "u0 clipped to [-9, 9]" in exact.assumptions[0]
    assert "without" not in exact.assumptions[0]
    assert exact.margin > 0
    policy = ContinuousPolicy.from_document(documents.load_document(tmp_path / "policy.json"))
    edge = design.funnel.outline(0.0, (0, 1))
    assert np.abs(policy(0.0, edge)).max() == LIMIT


def test_no_start_leaves_with_the_true_sine_and_with_less_torque_some_do(
    design: FunnelDesign,
) -> None:
    truth, rng = TrueDynamics(pendulum.truth), np.random.default_rng(2)
    for knot in (0, 4):
        run = Simulation(truth, design.policy, design.funnel).boundary(
            starts=3000, rng=rng, knot=knot
        )
        assert run.violations == 0
    weaker = replace(design.policy, limits=np.array([[0, -LIMIT / 2, LIMIT / 2]]))
    assert Simulation(truth, weaker, design.funnel).boundary(starts=500, rng=rng).violations > 0


# -- forgeries -------------------------------------------------------------------------------


def piece_of(mode: int, edit: Edit) -> Edit:
    """Changes the first piece of a mode."""

    def forge(files: Files) -> None:
        pieces = files[PROOF]["proof"]["pieces"]
        edit(next(piece for piece in pieces if piece["mode"] == [mode]))

    return forge


PIECES = f"{PROOF} proof pieces"
FORGERIES: dict[str, tuple[Edit, str]] = {
    "limits wider": (scaled(f"{POLICY} limits", 1.01), "not_positive"),
    "no limits": (put(f"{POLICY} limits", []), "malformed"),
    "nothing for the high limit": (
        changed(PIECES, lambda pieces: [each for each in pieces if each["mode"] != [1]]),
        "not_covered",
    ),
    "a free piece called high": (piece_of(0, put("mode", [1])), "not_covered"),
    "no such mode": (put(f"{PIECES} 0 mode", [2]), "not_covered"),
    "weights, for which format 2 had a place": (
        piece_of(1, put("tau 0 squares weights", [-1, -1])),
        "left",
    ),
    "a multiplier four times as large": (
        piece_of(-1, changed("tau 0 squares unit", lambda unit: unit - 1)),
        "not_positive",
    ),
}


@pytest.mark.parametrize(("forge", "reason"), FORGERIES.values(), ids=FORGERIES)
def test_a_forged_saturated_funnel_is_refused(files: Files, forge: Edit, reason: str) -> None:
    refusals.refused_with_fresh_digests(forged_by(forge, files), reason)


def test_the_same_files_bound_again_are_proved(files: Files) -> None:
    bind(files)
    assert proofs.decide(files[PROOF], files).margin > 0


# -- more inputs, bad input --------------------------------------------------------------------


@pytest.mark.slow
def test_a_saturated_funnel_comes_near_the_radius_known_in_closed_form() -> None:
    """ẋ = x + clip(u, ±1), |x(1)| ≤ 0.2: at the limit x(0) = 1 - 0.8/e, and no start beyond it."""
    field = VectorField.from_function(lambda x, u: np.array([x[0] + u[0]]), 1, 1)
    found = design_funnel(
        ContinuousTracking(
            field, still(field, 41, 1.0), goal=np.array([[25.0]]), limits=[[0, -1.0, 1.0]]
        )
    )
    radius = 1 / np.sqrt(found.funnel.shape(0.0)[0, 0])
    best = 1 - 0.8 / np.e
    assert 0.97 * best <= radius < best
    assert radius * found.policy.K(0.0)[0, 0] > 1.5  # it asks for far more than there is


@pytest.mark.slow
def test_two_inputs_have_nine_modes_and_all_are_proved(tmp_path: Path) -> None:
    def pair(x: Any, u: Any) -> Any:
        return np.array([x[0] + x[0] ** 3 / 6 + u[0], x[1] / 2 + x[0] / 4 + u[1]])

    field = VectorField.from_function(pair, 2, 2)
    options: Any = {"Q": np.eye(2), "R": np.eye(2), "limits": [[0, -0.9, 0.9], [1, -0.6, 0.8]]}
    problem = ContinuousTracking(field, still(field, 9, 0.4), goal=4 * np.eye(2), **options)
    found = design_funnel(problem)
    assert len(np.unique(found.found.proved.pieces.cases.mode, axis=0)) == 9
    edge = found.funnel.outline(0.0, (0, 1))
    asked = -(edge - found.policy.x(0.0)) @ found.policy.K(0.0).T
    assert (np.abs(asked).max(axis=0) > [0.9, 0.8]).all()
    assert proofs.check(found.save(tmp_path)[-1]).margin > 0
    rng = np.random.default_rng(7)
    assert (
        Simulation(field, found.policy, found.funnel).boundary(starts=3000, rng=rng).violations == 0
    )


@pytest.mark.slow
def test_pushes_and_limits_are_proved_together(tmp_path: Path) -> None:
    def pushed(x: Any, u: Any, w: Any) -> Any:
        return np.array([x[1] + w[1], x[0] - x[0] ** 3 / 6 + u[0] + w[0] - 2 * w[2]])

    bounds = [[-0.003, 0.003], [-0.002, 0.002], [-0.001, 0.001]]
    field = VectorField.from_function(pushed, 2, 1, uncertain=bounds, valid=[[2, -1.0, 1.0]])
    options: Any = {"nominal": still(field, 13, 0.6), "goal": 20 * np.eye(2)}
    free = design_funnel(ContinuousTracking(field, **options))
    policy = replace(free.policy, limits=np.array([[0, -0.5, 1.0]]))
    found = design_funnel(ContinuousTracking(field, **options, policy=policy))
    assert found.found.proved.pieces.kappa is not None
    assert demand(found, 0.0) > 0.6
    assert proofs.check(found.save(tmp_path)[-1]).margin > 0
    rng = np.random.default_rng(10)
    run = Simulation(field, found.policy, found.funnel).boundary(
        starts=2000, rng=rng, adversary=True
    )
    assert run.violations == 0


def test_a_policy_clips_what_it_asks_for_and_refuses_limits_that_are_none() -> None:
    t = np.array([0.0, 1.0])
    parts = (
        constant_on(t, np.zeros((1, 2))),
        constant_on(t, np.zeros((1, 4))),
        constant_on(t, np.ones((1, 4, 2))),
        "",
    )
    policy = ContinuousPolicy(*parts, limits=np.array([[2, -1.0, 3.0]]))
    assert policy(0.5, [[5.0, 5.0], [-9.0, 0.0]]) == pytest.approx(
        np.array([[-10.0, -10.0, -1.0, -10.0], [9.0, 9.0, 3.0, 9.0]])
    )
    assert ContinuousPolicy.from_document(policy.document()).limits.tolist() == [[2, -1, 3]]
    for limits in ([[4, -1, 1]], [[0, 1, -1]], [[0, -1, 1], [0, -2, 2]], [[0, -1, np.inf]]):
        with pytest.raises(DataError, match="rows of limits"):
            ContinuousPolicy(*parts, limits=np.array(limits, dtype=float))
    with pytest.raises(DataError, match=r"3\^4 modes"):
        ContinuousPolicy(*parts, limits=np.array([[i, -1.0, 1.0] for i in range(4)]))


def test_a_nominal_beyond_the_limits_is_refused() -> None:
    field, _ = pendulum.problem()
    nominal = still(field, 5, 0.2)
    with pytest.raises(DataError, match="no room is left"):
        design_funnel(ContinuousTracking(field, nominal, goal=GOAL, limits=[[0, 0.5, 6.0]]))


@pytest.mark.slow
def test_the_command_line_takes_limits_from_a_problem_file(tmp_path: Path) -> None:
    field, _ = pendulum.problem()
    asked = funnel_problem.document(
        field,
        still(field, 13, 0.3),
        Goal(np.zeros(2), GOAL),
        Q=pendulum.Q,
        R=pendulum.R,
        limits=[[0, -LIMIT, LIMIT]],
    )
    file = tmp_path / "problem.json"
    documents.write_document(file, asked)
    nlsid("funnel", tmp_path, "--problem", file)
    assert ContinuousPolicy.from_document(
        documents.load_document(tmp_path / "policy.json")
    ).limits.tolist() == [[0, -LIMIT, LIMIT]]
    checked = nlsid("check", tmp_path / "funnel.proof.json")
    assert "u0 clipped to [-9, 9]" in " ".join(checked.split())


@pytest.mark.slow
def test_the_torque_limited_pendulum_covers_most_of_its_best_ellipse() -> None:
    found = pendulum.designed()
    assert demand(found, 0.0) > 1.5 * pendulum.TORQUE
    everything, ellipse = pendulum.area_fractions(found.policy, found.funnel, points=201)
    assert 0.1 < everything < 1
    assert 0.8 < ellipse <= 1.02
    truth, rng = TrueDynamics(pendulum.truth), np.random.default_rng(3)
    run = Simulation(truth, found.policy, found.funnel).boundary(starts=10_000, rng=rng)
    assert run.violations == 0
