"""Simulation of any identified model, and its prediction of one step, trial by trial."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.identification.polynomial.rollout import simulate_together
from nlsid_core.models import (
    BlockCascade,
    CellNetwork,
    DifferenceEquation,
    ImplicitModel,
    MonotoneEquation,
    Polynomials,
    StableModel,
    StateAffineModel,
)
from nlsid_core.models.monotone_equation import solve_increasing
from nlsid_core.models.starts import nearest_start

Model = StableModel
Explicit = DifferenceEquation | StateAffineModel | MonotoneEquation | BlockCascade | CellNetwork


def history(model: Model) -> int:
    """How many measured samples start a simulation: a block cascade's second filter, a network's
    hidden states.
    """
    if isinstance(model, BlockCascade):
        return len(model.a2)
    if isinstance(model, CellNetwork):
        return model.start_samples
    return model.history if isinstance(model, MonotoneEquation | ImplicitModel) else len(model)


def learns(model: Model) -> bool:
    """Whether outputs after the first n change what the model predicts.

    Not of a block cascade or a network: their noise is that of the measurement.
    """
    return not isinstance(model, BlockCascade | CellNetwork)


def simulate_trial(model: Model, trial: Trajectory) -> FloatArray:
    """(N, n_y) outputs, from the first measured outputs with the recorded inputs.

    The input of a block cascade's first filter is held at its first value before the trial.
    """
    return simulate_trials(model, [trial])[0]


def _simulated(model: Explicit, start: FloatArray, u: FloatArray) -> FloatArray:
    """(N, n_y) outputs from the first ones (n, n_y)."""
    if isinstance(model, StateAffineModel | CellNetwork):
        return model.simulate(u, start)
    inputs = u if isinstance(model, MonotoneEquation) else u[:, 0]
    return model.simulate(inputs, start[:, 0])[:, None]


def simulate_started(model: Model, trials: Sequence[Trajectory], samples: int) -> list[FloatArray]:
    """`simulate_trials` from the starts that are nearest to the first samples of the trials."""
    n = history(model)
    if isinstance(model, CellNetwork):
        return [model.simulate(trial.u, trial.y[: samples or n]) for trial in trials]
    if samples <= n:
        return simulate_trials(model, trials)

    def begun(trial: Trajectory) -> Trajectory:
        beginning = trial.rows(slice(samples))

        def simulated(starts: FloatArray) -> FloatArray:
            if isinstance(model, ImplicitModel):
                return np.stack(simulate_together(model, [_from(s, beginning) for s in starts]))
            return np.stack([_simulated(model, start, beginning.u) for start in starts])

        return _from(nearest_start(simulated, beginning.y, n), trial)

    return simulate_trials(model, [begun(trial) for trial in trials])


def _from(start: FloatArray, trial: Trajectory) -> Trajectory:
    """The trial with other first outputs (n, p)."""
    return replace(trial, y=np.concatenate([start, trial.y[len(start) :]]))


def simulate_trials(model: Model, trials: Sequence[Trajectory]) -> list[FloatArray]:
    """`simulate_trial` of each; implicit models solve all trials together."""
    if isinstance(model, ImplicitModel):
        return simulate_together(model, trials)
    n = history(model)
    return [_simulated(model, trial.y[:n], trial.u) for trial in trials]


def one_step_residual(model: Model, trial: Trajectory) -> FloatArray:
    """(N - n, n_y): y(t) minus its prediction from the measurements before it, n the history.

    A model that does not learn (`learns`) predicts what it simulates.
    """
    n = history(model)
    measured = trial.y[n:]
    if isinstance(model, BlockCascade | CellNetwork):  # those that do not learn
        return np.asarray(measured - simulate_trial(model, trial)[n:])
    lags = model.lags if isinstance(model, ImplicitModel) else len(model)
    past = [trial.y[n - k : len(trial) - k] for k in range(1, lags + 1)]
    if isinstance(model, MonotoneEquation):
        return np.asarray(measured - _monotone_step(model, trial, past))
    stacked = np.concatenate(past, axis=1)
    if isinstance(model, ImplicitModel):
        predicted = model.step(stacked, model.windows(trial.u))
        return np.asarray(measured - predicted[:, : model.unknowns])
    gains, forcing = _explicit(model, trial)
    return np.asarray(measured - np.einsum("tij,tj->ti", gains, stacked) - forcing)


def _explicit(
    model: DifferenceEquation | StateAffineModel, trial: Trajectory
) -> tuple[FloatArray, FloatArray]:
    """y(t) = gains(t) [y(t-1); …; y(t-n)] + forcing(t) in the outputs' units, t = n …."""
    form = as_state_affine(model) if isinstance(model, DifferenceEquation) else model
    gains, forcing = form.explicit(form.windows(trial.u))
    scale, offset, n = form.y_scale, form.y_offset, len(form)
    gains = gains * scale[:, None] / np.tile(scale, n)
    return gains, forcing * scale + offset - gains @ np.tile(offset, n)


def as_state_affine(model: DifferenceEquation) -> StateAffineModel:
    """The same equation, 0 = y(t) - Σ a_k y(t-k) - Σ b_j u(t-j) - c."""
    n, constant = len(model), np.zeros((1, len(model) + 1), dtype=np.int64)
    largest = np.finfo(np.float64).max
    right = -np.append(model.b, model.c)[:, None]
    return StateAffineModel(
        G=tuple(Polynomials(constant, np.full((1, 1, 1), g)) for g in (1.0, *-model.a)),
        p=Polynomials(np.eye(n + 2, n + 1, dtype=np.int64), right),
        window=tuple((0, delay) for delay in range(n + 1)),
        y_offset=np.zeros(1),
        y_scale=np.ones(1),
        u_offset=np.zeros(1),
        u_scale=np.ones(1),
        u_range=np.array([[-largest, largest]]),
        y=(model.y,),
        u=(model.u,),
        period=model.period,
    )


def _monotone_step(
    model: MonotoneEquation, trial: Trajectory, past: Sequence[FloatArray]
) -> FloatArray:
    """The outputs (T, 1) that solve the equation, from the outputs before them."""
    target = model.forcing(trial.u) + sum(
        a * (y[:, 0] - model.y_offset) for a, y in zip(model.a, past, strict=True)
    )
    pairs = zip(target.tolist(), past[0][:, 0].tolist(), strict=True)
    e = tuple(model.e.tolist())
    found = [solve_increasing(e, value, guess - model.y_offset) for value, guess in pairs]
    return np.array(found)[:, None] + model.y_offset
