"""The Riccati equation of LQR and Kalman gains in discrete time."""

import numpy as np
from scipy.linalg import LinAlgError, solve_discrete_are

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import Infeasible

DOUBLINGS = 60  # of the horizon; a loop that shrinks by 1e-15 a sample would be seen to converge
CONVERGED = 1e-14  # relative change


def solve_riccati(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, S: FloatArray | None = None
) -> FloatArray:
    """X (n, n) of X = A'XA + Q - (A'XB + S)(R + B'XB)⁻¹(B'XA + S'), S (n, m) zero if None.

    By ordered eigenvalues, or where they cannot be ordered, as with poles near zero, by doubling
    the horizon (Anderson 1978). Raises Infeasible if neither finds it.
    """
    try:
        return np.asarray(solve_discrete_are(A, B, Q, R, s=S))
    except (LinAlgError, ValueError):
        return _by_doubling(A, B, Q, R, S)


def _by_doubling(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, S: FloatArray | None
) -> FloatArray:
    """H of A⁺ = A W A, G⁺ = G + A W G A', H⁺ = H + A'H W A, W = (I + G H)⁻¹, from BR⁻¹B' and Q."""
    H = Q
    if S is not None:
        gain = np.linalg.solve(R, S.T)
        A, H = A - B @ gain, Q - S @ gain
    G = B @ np.linalg.solve(R, B.T)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(DOUBLINGS):
            try:
                WA, WG = np.hsplit(
                    np.linalg.solve(np.eye(len(A)) + G @ H, np.hstack([A, G])), [len(A)]
                )
            except np.linalg.LinAlgError:
                break
            added = A.T @ H @ WA
            G, H = G + A @ WG @ A.T, H + (added + added.T) / 2.0
            A = A @ WA
            if not np.isfinite(H).all():
                break
            if np.abs(added).max() <= CONVERGED * np.abs(H).max():
                return np.asarray(H)
    raise Infeasible("the Riccati equation of this model has no solution in float64")
