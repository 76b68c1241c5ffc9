"""Implicit steps: the bound on the next state is what makes a reach true."""

import numpy as np
import pytest

from nlsid_core.certificate.nonnegative import prove_lower_bound
from nlsid_core.errors import CertificateRejected, DataError, SolverError
from nlsid_core.funnels.implicit import ImplicitStep
from nlsid_core.polynomial import constant, variables
from nlsid_core.sos import Program, SumOfSquares, solve

DECAY = 0.9


def cubic(spurious: float, bound: float = 1.5) -> ImplicitStep:
    """w - w³/spurious² = 0.9 z: one root near z, two more near ±spurious."""
    z, w = variables("z w")
    return ImplicitStep((w,), (w - w**3 / spurious**2 - DECAY * z,), ("z",), ("w",), bound)


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
    step = cubic(spurious)
    ball = constant(1.0, names=("z", "w")) - variables("z w")[0] ** 2
    for level in (0.9, 1.5, 3.0):  # below the square of the spurious roots: false
        constraint = SumOfSquares(
            constant(level, names=("z", "w")) - step.square,
            domain=(ball,),
            equalities=step.equations,
            degree=4,
            name="reach",
        )
        try:
            identity = solve(Program(("z", "w"), (constraint,)))["reach"]
        except SolverError:
            continue  # it says so itself
        with pytest.raises(CertificateRejected):
            prove_lower_bound(
                -step.square,
                -level,
                identity.gram,
                domain=(ball,),
                multipliers=identity.multipliers,
                equalities=[h.over(("z", "w")) for h in step.equations],
                equality_multipliers=identity.equality_multipliers,
            )


def test_a_bound_that_lets_the_spurious_roots_in_does_not_prove_the_small_reach() -> None:
    small = cubic(4.0).reach()
    assert cubic(4.0, bound=5.0).reach() > 3.0 > small


@pytest.mark.parametrize("bound", [0.0, -1.0, float("inf"), float("nan")])
def test_a_step_without_a_bound_cannot_be_made(bound: float) -> None:
    with pytest.raises(DataError, match="spurious"):
        cubic(4.0, bound=bound)
