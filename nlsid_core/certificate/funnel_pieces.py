"""Decide the pieces of a funnel's proof: c_k(z) = v'Q_k v with Q_k ≻ 0 for every Bernstein k.

One computation, in two arithmetics: `exact` in integers, `rigorous` in floating point with
proved bounds. See `trajectory_funnel` for the claim.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from math import comb

import numpy as np

from nlsid_core._types import FloatArray, IntArray
from nlsid_core.certificate import dyadic, rigorous
from nlsid_core.certificate.arithmetic import SLACK, Arithmetic, Ball, Exact, Number, U
from nlsid_core.certificate.closed_loop import closed_loop_polynomial
from nlsid_core.certificate.graded import elevate, monomials_of, positions
from nlsid_core.certificate.identity import Mode
from nlsid_core.continuous.funnel import Funnel
from nlsid_core.continuous.policy import Policy
from nlsid_core.continuous.vector_field import VectorField
from nlsid_core.errors import CertificateRejected, Undecided
from nlsid_core.polynomial.maps import monomials

# The stated Gram matrices have to represent c at the ends of a piece to this, relative to their
# largest entry: a proof is about these very objects. Designs leave 1e-12.
FIT = 1e-9
SHARED = ("basis", "kappa")  # by all pieces of a proof
CELLS = 6_000_000  # Gram entries held at once


@dataclass(frozen=True, eq=False)
class Pieces:
    """basis: (k, n) exponents of v. Per piece: interval, vertex of w, part index/2^level of it.

    T: (B, n, n), x̄ = Tz. mu: (B, 2, M) multiplier at both ends, in the monomials of degree 0 up to
    2 less than twice the basis'. gram: (B, 2, k(k+1)/2) upper triangles, row by row, of Q there.
    kappa: (n_w,) powers of two; then what w adds to ẋ is bounded with them and `vertex` is 0.
    mode: (B, L) of the policy's modes. tau: (B, 2, L, (n+1)(n+2)/2) upper triangles at both ends of
    S ⪰ 0, y'Sy with y = (1, z) the multiplier of what holds in that mode, see `saturation`.
    """

    basis: IntArray
    interval: IntArray
    vertex: IntArray
    level: IntArray
    index: IntArray
    T: FloatArray
    mu: FloatArray
    gram: FloatArray
    mode: IntArray
    tau: FloatArray
    kappa: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.interval)

    @staticmethod
    def multiplier_size(basis: IntArray) -> int:
        """M for this basis."""
        return len(monomials(basis.shape[1], Pieces.multiplier_degrees(basis)))

    @staticmethod
    def multiplier_degrees(basis: IntArray) -> range:
        """The degrees of the multiplier's monomials."""
        return range(max(2 * int(np.max(basis.sum(axis=1))) - 1, 1))

    def select(self, chosen: slice | IntArray) -> "Pieces":
        """Some of the pieces."""
        kept = {f.name: getattr(self, f.name)[chosen] for f in fields(self) if f.name not in SHARED}
        return replace(self, **kept)


def decide_pieces(
    field: VectorField, policy: Policy, funnel: Funnel, pieces: Pieces, mode: Mode
) -> float:
    """Prove every piece; returns the margin, a proved lower bound of -V̇ on the boundary in 1/s.

    Raises CertificateRejected naming the first piece that fails and why, Undecided if this mode
    cannot tell.
    """
    margins = piece_margins(field, policy, funnel, pieces, mode)
    if not np.isfinite(margins).all():
        i = int(np.flatnonzero(~np.isfinite(margins))[0])
        k = int(pieces.interval[i])
        where = f"{funnel.t[k]:g} to {funnel.t[k + 1]:g} s"
        if np.isneginf(margins[i]):
            raise CertificateRejected(
                f"piece {i} (interval {k}, {where}): the stated Gram matrices do not represent "
                "this funnel's polynomial"
            )
        refusal = Undecided if mode == "rigorous" else CertificateRejected
        raise refusal(
            f"piece {i} (interval {k}, {where}): V is not proved to decrease on the boundary"
        )
    return float(np.min(margins))


def piece_margins(
    field: VectorField, policy: Policy, funnel: Funnel, pieces: Pieces, mode: Mode
) -> FloatArray:
    """Each piece's margin in 1/s; nan where nothing is proved, -inf where Q does not fit."""
    arithmetic: Arithmetic = Exact if mode == "exact" else Ball
    margins = np.full(len(pieces), np.nan)
    for chosen in batches(field, funnel, pieces):
        part = pieces.select(chosen)
        margins[chosen] = _margins(field, policy, funnel, part, arithmetic)
    return margins


