"""Linear difference equations: their class, a dataset as rows of lagged signals, least squares.

A last step on the simulation error may be kept among the stable models.
"""

from dataclasses import dataclass
from functools import cached_property, partial
from typing import ClassVar

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.identification.methods.banded import Rows
from nlsid_core.identification.methods.newton import Descent
from nlsid_core.identification.methods.options import MOST_LAGS
from nlsid_core.identification.methods.simulation_error import SimulationError
from nlsid_core.identification.proofs.stability import prove_stability
from nlsid_core.identification.regressors import lagged, signal_scale
from nlsid_core.models import DifferenceEquation
from nlsid_core.models.signal import signals_of
from nlsid_core.options import require_whole

SLOWEST_POLE = 1.0 - 1e-7  # slower, and rounding may take the proof away
POLE_ROUNDING = 1e-9  # of a pole that was put on the radius
MIN_ROWS_PER_PARAMETER = 5  # fewer and the fit is an interpolation, not an estimate
RANK_TOLERANCE = 1e-10  # relative singular value below which a regressor repeats the others


@dataclass(frozen=True)
class LinearClass:
    """Linear difference equations of one input and one output. Source: thesis (4.1).

    lags: n of both, 1 to 100 samples. Raises OptionError, which names an option, its value and
    what is allowed, as every model class does.
    """

    lags: int
    kind: ClassVar[type[DifferenceEquation]] = DifferenceEquation

    def __post_init__(self) -> None:
        require_whole(self, "lags", 1, MOST_LAGS)


@dataclass(frozen=True, eq=False)
class Regression:
    """Rows t = n … of every trial: g_0 y(t) + … + g_n y(t-n) = b_0 u(t) + … + b_n u(t-n) + c.

    Signals are scaled to zero mean and unit spread over the dataset, undone once in `model`.
    Y: (N, n+1) with y(t-k) in column k; W: (N, n+2), the input window and a constant, as
    W = Q R with orthonormal Q; row: (N,) index of the row within its trial.
    """

    Y: FloatArray
    Q: FloatArray
    R: FloatArray
    row: FloatArray
    y_scale: tuple[float, float]
    u_scale: tuple[float, float]
    dataset: Dataset

    @cached_property
    def rows(self) -> Rows:
        """The same rows for the robust simulation error."""
        inside = [self.row >= k for k in range(self.lags + 1)]
        return Rows(
            offsets=tuple(range(self.lags + 1)),
            weights=np.asfortranarray(np.column_stack(inside).astype(np.float64)),
            errors=np.asfortranarray(self.Y),
            Q=np.asfortranarray(self.Q),
            identity=np.eye(self.lags + 1)[0],
        )

    @property
    def lags(self) -> int:
        """The number of lags n."""
        return int(self.Y.shape[1]) - 1

    def model(self, g: FloatArray, p: FloatArray) -> DifferenceEquation:
        """The model, in the signals' own units, of g (n+1,) and p (n+2,) with Y g = Q p."""
        (y_mean, y_std), (u_mean, u_std) = self.y_scale, self.u_scale
        window = np.linalg.solve(self.R, p) / g[0]
        a = -g[1:] / g[0]
        b = window[:-1] * y_std / u_std
        c = window[-1] * y_std + y_mean * (1.0 - a.sum()) - u_mean * b.sum()
        first = self.dataset.trajectories[0]
        inputs = np.concatenate([trial.u[:, 0] for trial in self.dataset])
        return DifferenceEquation(
            a=a,
            b=b,
            c=float(c),
            period=self.dataset.period,
            y=signals_of(first, "y")[0],
            u=signals_of(first, "u")[0],
            u_range=(float(inputs.min()), float(inputs.max())),
            bags=self.dataset.bags,
        )


