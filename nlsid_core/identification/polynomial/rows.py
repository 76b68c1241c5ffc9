"""Datasets as rows of a `StateAffineModel`, and back: scaled once here, undone once in the model.

Source: thesis (4.1)-(4.3).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError
from nlsid_core.identification.methods.banded import Rows
from nlsid_core.identification.polynomial.options import Polynomial
from nlsid_core.identification.regressors import FEWER, lagged, signal_scale
from nlsid_core.models import DifferenceEquation, Polynomials, StateAffineModel, signals_of
from nlsid_core.polynomial import monomial_values, monomials

MIN_ROWS_PER_PARAMETER = 5  # of a linear model; fewer and the fit is an interpolation
RANK_TOLERANCE = 1e-13  # relative singular value of unit columns at which a basis repeats itself


@dataclass(frozen=True, eq=False)
class StateAffineRows:
    """The rows of a dataset, their windows w (N, n_w), and the way back to a model.

    R: of the right basis, whose values are Q R. y_scale, u_scale: (mean, spread) of the signals.
    u_range: (n_u, 2), where models are proved. slowest: rate a sample that searches for models that
    are stable for every input keep.
    """

    rows: Rows
    w: FloatArray
    R: FloatArray
    scales: tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
    u_range: FloatArray
    dataset: Dataset
    model_class: Polynomial
    slowest: float = 1.0

    @property
    def y_scale(self) -> tuple[FloatArray, FloatArray]:
        """(mean, spread) of the outputs."""
        return self.scales[0]

    @property
    def u_scale(self) -> tuple[FloatArray, FloatArray]:
        """(mean, spread) of the inputs."""
        return self.scales[1]

    @property
    def window(self) -> tuple[tuple[int, int], ...]:
        """(input, delay) of each entry of w."""
        return self.model_class.window(len(self.u_scale[0]))

    @property
    def left(self) -> tuple[IntArray, ...]:
        """Exponents of G_0 … G_n."""
        return bases(self.model_class, len(self.window))[0]

    @property
    def right(self) -> IntArray:
        """Exponents of p."""
        return bases(self.model_class, len(self.window))[1]

    @property
    def is_constant(self) -> bool:
        """No coefficient of an output depends on the input."""
        return all(len(g) == 1 for g in self.left)

    @property
    def is_bounded_by_leading(self) -> bool:
        """One output, and G_1 … G_n do not depend on the input."""
        return len(self.y_scale[0]) == 1 and all(len(g) == 1 for g in self.left[1:])

    def window_range(self) -> FloatArray:
        """(n_w, 2): the box of normalised windows that the declared input range allows."""
        box = (self.u_range - self.u_scale[0][:, None]) / self.u_scale[1][:, None]
        return np.asarray(box[[i for i, _ in self.window]])

    def embedded(self, theta: FloatArray) -> FloatArray:
        """Left parameters of the linear model with constant ones θ ((n+1) n_y²,)."""
        blocks = [np.zeros((len(exponents), len(self.y_scale[0]) ** 2)) for exponents in self.left]
        for block, constant in zip(blocks, theta.reshape(len(blocks), -1), strict=True):
            block[0] = constant  # the monomials begin with 1
        return np.concatenate([block.ravel() for block in blocks])

    def model(self, theta: FloatArray, p: FloatArray) -> Any:
        """The model of left parameters θ and right parameters p of orthonormal columns.

        A `StateAffineModel`; with one input and output and no options a `DifferenceEquation`, which
        takes every input as it is.
        """
        n_y = len(self.y_scale[0])
        right = -np.linalg.solve(self.R, p.reshape(-1, n_y))
        first, y_unit, u_unit = self.dataset.trajectories[0], self.y_scale[1], self.u_scale[1]
        y, u = signals_of(first, "y"), signals_of(first, "u")
        if self.model_class.is_linear and n_y == len(u) == 1:
            of_u = right[:, 0] / theta[0] * -y_unit[0]  # of 1 and of every delay
            a, b = -theta[1:] / theta[0], of_u[1:] / u_unit[0]
            c = of_u[0] + self.y_scale[0][0] * (1.0 - a.sum()) - self.u_scale[0][0] * b.sum()
            return DifferenceEquation(
                a=a,
                b=b,
                c=float(c),
                period=self.dataset.period,
                y=y[0],
                u=u[0],
                u_range=(float(self.u_range[0, 0]), float(self.u_range[0, 1])),
                bags=self.dataset.bags,
            )
        G, start = [], 0
        for exponents in self.left:
            size = len(exponents) * n_y**2
            coefficients = theta[start : start + size].reshape(-1, n_y, n_y)
            G.append(Polynomials(exponents, coefficients))
            start += size
        return StateAffineModel(
            G=tuple(G),
            p=Polynomials(self.right, right),
            window=self.window,
            y_offset=self.y_scale[0],
            y_scale=y_unit,
            u_offset=self.u_scale[0],
            u_scale=u_unit,
            u_range=self.u_range,
            on_out_of_range=self.model_class.on_out_of_range,
            period=self.dataset.period,
            y=y,
            u=u,
            bags=self.dataset.bags,
        )


def build_state_affine_rows(
    dataset: Dataset, model_class: Polynomial, *, slowest: float = 1.0
) -> StateAffineRows:
    """Stack the rows t = n … of every trajectory, signals scaled to zero mean and unit spread.

    slowest: as of `StateAffineRows`.
    Raises DataError if there are too few rows, or the inputs do not excite the right basis.
    """
    n = model_class.lags
    short = [trial for trial in dataset if len(trial) <= n]
    if short:
        raise DataError(f"{short[0].name}: {len(short[0])} samples, {n} lags need more")
    y_scale, u_scale = signal_scale(dataset, "y"), signal_scale(dataset, "u")
    n_y = len(y_scale[0])
    declared = _declared_range(np.concatenate([trial.u for trial in dataset]), model_class)
    Y = np.concatenate([lagged((t.y - y_scale[0]) / y_scale[1], n) for t in dataset])
    clipped = [np.clip(t.u, declared[:, 0], declared[:, 1]) for t in dataset]
    U = np.concatenate([lagged((u - u_scale[0]) / u_scale[1], n) for u in clipped])
    row = np.concatenate([np.arange(len(trial) - n) for trial in dataset])
    w = np.stack([U[:, d, i] for i, d in model_class.window(U.shape[2])], axis=1)
    left, right = bases(model_class, w.shape[1])
    parameters = (sum(map(len, left)) - 1) * n_y**2 + len(right) * n_y
    needed = parameters * (MIN_ROWS_PER_PARAMETER if model_class.is_linear else 1)
    if len(Y) * n_y < needed:
        raise DataError(
            f"{len(Y) * n_y} equations for {parameters} parameters; give at least {needed}, or "
            f"fewer lags than {n}"
        )
    Q, R = np.linalg.qr(monomial_values(right, w))
    _refuse_rank(R, n)
    blocks = [_block(k, left[k], w, Y, row >= k) for k in range(n + 1)]
    identity = np.zeros(sum(len(block[0]) for block in blocks))
    identity[: n_y**2] = np.eye(n_y).ravel()
    rows = Rows(
        offsets=tuple(entry for block in blocks for entry in block[0]),
        weights=np.asfortranarray(np.concatenate([block[1] for block in blocks], axis=1)),
        errors=np.asfortranarray(np.concatenate([block[2] for block in blocks], axis=1)),
        Q=np.asfortranarray(np.kron(Q, np.eye(n_y)) if n_y > 1 else Q),
        identity=identity,
    )
    scales = y_scale, u_scale
    return StateAffineRows(rows, w, R, scales, declared, dataset, model_class, slowest)


def bases(model_class: Polynomial, variables: int) -> tuple[tuple[IntArray, ...], IntArray]:
    """Exponents of G_0 … G_n, and of p, in so many entries of w."""
    degrees = model_class.degrees
    lagged_basis = _basis(degrees.lagged, variables)
    left = (_basis(degrees.leading, variables), *([lagged_basis] * model_class.lags))
    return left, _basis(degrees.inputs, variables)


def _declared_range(u: FloatArray, model_class: Polynomial) -> FloatArray:
    """(n_u, 2) the class's range of inputs, or that of the data u (N, n_u)."""
    measured = np.column_stack([u.min(axis=0), u.max(axis=0)])
    if model_class.input_range is None:
        return measured
    declared = np.array(model_class.input_range, dtype=np.float64)
    if declared.shape != measured.shape:
        raise DataError(f"input_range has {len(declared)} inputs, the data {len(measured)}")
    beyond = (measured[:, 0] < declared[:, 0]) | (measured[:, 1] > declared[:, 1])
    if model_class.on_out_of_range == "refuse" and beyond.any():
        i = int(np.argmax(beyond))
        raise DataError(
            f"input {i} of the training data is in [{measured[i, 0]:g}, {measured[i, 1]:g}], "
            f"beyond [{declared[i, 0]:g}, {declared[i, 1]:g}], which the model refuses; "
            "declare a wider range, or on_out_of_range: clip"
        )
    return declared


