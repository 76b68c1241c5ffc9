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
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import DataError, Infeasible, NlsidError, NotPolynomial, OptionError
from tests import funnel_problem
from tests.edits import Edit, changed, exchanged, put
from tests.funnel_problem import hanging, hung
from tests.marks import slow_among


def fair() -> Json:
    """A problem with nothing wrong."""
    goal = Goal(np.zeros(2), 20 * np.eye(2))
    return funnel_problem.document(*hanging(), goal, Q=np.eye(2), R=np.eye(1))


def instead(function: Callable[..., Any], **bounds: Any) -> Edit:
    """A problem of one state that should rest in 0, under these dynamics."""
    field = VectorField.from_function(function, 1, 1, **bounds)
    t = np.linspace(0, 1, 5)
    rest = integrate_nominal(field, lambda _: np.zeros(1), t=t, start=np.zeros(1))
    goal = Goal(np.zeros(1), np.eye(1))
    other = funnel_problem.document(field, rest, goal, Q=np.eye(1), R=np.eye(1))
    return lambda problem: problem.update(other)


POWER = "vector_field pieces 0 0 exponents 0 1"
CASES: dict[str, tuple[Edit, str]] = {
    "nominal bent": (
        changed("nominal x 3 1 0", lambda x: x + 0.1),
        r"does not obey the dynamics: dx0/dt is off by 1\.2 at t = 0\.75 s",
    ),
    "nominal with a jump": (
        changed("nominal x 3 0 0", lambda x: x + 0.1),
        "the nominal states should be continuous",
    ),
    "goal elsewhere": (
        put("goal centre", [0.5, 0.0]),
        r"the nominal ends outside the goal: \|x - centre\|² = 5 > 1",
    ),
    "goal indefinite": (
        put("goal P", [[1.0, 2.0], [2.0, 1.0]]),
        "the goal's matrix should be symmetric positive definite",
    ),
    "a search that no file chooses": (
        put("search", "alternation"),
        "'search' is no member of a funnel problem; it has: .*shape",
    ),
    "state weight indefinite": (
        put("Q", [[1.0, 0.0], [0.0, -0.5]]),
        r"Q should be positive semidefinite; its smallest .* is -0\.5",
    ),
    "input weight zero": (
        put("R", [[0.0]]),
        "R should be positive definite; its smallest eigenvalue is 0",
    ),
    "weight not symmetric": (
        put("Q", [[1.0, 0.5], [0.0, 1.0]]),
        "Q should be a symmetric 2x2 matrix",
    ),
    "negative power": (put(POWER, -1), "exponents"),
    "broken power": (put(POWER, 0.5), "exponents"),
    "degree too high": (
        instead(lambda x, u: np.array([u[0] - x[0] ** 7])),
        "degree 7; .* give the dynamics as a function, which is then expanded",
    ),
    "pushed out": (
        instead(lambda x, u, w: np.array([x[0] + 0 * u[0] + w[0]]), uncertain=[[-9, 9]]),
        r"no funnel at t = .* the disturbance w takes .* Because of the disturbance w",
    ),
    "knots that stand still": (
        put("nominal t 4", 0.75),
        "time grid does not increase after knot 3: 0.75 s, then 0.75 s",
    ),
    "knots that go back": (
        exchanged("nominal t 4", "nominal t 5"),
        "time grid does not increase after knot 4: 1.25 s, then 1 s",
    ),
    "unknown shape": (put("shape", "Q"), "shape is 'Q'; it should be one of rho, P"),
}


@pytest.mark.parametrize("what", slow_among(CASES, {"pushed out"}))
def test_a_problem_that_cannot_be_right_is_told_alike_by_python_and_command_line(
    what: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    problem, out = tmp_path / "problem.json", tmp_path / "out"
    (spoil, message), asked = CASES[what], fair()
    spoil(asked)
    files.write_document(problem, asked)
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
    policy = hung().policy
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
