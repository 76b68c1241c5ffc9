"""Robust simulation error whose every iterate is stable for every input, and its exact proof.

For one output, constant lagged coefficients g = [G_1 … G_n] and quadratic q = G_0: around an
iterate with the bounds ℓ_m ≤ q ≤ h_m on the input box and storage function P, keep
    [r²(2 q̄ q̄_m - q̄_m²) P, (q̄ S - e₁g)'P; P(q̄ S - e₁g), P] ⪰ 0   at q̄ = ℓ and q̄ = h,
    ℓ ≤ q(w) ≤ h on the box (S-procedure with multipliers of (w_i - lo_i)(hi_i - w_i)).
Since q̄² ≥ 2 q̄ q̄_m - q̄_m² it implies r²P - A'PA ⪰ 0 at both ends, and the last iterate satisfies it.
P is centred again after every iterate.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from nlsid_core._types import FloatArray
from nlsid_core.errors import ShapeError
from nlsid_core.identification.bound import Bound, Point
from nlsid_core.identification.contraction import (
    StateAffineProof,
    box_inequalities,
    companion,
    leading_bounds,
    prove_state_affine,
    traceless,
)
from nlsid_core.identification.inequalities import MatrixInequality, centre, minimise_linear
from nlsid_core.identification.matrix_proof import MatrixProof
from nlsid_core.identification.newton import Descent, minimise
from nlsid_core.identification.simulation_error import SimulationError
from nlsid_core.identification.state_affine import StateAffineRows
from nlsid_core.models import StateAffineModel

SLOWEST_RATE = 1.0 - 1e-6  # V shrinks by its square at least, so that the proof is strict
START_BOUNDS = (0.9, 1.1)  # of G_0 around the first iterate's start G = I
START_SLACK = 0.05  # of those bounds, spent on the multipliers of the box
GROWTH = 4.0  # of h from one iterate to the next, at most: with one lag nothing else bounds it
TIGHT = 1e-4  # of h - ℓ, how tightly the bounds of G_0 are stated
RENEWALS = 10  # of P and the bounds of G_0 in the last step
STOP = 1e-4  # relative decrease of J that ends the iteration


@dataclass(frozen=True, eq=False)
class CertifiedIterate:
    """A minimiser with its bound J and the certificate's unknowns."""

    point: Point
    extra: FloatArray  # [ℓ, h, lower multipliers, upper multipliers]
    P: FloatArray

    @property
    def J(self) -> float:
        """The bound on the simulation error, scaled."""
        return self.point.J


def certified_simulation_error(
    problem: StateAffineRows, *, iterations: int = 40
) -> Iterator[CertifiedIterate]:
    """Yield the minimisers of the bounds inside the certified set, first to last.

    Raises ShapeError for several outputs, input-dependent lagged coefficients or deg q > 2.
    """
    _refuse_others(problem)
    n, box = len(problem.left) - 1, problem.window_range()
    theta, linearised = problem.rows.identity, None
    weights = START_SLACK / (len(box) * 0.25 * (box[:, 1] - box[:, 0]) ** 2)
    extra = np.concatenate([START_BOUNDS, weights, weights])
    linearised_at = np.array([1.0, 1.0])
    P = np.diag(0.5 ** np.arange(n))
    previous = np.inf
    for _ in range(iterations):
        inequalities = _inequalities(problem, P, linearised_at)
        found = minimise(
            Bound(problem.rows, linearised), theta, inequalities=inequalities, extra=extra
        )
        theta = linearised = found.point.theta
        extra = _tightened(inequalities[2:], theta, found.extra)
        linearised_at = extra[:2]
        P = _centred(P, [companion(theta[-n:], q) for q in linearised_at])
        yield CertifiedIterate(found.point, extra, P)
        if previous * (1.0 - STOP) <= found.point.J:
            return
        previous = found.point.J


def descend_certified(
    problem: StateAffineRows, model: StateAffineModel, proof: StateAffineProof | MatrixProof
) -> StateAffineModel:
    """The last step: a local minimum of the simulation error itself inside the certified set.

    From a model of the problem's class with its proof; the result is proved too and its simulation
    error on the problem's data is never above the model's. P and the bounds of G_0 are renewed
    while that goes on lowering it. Raises ShapeError as `certified_simulation_error` does.
    """
    _refuse_others(problem)
    if isinstance(proof, MatrixProof):
        raise ShapeError("the last step needs the proof by bounds of the leading coefficient")
    objective, best = SimulationError(problem.rows), model
    theta = np.concatenate([g.coefficients.ravel() for g in model.G])
    bounds, multipliers = proof.bounds, proof.multipliers
    if bounds is None or multipliers is None:  # a constant G_0 was proved without
        found_bounds = leading_bounds(model)
        if found_bounds is None:
            raise ShapeError("the last step needs a positive leading coefficient")
        bounds, multipliers = found_bounds
    P, extra = proof.P, np.concatenate([bounds, *multipliers])
    n, J = len(model), objective.at(theta).J
    for _ in range(RENEWALS):
        inequalities = _inequalities(problem, P, extra[:2])
        found = Descent(objective, inequalities, len(theta)).path(np.concatenate([theta, extra]))
        if found.point.J >= J * (1.0 - STOP):
            break
        theta, J = found.point.theta, found.point.J
        lower = problem.model(theta, found.point.p)
        if prove_state_affine(lower) is None:
            break
        best = lower
        extra = _tightened(inequalities[2:], theta, found.extra)
        P = _centred(P, [companion(theta[-n:], q) for q in extra[:2]])
    return best


def _refuse_others(problem: StateAffineRows) -> None:
    if not problem.has_constant_lags:
        raise ShapeError(
            "certified iterates are for one output and constant lagged coefficients; minimise the "
            "robust simulation error and prove that model instead"
        )
    if (problem.left[0].sum(axis=1) > 2).any():
        raise ShapeError("certified iterates are for a leading coefficient of degree 2 at most")


def _inequalities(
    problem: StateAffineRows, P: FloatArray, linearised_at: FloatArray
) -> tuple[MatrixInequality, ...]:
    """Both ends' contraction, both bounds on the box, and nonnegative multipliers.

    Unknowns z = [θ; ℓ; h; lower multipliers; upper multipliers].
    """
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
