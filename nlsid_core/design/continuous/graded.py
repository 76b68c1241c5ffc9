"""Batches of polynomials in z whose coefficients are polynomials in time, in floating point.

Time is s in [0, 1] with r = 1 - s. A part of degree q in z is an array (B, S+1, M_q): B
polynomials at once, the coefficient of s^k r^(S-k) at k (binomials included, so that a product is
a convolution), M_q monomials of degree q in z. Parts of one polynomial may differ in S.
"""

from collections.abc import Mapping
from functools import lru_cache, reduce
from math import comb
from typing import TypeAlias

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.polynomial.maps import monomials

Graded: TypeAlias = dict[int, FloatArray]


def weighted(points: FloatArray) -> FloatArray:
    """Bernstein control points (B, S+1, ...) times their binomials."""
    S = points.shape[1] - 1
    binomials = np.array([float(comb(S, i)) for i in range(S + 1)])
    return np.asarray(points * binomials.reshape(1, -1, *[1] * (points.ndim - 2)))


def restrict(part: FloatArray, level: IntArray, index: IntArray) -> FloatArray:
    """The polynomials in s on [index, index + 1]/2^level, again in s on [0, 1]; one pair per batch.

    part: (B, S+1, ...). s = ατ' + βσ, r = (1-α)τ' + (1-β)σ with the ends α and β.
    """
    S = part.shape[1] - 1
    if S == 0 or not level.any():
        return part
    table = np.array(
        [_restriction(S, j, i) for j, i in zip(level.tolist(), index.tolist(), strict=True)]
    )
    return np.asarray(np.einsum("bkj,bk...->bj...", table, part))


def elevate(part: FloatArray, degree: int) -> FloatArray:
    """The same polynomials in s, written with a higher degree."""
    more = degree - (part.shape[1] - 1)
    if more == 0:
        return part
    result = np.zeros((part.shape[0], degree + 1, *part.shape[2:]))
    for i in range(more + 1):
        result[:, i : i + part.shape[1]] += comb(more, i) * part
    return result


def add(p: Mapping[int, FloatArray], q: Mapping[int, FloatArray]) -> Graded:
    """p + q."""
    result = dict(p)
    for degree, part in q.items():
        if degree in result:
            S = max(part.shape[1], result[degree].shape[1]) - 1
            result[degree] = elevate(result[degree], S) + elevate(part, S)
        else:
            result[degree] = part
    return result


def negative(p: Mapping[int, FloatArray]) -> Graded:
    """-p."""
    return {degree: -part for degree, part in p.items()}


def multiply(p: Mapping[int, FloatArray], q: Mapping[int, FloatArray], n: int) -> Graded:
    """p q, both in n variables z."""
    result: Graded = {}
    for a, left in p.items():
        for b, right in q.items():
            shorter, longer = (left, right) if left.shape[2] <= right.shape[2] else (right, left)
            degrees = (a, b) if shorter is left else (b, a)
            product = _multiply_parts(shorter, longer, product_table(n, *degrees))
            result = add(result, {a + b: product})
    return result


def _multiply_parts(p: FloatArray, q: FloatArray, table: IntArray) -> FloatArray:
    batch = max(p.shape[0], q.shape[0])
    S = q.shape[1]
    result = np.zeros((batch, p.shape[1] + S - 1, int(np.max(table)) + 1))
    for k in range(p.shape[1]):
        for j in range(p.shape[2]):
            result[:, k : k + S, table[j]] += p[:, k, j][:, None, None] * q
    return result


@lru_cache(maxsize=256)
def monomials_of(n: int, degree: int) -> IntArray:
    """(M, n) monomials of one degree, in the order of the parts."""
    return monomials(n, [degree])


@lru_cache(maxsize=256)
def product_table(n: int, a: int, b: int) -> IntArray:
    """(M_a, M_b) position of each product among the monomials of degree a + b."""
    sums = monomials_of(n, a)[:, None] + monomials_of(n, b)[None]
    return positions(sums.reshape(-1, n), monomials_of(n, a + b)).reshape(sums.shape[:2])


def positions(rows: IntArray, among: IntArray) -> IntArray:
    """The row of `among` that equals each row; every one has to occur."""
    first, second = (np.asarray(part, dtype=np.int64).tobytes() for part in (rows, among))
    return _positions(first, second, 8 * rows.shape[1])


@lru_cache(maxsize=1024)
def _positions(rows: bytes, among: bytes, size: int) -> IntArray:
    places = {among[k : k + size]: k // size for k in range(0, len(among), size)}
    found = [places[rows[k : k + size]] for k in range(0, len(rows), size)]
    result = np.array(found, dtype=np.int64)
    result.setflags(write=False)  # everyone who asks is given the same
    return result


@lru_cache(maxsize=4096)
def _restriction(S: int, level: int, index: int) -> FloatArray:
    """(S+1, S+1) row k: s^k r^(S-k) written in σ^j τ^(S-j);  for S·level ≤ 53."""
    s = np.array([index, index + 1]) / 2**level  # s = s_0 τ + s_1 σ, and r = 1 - s so, too
    factors = [k * [s] + (S - k) * [1 - s] for k in range(S + 1)]
    return np.array([reduce(np.convolve, row, np.ones(1)) for row in factors])
