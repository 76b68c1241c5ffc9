"""An interior point for V-steps, whose matrices are small, many and coupled from knot to knot.

With x_κ the unknowns of knot κ and c_i known by its values at N points:
    minimise Σ cost_κ'x_κ   subject to   v_j'Q_i v_j = g_ij + (B_i x)_j,  Q_i ⪰ 0,  F_κl(x_κ) ⪰ 0
where B_i x is of two neighbouring knots. With Z_i = Σ_j y_ij v_j v_j' the Schur complement of Q_i
is a Hadamard product, as in `sos.sphere`, and what is left in x is block tridiagonal.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, blas, cho_solve_banded, cholesky_banded, lapack

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.errors import SolverError

MAX_ITERATIONS = 40  # some 10 are usual
GAP = 5e-2  # relative to Σ|cost|: L-steps judge what is found
FEASIBLE = 1e-3  # of c's values, relative to the largest: L-steps judge this too
STEP_TO_BOUNDARY = 0.95
CENTRING_POWER = 3  # Mehrotra's


@dataclass(frozen=True, eq=False)
class ShapeProgram:
    """V: (N, k) the v_j, of which the mean of v_j v_j' is I. g: (S, N). B: (S, 2, u, N), of the
    earlier knot and the later; first: (S,), the earlier. Knots beyond the K free ones are fixed.
    F: (K, L, 1 + u, n, n), the constant and what each unknown multiplies. cost: (K, u).
    """

    V: FloatArray
    g: FloatArray
    B: FloatArray
    first: IntArray
    F: FloatArray
    cost: FloatArray

    def solve(self, x: FloatArray) -> FloatArray:
        """x (K, u) near the optimum, from one with F(x) ≻ 0. SolverError if the c_i are not met."""
        (N, k), S = self.V.shape, len(self.g)
        Q, y = np.repeat(np.eye(k)[None] / k, S, axis=0), np.full((S, N), 1.0 / N)
        U = np.linalg.inv(self.inequalities(x)) * abs(self.cost).max()
        order = S * k + int(np.prod(U.shape[:3]))
        best = None
        for _ in range(MAX_ITERATIONS):
            here = _Iterate(self, x, Q, y, U)
            total = here.complementarity()
            if np.abs(_squares(self.V, Q) - here.wanted).max() <= FEASIBLE:
                best = x
                if total <= GAP * np.abs(self.cost).sum():
                    break
            try:
                system = _System(here)
                step = system.towards(0.0)
                a, b = here.lengths(step)
                aim = min(1.0, max(here.complementarity(step, a, b) / total, 0.0))
                step = system.towards(total / order * aim**CENTRING_POWER, step)
                a, b = here.lengths(step)
            except LinAlgError:  # rounding: what was found before has to do
                break
            x, Q, y, U = x + a * step.x, Q + a * step.Q, y + b * step.y, U + b * step.U
        if best is None:
            raise SolverError("the V-step found no P(t) that keeps the margins")
        return best

    def inequalities(self, x: FloatArray) -> FloatArray:
        """F(x) (K, L, n, n)."""
        return np.asarray(self.F[:, :, 0] + self.rates(x))

    def rates(self, dx: FloatArray) -> FloatArray:
        """F(x + dx) - F(x)."""
        return np.asarray(np.einsum("flaij,fa->flij", self.F[:, :, 1:], dx))

    def moved(self, dx: FloatArray) -> FloatArray:
        """(S, N): what dx adds to c at the points."""
        ends = np.concatenate([dx, np.zeros((2, dx.shape[1]))])
        pairs = np.stack([ends[self.first], ends[self.first + 1]], axis=1)
        return np.asarray(np.einsum("seuj,seu->sj", self.B, pairs))

    def gathered(self, values: FloatArray) -> FloatArray:
        """(K, u): Σ_i B_i' values_i."""
        total = np.zeros((len(self.cost) + 2, self.cost.shape[1]))
        parts = np.einsum("seuj,sj->seu", self.B, values)
        for later in (0, 1):
            np.add.at(total, self.first + later, parts[:, later])
        return total[: len(self.cost)]


@dataclass(frozen=True, eq=False)
class _Direction:
    x: FloatArray
    Q: FloatArray
    y: FloatArray
    Z: FloatArray
    U: FloatArray
    F: FloatArray


class _Iterate:
    """x, Q (S, k, k), y (S, N), multipliers U (K, L, n, n), and what follows from them."""

    def __init__(
        self, program: ShapeProgram, x: FloatArray, Q: FloatArray, y: FloatArray, U: FloatArray
    ) -> None:
        V = program.V
        self.program, self.Q, self.y, self.U = program, Q, y, U
        self.Z, self.F = (V.T * y[:, None, :]) @ V, program.inequalities(x)
        self.wanted = program.g + program.moved(x)

    def complementarity(self, step: _Direction | None = None, a: float = 0, b: float = 0) -> float:
        """⟨Q, Z⟩ + ⟨U, F⟩, after steps of length a and b."""
        if step is None:
            return float(np.vdot(self.Q, self.Z) + np.vdot(self.U, self.F))
        first = np.vdot(self.Q + a * step.Q, self.Z + b * step.Z)
        return float(first + np.vdot(self.U + b * step.U, self.F + a * step.F))

    def lengths(self, step: _Direction) -> tuple[float, float]:
        """How far x and Q can go, and how far y and U."""
        first = min(_longest(self.Q, step.Q), _longest(self.F, step.F))
        return first, min(_longest(self.Z, step.Z), _longest(self.U, step.U))


