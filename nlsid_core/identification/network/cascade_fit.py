"""Least squares on the simulation error of a block cascade: exact sensitivities, damped steps.

With r = ŷ - y and J = ∂ŷ/∂θ, minimise mean(r²) + smoothing·Σ(second differences of f)² by
Levenberg-Marquardt steps (J'J + λ diag(J'J))δ = -J'r; steps to unstable filters are rejected.
A trial begins at rest, or in motion: the input held at its first value before, the second filter's
state from the first n₂ measured outputs, as `BlockCascade.simulate` does; its sensitivities too.
Source: Marquardt 1963; the sensitivities are those of linear filters, each a filter itself.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from nlsid_core.arrays import FloatArray
from nlsid_core.identification.methods.damped import descend
from nlsid_core.models import Spline

FIRST_DAMPING, PATIENCE = 1e-1, 3
MAX_RADIUS = 1.0 - 1e-6  # of the poles: beyond it a step is refused


@dataclass(frozen=True, eq=False)
class Trial:
    """One record, scaled: u, y (N,). The first `transient` samples are simulated, not scored.

    from_rest: no input before the first sample; else it was held, and y starts as measured.
    """

    u: FloatArray
    y: FloatArray
    transient: int
    from_rest: bool


@dataclass(frozen=True, eq=False)
class Parameters:
    """The numbers of a `BlockCascade`, in the scaled units of its trials."""

    a1: FloatArray
    b1: FloatArray
    f: Spline
    a2: FloatArray
    b2: FloatArray

    def vector(self) -> FloatArray:
        """θ = [a1, b1, a2, b2, coefficients of f]."""
        parts = (self.a1, self.b1.ravel(), self.a2, self.b2.ravel(), self.f.coefficients)
        return np.concatenate(parts)

    def moved(self, step: FloatArray) -> "Parameters":
        """The parameters of θ + step."""
        theta, start, parts = self.vector() + step, 0, []
        for part in (self.a1, self.b1, self.a2, self.b2):
            parts.append(theta[start : start + part.size].reshape(part.shape))
            start += part.size
        a1, b1, a2, b2 = parts
        return Parameters(a1, b1, replace(self.f, coefficients=theta[start:]), a2, b2)

    @property
    def radius(self) -> float:
        """The largest pole radius of the two filters."""
        roots = [np.roots(np.concatenate([[1.0], -a])) for a in (self.a1, self.a2)]
        return float(np.abs(np.concatenate([[0.0], *roots])).max())


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where the steps ended: parameters, mean squared residual without penalty, steps taken."""

    parameters: Parameters
    cost: float
    steps: int


