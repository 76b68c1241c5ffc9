"""The benchmark's reachability problems, written here again and integrated on their own."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks.reachability import PROBLEMS, holding, run
from nlsid_core.arrays import FloatArray

BILINEAR = {  # (row, factor, factor): coefficient; of Laub-Loomis, states counted from 1
    (3, 2, 3): -0.8, (4, 3, 4): -1.3, (5, 4, 5): -1.0, (7, 2, 7): -1.5,
}  # fmt: skip
LINEAR = {
    (1, 1): -0.9, (1, 3): 1.4, (2, 2): -1.5, (2, 5): 2.5, (3, 7): 0.6,
    (5, 1): 0.7, (6, 1): 0.3, (6, 6): -3.1, (7, 6): 1.8,
}  # fmt: skip


def laub_loomis(t: float, x: FloatArray) -> FloatArray:
    """From the tables above."""
    del t
    rate = np.array([0.0, 0, 0, 2, 0, 0, 0])
    for (i, j), c in LINEAR.items():
        rate[i - 1] += c * x[j - 1]
    for (i, j, k), c in BILINEAR.items():
        rate[i - 1] += c * x[j - 1] * x[k - 1]
    return rate


def test_laub_loomis_is_the_published_one() -> None:
    problem = PROBLEMS["laub_loomis_0.01"]
    motion = problem.tracking(1.0).nominal
    own = solve_ivp(laub_loomis, (0, 20), problem.start, "LSODA", motion.t, rtol=1e-10, atol=1e-12)
    assert motion.x.ends() == pytest.approx(own.y.T, abs=2e-4)


def test_lotka_volterra_keeps_what_it_is_known_to_keep() -> None:
    problem = PROBLEMS["lotka_volterra"]
    x, y = problem.solutions(problem.corners(), np.linspace(0, 3.64, 50)).T
    kept = x - np.log(x) + 3 * (y - np.log(y))
    assert np.ptp(kept, axis=1).max() < 1e-7
    assert len(problem.corners()) == 2  # its box has no height


@pytest.mark.slow
def test_the_inlet_of_lotka_volterra_holds_the_box_and_its_end_every_solution() -> None:
    problem = PROBLEMS["lotka_volterra"]
    found, _ = holding(problem, 30.0)
    assert found is not None
    corners = problem.corners() - found.funnel.nominal(0.0)
    assert np.einsum("ni,ij,nj->n", corners, found.funnel.shape(0.0), corners).max() <= 1
    told = run(problem, 100, 30.0)
    assert told["left"] == 0
    assert told["spread"] < told["width"] < 1.3 * told["spread"]
