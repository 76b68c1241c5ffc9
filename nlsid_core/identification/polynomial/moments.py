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
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError
from nlsid_core.identification.polynomial.implicit_rows import ImplicitRows, build_implicit_rows
from nlsid_core.identification.polynomial.options import Polynomial
from nlsid_core.identification.repeats import refuse_false_repeats

POWER_FLOOR = 1e-3  # of an estimated mean square in spreads: less is noise


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


def rows_without_bias(
    data: Dataset,
    model_class: Polynomial,
    *,
    transient: int = 0,
    accept_untested_repeats: bool = False,
) -> ImplicitRows:
    """The rows of the dataset's groups of repeats, R of the moments without the bias of noise.

    Trajectories without a repeat are not used. transient: samples at the start of each that the
    test of the repeats leaves out. accept_untested_repeats: skip that test; the bias of noise is
    then removed only if the trials repeat one excitation all the same.
    Raises DataError if there are no repeats, they are not repeats or have nothing in common.
    """
    groups = tuple(data.repeats().values())
    if not groups:
        raise DataError(
            "no two trajectories share a `group`: bias removal needs repeated experiments; without "
            "them use another method"
        )
    if not accept_untested_repeats:
        refuse_false_repeats(data, transient=transient)
    used = Dataset(tuple(trial for group in groups for trial in group))
    return build_implicit_rows(used, model_class, lambda scaled: _factor(scaled, model_class))


def _factor(scaled: Dataset, model_class: Polynomial) -> FloatArray:
    """R with R'R the nearest moments that are those of a signal; M̂ is indefinite at much noise."""
    M = repeated_moments(list(scaled.repeats().values()), model_class).matrix()
    if not M[0, 0] > 0.0:
        raise DataError(
            f"the responses have nothing in common: their estimated mean square is {M[0, 0]:g} of "
            "the measured one; are they repeats, and is the noise smaller than the response?"
        )
    sizes = np.sqrt(np.maximum(np.diag(M), POWER_FLOOR))
    values, vectors = np.linalg.eigh(M / np.outer(sizes, sizes))
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * sizes)


def repeated_moments(groups: Sequence[Sequence[Trajectory]], model_class: Polynomial) -> Moments:
    """Moments without the bias of noise, from groups of repeats: every pair, in both roles.

    Raises DataError if trials are too short.
    """
    pairs = [pair for group in groups for pair in combinations(group, 2)]
    return reduce(add, (_pair(one, other, model_class) for one, other in pairs))


def _pair(first: Trajectory, second: Trajectory, model_class: Polynomial) -> Moments:
    N = min(len(first), len(second))
    if model_class.history >= N:
        raise DataError(
            f"{first.name} and {second.name}: {N} common samples; {model_class.history + 1} needed"
        )
    one, other = (_rows(trial, N, model_class) for trial in (first, second))
    return _sums(one, other, model_class.degrees.left) + _sums(other, one, model_class.degrees.left)


def _rows(
    trial: Trajectory, samples: int, model_class: Polynomial
) -> tuple[FloatArray, FloatArray]:
    """Powers y⁰ … (orders, T), and χ (m, T), of the first `samples` samples."""
    y, u = trial.y[:samples, 0], trial.u[:samples]
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
