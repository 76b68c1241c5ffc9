"""State-affine models kept convex and stable.

With x = [ȳ(t-1); …; ȳ(t-n)], ξ = [ȳ(t); x], V = |x|²_P and a multiplier M of the equation,
    r²|[ξ₁; …; ξ_n]|²_P - |[ξ₀; …; ξ_{n-1}]|²_P + 2 ξ'M'[G_0 … G_n] ξ ≥ 0,   P ≻ 0,
at every vertex of a hull that holds [G_0 … G_n](w) for all w in the input box: it is affine in
G_0 … G_n, so it holds in between, and along differences of solutions it says V⁺ ≤ r²V. Vertices
are the Bernstein coefficients, which are the values at the corners for degree 1. Where G_0 alone
depends on w and is a number, the hull is between two ends, ℓ ≤ q ≤ h for each coefficient q of G_0.
For a fixed M all is affine in the coefficients, the ends and P together, for fixed coefficients in
P and M: the first is searched, then the second centred.
Source: thesis Lemma 2.11, (4.1); `stability` for the proof of one model, N = M'.
"""

from dataclasses import dataclass
from itertools import product
from math import comb

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.errors import ShapeError
from nlsid_core.identification.methods.inequalities import MatrixInequality, centre, traceless
from nlsid_core.identification.polynomial.rows import StateAffineRows
from nlsid_core.identification.proofs.stability import StabilityProof
from nlsid_core.models import StateAffineModel

SLOWEST_RATE = 1.0 - 1e-6  # V shrinks by its square at least, so that the proof is strict
SLOWEST_IN_BOX = 1.0 - 1e-3  # the same where w matters: the search for a proof needs more room
GROWTH = 4.0  # of G_0 from one iterate to the next, at most, as its multiplier weighs it
MOST_VERTICES = 4096  # of the coefficients' hull, a matrix or two numbers for each
START_ENDS = (0.9, 1.1)  # of G_0 around the first iterate's start G = I
TIGHT = 0.1  # what is left of the room between coefficients of G_0 and ends, at the next iterate
ROOM = 1e-6  # relative to G_0, the same around a model with its proof
LARGEST_MULTIPLIER = 100.0  # of the mean eigenvalue of P: where nothing else bounds M


@dataclass(frozen=True, eq=False)
class MatrixSet:
    """The set around θ with P (n n_y, n n_y), M (n_y, (n + 1) n_y). Unknowns [θ; ends; P].

    ends: ℓ and h; empty where every vertex is of θ. Raises ShapeError unless the coefficients are
    of degree 1 at most, or 2 for G_0 of one output alone, in few inputs.
    """

    problem: StateAffineRows
    P: FloatArray
    M: FloatArray
    theta: FloatArray
    ends: FloatArray

    def __post_init__(self) -> None:
        most = 2 if self.problem.is_bounded_by_leading else 1
        if any((g.sum(axis=1) > most).any() for g in self.problem.left):
            raise ShapeError(
                "certified iterates are for degree 1 at most, and 2 of the coefficient of y(t) "
                "where there is one output and the others are constant; minimise the robust "
                "simulation error and prove that model instead"
            )
        vertices = int(np.prod(_degrees(self.problem) + 1))
        if vertices > MOST_VERTICES:
            raise ShapeError(
                f"certified iterates visit {vertices} vertices of what coefficients of the outputs "
                f"can be; they may be {MOST_VERTICES}: use fewer delays"
            )

    @classmethod
    def start(cls, problem: StateAffineRows) -> "MatrixSet":
        """The set around G = I."""
        n, n_y = len(problem.left) - 1, len(problem.y_scale[0])
        fall = 0.5 * slowest_rate(problem) ** 2
        P, M = np.kron(np.diag(fall ** np.arange(n)), np.eye(n_y)), np.eye(n_y, (n + 1) * n_y)
        ends = np.array(START_ENDS if _is_between_ends(problem) else ())
        return cls(problem, P, M, problem.rows.identity, ends)

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
        M, ends = np.array(proof.multipliers["N"]).T, np.zeros(0)
        if _is_between_ends(problem):
            low, high = _tight_ends(problem, theta)
            ends = np.array([low - ROOM * high, high + ROOM * high])
        return cls(problem, proof.P, M, theta, ends)

    @property
    def extra(self) -> FloatArray:
        """The ends, and the entries of P in the order of the unknowns."""
        return np.concatenate([self.ends, self.P[np.triu_indices(len(self.P))]])

    def inequalities(self) -> tuple[MatrixInequality, ...]:
        """A decrease at every vertex, P, the ends, and the scale of θ, which means nothing."""
        size, lead = len(self.P), len(self.M)
        n_P = size * (size + 1) // 2
        basis = np.array([_symmetric(entry, size) for entry in np.eye(n_P)])
        vertices = _vertices(self.problem)
        n_left = vertices.shape[1]
        positive = np.zeros((1 + n_left + n_P, size, size))
        positive[1 + n_left :] = basis
        result = [MatrixInequality(positive)]
        decrease = _decrease(self.problem, basis)
        slopes = _twice_symmetric(self.M.T @ vertices).transpose(1, 0, 2, 3)
        of_P = np.broadcast_to(decrease[:, None], (n_P, *slopes.shape[1:]))
        result.append(MatrixInequality(np.concatenate([0.0 * slopes[:1], slopes, of_P])))
        scale = np.einsum("ab,viab->i", self.M[:, :lead], vertices[..., :lead])  # Σ tr T G_0
        limit = np.zeros((1 + n_left + n_P, 1, 1))
        limit[0] = GROWTH * float(scale @ np.concatenate([self.theta, self.ends]))
        limit[1 : 1 + n_left, 0, 0] = -scale
        result.append(MatrixInequality(limit))
        if len(self.ends):
            bounds = _coefficients(self.problem)[:, :, 0, 0]
            between = np.zeros((1 + n_left + n_P, 2 * len(bounds), 1, 1))
            between[1 : n_left - 1, :, 0, 0] = np.concatenate([bounds, -bounds]).T
            between[n_left - 1, : len(bounds)], between[n_left, len(bounds) :] = -1.0, 1.0
            result.append(MatrixInequality(between))
        return tuple(result)

    def renewed(self, theta: FloatArray, extra: FloatArray) -> "MatrixSet":
        """The set around the analytic centre of P and M at θ, from P's entries inside this one."""
        problem, n_y, size, ends = self.problem, len(self.M), len(self.P), self.ends
        if len(ends):
            tight = _tight_ends(problem, theta)
            ends = tight + TIGHT * (extra[:2] - tight)
        P = _symmetric(extra[len(ends) :], size)
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
        G = np.einsum("i,viab->vab", np.concatenate([theta, ends]), _vertices(problem))
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
            ends,
        )


