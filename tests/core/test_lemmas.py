"""Lemmas 5.2 and 5.3, and the thesis's literal formulation with time in the program."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from examples import one_dimensional, two_lemmas
from nlsid_core.design import FunnelDesign, design_funnel, integrate_nominal
from nlsid_core.design.continuous.closed_loop import closed_loop_polynomial
from nlsid_core.design.continuous.graded import monomials_of
from nlsid_core.dynamics import Nominal, VectorField
from nlsid_core.errors import Infeasible
from nlsid_core.polynomial import variables
from nlsid_core.sos import Program, SumOfSquares, solve
from nlsid_core.sos.search import lower_bound


def test_example_5_1_1_is_refused() -> None:
    """ẋ = 1: V̇ ≤ 0 on V = 1, and yet solutions leave: Lemma 5.2 asks for V̇ < 0 there."""
    (x,) = variables("x")
    V = 1 + (x**2 - 1) ** 3
    assert lower_bound(-V.derivative("x"), equalities=[V - 1], degree=8).value <= 0


@pytest.mark.parametrize(("sigma", "proved"), [(0.36, True), (0.26, True), (0.24, False)])
def test_example_5_1_2_decays_down_to_a_quarter_and_not_below(sigma: float, proved: bool) -> None:
    if proved:
        assert two_lemmas.decay(sigma) > 0
    else:
        with pytest.raises(Infeasible):
            two_lemmas.decay(sigma)


def test_the_pieces_of_a_funnel_prove_a_lower_floor_than_the_thesis_states() -> None:
    """σ = 0.36 there; none below 1/4 is true."""
    assert two_lemmas.LEAST_SIGMA < two_lemmas.pulled_in() < 0.28 < two_lemmas.SIGMA


@pytest.mark.parametrize(("last", "proved"), [(1.1, True), (0.8, False)])
def test_example_5_1_2_shrinks_to_its_published_width_and_not_much_further(
    last: float, proved: bool
) -> None:
    assert (not two_lemmas.invariance(last)[1].unproved) is proved


def test_solutions_of_example_5_1_2_obey_both_guarantees() -> None:
    t = np.linspace(0, two_lemmas.END, 2001)
    limit = np.sqrt(two_lemmas.FIRST)
    W = two_lemmas.solutions(np.linspace(-limit, limit, 41), t) ** 2
    edge = np.interp(t, [0, two_lemmas.END], [two_lemmas.FIRST, two_lemmas.LAST])
    assert (edge + 1e-9 >= W).all()
    V = two_lemmas.solutions(np.linspace(-2, 2, 41), t) ** 2 / two_lemmas.LEVEL
    for start in (0, 300):
        high = V[:, start] > two_lemmas.SIGMA
        for row in V[high]:
            bound = two_lemmas.bound(t[start:], row[start], t[start])
            assert (row[start:] <= bound + 1e-9).all()
    assert V.max(axis=0)[0] == 1


@pytest.mark.slow
@pytest.mark.pictures
def test_the_two_figures_are_drawn_from_what_was_proved(tmp_path: Any) -> None:
    two_lemmas.draw(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


# -- the literal formulation, thesis (6.4) -----------------------------------------------------


@cache
def hanging() -> FunnelDesign:
    """A pendulum to third order in two states."""

    def pendulum(x: Any, u: Any) -> Any:
        return np.array([x[1], -x[0] + x[0] ** 3 / 6 - x[1] / 5 + u[0]])

    field = VectorField.from_function(pendulum, 2, 1)
    t = np.linspace(0, 2, 21)
    nominal: Nominal = integrate_nominal(field, lambda _: np.zeros(1), t=t, start=np.zeros(2))
    return design_funnel(field, nominal, goal=20 * np.eye(2))


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
    squares = SumOfSquares(p - gamma, (s * (1 - s),), (boundary,), degree=degree)
    best = solve(Program(names, (squares,), maximise=gamma)).objective
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
    [("one_dimensional", 0), ("one_dimensional", 17), ("one_dimensional", 38),
     ("hanging", 3), ("hanging", 12)],
)  # fmt: skip
def test_the_literal_formulation_lies_between_what_is_proved_and_what_is_true(
    problem: str, piece: int
) -> None:
    design = one_dimensional.designed() if problem == "one_dimensional" else hanging()
    assert not design.found.proved.pieces.level[piece]
    literal, lowest = literal_margin(design, piece, degree=8)
    assert 0.99 * design.found.proved.margins[piece] <= literal
    assert literal == pytest.approx(lowest, rel=0.01, abs=1e-5)
