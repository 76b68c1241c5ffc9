"""Dynamics of a higher degree than cubic are expanded, and no start leaves."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.thesis.soundness import Simulation, TrueDynamics
from nlsid import ContinuousTracking, VectorField, check, design, integrate_nominal
from nlsid_core.errors import DataError


def springs(x: Any, u: Any) -> list[Any]:
    """A chain of hardening springs, the force of each to fifth order, the last one driven."""
    force = [-e + e**3 / 6 - e**5 / 120 for e in x]
    return [*x[1:], sum(force) - sum(x[1:]) + u[0]]


@pytest.mark.parametrize("n", [1, 2])
def test_functions_of_degree_five_are_expanded_and_no_start_leaves(n: int, tmp_path: Path) -> None:
    t = np.linspace(0, 1, 9)
    moving = integrate_nominal(springs, lambda s: [0.2 * s], t=t, start=np.zeros(n))
    found = design(ContinuousTracking(springs, moving, goal=8 * np.eye(n)))
    assert found.model.expansion
    assert check(found.save(tmp_path)[-1]).margin > 0
    truth = TrueDynamics(lambda x, u: np.stack(springs(x.T, u.T), axis=1))
    rng = np.random.default_rng(2)
    run = Simulation(truth, found.policy, found.funnel).boundary(starts=2000, rng=rng)
    assert run.violations == 0


def test_a_vector_field_of_a_higher_degree_is_told_the_way() -> None:
    field = VectorField.from_function(lambda x: np.array([-(x[0] ** 7)]), 1, 0)
    nominal = integrate_nominal(field, lambda _: [], t=[0.0, 0.5, 1.0], start=[0.0])
    with pytest.raises(DataError, match=r"degree 7; .*up to 3: give the dynamics as a function"):
        design(ContinuousTracking(field, nominal, goal=np.eye(1), Q=np.zeros((1, 1))))
