"""The discrete time-varying LQR: the Riccati recursion, beside the differential one of `tvlqr`."""

from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import ArrayLike, FloatArray
from nlsid_core.design.continuous.tvlqr import definite
from nlsid_core.errors import ShapeError


@dataclass(frozen=True, eq=False)
class Feedback:
    """K (N, p, n) of u = u_k - K_k x̄, and P (N + 1, n, n), the cost to go x̄'P_k x̄."""

    K: FloatArray
    P: FloatArray


def discrete_tvlqr(
    A: ArrayLike, B: ArrayLike, *, Q: ArrayLike, R: ArrayLike, P_final: ArrayLike
) -> Feedback:
    """The LQR of x̄⁺ = A_k x̄ + B_k ū with cost Σ x̄'Qx̄ + ū'Rū, ending in x̄'P_final x̄.

        K_k = (R + B'P_{k+1}B)⁻¹ B'P_{k+1}A,   P_k = Q + K'RK + (A - BK)'P_{k+1}(A - BK)

    A: (N, n, n), B: (N, n, p). The form of P_k keeps it positive semidefinite whatever is rounded.
    Raises ShapeError on sizes that do not fit, DataError on indefinite weights.
    """
    A, B = np.asarray(A, dtype=np.float64), np.asarray(B, dtype=np.float64)
    if A.ndim != 3 or B.ndim != 3 or A.shape[1] != A.shape[2] or A.shape[:2] != B.shape[:2]:
        raise ShapeError(f"A should be (N, n, n) and B (N, n, p); they are {A.shape}, {B.shape}")
    Q = definite(Q, A.shape[2], "Q", strict=False)
    R = definite(R, B.shape[2], "R", strict=True)
    P = [definite(P_final, A.shape[2], "P_final", strict=False)]
    K = []
    for A_k, B_k in zip(A[::-1], B[::-1], strict=True):
        gain = np.linalg.solve(R + B_k.T @ P[-1] @ B_k, B_k.T @ P[-1] @ A_k)
        closed = A_k - B_k @ gain
        cost = Q + gain.T @ R @ gain + closed.T @ P[-1] @ closed
        P.append((cost + cost.T) / 2)
        K.append(gain)
    return Feedback(np.array(K[::-1]).reshape(len(A), B.shape[2], A.shape[2]), np.array(P[::-1]))
