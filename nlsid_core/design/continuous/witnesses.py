"""From pieces in floating point to what the kernel decides: small whole numbers.

Multipliers are rounded first; the polynomial c(s, x̄) is then what it is, and its Gram matrices are
corrected to it. Half of what the constant can lose is the margin. The rest is written as factors
R_j of low degree in s, with room for rounding. Source: docs/certificate_continuous_funnel.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import comb, floor, frexp, ldexp

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray, Json
from nlsid_core.design.continuous.closed_loop import Pieces, closed_loop_polynomial
from nlsid_core.design.continuous.graded import Graded, elevate, monomials_of, positions
from nlsid_core.dynamics.vector_field import VectorField
from nlsid_core.errors import Infeasible
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.polynomial.maps import monomials
from nlsid_core.sos.witness import Scale, multiplier, witness

SHARE = 0.5  # of what the constant can lose that becomes the margin
FIT = 0.4  # of the least eigenvalue of the scaled Gram matrices: how well factors have to fit
MU_BITS, TAU_BITS = 24, 16  # of multipliers, relative to the largest coefficient on the funnel
MARGIN_BITS = 10  # of the margin that is stated
MAX_DEGREE = 23  # of the factors in s: what the kernel takes


def rounded(pieces: Pieces) -> Pieces:
    """The pieces in x̄ with multipliers of few bits, and how a proof states these."""
    n = pieces.basis.shape[1]
    rows = monomials(n, pieces.multiplier_degrees(pieces.basis))
    places = positions(affine(n), pieces.basis)
    diagonal = np.diagonal(pieces.gram, axis1=2, axis2=3).max(axis=1)[:, places]
    reach = np.sqrt(diagonal[:, :1] / diagonal[:, 1:])  # of each x̄_i on the funnel, nearly
    sizes = np.exp(np.log(reach) @ monomials(n, [1]).T @ rows.T)  # (B, M) of the monomials
    largest = (np.abs(pieces.mu).max(axis=1) * sizes).max(axis=1, keepdims=True)
    shifts = np.round(np.log2(largest / sizes)).astype(np.int64) - MU_BITS
    whole = np.round(pieces.mu * np.exp2(-shifts[:, None].astype(np.float64)))
    mu = whole * np.exp2(shifts[:, None].astype(np.float64))
    pieces = stated_multipliers(replace(pieces, mu=mu))
    for b in range(len(pieces)):
        pieces.stated[b]["mu"] = {
            "shifts": shifts[b].tolist(),
            "start": whole[b, 0].astype(np.int64).tolist(),
            "end": whole[b, 1].astype(np.int64).tolist(),
        }
    return pieces


def stated_multipliers(pieces: Pieces) -> Pieces:
    """The pieces with τ of few bits, and how a proof states it."""
    tau, stated = np.zeros_like(pieces.tau), np.empty(len(pieces), dtype=object)
    for b in range(len(pieces)):
        factors = [_factors(S) for S in pieces.tau[b].swapaxes(0, 1)]
        for place, written in enumerate(factors):
            tau[b, :, place] = matrices(written["columns"], written["squares"])
        stated[b] = {"tau": factors} if factors else {}
        if pieces.cases.mode.shape[1]:
            stated[b]["mode"] = pieces.cases.mode[b].tolist()
    return replace(pieces, tau=tau, stated=stated)


def _factors(S: FloatArray) -> Json:
    """S (2, n+1, n+1) at both ends as factors in 1 and x̄; what is not used is charged least."""
    used = np.asarray(np.diagonal(S, axis1=1, axis2=2).any(axis=0))
    if not used.any():
        return {"columns": [0] * len(used), "squares": {"unit": 0, "factors": [[]]}}
    found = multiplier(affine(len(used) - 1), S, bits=TAU_BITS)
    columns = np.array(found["columns"])
    columns[~used] = columns[used].min()
    return {"columns": columns.tolist(), "squares": found["squares"]}


def affine(n: int) -> IntArray:
    """(n + 1, n) the monomials 1, x0, x1, ..."""
    return np.vstack([np.zeros((1, n), dtype=np.int64), np.eye(n, dtype=np.int64)])


def matrices(columns: Sequence[int], squares: Json) -> FloatArray:
    """(J+1, k, k) what factors of whole numbers stand for."""
    k = len(columns)
    result = np.zeros((len(squares["factors"]), k, k))
    for j, factor in enumerate(squares["factors"]):
        R = np.array([[0.0] * (k - len(row)) + [float(e) for e in row] for row in factor])
        R = R.reshape(-1, k) * np.exp2(np.array(columns, dtype=float) - squares["unit"])
        result[j] = R.T @ R
    return result


def piece_margins(
    field: VectorField, policy: ContinuousPolicy, funnel: ContinuousFunnel, pieces: Pieces
) -> FloatArray:
    """Each piece's margin in 1/s; nan where its Gram matrices are not positive definite."""
    c = closed_loop_polynomial(field, policy, funnel, pieces)
    curves = _Curves.of(funnel, pieces, c)
    margins = np.full(len(pieces), np.nan)
    sound = curves.lowest() > 0
    if sound.any():
        Q = curves.grams[sound]
        constant = 1 / np.linalg.inv(Q)[:, :, curves.one, curves.one]  # Schur complement
        margins[sound] = SHARE * (constant / curves.room[sound]).min(axis=1)
    margins[~(margins > 0)] = np.nan
    return margins


