"""Input that cannot give a funnel: what is wrong, by how much, where, and what to do instead.

Each through Python and through `nlsid funnel --problem`, which say the same.
"""

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bags.chain.problems import load_problem
from bags.commands.main import main
from nlsid_core import files
from nlsid_core.arrays import Json
from nlsid_core.design import ContinuousTracking, Goal, design_funnel, integrate_nominal, tvlqr
from nlsid_core.dynamics import Nominal, PiecewisePolynomial, VectorField
from nlsid_core.errors import DataError, Infeasible, NlsidError, NotPolynomial, OptionError
from tests import funnel_problem
from tests.funnel_problem import hanging
from tests.marks import slow_among

KNOTS = 9


def fair() -> Json:
    """A problem with nothing wrong."""
    goal = Goal(np.zeros(2), 20 * np.eye(2))
    return funnel_problem.document(*hanging(), goal, Q=np.eye(2), R=np.eye(1))


def other(field: VectorField) -> Json:
    """A problem of other dynamics, at rest."""
    t = np.linspace(0, 1, 5)
    rest = integrate_nominal(field, lambda _: np.zeros(field.m), t=t, start=np.zeros(field.n))
    goal = Goal(np.zeros(field.n), np.eye(field.n))
    return funnel_problem.document(field, rest, goal, Q=np.eye(field.n), R=np.eye(field.m))


def nominal_bent(problem: Json) -> Json:
    problem["nominal"]["x"][3][1][0] += 0.1
    return problem


def nominal_with_a_jump(problem: Json) -> Json:
    problem["nominal"]["x"][3][0][0] += 0.1
    return problem


def goal_elsewhere(problem: Json) -> Json:
    problem["goal"]["centre"] = [0.5, 0.0]
    return problem


def goal_indefinite(problem: Json) -> Json:
    problem["goal"]["P"] = [[1.0, 2.0], [2.0, 1.0]]
    return problem


def a_search_that_no_file_chooses(problem: Json) -> Json:
    return problem | {"search": "alternation"}


def state_weight_indefinite(problem: Json) -> Json:
    return problem | {"Q": [[1.0, 0.0], [0.0, -0.5]]}


def input_weight_zero(problem: Json) -> Json:
    return problem | {"R": [[0.0]]}


def weight_not_symmetric(problem: Json) -> Json:
    return problem | {"Q": [[1.0, 0.5], [0.0, 1.0]]}


def negative_power(problem: Json) -> Json:
    problem["vector_field"]["pieces"][0][0]["exponents"][0][1] = -1
    return problem


def broken_power(problem: Json) -> Json:
    problem["vector_field"]["pieces"][0][0]["exponents"][0][1] = 0.5
    return problem


def degree_too_high(problem: Json) -> Json:
    del problem
    field = VectorField.from_function(lambda x, u: np.array([u[0] - x[0] ** 7]), 1, 1)
    return other(field)


def pushed_out(problem: Json) -> Json:
    del problem
    field = VectorField.from_function(
        lambda x, u, w: np.array([x[0] + 0 * u[0] + w[0]]), 1, 1, uncertain=[[-9, 9]]
    )
    return other(field)


def knots_that_stand_still(problem: Json) -> Json:
    problem["nominal"]["t"][4] = problem["nominal"]["t"][3]
    return problem


def knots_that_go_back(problem: Json) -> Json:
    t = problem["nominal"]["t"]
    t[4], t[5] = t[5], t[4]
    return problem


def unknown_shape(problem: Json) -> Json:
    return problem | {"shape": "Q"}


CASES: list[tuple[Callable[[Json], Json], str]] = [
    (nominal_bent, r"does not obey the dynamics: dx0/dt is off by 1\.2 at t = 0\.75 s"),
    (nominal_with_a_jump, "the nominal states should be continuous"),
    (goal_elsewhere, r"the nominal ends outside the goal: \|x - centre\|² = 5 > 1"),
    (goal_indefinite, "the goal's matrix should be symmetric positive definite"),
    (a_search_that_no_file_chooses, "'search' is no member of a funnel problem; it has: .*shape"),
    (state_weight_indefinite, r"Q should be positive semidefinite; its smallest .* is -0\.5"),
    (input_weight_zero, "R should be positive definite; its smallest eigenvalue is 0"),
    (weight_not_symmetric, "Q should be a symmetric 2x2 matrix"),
    (negative_power, "exponents"),
    (broken_power, "exponents"),
    (degree_too_high, "degree 7; .* give the dynamics as a function, which is then expanded"),
    (
        pushed_out,
        r"no funnel at t = .* the disturbance w takes .* Because of the disturbance w",
    ),
    (knots_that_stand_still, "time grid does not increase after knot 3: 0.75 s, then 0.75 s"),
    (knots_that_go_back, "time grid does not increase after knot 4: 1.25 s, then 1 s"),
    (unknown_shape, "shape is 'Q'; it should be one of rho, P"),
]