def minimise(
    trials: tuple[Trial, ...],
    start: Parameters,
    *,
    smoothing: float,
    steps: int,
    tolerance: float,
    radius: float = MAX_RADIUS,
) -> Minimum:
    """Damped Gauss-Newton from `start` until steps gain less than `tolerance` of the cost.

    radius: of the poles, at most; those of `start` are within it.
    """
    D, begin = _second_differences(start), start.vector()
    weight = smoothing / float(np.ptp(start.f.coefficients) ** 2 + np.finfo(float).tiny)

    def at(theta: FloatArray) -> Parameters:
        return start.moved(theta - begin)

    def cost(theta: FloatArray) -> float:
        here = at(theta)
        if theta is not begin and here.radius >= radius:
            return float("inf")
        bend = D @ theta
        return _mean_square(_residual(trials, here)) + weight * float(bend @ bend)

    def normal(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        here = at(theta)
        residual = _residual(trials, here)
        J = np.concatenate([sensitivities(trial, here) for trial in trials], axis=1)
        gradient = J @ residual / len(residual) + weight * (D.T @ (D @ theta))
        return J @ J.T / len(residual) + weight * (D.T @ D), gradient

    theta, _, taken = descend(
        begin,
        cost,
        normal,
        steps=steps,
        tolerance=tolerance,
        damping=FIRST_DAMPING,
        patience=PATIENCE,
    )
    found = at(theta)
    return Minimum(found, _mean_square(_residual(trials, found)), taken)


def simulate(parameters: Parameters, trial: Trial) -> FloatArray:
    """Outputs (N,), as `BlockCascade.simulate` and faster."""
    forcing, A2 = np.zeros(len(trial.u)), _monic(parameters.a2)
    for x, b2 in zip(second_inputs(parameters, trial), parameters.b2, strict=True):
        forcing += filtered(b2, np.ones(1), parameters.f(x), trial)
    if n := 0 if trial.from_rest else len(parameters.a2):
        forcing[:n] = lfilter(A2, [1.0], trial.y[:n])  # what makes them the first outputs
    outputs: FloatArray = lfilter([1.0], A2, forcing)
    return outputs


def filtered(b: FloatArray, A: FloatArray, signal: FloatArray, trial: Trial) -> FloatArray:
    """(…, N): b/A of signal (…, N), before its first sample zero or held as the trial's input."""
    if trial.from_rest:
        return np.asarray(lfilter(b, A, signal))
    before = signal[..., :1]
    return np.asarray(lfilter(b, A, signal - before) + before * (np.sum(b) / np.sum(A)))


def output_of(b: FloatArray, a: FloatArray, signal: FloatArray, trial: Trial) -> FloatArray:
    """(…, N): the output's part of what passes b/A, zero where outputs are given: see `simulate`.

    Linear in the signal; `simulate` adds what the given outputs leave behind.
    """
    if trial.from_rest:
        return np.asarray(lfilter(b, _monic(a), signal))
    forcing = filtered(b, np.ones(1), signal, trial)
    forcing[..., : len(a)] = 0.0
    return np.asarray(lfilter([1.0], _monic(a), forcing))


def second_inputs(parameters: Parameters, trial: Trial) -> FloatArray:
    """(M, N): x_j, what each phase of f sees."""
    A1 = _monic(parameters.a1)
    return np.array([filtered(b1, A1, trial.u, trial) for b1 in parameters.b1])


def basis_responses(parameters: Parameters, x: FloatArray, trial: Trial) -> FloatArray:
    """(K + 3, N): the output's part of each coefficient of f, for x (M, N)."""
    rows = np.arange(x.shape[1])
    responses = np.zeros((len(parameters.f.coefficients), x.shape[1]))
    for x_j, b2 in zip(x, parameters.b2, strict=True):
        index, weights = parameters.f.weights(x_j)
        basis = np.zeros_like(responses)
        for r in range(4):
            basis[index + r, rows] = weights[r]
        responses += output_of(b2, parameters.a2, basis, trial)
    return responses


def _residual(trials: tuple[Trial, ...], parameters: Parameters) -> FloatArray:
    parts = [simulate(parameters, t)[t.transient :] - t.y[t.transient :] for t in trials]
    return np.concatenate(parts)


def _mean_square(residual: FloatArray) -> float:
    return float(residual @ residual) / len(residual)


def sensitivities(trial: Trial, parameters: Parameters) -> FloatArray:
    """(number of parameters, N - transient): ∂ŷ/∂θ, rows in the order of `Parameters.vector`."""
    p = parameters
    N, A1, one = len(trial.u), _monic(p.a1), np.ones(1)
    x, y = second_inputs(p, trial), simulate(p, trial)
    u_filtered = filtered(one, A1, trial.u, trial)
    n1, m1, n2, m2, M = len(p.a1), p.b1.shape[1], len(p.a2), p.b2.shape[1], len(p.b1)
    J = np.zeros((p.vector().size, N))
    at_b1, at_a2 = n1, n1 + M * m1
    at_b2, at_c = at_a2 + n2, at_a2 + n2 + M * m2
    for j in range(M):
        slope = p.f.slope(x[j])
        # ∂x/∂b1[i] and ∂x/∂a1[k] are u and x, delayed and filtered by 1/A1.
        for i in range(m1):
            J[at_b1 + j * m1 + i] = output_of(
                p.b2[j], p.a2, slope * delayed(u_filtered, i, trial), trial
            )
        x_filtered = filtered(one, A1, x[j], trial)
        for k in range(n1):
            J[k] += output_of(p.b2[j], p.a2, slope * delayed(x_filtered, k + 1, trial), trial)
        w = p.f(x[j])
        for i in range(m2):
            J[at_b2 + j * m2 + i] = output_of(one, p.a2, delayed(w, i, trial), trial)
    for k in range(n2):
        J[at_a2 + k] = output_of(one, p.a2, delayed(y, k + 1, trial), trial)
    J[at_c:] = basis_responses(p, x, trial)
    return J[:, trial.transient :]


def delayed(signal: FloatArray, samples: int, trial: Trial) -> FloatArray:
    """(N,): signal(t - samples), before its first sample zero or held as the trial's input."""
    moved = np.full_like(signal, 0.0 if trial.from_rest else signal[0])
    moved[samples:] = signal[: len(signal) - samples]
    return moved


def _monic(a: FloatArray) -> FloatArray:
    return np.concatenate([[1.0], -a])


def _second_differences(parameters: Parameters) -> FloatArray:
    """(K + 1, number of parameters): second differences of the coefficients of f."""
    K = parameters.f.intervals
    D = np.zeros((K + 1, parameters.vector().size))
    D[:, -(K + 3) :] = np.diff(np.eye(K + 3), n=2, axis=0)
    return D
