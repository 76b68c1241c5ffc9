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

from nlsid_core._types import FloatArray
from nlsid_core.errors import ShapeError
from nlsid_core.identification.contraction import (
    StateAffineProof,
    box_inequalities,
    companion,
    leading_bounds,
    traceless,
)
from nlsid_core.identification.inequalities import MatrixInequality, centre, minimise_linear
from nlsid_core.identification.matrix_proof import MatrixProof
from nlsid_core.identification.matrix_set import SLOWEST_RATE
from nlsid_core.identification.state_affine import StateAffineRows
from nlsid_core.models import StateAffineModel

START_BOUNDS = (0.9, 1.1)  # of G_0 around the first iterate's start G = I
START_SLACK = 0.05  # of those bounds, spent on the multipliers of the box
GROWTH = 4.0  # of h from one iterate to the next, at most: with one lag nothing else bounds it
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
        return cls(problem, np.diag(0.5 ** np.arange(n)), np.array([1.0, 1.0]), extra)

    @classmethod
    def of_proof(
        cls,
        problem: StateAffineRows,
        model: StateAffineModel,
        proof: StateAffineProof | MatrixProof,
    ) -> "BoundedSet":
        """A set that the model with its proof is strictly inside of."""
        if isinstance(proof, MatrixProof):
            raise ShapeError("the last step needs the proof by bounds of the leading coefficient")
        bounds, multipliers = proof.bounds, proof.multipliers
        if bounds is None or multipliers is None:  # a constant G_0 was proved without
            found_bounds = leading_bounds(model)
            if found_bounds is None:
                raise ShapeError("the last step needs a positive leading coefficient")
            bounds, multipliers = found_bounds
        return cls(problem, proof.P, np.array(bounds), np.concatenate([bounds, *multipliers]))

    def inequalities(self) -> tuple[MatrixInequality, ...]:
        """Both ends' contraction, both bounds on the box, growth, and nonnegative multipliers."""
        problem, P, linearised_at = self.problem, self.P, self.linearised_at
        n, box = len(problem.left) - 1, problem.window_range()
        n_q, n_w = len(problem.left[0]), len(box)
        n_g = n_q + n
        size = 1 + n_g + 2 + 2 * n_w
        S = np.diag(np.ones(n - 1), -1)
        result = []
        for end in (0, 1):
            F = np.zeros((size, 2 * n, 2 * n))
            F[0, :n, :n] = -((SLOWEST_RATE * linearised_at[end]) ** 2) * P
            F[0, n:, n:] = P
            level = F[1 + n_g + end]
            level[:n, :n] = 2.0 * SLOWEST_RATE**2 * linearised_at[end] * P
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
        P = _centred(self.P, [companion(theta[-n:], q) for q in tight[:2]])
        return BoundedSet(self.problem, P, tight[:2], tight)


def _tightened(
    bounds: Sequence[MatrixInequality], theta: FloatArray, extra: FloatArray
) -> FloatArray:
    """The largest ℓ and smallest h that the multipliers of the box can show for this θ."""
    fixed = [
        MatrixInequality(np.concatenate([[b.F[0] + np.tensordot(theta, b.F[1 : 1 + len(theta)], 1)],
                                         b.F[1 + len(theta) :]]))
        for b in bounds
    ]  # fmt: skip
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


def _centred(P: FloatArray, matrices: list[FloatArray]) -> FloatArray:
    """The analytic centre of {P : r²P - A'PA ≻ 0 for every A, tr P = n}, from P in it."""
    n = len(P)
    basis = traceless(n)
    start = P * n / np.trace(P)
    images = [
        np.stack([SLOWEST_RATE**2 * X - A.T @ X @ A for X in (start, *basis)]) for A in matrices
    ]
    inequalities = [MatrixInequality(F) for F in images]
    z = centre(inequalities, np.zeros(len(basis)))
    return np.asarray(start + np.tensordot(z, basis, axes=1))
