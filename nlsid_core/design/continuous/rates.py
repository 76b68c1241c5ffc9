"""How fast an input changes in a funnel at one instant: a bound, and the Gram matrix that shows it.

At an instant a rate is p(z) of degree 3 in |z| ≤ 1. Each of its cubic terms has a factor among the
states with which the L-steps' basis has products: z_y, the curving ones. With C its cubic part
written on products z_a z_y,
    r - p - (λ₀ + λ₁|z_y|²)(1 - |z|²)
is a sum of squares of 1, z and these products if r is large enough: of the basis of the proof.
Source: docs/theory-funnels.md, "The hold between samples".
"""

from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.design.continuous.graded import monomials_of, positions
from nlsid_core.design.continuous.lstep import coordinates
from nlsid_core.funnels.continuous import ContinuousFunnel

QUARTICS = (0.03, 0.1, 0.3, 1.0, 3.0)  # λ₁ over the cubic part's size
LEAST_QUARTIC = 1e-3  # of the linear part's size
NEWTONS = 6  # for a multiplier: any will do, and six are at the best one


def frames_of(
    funnel: ContinuousFunnel, interval: IntArray, share: FloatArray, curving: tuple[int, ...]
) -> tuple[FloatArray, FloatArray]:
    """T and its inverse (B, n, n), x̄ = Tz with W = ρ|z|², at shares (B,) of intervals (B,).

    Curving z are functions of these states only. The same state has the same place in x̄ and z.
    """
    instants, which = np.unique(np.column_stack([interval, share]), axis=0, return_inverse=True)
    frames = []
    for k, s in zip(instants[:, 0].astype(int).tolist(), instants[:, 1].tolist(), strict=True):
        P = (1 - s) * funnel.P[k] + s * funnel.P[k + 1]
        rho = (1 - s) * funnel.rho[k] + s * funnel.rho[k + 1]
        frames.append(np.sqrt(rho) * coordinates(P, curving))
    order = np.array([j for j in range(funnel.n) if j not in curving] + list(curving))
    M = np.array(frames)[:, order]
    T, inverse = np.zeros_like(M), np.zeros_like(M)
    T[:, order[:, None], order] = M
    inverse[:, order[:, None], order] = np.triu(np.linalg.inv(M))  # exactly, not up to rounding
    return T[which.ravel()], inverse[which.ravel()]


@dataclass(frozen=True, eq=False)
class Shown:
    """least: (B,) r for each polynomial. multipliers: (B, 2) λ₀ and λ₁, with which it is shown.

    polynomials: by degree 0 to 2, p₀ (B,), p₁ (B, n) and p₂ (B, n, n), λ₁|z_y|² with it; then C
    (B, n, products). weights: (products,) D, of the squares of products.
    """

    least: FloatArray
    multipliers: FloatArray
    polynomials: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
    weights: FloatArray
    products: IntArray

    def gram(self, basis: IntArray) -> FloatArray:
        """(B, k, k) in 1, z and these products; for r = 0: its constant is r more."""
        p0, p1, p2, C = self.polynomials
        count, n = p1.shape
        gram = np.zeros((count, len(basis), len(basis)))
        one = int(np.flatnonzero(~basis.any(axis=1))[0])
        first, second = positions(np.eye(n, dtype=np.int64), basis), positions(self.products, basis)
        constant, quartic = self.multipliers.T
        gram[:, one, one] = -p0 - constant
        gram[:, one, first] = gram[:, first, one] = -p1 / 2
        gram[:, first[:, None], first] = constant[:, None, None] * np.eye(n) - p2
        gram[:, first[:, None], second] = -C / 2
        gram[:, second[:, None], first] = -C.swapaxes(1, 2) / 2
        gram[:, second, second] = quartic[:, None] * self.weights
        return gram


