"""Rows of a small state-affine problem, and their banded matrices written out."""

import numpy as np

from nlsid import Dataset, Degrees, Polynomial, Trajectory
from nlsid_core.identification.methods.banded import Rows
from nlsid_core.identification.polynomial.rows import StateAffineRows, build_state_affine_rows

EXACT = 1e-10  # agreement of two floating-point routes to the same number


def problem(
    *,
    outputs: int = 1,
    trials: int = 2,
    samples: int = 24,
    noise: float = 0.05,
    model_class: Polynomial | None = None,
    seed: int = 3,
) -> StateAffineRows:
    """Rows of a small nonlinear system with `outputs` coupled outputs."""
    rng = np.random.default_rng(seed)
    trajectories = []
    for index in range(trials):
        u = rng.uniform(-1.0, 1.0, samples)
        y = np.zeros((samples, outputs))
        A = 0.6 * np.eye(outputs) - 0.2 * np.eye(outputs, k=1)
        for t in range(1, samples):
            y[t] = A @ y[t - 1] / (1.0 + 0.3 * u[t] ** 2) + u[t] - 0.3 * u[t - 1] ** 3
        y += noise * rng.standard_normal(y.shape)
        trajectories.append(Trajectory(t=np.arange(float(samples)), y=y, u=u, name=f"run {index}"))
    default = Polynomial(2, degrees=Degrees(leading=1, lagged=1))
    return build_state_affine_rows(Dataset(tuple(trajectories)), model_class or default)


def dense(rows: Rows, theta: np.ndarray) -> np.ndarray:
    """G(θ) as a full matrix."""
    N = len(rows)
    G = np.zeros((N, N))
    for D, weight, value in zip(rows.offsets, rows.weights.T, theta, strict=True):
        r = np.arange(max(D, 0), N + min(D, 0))
        G[r, r - D] += value * weight[r]
    return G


def near_identity(rows: Rows, seed: int, size: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.asarray(rows.identity + size * rng.standard_normal(len(rows.identity)))