def stated_margin(margins: FloatArray) -> float:
    """The least margin, rounded down to few bits."""
    part, exponent = frexp(float(np.min(margins)))
    return ldexp(floor(ldexp(part, MARGIN_BITS)), exponent - MARGIN_BITS)


def documents(
    field: VectorField,
    policy: ContinuousPolicy,
    funnel: ContinuousFunnel,
    pieces: Pieces,
    margin: float,
) -> list[Json]:
    """The pieces as the kernel reads them, all of one time span, for this margin in 1/s.

    Raises Infeasible if no factors of few enough degrees in s are near enough.
    """
    curves = _Curves.of(funnel, pieces, closed_loop_polynomial(field, policy, funnel, pieces))
    grams = curves.grams
    grams[:, :, curves.one, curves.one] -= margin * curves.room
    return [_written(pieces, curves, b) for b in range(len(pieces))]


def rate_documents(funnel: ContinuousFunnel, pieces: Pieces, c: Graded) -> list[Json | None]:
    """The rate pieces as the kernel reads them; None where one is not shown to be positive."""
    curves = _Curves.of(funnel, pieces, c)
    found: list[Json | None] = []
    for b, lowest in enumerate(curves.lowest().tolist()):
        try:
            found.append(_written(pieces, curves, b) if lowest > 0 else None)
        except Infeasible:
            found.append(None)
    return found


def _written(pieces: Pieces, curves: "_Curves", b: int) -> Json:
    squares = witness(pieces.basis, fitted(pieces.basis, curves.grams[b]))
    return {
        "interval": int(pieces.cases.interval[b]),
        "vertex": int(pieces.cases.vertex[b]),
        "level": int(pieces.cases.level[b]),
        "index": int(pieces.cases.index[b]),
        **pieces.stated[b],
        "columns": squares["columns"],
        "squares": squares["squares"],
    }


@dataclass(frozen=True, eq=False)
class _Curves:
    """grams: (B, N+1, k, k) Bernstein control points of Q(s), c = v'Qv. room: (B, N+1) of hρ(s).

    one: the place of the monomial 1 in v.
    """

    grams: FloatArray
    room: FloatArray
    one: int

    @classmethod
    def of(cls, funnel: ContinuousFunnel, pieces: Pieces, polynomials: Graded) -> "_Curves":
        """Make the curves of pieces whose Gram matrices are nearly those of the polynomials."""
        basis = pieces.basis
        c, rows = together(polynomials, basis.shape[1])
        N = c.shape[1] - 1
        c = c / np.array([comb(N, j) for j in range(N + 1)])[:, None]
        grams = gram_curves(basis, c, rows, pieces.gram)
        share = np.arange(N + 1) / max(N, 1)
        ends = funnel.rho[pieces.cases.interval], funnel.rho[pieces.cases.interval + 1]
        first, last = ((pieces.cases.index + end) / 2.0**pieces.cases.level for end in (0, 1))
        at = first[:, None] + (last - first)[:, None] * share
        rho = (1 - at) * ends[0][:, None] + at * ends[1][:, None]
        h = np.diff(funnel.t)[pieces.cases.interval]
        one = int(np.flatnonzero(~basis.any(axis=1))[0])
        return cls(grams, h[:, None] * rho, one)

    def lowest(self) -> FloatArray:
        """(B,) the least eigenvalue, with a unit diagonal; 0 where the numbers are not finite."""
        with np.errstate(all="ignore"):  # of a funnel so small that its numbers overflow
            root = np.sqrt(np.maximum(np.diagonal(self.grams, axis1=2, axis2=3), 1e-300))
            scaled = self.grams / root[..., :, None] / root[..., None, :]
        finite = np.isfinite(scaled).all(axis=(1, 2, 3), keepdims=True)
        return np.asarray(np.linalg.eigvalsh(np.where(finite, scaled, 0.0)).min(axis=(1, 2)))