class _System:
    """The linear system of the HKM direction at an iterate; every direction is a side of it."""

    def __init__(self, here: _Iterate) -> None:
        self.here, p = here, here.program
        (K, u), N = p.cost.shape, len(p.V)
        self.inverse_Z, self.inverse_F = np.linalg.inv(here.Z), np.linalg.inv(here.F)
        self.diagonal = _squares(p.V, self.inverse_Z)
        across = p.V @ np.linalg.cholesky(here.Q)
        dual = p.V @ np.linalg.cholesky(self.inverse_Z)
        self.factors = []
        blocks = np.zeros((K + 2, 2, u, u))  # of knots (κ, κ) and (κ, κ + 1)
        for i, first in enumerate(p.first.tolist()):
            M = blas.dsyrk(1.0, across[i].T, trans=1, lower=1)
            M *= blas.dsyrk(1.0, dual[i].T, trans=1, lower=1)
            factor, info = lapack.dpotrf(M, lower=1, clean=0, overwrite_a=1)
            if info:
                raise LinAlgError("the Schur complement is not positive definite")
            self.factors.append(factor)
            half, _ = lapack.dtrtrs(factor, p.B[i].reshape(2 * u, N).T, lower=1)
            normal = half.T @ half
            blocks[first, 0] += normal[:u, :u]
            blocks[first, 1] += normal[:u, u:]
            blocks[first + 1, 0] += normal[u:, u:]
        rates = p.F[:, :, 1:]
        bent = here.U[:, :, None] @ rates @ self.inverse_F[:, :, None]
        own = np.einsum("flaij,flbji->fab", rates, bent)
        blocks[:K, 0] += (own + own.transpose(0, 2, 1)) / 2
        self.normal = cholesky_banded(_band(blocks[:K]), lower=True)

    def towards(self, mu: float, before: _Direction | None = None) -> _Direction:
        """The step to the central path's point μ; before: the predictor, for its second order."""
        here, p, V = self.here, self.here.program, self.here.program.V
        aims = mu * self.diagonal - here.wanted
        Q, U = mu * self.inverse_Z - here.Q, mu * self.inverse_F - here.U
        if before is not None:
            bend = _symmetric(before.Q @ before.Z @ self.inverse_Z)
            aims, Q = aims - _squares(V, bend), Q - bend
            U -= _symmetric(before.U @ before.F @ self.inverse_F)
        side = p.gathered(here.y + self._solve(aims)) - p.cost
        side += np.einsum("flaij,flij->fa", p.F[:, :, 1:], here.U + U)
        x = cho_solve_banded((self.normal, True), side.ravel()).reshape(side.shape)
        y = self._solve(aims - p.moved(x))
        Z, F = (V.T * y[:, None, :]) @ V, p.rates(x)
        Q -= _symmetric(here.Q @ Z @ self.inverse_Z)
        U -= _symmetric(here.U @ F @ self.inverse_F)
        return _Direction(x, Q, y, Z, U, F)

    def _solve(self, sides: FloatArray) -> FloatArray:
        """(S, N): M_i⁻¹ sides_i."""
        pairs = zip(self.factors, sides, strict=True)
        return np.array([lapack.dpotrs(factor, side, lower=1)[0] for factor, side in pairs])


def _squares(V: FloatArray, Q: FloatArray) -> FloatArray:
    """(S, N): v_j'Q_i v_j."""
    return np.asarray(np.einsum("sjk,jk->sj", V @ Q, V))


def _symmetric(A: FloatArray) -> FloatArray:
    return np.asarray((A + A.swapaxes(-1, -2)) / 2)


def _longest(A: FloatArray, dA: FloatArray) -> float:
    """The longest step that keeps A + step·dA positive definite, with room; at most 1."""
    inverse = np.linalg.inv(np.linalg.cholesky(A))
    lowest = float(np.linalg.eigvalsh(inverse @ dA @ inverse.swapaxes(-1, -2)).min())
    return min(1.0, STEP_TO_BOUNDARY / -lowest) if lowest < 0 else 1.0


def _band(blocks: FloatArray) -> FloatArray:
    """The lower band of the block tridiagonal matrix of blocks (κ, κ), (κ, κ + 1)."""
    count, _, u, _ = blocks.shape
    band = np.zeros((2 * u, count * u))
    i, j = np.indices((u, u))
    for knot, (own, across) in enumerate(blocks):
        low = i >= j
        band[(i - j)[low], knot * u + j[low]] = own[low]
        if knot + 1 < count:
            band[(u + j - i), knot * u + i] = across
    return band