def batches(field: VectorField, funnel: Funnel, pieces: Pieces) -> Iterator[IntArray]:
    """Indices of pieces that obey the same equations, as many as fit at once."""
    size = max(1, CELLS // (len(pieces.basis) ** 2 * 16))
    span = np.searchsorted(field.breaks, funnel.t[:-1], side="right")[pieces.interval]
    for equations in np.unique(span):
        chosen = np.flatnonzero(span == equations)
        for start in range(0, len(chosen), size):
            yield chosen[start : start + size]


def _margins(
    field: VectorField, policy: Policy, funnel: Funnel, pieces: Pieces, arithmetic: Arithmetic
) -> FloatArray:
    refuse_singular(pieces)
    refuse_indefinite(pieces)
    c, unit = closed_loop_polynomial(field, policy, funnel, pieces, arithmetic)
    coefficients, rows = _together(c, arithmetic, pieces.basis.shape[1])
    N = coefficients.shape[1] - 1
    home = _Home.of(pieces.basis, rows)
    ends = _square(pieces.gram, len(pieces.basis))
    approximate = coefficients.approximate() / unit
    result = np.full(len(pieces), np.nan)
    for end in (0, 1):
        misfit = np.abs(approximate[:, -end] - home.sums(ends[:, end])).max(axis=1)
        result[misfit > FIT * np.abs(ends[:, end]).max(axis=(1, 2))] = -np.inf
    grams = _interpolated(ends, N)
    missing = approximate - home.sums(grams)
    grams += (missing / home.count)[..., home.of_pairs].reshape(grams.shape)
    grams = (grams + grams.swapaxes(-1, -2)) / 2
    if not np.isfinite(grams).all():
        raise Undecided("numbers overflow in floating point")
    shift = home.residual(coefficients, grams, unit)
    scale = np.array([comb(N, k) for k in range(N + 1)])
    h = np.diff(funnel.t)[pieces.interval]
    largest = np.maximum(funnel.rho[pieces.interval], funnel.rho[pieces.interval + 1])
    for i in np.flatnonzero(np.isnan(result)).tolist():
        bounds = [_lowest(grams[i, k], float(shift[i, k]), arithmetic) for k in range(N + 1)]
        # c ≥ min_k λ_k/binomial_k · |v|² ≥ that, since 1 is among v and the weights add to 1.
        if min(bounds) > 0:
            result[i] = float(np.min(bounds / scale) / (h[i] * largest[i])) / SLACK
    return result


def refuse_singular(pieces: Pieces) -> None:
    """Raise CertificateRejected if some T is not invertible: its z would not reach every state."""
    for T in np.unique(pieces.T, axis=0):
        rows = Exact.of(T).values
        if not dyadic.is_positive_definite((rows @ rows.T).tolist()):
            raise CertificateRejected("coordinates x̄ = Tz of a piece are singular")


def refuse_indefinite(pieces: Pieces) -> None:
    """Raise CertificateRejected unless every S is positive definite, and so in between too."""
    n, count = pieces.T.shape[1], pieces.tau.shape[-1]
    for S in _square(pieces.tau.reshape(-1, count), n + 1):
        if not dyadic.is_positive_definite(Exact.of(S).values.tolist()):
            raise CertificateRejected("the multiplier of a mode of the inputs is not nonnegative")


def _lowest(Q: FloatArray, shift: float, arithmetic: Arithmetic) -> float:
    """A proved lower bound of the eigenvalues of Q minus `shift`; nan if none above 0 is proved."""
    if not np.isfinite(shift):
        return float("nan")
    guess = (float(np.linalg.eigvalsh(Q)[0]) - shift) / 2
    if guess <= 0:
        return float("nan")
    if arithmetic is Ball:
        proved = rigorous.is_positive_definite(Q, (shift + guess) * SLACK)
    else:
        lowered = Exact.of(Q) - Exact.of(
            np.eye(len(Q)) * float(np.nextafter(shift + guess, np.inf))
        )
        proved = dyadic.is_positive_definite([[int(e) for e in row] for row in lowered.values])
    return guess if proved else float("nan")


@dataclass(frozen=True, eq=False)
class _Home:
    """Which products of the basis make which monomial.

    of_pairs: (k²,) monomial of each product. order, starts, present: the products sorted by
    monomial, where each run starts, and whose it is. count: (M,) products per monomial, at least 1.
    """

    of_pairs: IntArray
    order: IntArray
    starts: IntArray
    present: IntArray
    count: FloatArray
    rows: IntArray

    @classmethod
    def of(cls, basis: IntArray, rows: IntArray) -> "_Home":
        pairs = (basis[:, None] + basis[None]).reshape(-1, basis.shape[1])
        of_pairs = positions(pairs, rows)
        order = np.argsort(of_pairs, kind="stable")
        present, starts = np.unique(of_pairs[order], return_index=True)
        count = np.bincount(of_pairs, minlength=len(rows))
        return cls(of_pairs, order, starts, present, np.maximum(count, 1).astype(float), rows)

    def sums(self, Q: FloatArray) -> FloatArray:
        """(..., M) coefficients of v'Qv for Q (..., k, k), in floating point."""
        flat = Q.reshape(*Q.shape[:-2], -1)[..., self.order]
        result = np.zeros((*Q.shape[:-2], len(self.rows)))
        result[..., self.present] = np.add.reduceat(flat, self.starts, axis=-1)
        return result

    def residual(self, coefficients: Number, grams: FloatArray, unit: int) -> FloatArray:
        """An upper bound of Σ |c - v'Qv| over the monomials; inf where one has no home."""
        if isinstance(coefficients, Exact):
            total = self._exact_residual(coefficients, grams, unit)
        else:
            assert isinstance(coefficients, Ball)
            sums, sizes = self.sums(grams), self.sums(np.abs(grams))
            error = (self.count + 1) * U * sizes * SLACK
            difference = coefficients - Ball(sums, error)
            total = np.abs(difference.middle) + difference.radius
        homeless = np.ones(len(self.rows), dtype=bool)
        homeless[self.present] = False
        total[..., homeless] = np.where(total[..., homeless] == 0, 0.0, np.inf)
        return np.asarray(total.sum(axis=-1) * (1 + 2.0**-30))

    def _exact_residual(self, coefficients: Exact, grams: FloatArray, unit: int) -> FloatArray:
        flat = Exact.of(grams.reshape(*grams.shape[:-2], -1)[..., self.order])
        summed = np.zeros(coefficients.shape, dtype=object)
        summed[..., self.present] = np.add.reduceat(flat.values, self.starts, axis=-1)
        difference = coefficients - Exact(summed * unit, flat.bits)
        scale = unit << difference.bits
        # Division of integers rounds to nearest: a relative 2^-52 covers it, and zero stays zero.
        rounded = [abs(v) / scale * (1 + 2.0**-52) if v else 0.0 for v in difference.values.ravel()]
        above = [r if r or not v else 2.0**-1000 for r, v in
                 zip(rounded, difference.values.ravel(), strict=True)]  # fmt: skip
        return np.array(above).reshape(difference.shape)


def _together(c: dict[int, Number], arithmetic: Arithmetic, n: int) -> tuple[Number, IntArray]:
    """All degrees in one array (B, N+1, M), and its monomials (M, n)."""
    degrees = range(max(c) + 1)
    rows = np.concatenate([monomials_of(n, q) for q in degrees])
    N = max(part.shape[1] for part in c.values()) - 1
    batch = max(part.shape[0] for part in c.values())
    result = arithmetic.zeros((batch, N + 1, len(rows)))
    start = 0
    for q in degrees:
        size = len(monomials_of(n, q))
        if q in c:
            index = (slice(None), slice(None), slice(start, start + size))
            result.accumulate(index, elevate(c[q], N))
        start += size
    return result, rows


def _interpolated(ends: FloatArray, N: int) -> FloatArray:
    """(B, N+1, k, k): binomial times the linear interpolation of Q at each Bernstein index."""
    share = np.arange(N + 1) / N if N else np.zeros(1)
    weight = np.array([comb(N, k) for k in range(N + 1)])
    a, b = weight * (1 - share), weight * share
    return a[:, None, None] * ends[:, None, 0] + b[:, None, None] * ends[:, None, 1]


def _square(triangles: FloatArray, k: int) -> FloatArray:
    """(..., k, k) symmetric matrices from upper triangles, row by row."""
    i, j = np.triu_indices(k)
    result = np.zeros((*triangles.shape[:-1], k, k))
    result[..., i, j] = triangles
    result[..., j, i] = triangles
    return result
