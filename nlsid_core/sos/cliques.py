"""The largest m with g ≥ m on x'Px = 1, by many small Gram matrices in place of one.

y = (1, x). Where the terms of degree 3 and 4 of g have two factors of one clique S of variables
each, g - m is shown by Gram matrices of the products y_S ⊗ y, one for each clique, and one of y:
    g - m + (μ + Σ_S x_S'Λ_S x_S)(1 - x'Px) = y'Q y + Σ_S (y_S ⊗ y)'Q_S (y_S ⊗ y).
That is sufficient, and not necessary: multipliers in all products are for `sphere`. A monomial that
several products share may be moved between them, which is what the unknowns are, so every iterate
is exact. What belongs to one clique only is eliminated first: the rest is a small matrix.
Source: Waki, Kim, Kojima and Muramatsu, "Sums of squares and semidefinite program relaxations for
polynomial optimization problems with structured sparsity", SIAM J. Optim. 17 (2006).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.linalg import cho_factor, cho_solve

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import SolverError

MAX_ITERATIONS = 60
STEP_TO_BOUNDARY = 0.95
REGULARISATION = 1e-14  # of the Schur complement's diagonal
CONSTANT, LINEAR = 0.25, 0.75  # of the 1 that Gram matrices of it add up to at the start

Key = tuple[int, ...]  # four increasing entries of y


@dataclass(frozen=True, eq=False)
class CliqueSolution:
    """m ≤ max m ≤ upper. grams: by block. moments: (M,) the dual, for which g'moments = upper."""

    m: float
    upper: float
    grams: tuple[FloatArray, ...]
    moments: FloatArray
    iterations: int


class _Block:
    """A Gram matrix of products of two entries of y: (k, 2) of them; pairs i ≤ j of products."""

    def __init__(self, products: Sequence[tuple[int, int]]) -> None:
        self.products = np.array(products, dtype=np.int64)
        self.k = len(products)
        self.i, self.j = np.triu_indices(self.k)
        self.keys = np.sort(np.hstack([self.products[self.i], self.products[self.j]]), axis=1)
        self._work: FloatArray | None = None  # new memory costs more than what is computed in it
        self.place: dict[Key, int] = {}  # the first pair of every monomial
        self.moved: list[tuple[int, int]] = []  # and pairs that have the same one
        for pair, key in enumerate(map(tuple, self.keys.tolist())):
            first = self.place.setdefault(key, pair)
            if first != pair:
                self.moved.append((first, pair))

    def matrix(self, coefficients: FloatArray) -> FloatArray:
        """The symmetric matrix with these coefficients (pairs,) of the products of pairs."""
        A = np.zeros((self.k, self.k))
        A[self.i, self.j] = coefficients / 2
        return np.asarray(A + A.T)

    def inner(self, A: FloatArray) -> FloatArray:
        """(pairs,) tr(E_pair A) for symmetric A."""
        return np.asarray(A[self.i, self.j])

    def kronecker(self, X: FloatArray, W: FloatArray) -> FloatArray:
        """(pairs, pairs) tr(E_p X E_q W), symmetric; valid until the next call."""
        i, j = self.i, self.j
        if self._work is None:
            self._work = np.empty((3, len(i), len(i)))
        total, left, right = self._work
        total[:] = 0.0
        for a, b in ((i, j), (j, i)):
            for c, d in ((i, j), (j, i)):
                np.take(X[:, a], c, axis=0, out=left)
                np.take(W[:, b], d, axis=0, out=right)
                left *= right
                total += left
        total /= 4
        return np.asarray(total)


@dataclass(frozen=True, eq=False)
class _Changes:
    """What a block's coefficients gain by unknowns: its own, then those of `others`.

    rows, columns, scale: entries; at: of each, its factor's place in (1, P).
    """

    own: int
    others: list[int]
    rows: list[int]
    columns: list[int]
    scale: FloatArray
    at: list[int]

    def matrix(self, pairs: int, P: FloatArray) -> sp.csr_matrix:
        """(pairs, own + others) for one P."""
        values = self.scale * np.concatenate([[1.0], P.ravel()])[self.at]
        return sp.csr_matrix(
            (values, (self.rows, self.columns)), shape=(pairs, self.own + len(self.others))
        )


