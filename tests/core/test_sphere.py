"""The sphere form in a sampled basis: against Clarabel, and proved."""

import numpy as np
import pytest

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import (
    DataError,
    ShapeError,
    SolverError,
)
from nlsid_core.polynomial import Gram, Polynomial, constant, monomial_values, monomials, variables
from nlsid_core.sos import (
    Program,
    SphereProgram,
    SumOfSquares,
    solve,
    template,
)
from nlsid_core.sos import sphere as sphere_module

TWICE_SOLVER = 1e-6  # of the spread: Clarabel stops at 1e-8 of quantities of size 1, not of g


def random_quartic(n: int, seed: int) -> Polynomial:
    rows = monomials(n, range(5))
    rng = np.random.default_rng(seed)
    return Polynomial(rows, rng.normal(size=len(rows)), tuple(f"z{i}" for i in range(n)))


def oracle(g: Polynomial) -> float:
    (m,) = variables("m")
    sphere: Polynomial = 1 - sum((z**2 for z in variables(g.names)), constant(0.0))
    free = template("f", monomials(len(g.names), range(3)), g.names)
    squares = SumOfSquares(g - m - free * sphere)
    return -solve(Program(g.names, (squares,), minimise=-m)).objective


@pytest.mark.parametrize("n", [2, 3, 4, 5, 6])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_margin_is_clarabels(n: int, seed: int) -> None:
    g, program = random_quartic(n, seed), SphereProgram(n)
    values = g(program.points)
    found = program.solve(values)
    assert abs(found.m - oracle(g)) < TWICE_SOLVER * np.ptp(values)
    assert found.m <= found.upper


def test_the_number_of_points_is_the_number_of_equalities() -> None:
    program = SphereProgram(6)
    assert (program.points.shape, program.basis.shape) == ((182, 6), (27, 6))
    assert np.linalg.norm(program.points, axis=1) == pytest.approx(1.0)


def test_a_warm_start_reaches_the_same_margin_in_fewer_iterations() -> None:
    program = SphereProgram(6)
    g = random_quartic(6, 4)(program.points)
    start = program.solve(g, tolerance=1e-5)
    nearby = g * 1.01 + 0.02
    warm = program.solve(nearby, tolerance=1e-5, start=start)
    cold = program.solve(nearby, tolerance=1e-5)
    assert warm.iterations < cold.iterations
    assert warm.m == pytest.approx(cold.m, abs=2e-5 * np.ptp(nearby))


@pytest.mark.parametrize("degrees", [(1,), (2,), (4,), (0, 2, 4), (1, 2, 3, 4)])
def test_special_shapes_of_g_are_solved(degrees: tuple[int, ...]) -> None:
    program, rng = SphereProgram(4), np.random.default_rng(len(degrees))
    last = None
    for size in (1e-9, 1.0, 1e6):
        rows = monomials(4, degrees)
        g = Polynomial(rows, size * rng.normal(size=len(rows)), tuple("abcd"))
        last = program.solve(g(program.points), start=last)
        assert last.iterations > 0
        assert last.gap < 1e-6
        sphere_points = rng.normal(size=(5000, 4))
        sphere_points /= np.linalg.norm(sphere_points, axis=1)[:, None]
        assert last.m <= np.min(g(sphere_points)) + 1e-6 * size


def test_clarabel_steps_in_when_the_interior_point_gives_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    program, g = SphereProgram(4), random_quartic(4, 7)
    values = g(program.points)
    expected = program.solve(values)

    def gives_up(*_: object) -> None:
        raise SolverError("on purpose")

    monkeypatch.setattr(sphere_module, "_interior_point", gives_up)
    found = program.solve(values, start=expected)
    assert found.iterations == 0
    assert found.m == pytest.approx(expected.m, abs=1e-6 * float(np.ptp(values)))


def test_a_useless_warm_start_still_solves() -> None:
    program = SphereProgram(4)
    start = program.solve(random_quartic(4, 0)(program.points))
    other = -100 * random_quartic(4, 1)
    values = other(program.points)
    found = program.solve(values, tolerance=1e-6, start=start)
    assert abs(found.m - oracle(other)) < 1e-5 * np.ptp(values)


def test_fewer_monomials_suffice_where_few_states_enter_nonlinearly() -> None:
    program = SphereProgram(5, nonlinear=(3, 4))
    assert len(program.basis) < len(SphereProgram(5).basis)
    rng, k = np.random.default_rng(0), len(program.basis)
    A = rng.normal(size=(k, k))
    g = Gram(program.basis, A + A.T, tuple("abcde")).polynomial()
    found = program.solve(g(program.points))
    points = rng.normal(size=(20_000, 5))
    assert found.m <= np.min(g(points / np.linalg.norm(points, axis=1)[:, None]))


@pytest.mark.parametrize("nonlinear", [(2,), (1, 2)])
def test_a_push_of_every_state_needs_the_one_beside_few_products(
    nonlinear: tuple[int, ...],
) -> None:
    """g of degree 1 in all, of degree 4 with two or more factors that are nonlinear."""
    n, rng = 3, np.random.default_rng(7)
    program, full = SphereProgram(n, nonlinear, constant=True), SphereProgram(n)
    assert len(program.basis) < len(full.basis) + 1
    on_sphere = monomial_values(program.basis, program.points) * program.weight
    assert (on_sphere**2).sum(axis=1) == pytest.approx(np.ones(len(program.points)))
    some = program.basis[program.basis.sum(axis=1) > 0]
    A = rng.normal(size=(len(some), len(some)))
    push = rng.normal(size=n)
    turned = Gram(some, A + A.T, ("a", "b", "c")).polynomial()

    def g(points: FloatArray) -> FloatArray:
        return np.asarray(turned(points) + 5 * points @ push)

    found, expected = (p.solve(g(p.points)) for p in (program, full))
    assert found.m == pytest.approx(expected.m, abs=1e-6 * float(np.ptp(g(full.points))))
    without = SphereProgram(n, nonlinear)
    assert without.solve(g(without.points)).m != pytest.approx(expected.m, rel=1e-2)
    with pytest.raises(DataError, match="program of all variables"):
        SphereProgram(n, constant=True)


def test_a_constant_needs_no_iteration() -> None:
    program = SphereProgram(3)
    assert program.solve(np.full(len(program.points), 2.5)).m == 2.5


def test_values_of_the_wrong_shape_or_not_finite_are_refused() -> None:
    program = SphereProgram(3)
    with pytest.raises(ShapeError, match="values"):
        program.solve(np.zeros(3))
    with pytest.raises(DataError, match="finite"):
        program.solve(np.full(len(program.points), np.nan))
    with pytest.raises(DataError, match="expected indices"):
        SphereProgram(3, nonlinear=(5,))


def test_a_program_ends_where_half_of_what_is_left_is_enough() -> None:
    program = SphereProgram(6)
    g = random_quartic(6, 4)(program.points)
    whole = program.solve(g, tolerance=1e-8)
    spread = float(np.ptp(g))
    for share in (0.3, 0.03):
        enough = whole.m - share * spread
        found = program.solve(g, tolerance=1e-8, enough=enough)
        assert found.iterations < whole.iterations
        assert enough + (found.upper - found.m) <= found.m <= whole.upper
        gram = program.gram(found)
        assert np.linalg.eigvalsh(gram)[0] > -1e-9 * spread
    assert program.solve(g, tolerance=1e-8, enough=whole.upper + spread).gap <= 1e-8
