"""Motions from rest to rest by direct collocation (Hermite and Simpson), for the swing-ups.

Hargraves and Paris, "Direct trajectory optimization", 1987. Coarse by sequential quadratic
programs, then fine by least-norm Newton steps, so that cubics through the result obey the dynamics.
"""

from collections.abc import Callable

import numpy as np
from scipy.optimize import Bounds, minimize

from nlsid_core.arrays import FloatArray

Rate = Callable[[FloatArray, FloatArray], FloatArray]  # (N, n), (N, m) to (N, n), analytic
COMPLEX_STEP = 1e-30
SETTLED = 1e-11  # largest defect
NEWTON_STEPS = 20


def motion(
    rate: Rate,
    *,
    ends: tuple[FloatArray, FloatArray],
    u_rest: FloatArray,
    seconds: float,
    segments: tuple[int, int],
    guess: Callable[[float], FloatArray] | None = None,
    most: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """t (K,), x (K, n), u (K, m) of small ∫|u - u_rest|²; u is linear between the times.

    ends: (n,) first and last state; u starts and ends in u_rest (m,). segments: coarse and fine.
    guess: states at s in [0, 1]. most: (m,) bounds of |u - u_rest|.
    """
    n, m = len(ends[0]), len(u_rest)
    coarse, fine = segments
    path = guess or (lambda s: (1 - s) * ends[0] + s * ends[1])
    share = np.linspace(0, 1, coarse + 1)
    z = np.hstack([np.array([path(s) for s in share]), np.zeros((coarse + 1, m))])
    z[0, :n], z[-1, :n] = ends
    high = np.full_like(z, np.inf)
    if most is not None:
        high[:, n:] = most
    low = -high
    low[[0, -1]] = high[[0, -1]] = z[[0, -1]]
    h = seconds / coarse
    cost = np.zeros_like(z)
    cost[:, n:] = 2 * h

    def defects(flat: FloatArray) -> FloatArray:
        return _defects(rate, flat.reshape(z.shape), n, u_rest, h)

    found = minimize(
        lambda flat: (cost.ravel() * flat) @ flat / 2,
        z.ravel(),
        jac=lambda flat: cost.ravel() * flat,
        bounds=Bounds(low.ravel(), high.ravel()),
        constraints={"type": "eq", "fun": defects, "jac": lambda flat: _slopes(defects, flat)},
        method="SLSQP",
        options={"maxiter": 300, "ftol": 1e-6},
    )
    t = np.linspace(0, seconds, fine + 1)
    table = found.x.reshape(z.shape)
    z = np.stack([np.interp(t, seconds * share, column) for column in table.T], axis=1)
    return t, *_refined(rate, z, n, u_rest, seconds / fine)


def _refined(
    rate: Rate, z: FloatArray, n: int, u_rest: FloatArray, h: float
) -> tuple[FloatArray, FloatArray]:
    """The nearest motion on this mesh that obeys the dynamics, ends kept."""
    free = np.ones(z.shape, dtype=bool)
    free[[0, -1]] = False

    def defects(flat: FloatArray) -> FloatArray:
        whole = z.astype(flat.dtype)
        whole[free] = flat
        return _defects(rate, whole, n, u_rest, h)

    flat = z[free]
    for _ in range(NEWTON_STEPS):
        missing = defects(flat)
        if np.abs(missing).max() < SETTLED:
            break
        flat = flat - np.linalg.lstsq(_slopes(defects, flat), missing, rcond=None)[0]
    z[free] = flat
    return z[:, :n], z[:, n:] + u_rest


def _defects(rate: Rate, z: FloatArray, n: int, u_rest: FloatArray, h: float) -> FloatArray:
    """x_{k+1} - x_k - h/6 (f_k + 4 f_middle + f_{k+1}), x_middle on the cubic; flat."""
    x, u = z[:, :n], z[:, n:] + u_rest
    f = rate(x, u)
    middle = (x[:-1] + x[1:]) / 2 + h / 8 * (f[:-1] - f[1:])
    between = rate(middle, (u[:-1] + u[1:]) / 2)
    return np.asarray((x[1:] - x[:-1] - h / 6 * (f[:-1] + 4 * between + f[1:])).ravel())


def _slopes(function: Callable[[FloatArray], FloatArray], flat: FloatArray) -> FloatArray:
    """The Jacobian by complex steps: exact for analytic functions."""
    columns = []
    for j in range(len(flat)):
        moved = flat.astype(complex)
        moved[j] += 1j * COMPLEX_STEP
        columns.append(function(moved).imag / COMPLEX_STEP)
    return np.stack(columns, axis=1)
