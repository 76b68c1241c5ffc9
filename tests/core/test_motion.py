"""A motion of a measured state is the one that a slower solver finds."""

import numpy as np
from scipy.optimize import minimize

from nlsid_core.design.sampled.motion import NEARNESS, RESERVE, SMOOTHNESS, plan_motion
from tests.tracked import pendulum


def test_a_planned_motion_is_the_one_that_scipy_finds_more_slowly() -> None:
    """The same transcription of 15 samples by SLSQP, in units of the box."""
    model, steps = pendulum(), 15
    half_x, half_u = model.x_range[:, 1], model.u_range[:, 1]
    ends = np.array([[0.0, 0.0], [0.1, 0.0]]) / half_x

    def parts(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return z[: 2 * (steps + 1)].reshape(-1, 2), z[2 * (steps + 1) :].reshape(-1, 1)

    def cost(z: np.ndarray) -> float:
        x, u = parts(z)
        smooth = SMOOTHNESS * steps * float(np.sum(np.diff(u, axis=0) ** 2))
        return (NEARNESS * float(np.sum(x**2)) + float(np.sum(u**2)) + smooth) / 2

    def defects(z: np.ndarray) -> np.ndarray:
        x, u = parts(z)
        steps_missed = model(x[:-1] * half_x, u * half_u) / half_x - x[1:]
        return np.concatenate([steps_missed.ravel(), x[0] - ends[0], x[-1] - ends[1]])

    start = np.zeros(3 * steps + 2)
    found = minimize(
        cost,
        start,
        method="SLSQP",
        constraints={"type": "eq", "fun": defects},
        bounds=[(-1.0 + RESERVE, 1.0 - RESERVE)] * len(start),
        options={"maxiter": 300},
    )
    assert found.success
    x, u = plan_motion(model, [0.0, 0.0], [0.1, 0.0], steps=steps)
    ours = np.concatenate([(x / half_x).ravel(), (u / half_u).ravel()])
    assert cost(ours) <= found.fun * (1 + 1e-5)
    np.testing.assert_allclose(ours, found.x, atol=2e-3)
