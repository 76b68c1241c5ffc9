"""Block cascades and recordings of them that several tests use."""

import numpy as np

from nlsid_core.data.trajectory import Trajectory
from nlsid_core.models import BlockCascade, Signal, Spline


def truth() -> BlockCascade:
    """Two well damped filters around a saturation."""
    f = Spline(-3.0, 0.5, np.tanh(np.arange(-3.5, 3.75, 0.5)))
    return BlockCascade(
        a1=np.array([1.2, -0.5]),
        b1=np.array([[0.2, 0.1, 0.0]]),
        f=f,
        a2=np.array([0.7]),
        b2=np.array([[0.5, 0.2]]),
        period=0.01,
        y=Signal("y", "V"),
        u=Signal("u", "V"),
    )


def two_phases() -> BlockCascade:
    model = truth()
    return BlockCascade(
        a1=model.a1,
        b1=np.array([[0.2, 0.1, 0.0], [0.1, 0.2, 0.05]]),
        f=model.f,
        a2=model.a2,
        b2=np.array([[0.5, 0.2], [-0.1, 0.3]]),
        period=0.01,
        y=model.y,
        u=model.u,
    )


def wiener() -> BlockCascade:
    """No second filter: nothing of a measured output is needed to start it."""
    model = truth()
    return BlockCascade(
        model.a1, model.b1, model.f, np.zeros(0), model.b2, model.y, model.u, period=model.period
    )


def in_motion(samples: int, seed: int, noise: float = 0.002) -> Trajectory:
    """A trial that a long held input precedes, of steps held for 25 samples."""
    rng = np.random.default_rng(seed)
    u = np.repeat(2.0 * rng.standard_normal(samples // 25), 25)
    y = truth().simulate(np.concatenate([np.full(200, u[0]), u]))[200:]
    y += noise * rng.standard_normal(samples)
    return Trajectory(t=0.01 * np.arange(samples), y=y, u=u, name=f"run {seed}")


def recording(samples: int, seed: int, noise: float = 0.002) -> Trajectory:
    rng = np.random.default_rng(seed)
    u = 2.0 * rng.standard_normal(samples)
    y = truth().simulate(u) + noise * rng.standard_normal(samples)
    return Trajectory(t=0.01 * np.arange(samples), y=y, u=u, name=f"run {seed}")