class CliqueProgram:
    """n variables; cliques: tuples of them. Built once, solved for many P and g."""

    def __init__(self, n: int, cliques: Sequence[tuple[int, ...]]) -> None:
        self.n, self.cliques = n, tuple(cliques)
        self.blocks = [_Block([(0, j) for j in range(n + 1)])]
        for S in self.cliques:
            products = {(min(a + 1, j), max(a + 1, j)) for a in S for j in range(n + 1)}
            self.blocks.append(_Block(sorted(products)))
        homes: dict[Key, list[int]] = {}
        for number, block in enumerate(self.blocks):
            for key in block.place:
                homes.setdefault(key, []).append(number)
        self._homes = homes
        self._index = {key: place for place, key in enumerate(homes)}
        self._of_pairs = [
            np.array([self._index[key] for key in map(tuple, block.keys.tolist())])
            for block in self.blocks
        ]
        self._counts = np.bincount(np.concatenate(self._of_pairs))
        self._changes, self._unknowns = self._made()

    def _made(self) -> tuple[list[_Changes], int]:
        """By block what unknowns change: m, μ, Λ, and what is moved between blocks."""
        n, blocks = self.n, self.blocks
        found: list[list[tuple[int, int, float, int]]] = [[] for _ in blocks]
        one, squares = (0, 0, 0, 0), [(i, j) for i in range(n) for j in range(i, n)]

        def level(number: int, unknown: int, a: int, b: int) -> None:
            """Add unknown y_a y_b (1 - x'Px)."""
            base = sorted((a, b))
            found[0].append((blocks[0].place[0, 0, *base], unknown, 1.0, 0))
            for i, j in squares:
                key = sorted((*base, i + 1, j + 1))
                pair = blocks[number].place[key[0], key[1], key[2], key[3]]
                found[number].append((pair, unknown, -1.0 - (i != j), 1 + i * n + j))

        found[0].append((blocks[0].place[one], 0, -1.0, 0))
        level(0, 1, 0, 0)
        unknowns = 2
        done: set[tuple[int, int]] = set()
        for number, S in enumerate(self.cliques, start=1):
            for a, b in [(a, b) for a in S for b in S if a <= b and (a, b) not in done]:
                done.add((a, b))
                level(number, unknowns, a + 1, b + 1)
                unknowns += 1
        for key, numbers in self._homes.items():
            for other in numbers[1:]:
                found[numbers[0]].append((blocks[numbers[0]].place[key], unknowns, -1.0, 0))
                found[other].append((blocks[other].place[key], unknowns, 1.0, 0))
                unknowns += 1
        changes = []
        for block, entries in zip(blocks, found, strict=True):
            others = sorted({unknown for _, unknown, _, _ in entries})
            place = {unknown: len(block.moved) + i for i, unknown in enumerate(others)}
            entries = [(pair, place[unknown], by, at) for pair, unknown, by, at in entries]
            for unknown, (first, pair) in enumerate(block.moved):
                entries += [(first, unknown, -1.0, 0), (pair, unknown, 1.0, 0)]
            rows, columns, scale, at = zip(*entries, strict=True)
            changes.append(
                _Changes(
                    len(block.moved), others, list(rows), list(columns), np.array(scale), list(at)
                )
            )
        return changes, unknowns

    def vector(self, g: dict[Key, float]) -> FloatArray:
        """(M,) g in the program's monomials; KeyError if one of its terms has no place."""
        found = np.zeros(len(self._index))
        for key, value in g.items():
            found[self._index[key]] += value
        return found

    def _means(self, P: FloatArray) -> list[FloatArray]:
        """Over the ellipsoid, of the products of each block."""
        n = self.n
        C = np.zeros((n + 1, n + 1))
        C[1:, 1:] = np.linalg.inv(P)
        found: list[FloatArray] = []
        for block in self.blocks:
            a, b, c, d = block.keys.T  # sorted: zeros first
            degree = (block.keys > 0).sum(axis=1)
            four = (C[a, b] * C[c, d] + C[a, c] * C[b, d] + C[a, d] * C[b, c]) / (n * (n + 2))
            two = C[c, d] / n
            value = np.select([degree == 4, degree == 2, degree == 0], [four, two, 1.0], 0.0)
            A = np.zeros((block.k, block.k))
            A[block.i, block.j] = A[block.j, block.i] = value
            found.append(A)
        return found

    def _ones(self, P: FloatArray) -> list[FloatArray]:
        """Positive definite Gram matrices that add up to 1 on the ellipsoid."""
        n, times = self.n, np.zeros(self.n)
        for S in self.cliques:
            times[list(S)] += 1
        gamma = LINEAR * float(np.linalg.eigvalsh(P)[0]) / (4 * times.max())
        base = np.zeros((n + 1, n + 1))
        base[0, 0] = CONSTANT
        base[1:, 1:] = LINEAR * P - 2 * gamma * np.diag(times)
        found: list[FloatArray] = [base]
        for S, block in zip(self.cliques, self.blocks[1:], strict=True):
            home = {(int(a), int(b)): place for place, (a, b) in enumerate(block.products)}
            A = np.zeros((block.k, block.k))
            for a in S:
                rows = [home[min(a, j) + 1, max(a, j) + 1] for j in range(n)]
                A[np.ix_(rows, rows)] += gamma * P
                A[home[0, a + 1], home[0, a + 1]] += gamma
            found.append(A)
        return found

    def solve(self, P: FloatArray, g: FloatArray, *, tolerance: float = 1e-6) -> CliqueSolution:
        """Maximise m for g (M,) of `vector` on x'Px = 1, P of unit diagonal.

        tolerance: of m, in the unit of g's largest coefficient. Raises SolverError.
        """
        try:
            return self._solved(P, g, tolerance)
        except np.linalg.LinAlgError as failure:
            raise SolverError(f"clique program: {failure}") from failure

    def _solved(self, P: FloatArray, g: FloatArray, tolerance: float) -> CliqueSolution:
        """A primal-dual interior point with predictor and corrector, in the HKM direction."""
        blocks, size = self.blocks, float(np.abs(g).max()) or 1.0
        B = [
            changes.matrix(len(block.i), P)
            for changes, block in zip(self._changes, blocks, strict=True)
        ]
        X, ones = self._means(P), self._ones(P)
        shares = g / size / self._counts
        Z = [b.matrix(shares[of]) for b, of in zip(blocks, self._of_pairs, strict=True)]
        lowest = 0.0
        for A, one in zip(Z, ones, strict=True):
            L = np.linalg.inv(np.linalg.cholesky(one))
            lowest = min(lowest, float(np.linalg.eigvalsh(L @ A @ L.T)[0]))
        m = lowest - 1.0
        Z = [A - m * one for A, one in zip(Z, ones, strict=True)]
        total = sum(block.k for block in blocks)
        for iteration in range(MAX_ITERATIONS):
            gap = sum(float(np.vdot(x, z)) for x, z in zip(X, Z, strict=True))
            if gap <= tolerance:
                moments = np.zeros(len(g))
                for block, of, x in zip(blocks, self._of_pairs, X, strict=True):
                    moments[of] = block.inner(x)
                scaled = tuple(size * z for z in Z)
                return CliqueSolution(size * m, size * (m + gap), scaled, moments, iteration)
            Lx, Lz = ([np.linalg.cholesky(A) for A in matrices] for matrices in (X, Z))
            W = [cho_solve((L, True), np.eye(len(L))) for L in Lz]
            schur = _Schur(self, B, X, W)
            dZ, dm = schur.direction([np.zeros(part.shape[1]) for part in B])
            dX = [-x - _symmetric(x @ dz @ w) for x, dz, w in zip(X, dZ, W, strict=True)]
            a, b = _longest(dX, Lx), _longest(dZ, Lz)
            predicted = sum(
                float(np.vdot(x + a * dx, z + b * dz))
                for x, dx, z, dz in zip(X, dX, Z, dZ, strict=True)
            )
            centre = gap / total * min(1.0, max(predicted / gap, 0.0)) ** 2
            second = [
                centre * w - _symmetric(dx @ dz @ w) for dx, dz, w in zip(dX, dZ, W, strict=True)
            ]
            dZ, dm = schur.direction(
                [part.T @ block.inner(s) for part, block, s in zip(B, blocks, second, strict=True)]
            )
            dX = [
                s - x - _symmetric(x @ dz @ w) for x, dz, w, s in zip(X, dZ, W, second, strict=True)
            ]
            a, b = _longest(dX, Lx), _longest(dZ, Lz)
            X = [x + a * dx for x, dx in zip(X, dX, strict=True)]
            Z = [z + b * dz for z, dz in zip(Z, dZ, strict=True)]
            m += b * dm
        raise SolverError(f"clique program: a gap of {gap:.1e} after {MAX_ITERATIONS} iterations")