@pytest.mark.parametrize(
    ("spoil", "message"),
    slow_among(CASES, {"pushed_out"}),
    ids=lambda c: getattr(c, "__name__", ""),
)
def test_a_problem_that_cannot_be_right_is_told_alike_by_python_and_command_line(
    spoil: Callable[[Json], Json],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    problem, out = tmp_path / "problem.json", tmp_path / "out"
    files.write_document(problem, spoil(fair()))
    with pytest.raises(NlsidError, match=message):
        design_funnel(load_problem(problem))
    given = ["nlsid", "funnel", str(out), "--problem", str(problem)]
    monkeypatch.setattr(sys, "argv", given)
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    said = " ".join(capsys.readouterr().err.split())
    assert said.startswith("error: ")
    assert re.search(message, said)
    assert not out.exists()


def test_the_same_problem_unspoiled_is_designed(tmp_path: Path) -> None:
    files.write_document(tmp_path / "problem.json", fair())
    made = design_funnel(load_problem(tmp_path / "problem.json"))
    assert np.min(made.found.proved.margins) > 0


@pytest.mark.slow
def test_what_may_be_left_out_is_and_a_hold_is_read_and_proved(tmp_path: Path) -> None:
    problem = {key: fair()[key] for key in ("format", "version", "vector_field", "nominal", "goal")}
    files.write_document(tmp_path / "problem.json", problem | {"hold": 0.01, "error": [0.001, 0.0]})
    found = design_funnel(load_problem(tmp_path / "problem.json"))
    assert (found.claim["hold"], found.claim["error"]) == (0.01, [0.001, 0.0])
    files.write_document(tmp_path / "problem.json", problem | {"hold": "longest"})
    with pytest.raises(OptionError, match="hold is 'longest'"):
        design_funnel(load_problem(tmp_path / "problem.json"))


# -- where Python takes what a file cannot hold ------------------------------------------------


def test_a_nominal_that_disobeys_is_told_by_how_much_where_and_in_which_state() -> None:
    field, nominal = hanging()
    bent = nominal.x.control.copy()
    bent[3, 1, 0] += 0.1  # the slope at 0.75 s is then 3·0.1/0.25 more
    bad = Nominal(PiecewisePolynomial(nominal.t, bent), nominal.u)
    with pytest.raises(DataError, match=r"dx0/dt is off by 1\.2 at t = 0\.75 s"):
        design_funnel(ContinuousTracking(field, bad, goal=20 * np.eye(2)))


@pytest.mark.parametrize(
    ("function", "operation"),
    [
        (lambda x: np.array([np.sin(x[0])]), "sin"),
        (lambda x: np.array([1 / x[0]]), "division"),
        (lambda x: np.array([x[0] ** 0.5]), r"power 0\.5"),
        (lambda x: np.array([abs(x[0])]), "abs"),
    ],
)
def test_dynamics_that_are_not_polynomial_name_the_operation_and_offer_taylor(
    function: Callable[[Any], Any], operation: str
) -> None:
    told = f"{operation} .*with the function itself, .* as a bounded w"
    with pytest.raises(NotPolynomial, match=told):
        VectorField.from_function(function, 1, 0)


def test_a_nominal_of_other_sizes_is_told() -> None:
    field = VectorField.from_function(lambda x, u: np.array([-x[0] + u[0]]), 1, 1)
    with pytest.raises(DataError, match="the nominal has 2 states and 1 inputs, the dynamics 1"):
        design_funnel(ContinuousTracking(field, hanging()[1], goal=np.eye(1)))


def test_a_policy_around_another_nominal_is_told_and_one_that_was_found_is_taken() -> None:
    field, nominal = hanging()
    policy = design_funnel(ContinuousTracking(field, nominal, goal=20 * np.eye(2))).policy
    again = design_funnel(ContinuousTracking(field, nominal, goal=30 * np.eye(2), policy=policy))
    assert again.verdict is not None
    away = integrate_nominal(field, lambda _: np.zeros(1), t=nominal.t, start=np.array([0.01, 0]))
    with pytest.raises(DataError, match="around another nominal"):
        design_funnel(ContinuousTracking(field, away, goal=20 * np.eye(2), policy=policy))


def test_a_state_that_no_input_moves_has_a_riccati_solution_and_is_named_in_a_refusal() -> None:
    field = VectorField.from_function(
        lambda x, u, w: np.array([x[0] + w[0], -x[1] + u[0]]), 2, 1, uncertain=[[-1.0, 1.0]]
    )
    nominal = integrate_nominal(field, lambda _: np.zeros(1), t=np.arange(5) / 4, start=[0.0, 0.0])
    assert tvlqr(field, nominal, Q=np.eye(2), R=np.eye(1), S_final=np.eye(2)).S.shape == (5, 2, 2)
    with pytest.raises(Infeasible, match="No input moves x0, through no other state either"):
        design_funnel(ContinuousTracking(field, nominal, goal=[0.1, 0.1]))


def test_dynamics_valid_only_where_the_nominal_is_not_are_told() -> None:
    field, nominal = hanging()
    short = VectorField(field.pieces, 2, 1, valid=np.array([[0, 0.1, 0.3]]))
    with pytest.raises(DataError, match=r"entry 0 of \(x, u\) is 0 at 0 s, not well within"):
        design_funnel(ContinuousTracking(short, nominal, goal=20 * np.eye(2)))
