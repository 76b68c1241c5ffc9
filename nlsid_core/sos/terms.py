"""Candidates for multipliers and Gram bases, and the terms they contribute to an identity."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from nlsid_core import conic
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.polynomial import Gram, Polynomial, monomials

# Exponents in the indeterminates, column of the unknown, value.
TermColumns: TypeAlias = tuple[IntArray, IntArray, FloatArray]


@dataclass(frozen=True, eq=False)
class Block:
    """One Gram matrix, split by sign symmetry; columns of x start at `starts`."""

    basis: IntArray
    parts: tuple[IntArray, ...]
    starts: tuple[int, ...]

    def gram(self, x: FloatArray, names: Sequence[str]) -> Gram:
        """The Gram matrix that the unknowns x hold."""
        Q = np.zeros((len(self.basis), len(self.basis)))
        for part, start in zip(self.parts, self.starts, strict=True):
            size = len(part) * (len(part) + 1) // 2
            Q[np.ix_(part, part)] = conic.smat(x[start : start + size])
        return Gram(self.basis, Q, tuple(names))


def candidates(names: Sequence[str], forms: Sequence[str], degree: int) -> IntArray:
    """Monomials up to `degree`; with forms y: those in the other variables, times each y_i."""
    if not forms:
        return monomials(len(names), range(degree + 1))
    outer = np.array([name in forms for name in names])
    x = monomials(int((~outer).sum()), range(degree + 1))
    y = np.eye(int(outer.sum()), dtype=np.int64)
    basis = np.zeros((len(x) * len(y), len(names)), dtype=np.int64)
    basis[:, ~outer] = np.repeat(x, len(y), axis=0)
    basis[:, outer] = np.tile(y, (len(x), 1))
    return basis


def inner_degree(exponents: IntArray, inner: FloatArray | IntArray) -> int:
    """The largest degree in the variables that are not forms."""
    return int(np.max(exponents[:, inner].sum(axis=1), initial=0))


def gram_terms(block: Block, g: Polynomial) -> TermColumns:
    """v'Qv·g: x holds svec(Q), so an off-diagonal entry counts √2 times."""
    exponents, columns, values = [], [], []
    for part, start in zip(block.parts, block.starts, strict=True):
        i, j = conic.triangle(len(part))
        pair = block.basis[part][i] + block.basis[part][j]
        weight = np.where(i == j, 1.0, conic.SQRT2)
        exponents.append((pair[:, None] + g.exponents[None]).reshape(-1, pair.shape[1]))
        columns.append(np.repeat(start + np.arange(len(i)), len(g)))
        values.append(np.multiply.outer(weight, g.coefficients.astype(np.float64)).ravel())
    empty = np.zeros((0, block.basis.shape[1]), dtype=np.int64)
    return (
        np.concatenate([empty, *exponents]),
        np.concatenate([np.zeros(0, dtype=np.int64), *columns]),
        np.concatenate([np.zeros(0), *values]),
    )
