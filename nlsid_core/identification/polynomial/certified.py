"""Robust simulation error whose every iterate is stable for every input, and its exact proof.

Every bound is minimised inside a convex set of stable models around the iterate before, which it
contains strictly (`MatrixSet`).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.linalg import LinAlgError

from nlsid_core import conic
from nlsid_core.arrays import FloatArray
from nlsid_core.identification.methods.descent import Outputs, Step, descend
from nlsid_core.identification.methods.newton import INEQUALITY_GAP, Point, minimise
from nlsid_core.identification.methods.rse import Bound, affordable_steps
from nlsid_core.identification.methods.simulation_error import SimulationError
from nlsid_core.identification.polynomial.matrix_set import MatrixSet
from nlsid_core.identification.polynomial.rows import StateAffineRows
from nlsid_core.identification.proofs.stability import StabilityProof, prove_stability
from nlsid_core.models import StateAffineModel

IN_ONE_SET = 8  # steps of the descent before the set is renewed
STOP = 1e-4  # relative decrease of J that ends the iteration
STEPS_A_BOUND = 25  # of Newton's method, to its minimum in the set, as a rule
FEW_STEPS = 3  # towards it in a large problem, at one weight of the barrier,
FEWEST_BOUNDS = 12  # however large it is
GAP, GAP_FALL = 0.1, 0.5  # relative to J, which falls from bound to bound


@dataclass(frozen=True, eq=False)
class CertifiedIterate:
    """A minimiser with its bound J, and the set around it."""

    point: Point
    inside: MatrixSet

    @property
    def J(self) -> float:
        """The bound on the simulation error, scaled."""
        return self.point.J


def certified_simulation_error(
    problem: StateAffineRows, *, iterations: int = 40
) -> Iterator[CertifiedIterate]:
    """Yield the minimisers of the bounds inside the certified set, first to last.

    In a large problem, by `affordable_steps`, there are fewer bounds, and each iterate is a few
    steps towards its minimiser, so that J can go up.
    Raises ShapeError for degrees that there is no such set for: 2 at most for G_0 of one output
    beside constant lagged coefficients, 1 for all others, in few inputs.
    """
    inside = MatrixSet.start(problem)
    theta, linearised = problem.rows.identity, None
    previous, steps, gap = np.inf, None, GAP
    affordable = affordable_steps(problem.rows)
    if iterations * STEPS_A_BOUND > affordable:
        steps, iterations = FEW_STEPS, min(iterations, max(FEWEST_BOUNDS, affordable // FEW_STEPS))
    for _ in range(iterations):
        bound = Bound(problem.rows, linearised)
        found = minimise(
            bound,
            theta,
            inequalities=inside.inequalities(),
            extra=inside.extra,
            steps=steps,
            gap=gap,
        )
        gap = max(GAP_FALL * gap, INEQUALITY_GAP)
        theta = linearised = found.point.theta
        inside = inside.renewed(theta, found.extra)
        yield CertifiedIterate(found.point, inside)
        if previous * (1.0 - STOP) <= found.point.J and (steps is None or gap < STOP):
            return
        previous = found.point.J


@dataclass(frozen=True, eq=False)
class _Steps:
    """A `StableSet` of matrices F z' ⪰ 0 in z' = [1; θ; extra], p projected out of the error."""

    error: SimulationError
    F: FloatArray
    cones: tuple[conic.Cone, ...]

    def outputs(self, theta: FloatArray) -> Outputs | None:
        """r = L⁻¹(errors θ - Q p) at the best p, and its derivatives."""
        try:
            point = self.error.at(theta)
        except LinAlgError:
            return None
        return Outputs(point.residual, self.error.slopes(point))

    def cost(self, theta: FloatArray) -> float:
        """|r|²."""
        try:
            return self.error.at(theta).J
        except LinAlgError:
            return np.inf

    def inside(self, step: Step) -> FloatArray:
        """θ of the step's cone program, in v = u/|r| and the set's other unknowns."""
        n, size = len(step.D), float(np.linalg.norm(step.r))
        moved, of_extra = self.F[:, 1 : 1 + n], self.F[:, 1 + n :]
        units = 1.0 / np.maximum(np.linalg.norm(of_extra, axis=0), np.finfo(float).tiny)
        A = np.hstack([moved * (size / step.D), of_extra * units])
        quadratic = 2.0 * (step.R.T @ step.R + step.damping * np.eye(n))
        unmoved = sp.csc_matrix((len(units), len(units)))
        program = conic.ConeProgram(
            P=sp.block_diag([sp.csc_matrix(quadratic), unmoved], format="csc"),
            q=np.concatenate([2.0 * step.R.T @ step.r / size, np.zeros(len(units))]),
            A=sp.csc_matrix(-A),
            b=self.F[:, 0] + moved @ step.theta,
            cones=self.cones,
        )
        v = conic.solve(program, refined=True).x[:n]
        return np.asarray(step.theta + v * (size / step.D))


def _steps(error: SimulationError, inside: MatrixSet, theta: FloatArray) -> _Steps:
    """In units in which the matrices are I at θ, which is strictly inside."""
    z, blocks, cones = np.concatenate([theta, inside.extra]), [], []
    for part in inside.inequalities():
        order = part.F.shape[-1]
        F = part.F.reshape(len(part.F), -1, order, order)
        W = np.linalg.inv(np.linalg.cholesky(part.at(z).reshape(-1, order, order)))
        F = W @ F @ W.transpose(0, 2, 1)
        blocks += [conic.svec(F[:, k]).T for k in range(F.shape[1])]
        kind = [conic.Cone("psd", order)] * F.shape[1]
        cones += kind if order > 1 else [conic.Cone("nonnegative", F.shape[1])]
    return _Steps(error, np.concatenate(blocks), tuple(cones))


def descend_certified(
    problem: StateAffineRows, model: StateAffineModel, proof: StabilityProof, *, steps: int = 40
) -> StateAffineModel:
    """The last step: a local minimum of the simulation error itself inside the certified set.

    From a model of the problem's class with its proof; the result is proved too and its simulation
    error on the problem's data is never above the model's. The set is renewed while that goes on
    lowering it; steps: in all sets, at most. Raises ShapeError as `certified_simulation_error`.
    """
    inside = MatrixSet.of_proof(problem, model, proof)
    error, best = SimulationError(problem.rows), model
    theta = _left_parameters(model)
    J = error.at(theta).J
    for _ in range(0, steps, IN_ONE_SET):
        try:
            steps_inside = _steps(error, inside, theta)
        except LinAlgError:
            break  # proved at a rate slower than the set's
        found = descend(steps_inside, theta, steps=IN_ONE_SET)
        if found is None or (point := error.at(found)).J >= J * (1.0 - STOP):
            break
        theta, J = found, point.J
        lower = problem.model(theta, point.p)
        assert isinstance(lower, StateAffineModel), "as the model that it began with"
        proved = prove_stability(lower)
        if proved is None:
            break
        best, inside = lower, MatrixSet.of_proof(problem, lower, proved)
    return best


def _left_parameters(model: StateAffineModel) -> FloatArray:
    return np.concatenate([g.coefficients.ravel() for g in model.G])
