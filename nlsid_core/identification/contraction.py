"""Search for the exact proof that a state-affine model is incrementally stable for every input.

The bounds of G_0 on the input box are the tightest its S-procedure shows, and the storage function
is common to both, at (nearly) the fastest rate there is one for. Where all coefficients of the
outputs are constant, of one output or of several, the difference of two solutions is linear and P
is found directly.
"""

import warnings
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from nlsid_core import _json
from nlsid_core._types import FloatArray, IntArray, Json
from nlsid_core.certificate import proof_document
from nlsid_core.certificate.state_affine import block_matrix, contracts, contracts_constant
from nlsid_core.identification.inequalities import MatrixInequality, minimise_linear
from nlsid_core.identification.matrix_proof import MatrixProof, prove_by_matrix
from nlsid_core.models import StateAffineModel

BOUNDS_GAP = 1e-6  # relative to |G_0|, how tightly its bounds are stated
BOUND_ROOM = 1e-9  # the stated bounds are this much wider than found, for a strict proof
RATE_STEPS = 5  # bisections of 1 - rate, from a factor of four
SLOWEST = 1e-8  # 1 - rate below which nothing is claimed
FASTEST_ROOM = 0.05  # of the way from the fastest rate found to 1 given up for a well conditioned P
STOP_MARGIN = 1e-10  # λ_min of r²P - A'PA, tr P = n, that counts as feasible in the search


@dataclass(frozen=True, eq=False)
class StateAffineProof:
    """The numbers of a `state_affine_stability` proof, decided exactly by the checker's code."""

    P: FloatArray
    rate: float
    bounds: tuple[float, float] | None = None  # None: every coefficient of an output is constant
    multipliers: tuple[FloatArray, FloatArray] | None = None

    def document(self, model: StateAffineModel, file: str) -> Json:
        """The proof file's content for the model stored in `file` beside it."""
        about = {"model": {"file": file, "digest": _json.digest(model.document())}}
        claim = {"kind": "state_affine_stability", "rate": self.rate, "about": about}
        proof: Json = {"P": self.P.tolist()}
        if self.bounds is not None and self.multipliers is not None:
            proof |= {"lower": self.bounds[0], "upper": self.bounds[1]}
            proof |= {
                "lower_box": self.multipliers[0].tolist(),
                "upper_box": self.multipliers[1].tolist(),
            }
        return proof_document(claim, proof)


def prove_state_affine(model: StateAffineModel) -> StateAffineProof | MatrixProof | None:
    """An exact proof, or None if the search finds none.

    By one Lyapunov equation where all coefficients of the outputs are constant; by bounds of G_0
    where the lagged ones are and G_0 is quadratic, one output; else by a matrix inequality in the
    input.
    """
    if not any(g.exponents.any() for g in model.G):
        return _prove_constant(model)
    if (
        len(model.y) > 1
        or any(g.exponents.any() for g in model.G[1:])
        or (model.G[0].exponents.sum(axis=1) > 2).any()
    ):
        return prove_by_matrix(model)
    found = leading_bounds(model)
    if found is None:
        return None
    (low, high), multipliers = found
    lagged = np.array([g.coefficients.sum() for g in model.G[1:]])
    matrices = [companion(lagged, q) for q in (low, high)]
    rate = _fastest_rate(matrices)
    if rate is None:
        return None
    rate += FASTEST_ROOM * (1.0 - rate)
    P = _common_storage(matrices, rate)
    if P is None:
        return None
    P = P / np.abs(P).max()
    if contracts(model, rate, P=P, bounds=(low, high), multipliers=multipliers) is not None:
        return None
    return StateAffineProof(P, rate, (low, high), multipliers)


def _prove_constant(model: StateAffineModel) -> StateAffineProof | None:
    """The proof for constant G_0 … G_n: P solves (A/r)'P(A/r) - P + I = 0."""
    exact = block_matrix(model)
    if exact is None:
        return None
    A = np.array(exact, dtype=np.float64)
    radius = float(np.max(abs(np.linalg.eigvals(A))))
    rate = radius + FASTEST_ROOM * (1.0 - radius)
    if not 0.0 < rate < 1.0 - SLOWEST:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of bad conditioning: the checker judges the result
        P = solve_discrete_lyapunov(A.T / rate, np.eye(len(A)))
    P = (P + P.T) / (2.0 * np.abs(P).max())
    return StateAffineProof(P, rate) if contracts_constant(model, rate, P=P) is None else None


