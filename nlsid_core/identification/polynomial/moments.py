"""Moments of the noise-free signals behind two noisy repeats of one experiment.

Λ = [y, y², y³, 1, y(t-1) … y(t-n), w], y = y(t): all monomials of e(y) - f(x, w). What is wanted is
M = (1/T) Σ ΛΛ' of signals nobody measured. With y_i = y + noise_i, noise_i of zero mean and
independent of the signals and of the other run, averages over both runs in both roles satisfy
    avg(y_iᵃ χ_j) = Σ_b C(a, b) μ(yᵃ⁻ᵇ χ) ν(b),    avg(y_iᵃ) = Σ_b C(a, b) μ(yᵃ⁻ᵇ) ν(b)
for χ one of y, 1, y(t-k), w: solved in turn for the moments μ of the signal and ν of the noise.
Source: Hausman, Newey, Ichimura and Powell 1991; thesis Lemma 3.12 and its proof.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import combinations
from math import comb
from operator import add

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.identification.polynomial.options import Polynomial


@dataclass(frozen=True, eq=False)
class Moments:
    """Sums over rows, which add over bags: count; powers, crossed (orders of a) Σ y_iᵃ, Σ y_iᵃ y_j;
    mixed (D+1, m) Σ y_iᵃ χ_j, χ = [y(t-1) … y(t-n), w]; products (m, m) Σ χ_i χ_j'.

    D is the degree of e; a = 0 … max(2D - 1, 2). Sums of one run with itself (i = j) are the
    moments with their bias.
    """

    count: int
    powers: FloatArray
    crossed: FloatArray
    mixed: FloatArray
    products: FloatArray

    def __add__(self, other: "Moments") -> "Moments":
        """Sums of both; exact for repeats of several excitations if the noise is the same."""
        return Moments(
            self.count + other.count,
            self.powers + other.powers,
            self.crossed + other.crossed,
            self.mixed + other.mixed,
            self.products + other.products,
        )

    @property
    def degree(self) -> int:
        """The degree of e."""
        return len(self.mixed) - 1

    def noise(self) -> FloatArray:
        """ν, from order 0: estimated moments of the noise; ν[2] is its variance."""
        return self._recursion()[1]

    def matrix(self) -> FloatArray:
        """(D + 1 + m, D + 1 + m) M̂ in the order of Λ; symmetric, not projected."""
        D, m = self.degree, self.mixed.shape[1]
        mu, nu = self._recursion()
        mixed = self.mixed / self.count
        signal = np.zeros_like(mixed)  # μ(yᵃ χ)
        for a in range(D + 1):
            known = sum(comb(a, b) * nu[b] * signal[a - b] for b in range(1, a + 1))
            signal[a] = mixed[a] - known
        order = [*range(1, D + 1), 0]  # y, y², y³, 1
        M = np.zeros((D + 1 + m, D + 1 + m))
        M[: D + 1, : D + 1] = mu[np.add.outer(order, order)]
        M[: D + 1, D + 1 :] = signal[order]
        M[D + 1 :, : D + 1] = signal[order].T
        M[D + 1 :, D + 1 :] = (self.products + self.products.T) / (2.0 * self.count)
        return M

    def _recursion(self) -> tuple[FloatArray, FloatArray]:
        """μ and ν of y, from order 0; one order more of μ."""
        top = len(self.powers)
        powers, crossed = self.powers / self.count, self.crossed / self.count
        mu, nu = np.zeros(top + 1), np.zeros(top)
        mu[0] = nu[0] = 1.0
        for a in range(1, top + 1):
            known = sum(comb(a - 1, b) * nu[b] * mu[a - b] for b in range(1, a))
            mu[a] = crossed[a - 1] - known
            if a < top:
                nu[a] = powers[a] - sum(comb(a, b) * nu[b] * mu[a - b] for b in range(a))
        return mu, nu


@dataclass(frozen=True, eq=False)
class Offsets:
    """What is subtracted from y (a number) and from u (n_u,) before moments are taken."""

    y: float
    u: FloatArray


def offsets_of(trials: Sequence[Trajectory]) -> Offsets:
    """Means over all samples of all trials. Raises ShapeError for several outputs."""
    if not trials:
        raise DataError("no trials to take moments of")
    if any(t.y.shape[1] != 1 for t in trials):
        raise ShapeError("moments are taken of one output")
    return Offsets(
        float(np.mean(np.concatenate([t.y[:, 0] for t in trials]))),
        np.mean(np.concatenate([t.u for t in trials]), axis=0),
    )


def repeated_moments(
    groups: Sequence[Sequence[Trajectory]],
    model_class: Polynomial,
    offsets: Offsets,
) -> Moments:
    """Moments without the bias of noise, from groups of repeats: every pair, in both roles.

    Raises DataError if a group has fewer than two trials or trials are too short.
    """
    pairs = []
    for group in groups:
        if len(group) < 2:
            name = group[0].name if group else ""
            raise DataError(f"group of '{name}': bias removal needs two repeats or more")
        pairs += list(combinations(group, 2))
    if not pairs:
        raise DataError("no repeated experiments; bias removal needs a pair")
    return reduce(add, (_pair(one, other, model_class, offsets) for one, other in pairs))


def plain_moments(
    trials: Sequence[Trajectory],
    model_class: Polynomial,
    offsets: Offsets,
) -> Moments:
    """Moments of the signals as measured: right without noise, biased with it."""
    return reduce(add, (_pair(trial, trial, model_class, offsets) for trial in trials))


def _pair(
    first: Trajectory, second: Trajectory, model_class: Polynomial, offsets: Offsets
) -> Moments:
    N = min(len(first), len(second))
    if model_class.history >= N:
        raise DataError(
            f"{first.name} and {second.name}: {N} common samples; {model_class.history + 1} needed"
        )
    one, other = (_rows(trial, N, model_class, offsets) for trial in (first, second))
    if first is second:
        return _sums(one, one, model_class.degrees.left)
    return _sums(one, other, model_class.degrees.left) + _sums(other, one, model_class.degrees.left)


def _rows(
    trial: Trajectory, samples: int, model_class: Polynomial, offsets: Offsets
) -> tuple[FloatArray, FloatArray]:
    """Powers y⁰ … (orders, T), and χ (m, T), of the first `samples` samples."""
    y, u = trial.y[:samples, 0] - offsets.y, trial.u[:samples] - offsets.u
    h = model_class.history
    now = y[h:]
    powers = np.ones((max(2 * model_class.degrees.left, 3), len(now)))
    for a in range(1, len(powers)):
        np.multiply(powers[a - 1], now, out=powers[a])
    lagged = [y[h - k : samples - k] for k in range(1, model_class.lags + 1)]
    window = [u[h - d : samples - d, i] for i, d in model_class.window(u.shape[1])]
    return powers, np.stack([*lagged, *window])


def _sums(
    one: tuple[FloatArray, FloatArray], other: tuple[FloatArray, FloatArray], degree: int
) -> Moments:
    powers, chi = one
    return Moments(
        count=powers.shape[1],
        powers=powers.sum(axis=1),
        crossed=powers @ other[0][1],
        mixed=powers[: degree + 1] @ other[1].T,
        products=chi @ other[1].T,
    )
