"""Programs and designs whose Gram matrices are sums of small ones."""

from itertools import combinations_with_replacement
from math import comb
from typing import Any

import numpy as np
import pytest

from benchmarks.funnel_scaling import chain
from benchmarks.thesis.soundness import simulate_boundary
from nlsid_core.arrays import FloatArray
from nlsid_core.design import ContinuousTracking, design_funnel, integrate_nominal
from nlsid_core.design.continuous import cliques
from nlsid_core.design.continuous.cliques import CliqueSteps, cliques_of, share_of_work
from nlsid_core.design.continuous.diagnosis import NoFunnel
from nlsid_core.design.continuous.lstep import LSteps, section_at
from nlsid_core.design.continuous.sweep import sweep_rho
from nlsid_core.design.continuous.tvlqr import tvlqr
from nlsid_core.dynamics import Nominal, VectorField
from nlsid_core.errors import SolverError
from nlsid_core.proofs import check
from nlsid_core.sos.cliques import CliqueProgram

GROUPS = ((0, 1), (2,), (1, 3))


def posed(rng: np.random.Generator) -> tuple[FloatArray, dict[tuple[int, ...], float]]:
    """P of unit diagonal, and g with two factors of a group in each term above degree 2."""
    root = rng.normal(size=(5, 5))
    P = root @ root.T + 3 * np.eye(5)
    size = np.sqrt(np.diag(P))
    g: dict[tuple[int, ...], float] = {(0, 0, 0, 0): 0.3}
    for i, j in combinations_with_replacement(range(6), 2):
        g[0, 0, i, j] = g.get((0, 0, i, j), 0.0) + float(rng.normal())
    for S in GROUPS:
        for a, b in combinations_with_replacement(S, 2):
            for i, j in combinations_with_replacement(range(6), 2):
                key = tuple(sorted((a + 1, b + 1, i, j)))
                g[key] = g.get(key, 0.0) + 0.5 * float(rng.normal())
    return P / size / size[:, None], g


def values(g: dict[tuple[int, ...], float], x: FloatArray) -> FloatArray:
    y = np.column_stack([np.ones(len(x)), x])
    return np.asarray(sum(c * np.prod(y[:, list(key)], axis=1) for key, c in g.items()))


@pytest.mark.parametrize("seed", range(4))
def test_small_gram_matrices_show_their_bound(seed: int) -> None:
    rng = np.random.default_rng(seed)
    P, g = posed(rng)
    program = CliqueProgram(5, GROUPS)
    found = program.solve(P, program.vector(g))
    x = rng.normal(size=(20000, 5))
    x /= np.sqrt(np.einsum("bi,ij,bj->b", x, P, x))[:, None]
    y, squares = np.column_stack([np.ones(len(x)), x]), np.zeros(len(x))
    for block, gram in zip(program.blocks, found.grams, strict=True):
        assert np.linalg.eigvalsh(gram)[0] > 0
        v = np.prod(y[:, block.products], axis=2)
        squares += np.einsum("bi,ij,bj->b", v, gram, v)
    np.testing.assert_allclose(values(g, x) - found.m, squares, atol=1e-9)
    assert 0 <= found.upper - found.m < 1e-4
    assert found.m <= values(g, x).min()
    assert found.upper == pytest.approx(float(program.vector(g) @ found.moments), abs=1e-8)


@pytest.mark.parametrize(
    ("rate", "expected"),
    [
        (lambda x, u: [x[1] ** 2, x[0] * x[1] ** 2 + u[0], *(-x[2:])], ((0, 1),)),
        (lambda x, u: [x[7] ** 3, u[0] + x[2] * x[0], *(-x[2:])], ((0, 2), (7,))),
        (lambda x, u: [x[1] * u[0], x[0], *(-x[2:])], ()),  # an input times a state
        (lambda x, u: [x[0] * x[1] * x[2], u[0], *(-x[2:])], ((0, 1, 2),)),
        (lambda x, u: [u[0], *(-x[1:])], ()),
    ],
)
def test_a_clique_is_what_one_rate_multiplies(rate: Any, expected: Any) -> None:
    assert cliques_of(VectorField.from_function(rate, 8, 1)) == expected


def pendulums() -> tuple[VectorField, Nominal]:
    """Four of them, which swing: there are terms of degree 3."""
    field = VectorField.from_function(chain(4), 8, 4)
    t = np.linspace(0, 1, 7)
    torque = np.array([0.3, 0.2, -0.2, 0.1])
    return field, integrate_nominal(field, lambda _: torque, t=t, start=np.full(8, 0.2))


