"""The thesis's literal formulation of Lemma 5.2, with time in the program."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from examples import one_dimensional
from nlsid_core.design import ContinuousTracking, FunnelDesign, design_funnel, integrate_nominal
from nlsid_core.design.continuous.closed_loop import closed_loop_polynomial
from nlsid_core.design.continuous.graded import monomials_of
from nlsid_core.dynamics import Nominal, VectorField
from nlsid_core.polynomial import monomials, variables
from nlsid_core.sos import Program, SumOfSquares, solve, template


@cache
def hanging() -> FunnelDesign:
    """A pendulum to third order in two states."""

    def pendulum(x: Any, u: Any) -> Any:
        return np.array([x[1], -x[0] + x[0] ** 3 / 6 - x[1] / 5 + u[0]])

    field = VectorField.from_function(pendulum, 2, 1)
    t = np.linspace(0, 2, 21)
    nominal: Nominal = integrate_nominal(field, lambda _: np.zeros(1), t=t, start=np.zeros(2))
    return design_funnel(ContinuousTracking(field, nominal, goal=20 * np.eye(2)))


def literal_margin(design: FunnelDesign, piece: int, degree: int) -> tuple[float, float]:
    """The largest margin with (ρ̇ - Ẇ)/ρ ≥ it on W = ρ, 0 ≤ s ≤ 1, with multipliers in s and z.

    And the least (ρ̇ - Ẇ)/ρ of many points there: no true margin is above it. Both in 1/s.
    """
    chosen = design.found.proved.pieces.select(np.array([piece]))
    knot = int(chosen.interval[0])
    root = np.linalg.cholesky(design.funnel.P[knot] / design.funnel.rho[knot])
    blank = replace(chosen, mu=0 * chosen.mu, T=np.linalg.inv(root).T[None])  # |z| near 1
    c = closed_loop_polynomial(design.model, design.policy, design.funnel, blank)
    n = design.funnel.n
    names = ("s", *(f"z{i}" for i in range(n)))
    s, *z = variables(names)
    p = 0 * s
    for q, part in c.items():
        values = part[0]
        S = len(values) - 1
        for k, row in enumerate(values.tolist()):
            for value, exponent in zip(row, monomials_of(n, q).tolist(), strict=True):
                if abs(value) > 1e-14:  # rounding of zeros
                    term = value * s**k * (1 - s) ** (S - k)
                    for v, power in zip(z, exponent, strict=True):
                        term = term * v**power
                    p = p + term
    k, T = knot, blank.T[0]
    rho = design.funnel.rho[k : k + 2].tolist()
    start, end = (T.T @ P @ T for P in design.funnel.P[k : k + 2])
    boundary = (1 - s) * rho[0] + s * rho[1]
    for i in range(n):
        for j in range(n):
            a, b = float(start[i, j]), float(end[i, j])
            boundary = boundary - ((1 - s) * a + s * b) * z[i] * z[j]
    (gamma,) = variables("gamma")
    on_time = template("a", monomials(1 + n, range(degree - 1)), names)
    free = template("f", monomials(1 + n, range(degree - 2)), names)
    squares = SumOfSquares(p - gamma - on_time * s * (1 - s) - free * boundary)
    best = -solve(Program(names, (SumOfSquares(on_time), squares), minimise=-gamma)).objective
    scale = float(design.funnel.t[k + 1] - design.funnel.t[k]) * max(rho)
    directions = np.random.default_rng(1).normal(size=(400, n))
    lowest = np.inf
    for share in np.linspace(0, 1, 21):
        L = np.linalg.cholesky((1 - share) * start + share * end)
        radius = np.sqrt((1 - share) * rho[0] + share * rho[1])
        unit_sphere = directions / np.linalg.norm(directions, axis=1)[:, None]
        on_boundary = radius * np.linalg.solve(L.T, unit_sphere.T).T
        points = np.column_stack([np.full(len(directions), share), on_boundary])
        lowest = min(lowest, float(np.min(p.over(names)(points))))
    return best / scale, lowest / scale


@pytest.mark.slow
@pytest.mark.parametrize(
    ("problem", "piece"),
    [
        ("one_dimensional", 0),
        ("one_dimensional", 38),
        ("hanging", 3),
    ],
)
def test_the_literal_formulation_lies_between_what_is_proved_and_what_is_true(
    problem: str, piece: int
) -> None:
    design = one_dimensional.designed() if problem == "one_dimensional" else hanging()
    assert not design.found.proved.pieces.level[piece]
    literal, lowest = literal_margin(design, piece, degree=8)
    assert 0.99 * design.found.proved.margins[piece] <= literal
    assert literal == pytest.approx(lowest, rel=0.01, abs=1e-5)
