"""Dynamics of degree 4 and 5: larger squares, the same proof; what is beyond is told the way."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.thesis.soundness import simulate_boundary
from nlsid_core.design import ContinuousTracking, design, design_funnel, integrate_nominal
from nlsid_core.design.continuous.lstep import sphere_program
from nlsid_core.dynamics import Nominal, VectorField
from nlsid_core.errors import DataError
from nlsid_core.polynomial import constant, monomials, variables
from nlsid_core.polynomial.values import monomial_values
from nlsid_core.proofs import check
from nlsid_core.sos import Program, SphereProgram, SumOfSquares, solve, template
from tests.marks import slow_among


def quintic(n: int) -> VectorField:
    """A chain of hardening springs, the force of each to fifth order, the first one driven."""

    def rates(x: Any, u: Any) -> Any:
        force = [-e + e**3 / 6 - e**5 / 120 for e in x]
        return np.array([*x[1:], sum(force) - sum(x[1:]) + u[0] + 0 * x[0]])

    return VectorField.from_function(rates, n, 1)


def moving(field: VectorField, knots: int = 9) -> Nominal:
    """From rest under a slow push."""
    t = np.linspace(0, 1, knots)
    return integrate_nominal(field, lambda s: [0.2 * s], t=t, start=np.zeros(field.n))


@pytest.mark.parametrize("n", slow_among([1, 2, 3], {2, 3}))
def test_dynamics_of_degree_five_are_proved_and_no_start_leaves(n: int, tmp_path: Path) -> None:
    field = quintic(n)
    assert field.degree == 5
    design = design_funnel(
        ContinuousTracking(field, moving(field), goal=8 * np.eye(n), Q=np.eye(n), R=np.eye(field.m))
    )
    assert check(design.save(tmp_path)[-1]).margin > 0
    rng = np.random.default_rng(2)
    parts = (field, design.policy, design.funnel)
    run = simulate_boundary(*parts, starts=2000, rng=rng)
    assert run.violations == 0
    assert run.max_v > 0.9


def test_degree_four_takes_the_same_squares_as_degree_five() -> None:
    field = VectorField.from_function(
        lambda x, u: np.array([x[1], -x[0] - x[1] + x[0] ** 4 / 4 + u[0]]), 2, 1
    )
    program = sphere_program(field)
    assert isinstance(program, SphereProgram)
    assert program.half == 3
    assert (
        np.min(
            design_funnel(
                ContinuousTracking(field, moving(field), goal=8 * np.eye(2))
            ).found.proved.margins
        )
        > 0
    )


def test_beyond_degree_five_the_taylor_way_is_named() -> None:
    field = VectorField.from_function(lambda x: np.array([-(x[0] ** 7)]), 1, 0)
    nominal = integrate_nominal(field, lambda _: [], t=[0.0, 0.5, 1.0], start=[0.0])
    with pytest.raises(DataError, match=r"degree 7; L-steps are solved up to 5: take a Taylor"):
        design_funnel(ContinuousTracking(field, nominal, goal=np.eye(1), Q=np.zeros((1, 1))))


def test_v_steps_are_for_degree_three_and_say_what_to_do_instead() -> None:
    field = quintic(2)
    problem = ContinuousTracking(field, moving(field), goal=8 * np.eye(2), shape="P")
    with pytest.raises(DataError, match="degree up to 3, not 5: take shape rho by the sweep"):
        design(problem)


@pytest.mark.parametrize("n", [2, 3])
def test_the_sphere_program_of_degree_six_agrees_with_sums_of_squares(n: int) -> None:
    program = SphereProgram(n, half=3)
    on_sphere = monomial_values(program.basis, program.points) * program.weight
    assert (on_sphere**2).sum(axis=1) == pytest.approx(np.ones(len(program.points)))
    names = tuple(f"z{i}" for i in range(n))
    z = variables(names)
    rng = np.random.default_rng(n)
    g = constant(0.0, names=names)
    for i in range(n):
        for j in range(n):
            a, b = rng.normal(size=2).tolist()
            g = g + a * z[i] ** 5 * z[j] + b * z[i] ** 2 * z[j] ** 3
    found = program.solve(g(program.points))
    sphere = constant(1.0, names=names) - sum(v * v for v in z)
    (m,) = variables("m")
    free = template("f", monomials(n, range(5)), names)
    literal = solve(Program(names, (SumOfSquares(g - m - free * sphere),), minimise=-m))
    assert found.m == pytest.approx(-literal.objective, abs=1e-5)
    cloud = rng.normal(size=(20_000, n))
    lowest = float(np.min(g(cloud / np.linalg.norm(cloud, axis=1)[:, None])))
    assert found.m <= lowest + 1e-9


def test_a_sphere_program_of_no_use_is_refused() -> None:
    for arguments in ({"half": 4}, {"half": 3, "nonlinear": (1,)}):
        with pytest.raises(DataError, match="half = "):
            SphereProgram(2, **arguments)