def test_small_matrices_lose_little() -> None:
    """φ at most what a Gram matrix of every product shows, and nearly that."""
    field, nominal = pendulums()
    goal = 8.0 * np.eye(8)
    tracking = tvlqr(field, nominal, Q=np.eye(8), R=np.eye(4), S_final=goal)
    steps = LSteps(field)
    small = CliqueSteps(steps, cliques_of(field))
    for k, s in ((0, 0.0), (3, 0.5), (5, 1.0)):
        section = section_at(steps, tracking.policy, tracking.S, k, s)
        (whole,), (parts,) = steps.solve(section, 0.7), small.solve(section, 0.7)
        assert parts.m <= whole.upper + 1e-5
        assert parts.m > whole.m - 0.01
        assert small.bounds(section, 0.7, [parts], [0])[0] == pytest.approx(parts.upper, abs=1e-6)


def test_a_sweep_that_fails_says_where() -> None:
    field, nominal = pendulums()
    tracking = tvlqr(field, nominal, Q=np.eye(8), R=np.eye(4), S_final=8.0 * np.eye(8))
    small = CliqueSteps(LSteps(field), cliques_of(field))
    pairs = [
        [section_at(small, tracking.policy, tracking.S, k, s) for s in (0.0, 1.0)] for k in range(6)
    ]
    rho, _ = sweep_rho(small, pairs, margin=1e-3)
    assert (rho > 0.5).all()
    with pytest.raises(NoFunnel, match="no funnel at t = 1 s"):
        sweep_rho(small, pairs, margin=1e3)


def designed() -> Any:
    field, nominal = pendulums()
    return design_funnel(
        ContinuousTracking(field, nominal, goal=8.0 * np.eye(8), Q=np.eye(8), R=np.eye(4))
    )


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cliques from eight states on."""
    monkeypatch.setattr(cliques, "LARGE", 8)
    monkeypatch.setattr(cliques, "CHEAPER", np.inf)


def test_cliques_are_taken_where_they_take_less_time() -> None:
    """The work of a chain's programs is known; springs that harden have no products of rates."""
    steps = LSteps(VectorField.from_function(chain(6), 12, 6))
    pairs = 6 * (25 * 26 // 2) ** 3
    assert share_of_work(12, 12, cliques_of(steps.field)) == pytest.approx(
        pairs / (comb(16, 4) - comb(14, 2)) ** 3
    )
    assert CliqueSteps.of(steps) is not None

    def masses(x: Any, u: Any) -> Any:
        d = np.concatenate([x[:1], x[1:6] - x[:5], -x[5:6]])
        pull = d + d**3 / 2
        return [*x[6:], *(pull[1:] - pull[:-1] + u)]

    steps = LSteps(VectorField.from_function(masses, 12, 6))
    assert CliqueSteps.of(steps) is None
    program, count = steps.program, len(steps.nonlinear)
    some = ((0, 1),)  # two states of 12: 25 products
    monomials = len(program.points)
    assert share_of_work(12, count, some) == pytest.approx((25 * 26 // 2) ** 3 / monomials**3)


@pytest.mark.usefixtures("small")
def test_a_design_of_small_matrices_is_proved(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: Any, **__: Any) -> Any:
        raise AssertionError("a program with every product was solved")

    with monkeypatch.context() as patched:
        patched.setattr(LSteps, "solved_case", refused)
        found = designed()
    assert check(found.save(tmp_path)[-1]).margin > 0
    rng = np.random.default_rng(0)
    run = simulate_boundary(
        found.model, found.policy, found.funnel, starts=500, rng=rng, substeps=10
    )
    assert run.violations == 0
    monkeypatch.setattr(cliques, "LARGE", 9)
    whole = designed().funnel.widths(0.0)
    assert (found.funnel.widths(0.0) > 0.98 * whole).all()


@pytest.mark.usefixtures("small")
def test_what_small_matrices_do_not_show_is_searched_with_every_product(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def failing(*_: Any, **__: Any) -> Any:
        raise SolverError("no")

    monkeypatch.setattr(CliqueProgram, "solve", failing)
    found = designed().funnel.widths(0.0)
    monkeypatch.setattr(cliques, "LARGE", 9)
    np.testing.assert_array_equal(found, designed().funnel.widths(0.0))