def fitted(basis: IntArray, grams: FloatArray) -> FloatArray:
    """(J+1, k, k) control points of the lowest degree that are near enough to (N+1, k, k).

    Raises Infeasible if none of few enough are.
    """
    N = len(grams) - 1
    for J in range(min(N, 1), min(N, MAX_DEGREE) + 1):
        lift = _lift(J, N)
        points = np.einsum("jk,kab->jab", _nearest(J, N), grams)
        scale = Scale.of(basis, points)
        scaled = points / scale.diagonal[:, None] / scale.diagonal
        room = FIT * float(np.linalg.eigvalsh(scaled)[:, 0].min()) * scale.small**2
        written = scale.diagonal / scale.small
        gap = (grams - np.einsum("kj,jab->kab", lift, points)) / written[:, None] / written
        if (scale.lost(gap) <= room).all():
            return np.asarray(points)
    raise Infeasible(f"the Gram matrices of a piece need factors of degree above {MAX_DEGREE}")


def gram_curves(basis: IntArray, c: FloatArray, rows: IntArray, ends: FloatArray) -> FloatArray:
    """(B, N+1, k, k) control points of Q(s) with c = v'Qv, near to those linear between `ends`.

    c: (B, N+1, M) control points of the coefficients of `rows` (M, n). ends: (B, 2, k, k).
    """
    N = c.shape[1] - 1
    of_pairs = positions((basis[:, None] + basis[None]).reshape(-1, basis.shape[1]), rows)
    count = np.bincount(of_pairs, minlength=len(rows))
    share = (np.arange(N + 1) / max(N, 1))[:, None, None]
    grams = (1 - share) * ends[:, :1] + share * ends[:, 1:]
    missing = (c - _sums(grams, of_pairs, len(rows))) / np.maximum(count, 1)
    grams = grams + missing[..., of_pairs].reshape(grams.shape)
    return np.asarray((grams + grams.swapaxes(-1, -2)) / 2)


def _sums(Q: FloatArray, of_pairs: IntArray, count: int) -> FloatArray:
    """(..., M) coefficients of v'Qv for Q (..., k, k)."""
    order = np.argsort(of_pairs, kind="stable")
    present, starts = np.unique(of_pairs[order], return_index=True)
    sums = np.add.reduceat(Q.reshape(*Q.shape[:-2], -1)[..., order], starts, axis=-1)
    result = np.zeros((*Q.shape[:-2], count))
    result[..., present] = sums
    return result


@lru_cache(maxsize=256)
def _nearest(J: int, N: int) -> FloatArray:
    """(J+1, N+1) control points of degree J from those of degree N, by least squares."""
    return np.asarray(np.linalg.pinv(_lift(J, N)))


@lru_cache(maxsize=256)
def _lift(J: int, N: int) -> FloatArray:
    """(N+1, J+1) Bernstein control points of degree N from those of degree J."""
    return np.array(
        [
            [
                comb(J, j) * comb(N - J, k - j) / comb(N, k) if 0 <= k - j <= N - J else 0.0
                for j in range(J + 1)
            ]
            for k in range(N + 1)
        ]
    )


def together(c: Graded, n: int) -> tuple[FloatArray, IntArray]:
    """All degrees in one array (B, N+1, M), and its monomials (M, n)."""
    degrees = range(max(c) + 1)
    rows = np.concatenate([monomials_of(n, q) for q in degrees])
    N = max(part.shape[1] for part in c.values()) - 1
    batch = max(part.shape[0] for part in c.values())
    parts = [
        elevate(np.broadcast_to(c[q], (batch, *c[q].shape[1:])), N)
        if q in c
        else np.zeros((batch, N + 1, len(monomials_of(n, q))))
        for q in degrees
    ]
    return np.concatenate(parts, axis=2), rows
