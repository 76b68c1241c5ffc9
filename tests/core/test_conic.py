"""Cone programs with known answers, and the ladder."""

import os
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

from nlsid_core import conic
from nlsid_core.conic import Cone, ConeProgram, smat, solve, svec
from nlsid_core.errors import DataError, Infeasible, ShapeError, SolverError


def smallest_eigenvalue(C: np.ndarray) -> ConeProgram:
    """minimise tr(CX) with tr X = 1, X ⪰ 0."""
    n, m = len(C), len(svec(C))
    A = sp.csc_matrix(np.vstack([svec(np.eye(n))[None], -np.eye(m)]))
    b = np.r_[1.0, np.zeros(m)]
    return ConeProgram(sp.csc_matrix((m, m)), svec(C), A, b, (Cone("zero", 1), Cone("psd", n)))


def random_symmetric(seed: int, n: int = 5) -> np.ndarray:
    C = np.random.default_rng(seed).normal(size=(n, n))
    return np.asarray(C + C.T)


@pytest.mark.parametrize(("rung", "attempt"), conic._LADDER)
def test_the_smallest_eigenvalue_is_found_by_every_rung(rung: str, attempt: Any) -> None:
    C = random_symmetric(0)
    program = smallest_eigenvalue(C)
    outcome = attempt(program, conic.TOLERANCE)
    assert program.q @ outcome.x == pytest.approx(np.linalg.eigvalsh(C)[0], abs=1e-5), rung
    assert conic._residual(program, outcome.x, outcome.s, outcome.z) < 1e-5


def test_a_second_order_cone_gives_the_distance_to_a_plane() -> None:
    """minimise t with |x| ≤ t, 3x + 4y = 10: t = 2."""
    A = sp.csc_matrix(np.array([[0, 3, 4], [-1, 0, 0], [0, -1, 0], [0, 0, -1.0]]))
    program = ConeProgram(
        sp.csc_matrix((3, 3)),
        np.array([1.0, 0, 0]),
        A,
        np.array([10.0, 0, 0, 0]),
        (Cone("zero", 1), Cone("second_order", 3)),
    )
    assert solve(program).objective == pytest.approx(2.0, abs=1e-5)


def test_a_quadratic_objective_is_minimised() -> None:
    """minimise ½(x-3)² with x ≤ 1, up to a constant."""
    program = ConeProgram(
        sp.csc_matrix([[1.0]]),
        np.array([-3.0]),
        sp.csc_matrix([[1.0]]),
        np.array([1.0]),
        (Cone("nonnegative", 1),),
    )
    assert solve(program).x == pytest.approx([1.0], abs=1e-5)


def test_an_infeasible_program_says_what_was_tried() -> None:
    program = smallest_eigenvalue(random_symmetric(0))
    contradiction = ConeProgram(program.P, program.q, program.A, -program.b, program.cones)
    with pytest.raises(Infeasible, match="clarabel"):
        solve(contradiction)


def test_the_result_says_which_rung_succeeded(monkeypatch: pytest.MonkeyPatch) -> None:
    def gives_up(program: ConeProgram, tolerance: float) -> conic._Outcome:
        del program, tolerance
        return conic._Outcome("NumericalError")

    ladder = [(rung, gives_up) for rung, _ in conic._LADDER[:2]]
    monkeypatch.setattr(conic, "_LADDER", (*ladder, conic._LADDER[2]))
    found = solve(smallest_eigenvalue(random_symmetric(2)))
    assert found.attempts == (
        "clarabel: NumericalError",
        "clarabel refined: NumericalError",
        "clarabel rescaled: Solved",
    )


def test_a_wrong_answer_with_a_good_status_is_not_believed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def liar(program: ConeProgram, tolerance: float) -> conic._Outcome:
        del tolerance
        zero = np.zeros(len(program.b))
        return conic._Outcome("Solved", np.ones(len(program.q)), zero, zero)

    monkeypatch.setattr(conic, "_LADDER", (("clarabel", liar),))
    with pytest.raises(SolverError, match="Solved"):
        solve(smallest_eigenvalue(random_symmetric(2)))


def test_svec_keeps_inner_products() -> None:
    A, B = random_symmetric(3), random_symmetric(4)
    assert svec(A) @ svec(B) == pytest.approx(np.trace(A @ B))
    assert smat(svec(A)) == pytest.approx(A)


def test_sizes_and_numbers_are_checked_before_solving() -> None:
    program = smallest_eigenvalue(random_symmetric(0))
    with pytest.raises(ShapeError, match="do not fit"):
        ConeProgram(program.P, program.q, program.A, program.b, (Cone("zero", 1),))
    with pytest.raises(DataError, match="finite"):
        ConeProgram(program.P, program.q * np.nan, program.A, program.b, program.cones)


def test_a_panic_of_the_solver_is_an_attempt_that_failed_and_prints_nothing(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """One column, entries of 10^-215 to 10^241: the eigenvalues of a step are not numbers."""
    column = """-2.88481220941042e-82 0 0 -3.054797044781065e101 0
        -3.094823539018133e-36 0 -1.611280049830286e-215 0 3.578324344076351e20"""
    limits = """1.5052027581482968e72 3.272103161582988e-89 5.302264302162142e46
        -2.695988004602899e-283 3.850686863014254e76 -2.8356640469606646e154
        -3.3870182999492134e-186 -1.4487954331111758e-103 4.365991851993807e156
        -1.6834951674147448e241"""
    A, b = (np.array(numbers.split(), dtype=np.float64) for numbers in (column, limits))
    program = ConeProgram(
        sp.csc_matrix((1, 1)),
        np.array([4.04773233831723e285]),
        sp.csc_matrix(A[:, None]),
        b,
        (Cone("psd", 4),),
    )
    outcome = conic._clarabel(program, conic.TOLERANCE, refine=True)
    with conic._STDERR.without_panics():
        os.write(2, b"kept")
    assert outcome.status == "panicked"
    assert capfd.readouterr().err == "kept"
