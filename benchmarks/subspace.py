"""N4SID as it is usually run, for comparison: a linear model from block Hankel matrices.

The future outputs are projected along the future inputs on what the past explains; the singular
vectors of that are the observability matrix, whose shift gives A. B, D and the starts are then
least squares on the simulation. Source: Van Overschee and De Moor 1996, Chapter 4.
"""

from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory

SLOWEST = 0.9999  # poles outside are put there: an unstable model simulates nothing
ROWS_PER_ORDER = 3  # block rows of the future, for each state
MOST_COLUMNS = 20_000  # of the Hankel matrices


@dataclass(frozen=True, eq=False)
class StateSpace:
    """x⁺ = A x + B [u; 1], y = C x + D [u; 1], in signals of zero mean and unit spread."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    y_scale: tuple[FloatArray, FloatArray]
    u_scale: tuple[FloatArray, FloatArray]
    start: int  # measured samples that x(0) is estimated from

    def simulate(self, trial: Trajectory) -> FloatArray:
        """Outputs (N, n_y); x(0) from the first `start` samples."""
        y, u = (trial.y - self.y_scale[0]) / self.y_scale[1], self._scaled(trial.u)
        forced = _response(self.A, self.C, u @ self.B.T, np.zeros(len(self.A))) + u @ self.D.T
        powers = [self.C]
        for _ in range(self.start - 1):
            powers.append(powers[-1] @ self.A)
        left = (y - forced)[: self.start].ravel()
        x = np.linalg.lstsq(np.concatenate(powers), left, rcond=None)[0]
        free = _response(self.A, self.C, np.zeros((len(u), len(self.A))), x)
        return np.asarray((forced + free) * self.y_scale[1] + self.y_scale[0])

    def _scaled(self, u: FloatArray) -> FloatArray:
        scaled = (u - self.u_scale[0]) / self.u_scale[1]
        return np.column_stack([scaled, np.ones(len(u))])


def n4sid(train: Dataset, order: int) -> StateSpace:
    """A model of this order; ValueError if the trials are too short for it."""
    rows = ROWS_PER_ORDER * order
    y_scale, u_scale = (
        (np.concatenate(parts).mean(axis=0), np.concatenate(parts).std(axis=0))
        for parts in ([t.y for t in train], [t.u for t in train])
    )
    scaled = [
        ((t.y - y_scale[0]) / y_scale[1], (t.u - u_scale[0]) / u_scale[1])
        for t in train
        if len(t) > 4 * rows
    ]
    if not scaled:
        raise ValueError(f"no trial has more than {4 * rows} samples")
    n_y, n_u = scaled[0][0].shape[1], scaled[0][1].shape[1]
    Y = np.hstack([_hankel(y, 2 * rows) for y, _ in scaled])[:, :MOST_COLUMNS]
    U = np.hstack([_hankel(u, 2 * rows) for _, u in scaled])[:, :MOST_COLUMNS]
    past = np.vstack([U[: rows * n_u], Y[: rows * n_y]])
    stacked = np.vstack([U[rows * n_u :], past, Y[rows * n_y :]])
    L = np.asarray(np.linalg.qr(stacked.T, mode="r")).T
    a, b = rows * n_u, rows * n_u + len(past)
    oblique = L[b:, a:b]  # what the past adds to what the future inputs explain
    vectors, values, _ = np.linalg.svd(oblique, full_matrices=False)
    observability = vectors[:, :order] * np.sqrt(values[:order])
    A = np.linalg.lstsq(observability[:-n_y], observability[n_y:], rcond=None)[0]
    poles, basis = np.linalg.eig(A)
    poles = np.where(np.abs(poles) > SLOWEST, SLOWEST * poles / np.abs(poles), poles)
    A, C = np.real(basis @ np.diag(poles) @ np.linalg.inv(basis)), observability[:n_y]
    B, D = _inputs(A, C, [(y, np.column_stack([u, np.ones(len(u))])) for y, u in scaled])
    return StateSpace(A, B, C, D, y_scale, u_scale, 2 * order)


def _inputs(
    A: FloatArray, C: FloatArray, trials: list[tuple[FloatArray, FloatArray]]
) -> tuple[FloatArray, FloatArray]:
    """B (n, n_u), D (n_y, n_u) and a start for every trial, linear in the simulated outputs."""
    n, n_y, n_u = len(A), len(C), trials[0][1].shape[1]
    columns, targets = [], []
    for k, (y, u) in enumerate(trials):
        parts = np.zeros((*y.shape, n * n_u + n_y * n_u + n * len(trials)))
        for i in range(n):
            for j in range(n_u):
                entry = np.zeros((len(u), n))
                entry[:, i] = u[:, j]
                parts[:, :, i * n_u + j] = _response(A, C, entry, np.zeros(n))
            at = n * n_u + n_y * n_u + k * n + i
            parts[:, :, at] = _response(A, C, np.zeros((len(u), n)), np.eye(n)[i])
        for i in range(n_y):
            for j in range(n_u):
                parts[:, i, n * n_u + i * n_u + j] = u[:, j]
        columns.append(parts.reshape(-1, parts.shape[2]))
        targets.append(y.ravel())
    found = np.linalg.lstsq(np.concatenate(columns), np.concatenate(targets), rcond=None)[0]
    return (
        found[: n * n_u].reshape(n, n_u),
        found[n * n_u : (n + n_y) * n_u].reshape(n_y, n_u),
    )


def _response(A: FloatArray, C: FloatArray, forcing: FloatArray, x: FloatArray) -> FloatArray:
    """C x(t), x⁺ = A x + forcing(t)."""
    states = np.empty((len(forcing), len(A)))
    for t, push in enumerate(forcing):
        states[t] = x
        x = A @ x + push
    return states @ C.T


def _hankel(signal: FloatArray, rows: int) -> FloatArray:
    """(rows n, N - rows + 1): columns stack signal(t) … signal(t + rows - 1)."""
    columns = len(signal) - rows + 1
    return np.vstack([signal[k : k + columns].T for k in range(rows)])
