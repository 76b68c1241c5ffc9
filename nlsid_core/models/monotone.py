"""Solving c(v) = 0 for a strictly monotone c: Newton's method, and the ellipsoid method behind it.

(v - v̂)'(c(v) - c(v̂)) ≥ δ|v - v̂|²  makes c a bijection. Source: thesis (2.11), Theorem 2.5.
"""

from collections.abc import Callable

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.errors import SolverError

RESIDUAL = 1e-12  # of c(v) relative to its size: a few units of rounding
NEWTON_STEPS = 60
SHORTEST_STEP = 2.0**-30
ELLIPSOID_STEPS = 4000  # each shrinks the volume by exp(-1/(2(n+1))) or more

Rows = Callable[[FloatArray, IntArray], FloatArray]


def newton(
    c: Rows, slope: Rows, *, start: FloatArray, size: FloatArray
) -> tuple[FloatArray, IntArray]:
    """v (B, n) from `start`, with step halving, and the rows where it did not get to zero.

    c, slope: values (k, n) and Jacobians (k, n, n) at points (k, n) of the k rows named. size: (B,)
    what |c| is small to.
    """
    v, everything = start.copy(), np.arange(len(start))
    residual = c(v, everything)
    error = np.linalg.norm(residual, axis=1)
    for _ in range(NEWTON_STEPS):
        active = np.flatnonzero(~(error <= RESIDUAL * size))
        if not len(active):
            break
        try:
            steps = _solved(slope(v[active], active), -residual[active])
        except np.linalg.LinAlgError:  # a singular slope: c is not monotone, or overflows
            break
        length, waiting = np.ones(len(active)), np.arange(len(active))
        while len(waiting):
            rows = active[waiting]
            trial = v[rows] + length[waiting, None] * steps[waiting]
            found = c(trial, rows)
            better = np.linalg.norm(found, axis=1) < error[rows]
            moved = rows[better]
            v[moved], residual[moved] = trial[better], found[better]
            error[moved] = np.linalg.norm(found[better], axis=1)
            waiting = waiting[~better]
            length[waiting] /= 2.0
            waiting = waiting[length[waiting] >= SHORTEST_STEP]
    return v, np.flatnonzero(~(error <= RESIDUAL * size))


def _solved(slopes: FloatArray, right: FloatArray) -> FloatArray:
    """(k, n): what slopes (k, n, n) take to right (k, n)."""
    if right.shape[1] > 1:
        return np.asarray(np.linalg.solve(slopes, right[..., None])[..., 0])
    if not slopes.all():
        raise np.linalg.LinAlgError("a slope is zero")
    return np.asarray(right / slopes[:, 0])


def ellipsoid(
    c: Callable[[FloatArray], FloatArray], *, start: FloatArray, monotonicity: float, size: float
) -> FloatArray:
    """v (n,) with c(v) = 0; needs only that c is monotone, not that it is smooth.

    The first ball {v : |v - start| ≤ |c(start)|/δ} holds the solution, and (v - v*)'c(v) ≥ 0 cuts
    every ellipsoid through its centre. Raises SolverError if the residual does not get small: then
    `monotonicity` is not true.
    """
    n, v = len(start), start.copy()
    best, least = v, np.inf
    radius = float(np.linalg.norm(c(v))) / monotonicity
    P = radius**2 * np.eye(n)
    for _ in range(ELLIPSOID_STEPS):
        g = c(v)
        error = float(np.linalg.norm(g))
        if error < least:
            best, least = v.copy(), error
        if error <= RESIDUAL * size or not g @ P @ g > 0.0:
            break
        step = P @ g / np.sqrt(g @ P @ g)
        v = v - step / (n + 1)
        if n == 1:
            P = P / 4.0
        else:
            P = n**2 / (n**2 - 1.0) * (P - 2.0 / (n + 1) * np.outer(step, step))
    if least > np.sqrt(RESIDUAL) * size:
        raise SolverError(
            f"the equation is solved to {least:.1e} only; it is not {monotonicity:g}-monotone"
        )
    return best
