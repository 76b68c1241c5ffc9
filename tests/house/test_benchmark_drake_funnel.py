"""Drake's side of the comparison is the same problem: one L-step and one V-step of it, by hand."""

import numpy as np
import pytest

pytest.importorskip("pydrake", reason="Drake is not installed (extra bench)")

from benchmarks.drake_funnel import DrakeAlternation
from examples import satellite
from nlsid_core.sos import SphereProgram


@pytest.fixture(scope="module")
def drake() -> DrakeAlternation:
    return DrakeAlternation(satellite.nominal(), limit=120.0)


@pytest.mark.slow
def test_drakes_multiplier_shows_what_our_l_step_shows(drake: DrakeAlternation) -> None:
    """g - m + μ(1 - |z|²) is nonnegative everywhere with our m, to Drake's tolerance."""
    i = 95
    mu = drake.l_step(i)
    program = SphereProgram(6)
    step = drake.steps[i]
    ours = program.solve(step.values(program.points)).m
    rng = np.random.default_rng(1)
    z = rng.normal(size=(5000, 6)) * rng.uniform(0, 2, size=(5000, 1))
    value = sum(v * np.prod(z ** np.array(e), axis=1) for e, v in mu.items())
    left = step.polynomial()(z) - ours + value * (1 - (z**2).sum(axis=1))
    assert left.min() > -1e-4 * np.abs(left).max()


def test_the_first_volume_is_the_first_guesss(drake: DrakeAlternation) -> None:
    assert drake.volume() == pytest.approx(3.2832e-3, rel=1e-4)  # c = 3, P_G as printed
