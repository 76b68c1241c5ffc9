"""Datasets as rows of a `StateAffineModel`, and back: scaled once here, undone once in the model.

Source: thesis (4.1)-(4.3).
"""

from dataclasses import dataclass
from typing import ClassVar, get_args

import numpy as np
from numpy.typing import NDArray

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError
from nlsid_core.identification.methods.banded import Rows
from nlsid_core.identification.methods.options import MOST_LAGS
from nlsid_core.identification.regressors import FEWER, lagged, signal_scale
from nlsid_core.models import StateAffineModel
from nlsid_core.models.polynomials import Polynomials
from nlsid_core.models.signal import signals_of
from nlsid_core.models.state_affine import OutOfRange
from nlsid_core.options import (
    require_delays,
    require_one_of,
    require_ranges,
    require_weights,
    require_whole,
)
from nlsid_core.polynomial import monomials
from nlsid_core.polynomial.values import monomial_values

HIGHEST_DEGREE = 5  # of a coefficient; its terms grow with that power of the number of inputs
RANK_TOLERANCE = 1e-13  # relative singular value of unit columns at which a basis repeats itself


@dataclass(frozen=True)
class StateAffineClass:
    """Linear in the outputs, polynomial in the inputs w. Source: thesis (4.1).

    lags: n, 1 to 100 samples; delays: of the inputs in w, each 0 … n samples (None: all of them).
    leading_degree: of G_0 in w, lagged_degree: of G_1 … G_n, right_degree: of p, each 0 to 5.
    input_range: (low, high) of each input in its unit, where the model is proved (None: the range
    in the data). on_out_of_range: what the model does with an input beyond it, "clip" or "refuse".
    weights: of the squared error of each output in units of its spread, above 0 (None: all equal).
    """

    lags: int
    delays: tuple[int, ...] | None = None
    leading_degree: int = 0
    lagged_degree: int = 0
    right_degree: int = 1
    input_range: tuple[tuple[float, float], ...] | None = None
    on_out_of_range: OutOfRange = "clip"
    weights: tuple[float, ...] | None = None
    kind: ClassVar[type[StateAffineModel]] = StateAffineModel

    def __post_init__(self) -> None:
        require_whole(self, "lags", 1, MOST_LAGS)
        require_delays(self, "delays", self.lags)
        for key in ("leading_degree", "lagged_degree", "right_degree"):
            require_whole(self, key, 0, HIGHEST_DEGREE)
        require_ranges(self, "input_range")
        require_one_of(self, "on_out_of_range", get_args(OutOfRange))
        require_weights(self, "weights")

    def window(self, inputs: int) -> tuple[tuple[int, int], ...]:
        """(input, delay) of each entry of w."""
        delays = tuple(range(self.lags + 1)) if self.delays is None else self.delays
        return tuple((i, d) for d in delays for i in range(inputs))


@dataclass(frozen=True, eq=False)
class StateAffineRows:
    """The rows of a dataset, their windows w (N, n_w), and the way back to a model.

    y_scale: (mean, unit) of the outputs, a unit being the spread over the root of the output's
    weight, so that W in Σ |y - ŷ|²_W is the identity. weights: (n_y,).
    slowest: rate a sample that searches for models that are stable for every input keep.
    """

    rows: Rows
    w: FloatArray
    dataset: Dataset
    left: tuple[IntArray, ...]
    right: IntArray
    R: FloatArray  # of the right basis: values = Q R
    window: tuple[tuple[int, int], ...]
    y_scale: tuple[FloatArray, FloatArray]
    u_scale: tuple[FloatArray, FloatArray]
    u_range: FloatArray
    weights: FloatArray
    on_out_of_range: OutOfRange = "clip"
    slowest: float = 1.0

    @property
    def is_bounded_by_leading(self) -> bool:
        """One output, and G_1 … G_n do not depend on the input."""
        return len(self.y_scale[0]) == 1 and all(len(g) == 1 for g in self.left[1:])

    def window_range(self) -> FloatArray:
        """(n_w, 2): the box of normalised windows that the declared input range allows."""
        box = (self.u_range - self.u_scale[0][:, None]) / self.u_scale[1][:, None]
        return np.asarray(box[[i for i, _ in self.window]])

    def embedded(self, theta: FloatArray) -> FloatArray:
        """Left parameters of the linear model with constant ones θ ((n+1) n_y²,), of outputs in
        units of their spread.
        """
        n_y, root = len(self.y_scale[0]), np.sqrt(self.weights)
        blocks = [np.zeros((len(exponents), n_y**2)) for exponents in self.left]
        units = np.outer(root, 1.0 / root).ravel()
        for block, constant in zip(blocks, theta.reshape(len(blocks), -1), strict=True):
            block[0] = constant * units  # the monomials begin with 1
        return np.concatenate([block.ravel() for block in blocks])

    def model(self, theta: FloatArray, p: FloatArray) -> StateAffineModel:
        """The model of left parameters θ and right parameters p of orthonormal columns."""
        n_y = len(self.y_scale[0])
        G, start = [], 0
        for exponents in self.left:
            size = len(exponents) * n_y**2
            coefficients = theta[start : start + size].reshape(-1, n_y, n_y)
            G.append(Polynomials(exponents, coefficients))
            start += size
        first = self.dataset.trajectories[0]
        right = -np.linalg.solve(self.R, p.reshape(-1, n_y))
        return StateAffineModel(
            G=tuple(G),
            p=Polynomials(self.right, right),
            window=self.window,
            y_offset=self.y_scale[0],
            y_scale=self.y_scale[1],
            u_offset=self.u_scale[0],
            u_scale=self.u_scale[1],
            u_range=self.u_range,
            on_out_of_range=self.on_out_of_range,
            period=self.dataset.period,
            y=signals_of(first, "y"),
            u=signals_of(first, "u"),
            bags=self.dataset.bags,
        )