def least_rates(p: list[FloatArray], curving: tuple[int, ...]) -> Shown:
    """The least r with r - p - (λ₀ + λ₁|z_y|²)(1 - |z|²) a sum of squares; p by degree, (B, M_q).

    p₃ holds no term without a curving z.
    """
    p0, count, n = p[0][:, 0], len(p[0]), p[1].shape[1]
    linear = p[1][:, positions(np.eye(n, dtype=np.int64), monomials_of(n, 1))]
    quadratic, cubic = monomials_of(n, 2), monomials_of(n, 3)
    products = quadratic[quadratic[:, list(curving)].any(axis=1)]
    i, j = (np.array([np.repeat(np.arange(n), row)[side] for row in quadratic]) for side in (0, 1))
    Q = np.zeros((count, n, n))
    Q[:, i, j] += p[2] / 2
    Q[:, j, i] += p[2] / 2
    C = (p[3] @ _shares(cubic, products)).reshape(count, n, len(products))
    curved = np.zeros((n, n))
    curved[curving, curving] = 1.0
    twice = products[:, list(curving)].sum(axis=1) == 2
    D = np.where(twice & (products < 2).all(axis=1), 2.0, 1.0)
    N = C / D @ C.swapaxes(1, 2) / 4
    size = np.linalg.norm(linear, axis=1) + np.abs(p0) + np.linalg.norm(Q, axis=(1, 2))
    size = np.maximum(size, np.finfo(float).tiny)
    root = np.sqrt(np.linalg.norm(N, axis=(1, 2)))
    quartic = np.multiply.outer(QUARTICS, root) + LEAST_QUARTIC * size  # (scales, B)
    values, vectors = np.linalg.eigh(
        Q + quartic[..., None, None] * curved + N / quartic[..., None, None]
    )
    turned = np.einsum("sbij,bi->sbj", vectors, linear)
    constant = _smallest(values, turned, LEAST_QUARTIC * size)
    rate = p0 + constant + (turned**2 / (constant[..., None] - values)).sum(axis=-1) / 4
    chosen = np.argmin(rate, axis=0), np.arange(count)
    multipliers = np.stack([constant[chosen], quartic[chosen]], axis=1)
    bent = Q + multipliers[:, 1, None, None] * curved
    return Shown(rate[chosen], multipliers, (p0, linear, bent, C), D, products)


def _shares(cubic: IntArray, products: IntArray) -> FloatArray:
    """(M_3, n·products) how each cubic monomial is shared out among z_i times a product."""
    n = cubic.shape[1]
    places = {tuple(row): place for place, row in enumerate(products.tolist())}
    shares = np.zeros((len(cubic), n, len(products)))
    for place, row in enumerate(cubic):
        for i in np.flatnonzero(row).tolist():
            rest = places.get(tuple((row - np.eye(n, dtype=np.int64)[i]).tolist()))
            if rest is not None:
                shares[place, i, rest] = row[i]
    total = shares.sum(axis=(1, 2), keepdims=True)
    return np.asarray(shares / np.where(total > 0, total, 1.0)).reshape(len(cubic), -1)


def _smallest(values: FloatArray, b: FloatArray, least: FloatArray) -> FloatArray:
    """μ ≥ max(values, 0) + least that makes μ + Σ b²/(μ - values)/4 least, nearly; (..., B, n).

    Where it is inside, r(μ) = |b/(μ - values)|/2 = 1. Newton on 1/r, which is nearly affine.
    Source: Moré and Sorensen, "Computing a trust region step", 1983, (3.11).
    """
    low = np.maximum(values[..., -1], 0.0) + least
    mu = low
    for _ in range(NEWTONS):
        apart = mu[..., None] - values
        square = (b**2 / apart**2).sum(axis=-1) / 4
        cube = (b**2 / apart**3).sum(axis=-1) / 4
        step = square / np.maximum(cube, np.finfo(float).tiny) * (np.sqrt(square) - 1)
        mu = np.maximum(mu + step, low)
    return mu
