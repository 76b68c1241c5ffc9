"""State-affine models of one output, constant lags and quadratic q = G_0, kept convex and stable.

Around an iterate with the bounds ℓ_m ≤ q ≤ h_m on the input box and storage function P, keep
    [r²(2 q̄ q̄_m - q̄_m²) P, (q̄ S - e₁g)'P; P(q̄ S - e₁g), P] ⪰ 0   at q̄ = ℓ and q̄ = h,
    ℓ ≤ q(w) ≤ h on the box (S-procedure with multipliers of (w_i - lo_i)(hi_i - w_i)),
g = [G_1 … G_n]. Since q̄² ≥ 2 q̄ q̄_m - q̄_m² it implies r²P - A'PA ⪰ 0 at both ends, and the last
iterate satisfies it. P is centred again after every iterate.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import ShapeError
from nlsid_core.identification.methods.inequalities import (
    MatrixInequality,
    centre,
    minimise_linear,
    traceless,
)
from nlsid_core.identification.polynomial.matrix_set import SLOWEST_RATE
from nlsid_core.identification.polynomial.rows import StateAffineRows
from nlsid_core.identification.proofs.leading_bounds import box_inequalities, leading_bounds
from nlsid_core.identification.proofs.stability import StabilityProof
from nlsid_core.models import StateAffineModel

START_BOUNDS = (0.9, 1.1)  # of G_0 around the first iterate's start G = I
START_SLACK = 0.05  # of those bounds, spent on the multipliers of the box
GROWTH = 4.0  # of h from one iterate to the next, at most: with one lag nothing else bounds it
STOP_MARGIN = 1e-10  # λ_min of r²P - A'PA, tr P = n, that counts as feasible
TIGHT = 1e-4  # of h - ℓ, how tightly the bounds of G_0 are stated


@dataclass(frozen=True, eq=False)
class BoundedSet:
    """The set around P (n, n) and ℓ_m, h_m. Unknowns [θ; ℓ; h; lower, upper multipliers].

    Raises ShapeError for G_0 of degree above 2.
    """

    problem: StateAffineRows
    P: FloatArray
    linearised_at: FloatArray  # ℓ_m, h_m
    extra: FloatArray  # [ℓ; h; lower, upper multipliers] strictly inside

    def __post_init__(self) -> None:
        if (self.problem.left[0].sum(axis=1) > 2).any():
            raise ShapeError("certified iterates are for a leading coefficient of degree 2 at most")

    @classmethod
    def start(cls, problem: StateAffineRows) -> "BoundedSet":
        """The set around G = I."""
        n, box = len(problem.left) - 1, problem.window_range()
        weights = START_SLACK / (len(box) * 0.25 * (box[:, 1] - box[:, 0]) ** 2)
        extra = np.concatenate([START_BOUNDS, weights, weights])
        fall = 0.5 * _rate(problem) ** 2
        return cls(problem, np.diag(fall ** np.arange(n)), np.array([1.0, 1.0]), extra)

    @classmethod
    def of_proof(
        cls, problem: StateAffineRows, model: StateAffineModel, proof: StabilityProof
    ) -> "BoundedSet":
        """A set that the model with its proof is strictly inside of."""
        found = leading_bounds(model)
        if found is None:
            raise ShapeError("the last step needs a positive leading coefficient")
        bounds, multipliers = found
        lagged = np.array([g.coefficients.sum() for g in model.G[1:]])
        P = _common_storage([companion(lagged, q) for q in bounds], _rate(problem))
        return cls(
            problem,
            proof.P if P is None else P,
            np.array(bounds),
            np.concatenate([bounds, *multipliers]),
        )

    def inequalities(self) -> tuple[MatrixInequality, ...]:
        """Both ends' contraction, both bounds on the box, growth, and nonnegative multipliers."""
        problem, P, linearised_at = self.problem, self.P, self.linearised_at
        n, box = len(problem.left) - 1, problem.window_range()
        n_q, n_w = len(problem.left[0]), len(box)
        n_g = n_q + n
        size, rate = 1 + n_g + 2 + 2 * n_w, _rate(problem)
        S = np.diag(np.ones(n - 1), -1)
        result = []
        for end in (0, 1):
            F = np.zeros((size, 2 * n, 2 * n))
            F[0, :n, :n] = -((rate * linearised_at[end]) ** 2) * P
            F[0, n:, n:] = P
            level = F[1 + n_g + end]
            level[:n, :n] = 2.0 * rate**2 * linearised_at[end] * P
            level[n:, :n], level[:n, n:] = P @ S, (P @ S).T
            for k in range(n):
                entry = F[1 + n_q + k]
                entry[n:, k] = entry[k, n:] = -P[:, 0]
            result.append(MatrixInequality(F))
        for part in box_inequalities(problem.left[0], box):
            F = np.zeros((size, n_w + 1, n_w + 1))
            F[1 : 1 + n_q], F[1 + n_g :] = part[:n_q], part[n_q:]
            result.append(MatrixInequality(F))
        F = np.zeros((size, 1, 1))
        F[0], F[1 + n_g + 1] = GROWTH * linearised_at[1], -1.0
        result.append(MatrixInequality(F))
        F = np.zeros((size, 2 * n_w, 2 * n_w))
        for i in range(2 * n_w):
            F[1 + n_g + 2 + i, i, i] = 1.0
        return (*result, MatrixInequality(F))

    def renewed(self, theta: FloatArray, extra: FloatArray) -> "BoundedSet":
        """The set around θ: the tightest bounds there, and P centred between them."""
        n = len(self.P)
        tight = _tightened(self.inequalities()[2:], theta, extra)
        A = [companion(theta[-n:], q) for q in tight[:2]]
        P = _centred(self.P, A, _rate(self.problem))
        return BoundedSet(self.problem, P, tight[:2], tight)