def build_state_affine_rows(
    dataset: Dataset,
    model_class: StateAffineClass,
    *,
    slowest: float = 1.0,
) -> StateAffineRows:
    """Stack the rows t = n … of every trajectory, signals scaled to zero mean and unit spread.

    slowest: as of `StateAffineRows`. Raises DataError if there are too few rows, or the inputs do
    not excite the right basis.
    """
    n = model_class.lags
    short = [trial for trial in dataset if len(trial) <= n]
    if short:
        raise DataError(f"{short[0].name}: {len(short[0])} samples, {n} lags need more")
    mean, spread = signal_scale(dataset, "y")
    W = np.ones(len(spread)) if model_class.weights is None else np.array(model_class.weights)
    if len(W) != len(spread):
        raise DataError(f"weights has {len(W)} outputs, the data {len(spread)}")
    y_scale = mean, spread / np.sqrt(W)
    u_all = np.concatenate([trial.u for trial in dataset])
    u_scale = signal_scale(dataset, "u")
    n_y, n_u = len(y_scale[0]), len(u_scale[0])
    window = model_class.window(n_u)
    Y = np.concatenate([lagged((t.y - y_scale[0]) / y_scale[1], n) for t in dataset])
    declared = _declared_range(u_all, model_class)
    clipped = [np.clip(t.u, declared[:, 0], declared[:, 1]) for t in dataset]
    U = np.concatenate([lagged((u - u_scale[0]) / u_scale[1], n) for u in clipped])
    row = np.concatenate([np.arange(len(trial) - n) for trial in dataset])
    w = np.stack([U[:, d, i] for i, d in window], axis=1)
    left = tuple(
        _basis(model_class.lagged_degree if k else model_class.leading_degree, len(window))
        for k in range(n + 1)
    )
    right = _basis(model_class.right_degree, len(window))
    parameters = sum(map(len, left)) * n_y**2 + len(right) * n_y
    if len(Y) * n_y < parameters:
        raise DataError(f"{len(Y) * n_y} equations for {parameters} parameters; give more data")
    Q, R = np.linalg.qr(monomial_values(right, w))
    _refuse_rank(R, n)
    blocks = [
        _block(k, left[k], w, Y, row >= k)
        for k in range(n + 1)
    ]  # fmt: skip
    offsets, weights, errors = (
        [entry for block in blocks for entry in block[0]],
        np.concatenate([block[1] for block in blocks], axis=1),
        np.concatenate([block[2] for block in blocks], axis=1),
    )
    identity = np.zeros(len(offsets))
    identity[: n_y**2] = np.eye(n_y).ravel()
    rows = Rows(
        offsets=tuple(offsets),
        weights=np.asfortranarray(weights),
        errors=np.asfortranarray(errors),
        Q=np.asfortranarray(np.kron(Q, np.eye(n_y)) if n_y > 1 else Q),
        identity=identity,
    )
    return StateAffineRows(
        rows, w, dataset, left, right, R, window, y_scale, u_scale, declared, W,
        model_class.on_out_of_range, slowest,
    )  # fmt: skip


def _declared_range(u: FloatArray, model_class: StateAffineClass) -> FloatArray:
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
