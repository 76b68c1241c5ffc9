"""Equations, recordings of what they leave out, and the funnel that is proved for it."""

from typing import Any

import numpy as np
import pytest

from benchmarks.thesis.soundness import Simulation, TrueDynamics
from nlsid import ContinuousTracking, Dataset, Trajectory, VectorField, design, plan_motion
from nlsid_core.arrays import FloatArray
from nlsid_core.dynamics import measured_push
from nlsid_core.errors import DataError

PERIOD, PUSH = 0.02, 0.06  # s, m/s²: what the equations leave out


def rate(x: Any, u: Any) -> Any:
    return [x[1], u[0] - np.sin(x[0])]


def true_rate(x: FloatArray, u: FloatArray) -> FloatArray:
    """A friction of which `rate` knows nothing, never more than PUSH."""
    x, u = np.atleast_2d(x), np.atleast_2d(u)
    return np.column_stack([x[:, 1], u[:, 0] - np.sin(x[:, 0]) - PUSH * np.tanh(20 * x[:, 1])])


def recorded(seed: int, noise: float = 0.0) -> Trajectory:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-0.5, 0.5, (8, 1)), 25, axis=0)
    x, h = np.zeros((len(u), 2)), PERIOD / 20
    for k in range(len(u) - 1):
        z = x[k]
        for _ in range(20):
            z = z + h * true_rate(z + h / 2 * true_rate(z, u[k])[0], u[k])[0]
        x[k + 1] = z
    x = x + noise * rng.standard_normal(x.shape)
    return Trajectory(t=PERIOD * np.arange(len(u)), y=x, u=u, name=f"run {seed}")


@pytest.mark.slow
def test_a_friction_that_equations_leave_out_is_measured_and_the_funnel_holds_with_it() -> None:
    push = measured_push(rate, Dataset(tuple(recorded(i) for i in range(4))), safety_factor=1.2)
    assert push.largest.shape == (4, 2)
    assert push.largest[:, 0].max() < 0.02 * PUSH, "how fast the angle changes is right"
    assert push.largest[:, 1].max() == pytest.approx(PUSH, rel=0.02)
    assert push.exceeded == pytest.approx(2 / 5)
    assert "largest of 4 distinct trials, safety factor 1.2" in str(push)

    def pushed(x: Any, u: Any, w: Any) -> Any:
        a, b = rate(x, u)
        return [a + w[0], b + w[1]]

    motion = plan_motion(rate, start=[0, 0], end=[0.2, 0], seconds=1, u=[0.0])
    problem = ContinuousTracking(pushed, motion, goal=[0.2, 0.3], uncertain=push.box)
    found = design(problem)
    np.testing.assert_array_equal(found.model.uncertain[:2], push.box)
    simulated = Simulation(TrueDynamics(true_rate), found.policy, found.funnel).boundary(
        starts=200, rng=np.random.default_rng(1), substeps=5
    )
    assert simulated.violations == 0


def test_noise_counts_less_over_a_longer_time_and_a_trial_given_twice_counts_once() -> None:
    trials = [recorded(i, noise=1e-3) for i in range(3)]
    sample = measured_push(rate, Dataset(tuple(trials)))
    longer = measured_push(rate, Dataset((*trials, trials[0])), seconds=0.2)
    assert sample.largest[:, 1].max() > 2 * PUSH
    assert longer.largest[:, 1].max() == pytest.approx(PUSH, rel=0.5)
    assert longer.seconds == pytest.approx(0.2)
    assert len(longer.largest) == len(longer.measured_on) == 3


@pytest.mark.parametrize(
    ("dynamics", "options", "reason"),
    [
        (lambda t, x, u: [x[1], t * u[0]], {}, "no time of a motion"),
        (lambda x, u: [x[1], x[0] + u[0]], {"seconds": 0.001}, "a sample, 0.02 s, or more"),
        (lambda x, u: [x[1], x[0] + u[0]], {"seconds": 100.0}, "200 samples, 5001 needed"),
        (lambda x, u: [x[1], x[0] + u[0]], {"safety_factor": 0.5}, "1 or more"),
        (VectorField.from_function(lambda x: [-x[0]], 1, 0), {}, "2 states .as y. and 1 inputs"),
    ],
)
def test_what_cannot_be_measured_is_refused(dynamics: Any, options: Any, reason: str) -> None:
    with pytest.raises(DataError, match=reason):
        measured_push(dynamics, Dataset((recorded(0),)), **options)