def _tightened(
    bounds: Sequence[MatrixInequality], theta: FloatArray, extra: FloatArray
) -> FloatArray:
    """The largest ℓ and smallest h that the multipliers of the box can show for this θ."""
    fixed = [
        MatrixInequality(
            np.concatenate(
                [[b.F[0] + np.tensordot(theta, b.F[1 : 1 + len(theta)], 1)], b.F[1 + len(theta) :]]
            )
        )
        for b in bounds
    ]
    objective = np.zeros(len(extra))
    objective[:2] = -1.0, 1.0
    gap = TIGHT * float(extra[1] - extra[0])
    tight = minimise_linear(objective, fixed, extra, gap=gap)
    n_w = len(extra) // 2 - 1
    lower, upper = [0, *range(2, 2 + n_w)], [1, *range(2 + n_w, 2 + 2 * n_w)]
    for part, better in ((lower, tight[0] > extra[0]), (upper, tight[1] < extra[1])):
        if not better:
            tight[part] = extra[part]
    return tight


def _rate(problem: StateAffineRows) -> float:
    return min(SLOWEST_RATE, problem.slowest)


def _centred(P: FloatArray, matrices: list[FloatArray], rate: float) -> FloatArray:
    """The analytic centre of {P : r²P - A'PA ≻ 0 for every A, tr P = n}, from P in it."""
    n = len(P)
    basis = traceless(n)
    start = P * n / np.trace(P)
    images = [np.stack([rate**2 * X - A.T @ X @ A for X in (start, *basis)]) for A in matrices]
    inequalities = [MatrixInequality(F) for F in images]
    z = centre(inequalities, np.zeros(len(basis)))
    return np.asarray(start + np.tensordot(z, basis, axes=1))


def _common_storage(matrices: list[FloatArray], rate: float) -> FloatArray | None:
    """P, tr P = n, that maximises the least eigenvalue of r²P - A'PA over the matrices."""
    n = len(matrices[0])
    basis = traceless(n)
    inequalities = []
    for A in matrices:
        images = [rate**2 * X - A.T @ X @ A for X in (np.eye(n), *basis)]
        inequalities.append(MatrixInequality(np.array([*images, -np.eye(n)])))
    objective = np.zeros(len(basis) + 1)
    objective[-1] = -1.0
    start = np.zeros(len(basis) + 1)
    start[-1] = -1.0 + min(np.linalg.eigvalsh(i.F[0])[0] for i in inequalities)
    z = minimise_linear(objective, inequalities, start, gap=0.1 * STOP_MARGIN)
    if z[-1] < STOP_MARGIN:
        return None
    return np.asarray(np.eye(n) + np.tensordot(z[:-1], basis, axes=1))


def companion(lagged: FloatArray, q: float) -> FloatArray:
    """A(1/q) of x = [ȳ(t-1); …; ȳ(t-n)] for constants `lagged` = [G_1 … G_n]."""
    A = np.diag(np.ones(len(lagged) - 1), -1)
    A[0] -= lagged / q
    return A
