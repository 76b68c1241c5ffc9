"""Implicit steps: the bound on the next state is what makes a reach true."""

from fractions import Fraction

import numpy as np
import pytest

from nlsid_core.design.sampled import closed_loop
from nlsid_core.design.sampled.implicit_step import ImplicitStep
from nlsid_core.errors import DataError, Infeasible, SolverError
from nlsid_core.kernel import Rejected
from nlsid_core.kernel.files import Node
from nlsid_core.kernel.positivity import WITNESS, expanded, positive, read_squares
from nlsid_core.polynomial import constant, monomials, variables
from nlsid_core.sos import Program, SumOfSquares, solve
from nlsid_core.sos.program import Identity

DECAY = 0.9


def cubic(spurious: float, bound: float = 1.5) -> ImplicitStep:
    """w - w³/spurious² = 0.9 z: one root near z, two more near ±spurious."""
    ring = closed_loop.ring_of(2)
    h: dict[tuple[int, ...], Fraction] = {
        (0, 1): Fraction(1),
        (0, 3): Fraction(-1 / spurious**2),
        (1, 0): Fraction(-DECAY),
    }
    z, w = ring.variables
    return ImplicitStep(ring, [w], [closed_loop.polynomial(h, ring)], z * z, 1.0, bound)


def farthest_root_within(spurious: float, bound: float) -> float:
    roots = np.concatenate(
        [np.roots([-1 / spurious**2, 0.0, 1.0, -DECAY * z]) for z in np.linspace(-1.0, 1.0, 2001)]
    )
    real = np.abs(roots[np.abs(roots.imag) < 1e-9])
    return float(real[real <= bound].max())


@pytest.mark.parametrize("spurious", [4.0, 20.0])
def test_with_the_bound_the_reach_is_proved_and_tight(spurious: float) -> None:
    reach = cubic(spurious).reach()
    true = farthest_root_within(spurious, 1.5)
    assert true <= reach < 1.01 * true


@pytest.mark.parametrize("spurious", [4.0, 20.0, 450.0])
def test_without_the_bound_nothing_is_proved_whatever_the_solver_says(
    spurious: float,
) -> None:
    z, w = variables("z w")
    names, h = ("z", "w"), w - w**3 / spurious**2 - DECAY * z
    ball = constant(1.0, names=names) - z.over(names) ** 2
    for level in (0.9, 1.5, 3.0):  # below the square of the spurious roots: false
        level_above = constant(level, names=names) - w.over(names) ** 2
        basis = monomials(2, range(3))
        constraint = SumOfSquares(level_above, (ball,), (h,), degree=4, basis=basis, name="reach")
        try:
            identity = solve(Program(names, (constraint,)))["reach"]
        except SolverError:
            continue  # it says so itself
        with pytest.raises((Rejected, Infeasible)):
            prove(level, spurious, identity)


def prove(level: float, spurious: float, identity: Identity) -> None:
    """Decide level - w² - ν h - σ(1 - z²) ≥ 0 by the solver's multipliers, as the kernel does."""
    step = cubic(spurious)
    ring, scale = step.ring, [1.0, 1.0]
    inner = monomials(2, range(2))
    sigma = np.zeros((3, 3))
    (found,) = identity.multipliers
    at = [inner.tolist().index(row) for row in found.basis.tolist()]
    sigma[np.ix_(at, at)] = found.Q
    stated, _ = closed_loop.stated_multiplier(inner, sigma, scale, ring)
    stated["basis"] = inner.tolist()
    multiplier = expanded(Node(stated, "multiplier").members(WITNESS), ring)
    nu = {tuple(e): Fraction(float(c)) for e, c in identity.equality_multipliers[0].terms()}
    basis, w = identity.gram.basis, ring.variables[1]
    c = Fraction(level) - w * w - closed_loop.polynomial(nu, ring) * step.h[0]
    c += multiplier * (step.size - 1)
    squares = closed_loop.stated_squares(c, basis, identity.gram.Q, scale, ring)
    squares["basis"] = basis.tolist()
    positive(c, read_squares(Node(squares, "reach").members(WITNESS), ring), ring, "reach")


def test_a_bound_that_lets_the_spurious_roots_in_does_not_prove_the_small_reach() -> None:
    small = cubic(4.0).reach()
    assert cubic(4.0, bound=5.0).reach() > 3.0 > small


@pytest.mark.parametrize("bound", [0.0, -1.0, float("inf"), float("nan")])
def test_a_step_without_a_bound_cannot_be_made(bound: float) -> None:
    with pytest.raises(DataError, match="spurious"):
        cubic(4.0, bound=bound)