def _degrees(problem: StateAffineRows) -> IntArray:
    """(n_w,): of the coefficients of the outputs in each entry of w."""
    return np.asarray(np.max(np.concatenate(problem.left), axis=0))


def _is_between_ends(problem: StateAffineRows) -> bool:
    """G_0 alone depends on w, and is a number."""
    return problem.is_bounded_by_leading and bool(_degrees(problem).any())


def _coefficients(problem: StateAffineRows) -> FloatArray:
    """(V, n_θ, n_y, (n + 1) n_y): Bernstein coefficients of [G_0 … G_n] for each left parameter.

    On [lo, hi], w^e has the coefficient Σ_j C(e, j) lo^(e-j) (hi - lo)^j C(k, j)/C(d, j) at index k
    of degree d.
    """
    n_y, degrees = len(problem.y_scale[0]), _degrees(problem)
    index = np.array(list(product(*(range(d + 1) for d in degrees.tolist()))))
    parts = []
    for k, exponents in enumerate(problem.left):
        place = np.eye(n_y**2).reshape(n_y**2, n_y, n_y)
        placed = np.pad(place, ((0, 0), (0, 0), (k * n_y, (len(problem.left) - 1 - k) * n_y)))
        values = np.ones((len(index), len(exponents)))
        for i, (low, high) in enumerate(problem.window_range()):
            table = _bernstein(int(degrees[i]), low, high)
            values *= table[index[:, i]][:, exponents[:, i]]
        each = np.einsum("vj,iab->vjiab", values, placed)
        parts.append(each.reshape(len(index), -1, *placed.shape[1:]))
    return np.concatenate(parts, axis=1)


def _bernstein(d: int, low: float, high: float) -> FloatArray:
    """(d + 1, d + 1): coefficient k of w^e on [low, high]."""
    table = np.zeros((d + 1, d + 1))
    for k, e in np.ndindex(d + 1, d + 1):
        for j in range(min(e, k) + 1):
            share = comb(k, j) / comb(d, j)
            table[k, e] += comb(e, j) * low ** (e - j) * (high - low) ** j * share
    return table


def _vertices(problem: StateAffineRows) -> FloatArray:
    """(V, n_θ + ends, n_y, (n + 1) n_y): the hull's vertices for each of [θ; ends]."""
    found = _coefficients(problem)
    if not _is_between_ends(problem):
        return found
    between = np.zeros((2, found.shape[1] + 2, *found.shape[2:]))
    between[:, :-2, :, 1:] = found[0, :, :, 1:]
    between[0, -2, 0, 0] = between[1, -1, 0, 0] = 1.0
    return between


def _tight_ends(problem: StateAffineRows, theta: FloatArray) -> FloatArray:
    """The least and the largest coefficient of G_0."""
    q = _coefficients(problem)[:, :, 0, 0] @ theta
    return np.array([q.min(), q.max()])


def slowest_rate(problem: StateAffineRows) -> float:
    """r: V shrinks by r² a sample, or faster, in the whole set."""
    return min(SLOWEST_IN_BOX if _degrees(problem).any() else SLOWEST_RATE, problem.slowest)


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
