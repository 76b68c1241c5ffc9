"""Implicit models simulated over whole trials: the equations of all samples solved together.

Stacked over every sample of every trial, 0 = h(y(t), [y(t-1); …; y(t-n)], w(t)) is one system in
all outputs, with a banded, block lower triangular Jacobian. Newton's method starts from the
measured outputs and takes a few steps, each a handful of array operations and one triangular solve;
a model that forgets its start is solved in fewer than ten. Where it does not settle, the samples
are stepped one after the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError
from scipy.linalg.lapack import dtbtrs

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.errors import SolverError
from nlsid_core.models import ImplicitModel
from nlsid_core.models.implicit_step import SingleStep
from nlsid_core.polynomial.values import monomial_values

NEWTON_STEPS = 40
DIVERGED = 1e30  # a state whose powers would overflow
SETTLED = 1e-12  # step relative to the largest output at which the outputs are found


@dataclass(frozen=True, eq=False)
class Linearised:
    """The system's Jacobian: unit diagonal after multiplying every sample's rows by `inverse`.

    band: (bandwidth + 1, N n_v) as LAPACK stores a lower band; inverse: (N, n_v, n_v).
    """

    band: FloatArray
    inverse: FloatArray

    def solve(self, B: FloatArray) -> FloatArray:
        """J⁻¹B for right sides B (N, n_v, m)."""
        columns = np.asfortranarray((self.inverse @ B).reshape(-1, B.shape[2]))
        solved, info = dtbtrs(self.band, columns, uplo="L", diag="U", overwrite_b=True)
        if info != 0:
            raise LinAlgError(f"triangular solve failed ({info})")
        return np.asarray(solved).reshape(B.shape)


class Rollout:
    """All samples of some trials as one system in the outputs y (N, n_v).

    The first `history` samples of a trial are given. exponents: of h, (m, n_v + n + inputs);
    coefficients: (m, n_v).
    """

    def __init__(self, model: ImplicitModel, trials: Sequence[Trajectory]) -> None:
        self.model, self.lags, self.unknowns = model, model.lags, model.unknowns
        h = model.history
        self.measured = np.concatenate([trial.y for trial in trials])
        self.ends = np.cumsum([0, *map(len, trials)])
        self.free = np.ones(len(self.measured), dtype=bool)
        w = np.zeros((len(self.measured), len(model.inputs)))
        for begin, end, trial in zip(self.ends, self.ends[1:], trials, strict=False):
            self.free[begin : begin + h] = False
            w[begin + h : end] = model.windows(trial.u)
        self.w, of_states = w, model.h.exponents[:, : self.unknowns * (self.lags + 1)]
        self.powers, self._place = np.unique(of_states, axis=0, return_inverse=True)
        self._of_w = monomial_values(model.h.exponents[:, of_states.shape[1] :], w)

    def weights(self, coefficients: FloatArray) -> FloatArray:
        """(N or 1, groups, n_v): the factors of the monomials in the outputs at every sample."""
        exponents = self.model.h.exponents[:, self.powers.shape[1] :]
        varying = np.asarray(exponents.any(axis=1))
        N = len(self.w) if varying.any() else 1
        found = np.zeros((N, len(self.powers), self.unknowns))
        place = self._place.ravel()
        for k, c in enumerate(coefficients):
            values = self._of_w[:N, k, None] if varying[k] else 1.0
            found[:, place[k]] += values * c
        return found

    def monomials(self, y: FloatArray) -> FloatArray:
        """(N, m): the values of h's monomials along outputs y, zero where outputs are given."""
        grouped = np.column_stack([_product(self.lagged(y), row) for row in self.powers.tolist()])
        return np.asarray(grouped[:, self._place.ravel()] * self._of_w * self.free[:, None])

    def lagged(self, y: FloatArray) -> list[FloatArray]:
        """Columns y(t), y(t-1), … (N,) of every output; nothing before the first sample."""
        columns = []
        for k in range(self.lags + 1):
            moved = np.zeros_like(y)
            moved[k:] = y[: len(y) - k]
            columns += [moved[:, i] for i in range(self.unknowns)]
        return columns

    def residual(self, y: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """h (N, n_v) and its derivatives (N, n_v, n_v (lags + 1)) in the lagged outputs."""
        columns = self.lagged(y)
        h = np.zeros_like(y)
        slopes = np.zeros((len(y), self.unknowns, len(columns)))
        for j, row in enumerate(self.powers.tolist()):
            weight = weights[:, j]
            h += weight * _product(columns, row)[:, None]
            for k, power in enumerate(row):
                if power:
                    lower = [p - (i == k) for i, p in enumerate(row)]
                    slopes[:, :, k] += weight * (power * _product(columns, lower))[:, None]
        h[~self.free] = 0.0
        return h, slopes

    def linearised(self, slopes: FloatArray) -> Linearised:
        """The system's Jacobian; LinAlgError where an equation does not determine its output."""
        p, N = self.unknowns, len(self.free)
        lead = slopes[:, :, :p].copy()
        lead[~self.free] = np.eye(p)
        inverse = np.linalg.inv(lead) if p > 1 else 1.0 / lead
        band = np.zeros((p * (self.lags + 1), N * p), order="F")
        band[0] = 1.0
        for k in range(1, self.lags + 1):
            block = inverse @ slopes[:, :, k * p : (k + 1) * p]
            block[~self.free] = 0.0
            for i in range(p):
                for j in range(p):
                    band[k * p + i - j, j : (N - k) * p : p] = block[k:, i, j]
        return Linearised(band, inverse)

    def solved(self, coefficients: FloatArray) -> tuple[FloatArray, Linearised] | None:
        """Outputs (N, n_v) with h = 0, and the Jacobian there; None if Newton does not settle."""
        y, weights = self.measured.copy(), self.weights(coefficients)
        with np.errstate(all="ignore"):
            for _ in range(NEWTON_STEPS):
                h, slopes = self.residual(y, weights)
                try:
                    jacobian = self.linearised(slopes)
                except LinAlgError:
                    return None
                step = jacobian.solve(h[:, :, None])[:, :, 0]
                y -= step
                size = float(np.abs(step).max(initial=0.0))
                if not np.isfinite(size):
                    return None
                if size <= SETTLED * float(np.abs(y).max(initial=0.0)):
                    return y, jacobian
        return None


def simulate_together(model: ImplicitModel, trials: Sequence[Trajectory]) -> list[FloatArray]:
    """Outputs (N, n_v) of every trial, the first `history` of each as measured.

    Infinite from where a model without proof diverges.
    """
    if _is_delayed(model):
        found = Rollout(model, trials).solved(model.h.coefficients)
        if found is not None and np.abs(found[0]).max() < DIVERGED:
            return np.split(found[0], np.cumsum([len(trial) for trial in trials])[:-1])
    return [_stepped(model, trial) for trial in trials]


def _stepped(model: ImplicitModel, trial: Trajectory) -> FloatArray:
    """One sample after the other."""
    h, n_v = model.history, model.unknowns
    outputs = np.full((len(trial), n_v), np.inf)
    outputs[:h] = trial.y[:h]
    step, x = SingleStep(model), trial.y[:h][: -model.lags - 1 : -1].reshape(1, -1)
    for t, w in enumerate(model.windows(trial.u), h):
        try:
            x = step(x, w)
        except SolverError:
            break
        if not np.abs(x).max() < DIVERGED:
            break
        outputs[t] = x[0, :n_v]
    return outputs


def _is_delayed(model: ImplicitModel) -> bool:
    """ã is the first states, as seen at a random point: x stacks the past outputs."""
    known = np.random.default_rng(0).standard_normal((1, len(model) + len(model.inputs)))
    return np.array_equal(model.shift(known), known[:, : len(model) - model.unknowns])


def _product(columns: Sequence[FloatArray], powers: Sequence[int]) -> FloatArray:
    """Π columns_i^powers_i."""
    result: FloatArray | None = None
    for column, power in zip(columns, powers, strict=True):
        for _ in range(power):
            result = column if result is None else result * column
    return np.ones_like(columns[0]) if result is None else result