def _basis(degree: int, variables: int) -> IntArray:
    """Exponents of every monomial of total degree 0 … `degree`, lowest first."""
    return monomials(variables, range(degree + 1))


def _block(
    k: int, exponents: IntArray, w: FloatArray, Y: FloatArray, inside: NDArray[np.bool_]
) -> tuple[list[int], FloatArray, FloatArray]:
    """Offsets, weights and errors of G_k's parameters (monomial j, output a, lagged output b).

    Row t·n_y + a, monomial φ_j: weight φ_j(w(t)) on the diagonal k·n_y + a - b.
    """
    T, _, n_y = Y.shape
    offsets, weights, errors = [], [], []
    for values in monomial_values(exponents, w).T:
        for a in range(n_y):
            for b in range(n_y):
                weight, error = np.zeros((T, n_y)), np.zeros((T, n_y))
                weight[:, a] = values * inside
                error[:, a] = values * Y[:, k, b]
                offsets.append(k * n_y + a - b)
                weights.append(weight.ravel())
                errors.append(error.ravel())
    return offsets, np.column_stack(weights), np.column_stack(errors)


def _refuse_rank(R: FloatArray, lags: int) -> None:
    singular = np.linalg.svd(R / np.linalg.norm(R, axis=0), compute_uv=False)
    rank = int((singular > RANK_TOLERANCE * singular[0]).sum())
    if rank < len(R):
        raise DataError(
            f"the excitation does not excite {lags} lags: its polynomial basis of {len(R)} has "
            f"rank {rank}; {FEWER}"
        )
