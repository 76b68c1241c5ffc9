"""Signals in a row as a `CellNetwork`, in recorded signals: where scaling is undone.

A signal s(t) = Σ_k w_k r(t - k) has the states x_j(t+1) = x_{j+1}(t) + w_j r(t), s = x_1 + w_0 r.
The states are written in units in which those along the trials are white and, beside a start's
error of the model's own, as certain as `CellNetwork.start_from` takes them to be.
"""

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.identification.network.fit import Minimum, Scaled
from nlsid_core.identification.network.maps import as_piecewise_linear
from nlsid_core.identification.network.signals import Mapped, Signal, Signals, Trial, passed
from nlsid_core.models import CellNetwork, signals_of
from nlsid_core.models.cell_network import PRIOR

SMALLEST = 1e-3  # rms error in spreads of y, below which a start is not trusted


def network_of(
    signals: Signals, found: Minimum, scaled: Scaled, train: Dataset, start_samples: int
) -> CellNetwork:
    """The network of these signals, with states as they are along the minimum's trials.

    Its usual start is the mean of the states that these trials begin with.
    """
    theta = found.parameters
    into, after, y = _rows(signals, theta)
    m, size = len(into), len(after)
    along = [_states(signals, theta, trial) for trial in found.trials]
    x, begun = np.concatenate(along), np.mean([states[0] for states in along], axis=0)
    middle, spread = x.mean(axis=0), x.std(axis=0)
    C = (
        np.cov((x - middle).T).reshape(size, size)
        + 1e-9 * np.diag(spread**2)
        + 1e-12 * np.eye(size)
    )
    T = cholesky(C, lower=True) * min(1.0, PRIOR / max(found.rms, SMALLEST))
    inside = slice(m, m + size)

    def recorded(rows: FloatArray) -> FloatArray:
        """In the new states, x = middle + T x', and of recorded inputs."""
        moved = rows.copy()
        moved[:, inside] = rows[:, inside] @ T
        moved[:, m + size : -1] /= scaled.u[1]
        moved[:, -1] += rows[:, inside] @ middle - moved[:, m + size : -1] @ scaled.u[0]
        return moved

    following = recorded(after)
    following[:, -1] -= middle
    output = scaled.y[1] * recorded(y[None])
    output[:, -1] += scaled.y[0]
    first = train.trajectories[0]
    return CellNetwork(
        maps=tuple(
            as_piecewise_linear(node.function, theta[node.at])
            for node in signals.nodes
            if isinstance(node, Mapped)
        ),
        into=recorded(into),
        next=solve_triangular(T, following, lower=True),
        output=output,
        start=solve_triangular(T, begun - middle, lower=True),
        start_samples=start_samples,
        period=train.period,
        y=signals_of(first, "y"),
        u=signals_of(first, "u"),
        bags=train.bags,
    )


def _depth(signal: Signal, theta: FloatArray) -> int:
    """How many states a signal has: its longest delay."""
    return max(k for part in signal.taps for k, _ in part.weights(theta))


def _rows(signals: Signals, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What goes into every map, the next states, and y: rows of [maps; states; u; 1]."""
    depths = [_depth(node, theta) for node in signals.nodes if isinstance(node, Signal)]
    m, size = len(signals.nodes) - len(depths), sum(depths)
    unit = np.eye(m + size + signals.inputs + 1)
    sources: list[FloatArray] = list(unit[m + size :])
    into: list[FloatArray] = []
    after: list[FloatArray] = []
    first = m
    for node in signals.nodes:
        if isinstance(node, Mapped):
            sources.append(unit[len(into)])
            into.append(sources[node.source])
        else:
            depth = _depth(node, theta)
            own = unit[first : first + min(depth, 1)].sum(axis=0)  # none of a signal without past
            sources.append(own + _at_delay(0, node, theta, sources))
            first += depth
    first = m
    for node in signals.nodes:
        if isinstance(node, Signal):
            depth = _depth(node, theta)
            for j in range(1, depth + 1):
                shifted = unit[first + j] if j < depth else np.zeros(len(unit))
                after.append(shifted + _at_delay(j, node, theta, sources))
            first += depth
    return np.array(into), np.array(after), sources[signals.output]


def _at_delay(
    delay: int, signal: Signal, theta: FloatArray, sources: list[FloatArray]
) -> FloatArray:
    """Σ w r of the taps with this delay."""
    total: FloatArray = np.zeros(len(sources[0]))
    for part in signal.taps:
        for k, weight in part.weights(theta):
            if k == delay:
                total = total + weight * sources[part.source]
    return total


def _states(signals: Signals, theta: FloatArray, trial: Trial) -> FloatArray:
    """The states of all signals along a trial, (samples, states)."""
    sources, columns, given = signals.run(theta, trial), [], 0
    for node in signals.nodes:
        if isinstance(node, Signal):
            depth, given = _depth(node, theta), max(given, node.given)
            for j in range(1, depth + 1):
                column = np.zeros(len(trial.u))
                for part in node.taps:
                    late = [(k - j + 1, w) for k, w in part.weights(theta) if k >= j]
                    column += passed(late, sources[part.source], trial)
                columns.append(column)
    return np.array(columns).T[given:]