def build_regression(dataset: Dataset, lags: int) -> Regression:
    """Stack the lagged rows of every trial of a one-input one-output dataset.

    Raises ShapeError if there is more than one input or output, DataError if there are too few
    rows or the input does not excite the model (rank-deficient window).
    """
    first = dataset.trajectories[0]
    if first.y.shape[1] != 1 or first.u.shape[1] != 1:
        raise ShapeError(
            f"a linear model has one output and one input; there are {first.y.shape[1]} and "
            f"{first.u.shape[1]}; state_affine and linear_states are for several"
        )
    short = [trial for trial in dataset if len(trial) <= lags]
    if short:
        raise DataError(f"{short[0].name}: {len(short[0])} samples, {lags} lags need more")
    rows = sum(len(trial) - lags for trial in dataset)
    parameters = 2 * lags + 2
    if rows < MIN_ROWS_PER_PARAMETER * parameters:
        raise DataError(
            f"{rows} rows for {parameters} parameters; give at least "
            f"{MIN_ROWS_PER_PARAMETER * parameters} or fewer lags than {lags}"
        )
    y_scale = _scalars(signal_scale(dataset, "y"))
    u_scale = _scalars(signal_scale(dataset, "u"))
    outputs, windows, row = [], [], []
    for trial in dataset:
        outputs.append(lagged((trial.y - y_scale[0]) / y_scale[1], lags)[:, :, 0])
        windows.append(lagged((trial.u - u_scale[0]) / u_scale[1], lags)[:, :, 0])
        row.append(np.arange(len(trial) - lags))
    W = np.concatenate(windows)
    Q, R = np.linalg.qr(np.column_stack([W, np.ones(len(W))]))
    singular = np.linalg.svd(R, compute_uv=False)
    if singular[-1] < RANK_TOLERANCE * singular[0]:
        rank = int((singular > RANK_TOLERANCE * singular[0]).sum()) - 1
        raise DataError(
            f"the excitation does not excite {lags} lags: its window of {lags + 1} samples has "
            f"rank {rank}; use richer inputs, fewer lags, or the class state_affine with fewer "
            "delays of the input, such as `delays: [1]`"
        )
    return Regression(
        Y=np.concatenate(outputs),
        Q=Q,
        R=R,
        row=np.concatenate(row),
        y_scale=y_scale,
        u_scale=u_scale,
        dataset=dataset,
    )


def least_squares(regression: Regression) -> DifferenceEquation:
    """Minimise Σ (y(t) - Σ a_k y(t-k) - Σ b_j u(t-j) - c)².

    Source: thesis Section 3.2 (equation error).
    """
    lags = regression.lags
    columns = np.column_stack([regression.Y[:, 1:], regression.Q])
    theta = np.linalg.lstsq(columns, regression.Y[:, 0], rcond=None)[0]
    return regression.model(np.concatenate([[1.0], -theta[:lags]]), theta[lags:])


def minimise_simulation_error(
    regression: Regression,
    start: DifferenceEquation,
    *,
    stable: bool = False,
    radius: float = SLOWEST_POLE,
) -> DifferenceEquation:
    """A local minimum of Σ (y - ŷ)² from `start`'s lagged coefficients, never above it.

    stable: search among stable models only, their poles within `radius`, for a `start` that has a
    proof and is one of them; the result has one too, or is `start` itself. Otherwise nothing keeps
    the model stable.
    """
    inside = partial(_is_stable, radius=min(radius, SLOWEST_POLE)) if stable else None
    theta = np.concatenate([[1.0], -start.a])
    objective = SimulationError(regression.rows, inside=inside)
    point = Descent(objective, (), len(theta)).to_minimum(theta).point
    found = regression.model(point.theta, point.p)
    return start if stable and prove_stability(found) is None else found


def _is_stable(theta: FloatArray, radius: float) -> bool:
    """Every pole of g_0 y(t) + … + g_n y(t-n) is within the radius, up to rounding."""
    return bool(theta[0] and (abs(np.roots(theta)) <= radius + POLE_ROUNDING).all())


def _scalars(scale: tuple[FloatArray, FloatArray]) -> tuple[float, float]:
    mean, spread = scale
    return float(mean[0]), float(spread[0])