def leading_bounds(
    model: StateAffineModel,
) -> tuple[tuple[float, float], tuple[FloatArray, FloatArray]] | None:
    """(ℓ, h) with ℓ ≤ G_0 ≤ h on the input box, and the multipliers of each; None if ℓ ≤ 0."""
    box, (exponents, values) = model.window_range(), (model.G[0].exponents, model.G[0].coefficients)
    q = values[:, 0, 0]
    size, n_w = float(abs(q).sum()), len(box)
    ends, multipliers = [], []
    half_widths = 0.25 * (box[:, 1] - box[:, 0]) ** 2
    corner = float(abs(q) @ np.prod(np.maximum(1.0, abs(box).max(axis=1)) ** exponents, axis=1))
    for part, sign, column in zip(
        box_inequalities(exponents, box), (1.0, -1.0), (0, 1), strict=True
    ):
        fixed = np.tensordot(q, part[: len(q)], axes=1)
        columns = part[len(q) :][[column, *range(2 + column * n_w, 2 + (column + 1) * n_w)]]
        bound = MatrixInequality(np.concatenate([[fixed], columns]))
        signs = np.zeros((2 + n_w, n_w, n_w))
        signs[2 + np.arange(n_w), np.arange(n_w), np.arange(n_w)] = 1.0
        # Inside: large multipliers dominate q's curvature, a very wide bound pays for them.
        weight = 4.0 * corner * (1.0 + 1.0 / half_widths)
        start = np.concatenate([[0.0], weight])
        wide = bound.at(start)
        start[0] = -sign * (10.0 * float(abs(wide).sum()) * (1.0 + corner))
        objective = np.zeros(1 + n_w)
        objective[0] = -sign
        z = minimise_linear(
            objective, (bound, MatrixInequality(signs)), start, gap=BOUNDS_GAP * size
        )
        ends.append(float(z[0]) - sign * BOUND_ROOM * size)
        multipliers.append(z[1:])
    if ends[0] <= 0.0:
        return None
    return (ends[0], ends[1]), (multipliers[0], multipliers[1])


def box_inequalities(exponents: IntArray, box: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Matrices in [1; w] of q - ℓ - Σ a_i (w_i - lo_i)(hi_i - w_i) and of the same for h - q.

    Linear in [q's coefficients; ℓ; h; a; b]: two arrays (n_q + 2 + 2 n_w, n_w + 1, n_w + 1).
    """
    n_q, n_w = len(exponents), len(box)
    parts = []
    for end, sign in ((0, 1.0), (1, -1.0)):
        F = np.zeros((n_q + 2 + 2 * n_w, n_w + 1, n_w + 1))
        for index, powers in enumerate(exponents):
            used = [i + 1 for i, power in enumerate(powers) for _ in range(int(power))]
            i, j = [0] * (2 - len(used)) + used
            F[index, i, j] += 0.5 * sign
            F[index, j, i] += 0.5 * sign
        F[n_q + end, 0, 0] = -sign
        for i, (low, high) in enumerate(box, 1):
            entry = F[n_q + 2 + end * n_w + i - 1]
            entry[0, 0], entry[i, i] = low * high, 1.0
            entry[0, i] = entry[i, 0] = -0.5 * (low + high)
        parts.append(F)
    return parts[0], parts[1]


def companion(lagged: FloatArray, q: float) -> FloatArray:
    """A(1/q) of x = [ȳ(t-1); …; ȳ(t-n)] for constants `lagged` = [G_1 … G_n]."""
    A = np.diag(np.ones(len(lagged) - 1), -1)
    A[0] -= lagged / q
    return A


def traceless(n: int) -> FloatArray:
    """(n(n+1)/2 - 1, n, n): a basis of the symmetric matrices with trace zero."""
    basis = []
    for i in range(n):
        for j in range(i, n):
            X = np.zeros((n, n))
            X[i, j] = X[j, i] = 1.0
            if i == j:
                if i == 0:
                    continue
                X[0, 0] = -1.0
            basis.append(X)
    return np.array(basis).reshape(-1, n, n)


def _fastest_rate(matrices: list[FloatArray]) -> float | None:
    """About the smallest rate with a common storage function: 1 - rate to some per cent."""
    room = 1.0 - float(max(np.max(abs(np.linalg.eigvals(A))) for A in matrices))
    while room > SLOWEST and _common_storage(matrices, 1.0 - room) is None:
        room /= 4.0
    if room <= SLOWEST:
        return None
    upper = 4.0 * room
    for _ in range(RATE_STEPS):
        middle = float(np.sqrt(room * upper))
        if _common_storage(matrices, 1.0 - middle) is None:
            upper = middle
        else:
            room = middle
    return 1.0 - room


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
