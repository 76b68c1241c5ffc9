"""State-affine models of several outputs, or input-dependent lags, kept convex and stable.

With x = [ȳ(t-1); …; ȳ(t-n)], ξ = [ȳ(t); x], V = |x|²_P and a multiplier M of the equation,
    r²|[ξ₁; …; ξ_n]|²_P - |[ξ₀; …; ξ_{n-1}]|²_P + 2 ξ'M'[G_0 … G_n](w) ξ ≥ 0,   P ≻ 0,
at every corner w of the input box: it is affine in G_0 … G_n, those in w, so it holds in between,
and along differences of solutions it says V⁺ ≤ r²V. For a fixed M it is affine in the coefficients
and P together, for fixed coefficients in P and M: the first is searched, then the second centred.
Source: thesis Lemma 2.11, (4.1); `stability` for the proof of one model, N = M'.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import ShapeError
from nlsid_core.identification.methods.inequalities import MatrixInequality, centre, traceless
from nlsid_core.identification.polynomial.rows import StateAffineRows
from nlsid_core.identification.proofs.stability import StabilityProof
from nlsid_core.models import StateAffineModel
from nlsid_core.polynomial.values import monomial_values

SLOWEST_RATE = 1.0 - 1e-6  # V shrinks by its square at least, so that the proof is strict
SLOWEST_IN_BOX = 1.0 - 1e-3  # the same where w matters: the search for a proof needs more room
GROWTH = 4.0  # of G_0 from one iterate to the next, at most, as its multiplier weighs it
MOST_CORNERS = 4096  # of the input box, a matrix for each
LARGEST_MULTIPLIER = 100.0  # of the mean eigenvalue of P: where nothing else bounds M


@dataclass(frozen=True, eq=False)
class MatrixSet:
    """The set around θ with P (n n_y, n n_y), M (n_y, (n + 1) n_y). Unknowns [θ; entries of P].

    Raises ShapeError unless the coefficients are of degree 1 at most, in few inputs.
    """

    problem: StateAffineRows
    P: FloatArray
    M: FloatArray
    theta: FloatArray

    def __post_init__(self) -> None:
        if any((g.sum(axis=1) > 1).any() for g in self.problem.left):
            raise ShapeError(
                "certified iterates of several outputs, or of lagged coefficients that depend on "
                "the input, are for degree 1 at most; minimise the robust simulation error and "
                "prove that model instead"
            )
        used = int(_used(self.problem).sum())
        if 2**used > MOST_CORNERS:
            raise ShapeError(
                f"certified iterates visit the 2^{used} corners of the inputs that coefficients "
                f"of the outputs depend on; they may be {MOST_CORNERS}: use fewer delays"
            )

    @classmethod
    def start(cls, problem: StateAffineRows) -> "MatrixSet":
        """The set around G = I."""
        n, n_y = len(problem.left) - 1, len(problem.y_scale[0])
        fall = 0.5 * slowest_rate(problem) ** 2
        P = np.kron(np.diag(fall ** np.arange(n)), np.eye(n_y))
        return cls(problem, P, np.eye(n_y, (n + 1) * n_y), problem.rows.identity)

    @classmethod
    def of_proof(
        cls, problem: StateAffineRows, model: StateAffineModel, proof: StabilityProof
    ) -> "MatrixSet":
        """A set that the model is strictly inside of, if its proved rate is below the set's.

        Raises ShapeError if the proof has no multiplier that serves the whole box.
        """
        if proof.multipliers is None or "N" not in proof.multipliers:
            raise ShapeError("the last step needs a proof with one multiplier for the whole box")
        theta = np.concatenate([g.coefficients.ravel() for g in model.G])
        return cls(problem, proof.P, np.array(proof.multipliers["N"]).T, theta)

    @property
    def extra(self) -> FloatArray:
        """The entries of P, in the order of the unknowns."""
        return self.P[np.triu_indices(len(self.P))]

    def inequalities(self) -> tuple[MatrixInequality, ...]:
        """A decrease at every corner, P, and the scale of θ, which the error does not depend on."""
        n_P, size = len(self.extra), len(self.P)
        basis = np.array([_symmetric(entry, size) for entry in np.eye(n_P)])
        corners = _coefficients(self.problem)
        n_theta = corners.shape[1]
        positive = np.zeros((1 + n_theta + n_P, size, size))
        positive[1 + n_theta :] = basis
        result = [MatrixInequality(positive)]
        decrease = _decrease(self.problem, basis)
        slopes = _twice_symmetric(self.M.T @ corners).transpose(1, 0, 2, 3)
        of_P = np.broadcast_to(decrease[:, None], (n_P, *slopes.shape[1:]))
        result.append(MatrixInequality(np.concatenate([0.0 * slopes[:1], slopes, of_P])))
        lead = len(self.M)
        scale = np.einsum("ab,viab->i", self.M[:, :lead], corners[..., :lead])  # Σ tr T G_0
        limit = np.zeros((1 + n_theta + n_P, 1, 1))
        limit[0], limit[1 : 1 + n_theta, 0, 0] = GROWTH * float(scale @ self.theta), -scale
        result.append(MatrixInequality(limit))
        return tuple(result)

    def renewed(self, theta: FloatArray, extra: FloatArray) -> "MatrixSet":
        """The set around the analytic centre of P and M at θ, from P's entries inside this one."""
        problem, n_y, size = self.problem, len(self.M), len(self.P)
        P = _symmetric(extra, size)
        scale = size / np.trace(P)
        P, M = scale * P, scale * self.M
        moves, columns = traceless(size), size + n_y
        multipliers = np.eye(n_y * columns).reshape(-1, n_y, columns)
        n_P, n_M = len(moves), len(multipliers)
        positive = np.zeros((1 + n_P + n_M, size, size))
        positive[0], positive[1 : 1 + n_P] = P, moves
        bounded = np.zeros((1 + n_P + n_M, size + 2 * n_y, size + 2 * n_y))
        largest = max(LARGEST_MULTIPLIER, 2.0 * float(np.linalg.norm(M)))
        bounded[0] = largest * np.eye(size + 2 * n_y)
        bounded[0, :n_y, n_y:], bounded[0, n_y:, :n_y] = M, M.T
        bounded[1 + n_P :, :n_y, n_y:] = multipliers
        bounded[1 + n_P :, n_y:, :n_y] = multipliers.transpose(0, 2, 1)
        inequalities = [MatrixInequality(positive), MatrixInequality(bounded)]
        storage = _decrease(problem, np.concatenate([P[None], moves]))
        G = np.einsum("i,viab->vab", theta, _coefficients(problem))
        each = np.concatenate([M[None], multipliers]).transpose(0, 2, 1)
        terms = _twice_symmetric(each[:, None] @ G)
        of_P = np.broadcast_to(storage[:, None], (len(storage), *terms.shape[1:]))
        F = np.concatenate([of_P, terms[1:]])
        F[0] += terms[0]
        inequalities.append(MatrixInequality(F))
        z = centre(inequalities, np.zeros(n_P + n_M))
        return MatrixSet(
            problem,
            P + np.tensordot(z[:n_P], moves, axes=1),
            M + np.tensordot(z[n_P:], multipliers, axes=1),
            theta,
        )