class _Schur:
    """The matrix of the unknowns: block diagonal in a block's own, bordered by the others."""

    def __init__(
        self,
        program: CliqueProgram,
        B: list[sp.csr_matrix],
        X: Sequence[FloatArray],
        W: Sequence[FloatArray],
    ) -> None:
        self.program, self.B = program, B
        border = np.zeros((program._unknowns, program._unknowns))
        self.parts = []
        for changes, block, part, x, w in zip(
            program._changes, program.blocks, B, X, W, strict=True
        ):
            own, others = changes.own, changes.others
            H = np.asarray(part.T @ (part.T @ block.kronecker(x, w)).T)
            inner = H[:own, :own]
            inner[np.diag_indices(own)] *= 1 + REGULARISATION
            factor = cho_factor(inner, lower=True) if own else None
            across = cho_solve(factor, H[:own, own:]) if factor else np.zeros((0, len(others)))
            border[np.ix_(others, others)] += H[own:, own:] - H[own:, :own] @ across
            self.parts.append((factor, across))
        border[np.diag_indices(len(border))] *= 1 + REGULARISATION
        self.factor = cho_factor((border + border.T) / 2, lower=True)

    def direction(self, pull: list[FloatArray]) -> tuple[list[FloatArray], float]:
        """dZ and dm where the gradient is that of m and `pull`, by block."""
        program, rest = self.program, np.zeros(self.program._unknowns)
        rest[0] = 1.0
        for changes, (_, across), row in zip(program._changes, self.parts, pull, strict=True):
            rest[changes.others] += row[changes.own :] - across.T @ row[: changes.own]
        du = cho_solve(self.factor, rest)
        dZ = []
        for changes, block, part, (factor, across), row in zip(
            program._changes, program.blocks, self.B, self.parts, pull, strict=True
        ):
            others = du[changes.others]
            own = cho_solve(factor, row[: changes.own]) if factor else np.zeros(0)
            dZ.append(block.matrix(part @ np.concatenate([own - across @ others, others])))
        return dZ, float(du[0])


def _symmetric(A: FloatArray) -> FloatArray:
    return np.asarray((A + A.T) / 2)


def _longest(steps: Sequence[FloatArray], factors: Sequence[FloatArray]) -> float:
    """How far all of the matrices may go and stay positive definite, 1 at most."""
    lowest = 0.0
    for step, L in zip(steps, factors, strict=True):
        inverse = np.linalg.inv(L)
        lowest = min(lowest, float(np.linalg.eigvalsh(_symmetric(inverse @ step @ inverse.T))[0]))
    return min(1.0, STEP_TO_BOUNDARY / -lowest) if lowest < 0 else 1.0