def _used(problem: StateAffineRows) -> FloatArray:
    """(n_w,): 1 for the entries of w that a coefficient of the outputs depends on, else 0."""
    return np.asarray(np.any([g.any(axis=0) for g in problem.left], axis=0), dtype=np.float64)


def _coefficients(problem: StateAffineRows) -> FloatArray:
    """(corners, n_θ, n_y, (n + 1) n_y): [G_0 … G_n] at each corner for each left parameter."""
    n_y, used, box = len(problem.y_scale[0]), _used(problem), problem.window_range()
    ends = [box[i] if use else np.zeros(1) for i, use in enumerate(used)]
    corners = np.array(list(product(*ends)))
    parts = []
    for k, exponents in enumerate(problem.left):
        place = np.eye(n_y**2).reshape(n_y**2, n_y, n_y)
        placed = np.pad(place, ((0, 0), (0, 0), (k * n_y, (len(problem.left) - 1 - k) * n_y)))
        values = monomial_values(exponents, corners)
        each = np.einsum("vj,iab->vjiab", values, placed)
        parts.append(each.reshape(len(corners), -1, *placed.shape[1:]))
    return np.concatenate(parts, axis=1)


def slowest_rate(problem: StateAffineRows) -> float:
    """r: V shrinks by r² a sample, or faster, in the whole set."""
    return min(SLOWEST_IN_BOX if _used(problem).any() else SLOWEST_RATE, problem.slowest)


def _decrease(problem: StateAffineRows, P: FloatArray) -> FloatArray:
    """(…, s, s): r²|[ξ₁; …; ξ_n]|²_P - |[ξ₀; …; ξ_{n-1}]|²_P for P (…, n n_y, n n_y)."""
    states, n_y = P.shape[-1], len(problem.y_scale[0])
    F = np.zeros((len(P), states + n_y, states + n_y))
    F[:, n_y:, n_y:] += slowest_rate(problem) ** 2 * P
    F[:, :states, :states] -= P
    return F


def _symmetric(entries: FloatArray, size: int) -> FloatArray:
    P = np.zeros((size, size))
    P[np.triu_indices(size)] = entries
    return np.asarray(P + np.triu(P, 1).T)


def _twice_symmetric(X: FloatArray) -> FloatArray:
    return np.asarray(X + np.swapaxes(X, -2, -1))
