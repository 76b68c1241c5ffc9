"""Robust simulation error whose every iterate is stable for every input, and its exact proof.

Every bound is minimised inside a convex set of stable models around the iterate before, which it
contains strictly: `BoundedSet` for one output and constant lags, `MatrixSet` for others.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.identification.bounded_set import BoundedSet
from nlsid_core.identification.matrix_set import MatrixSet
from nlsid_core.identification.newton import Descent, Point, minimise
from nlsid_core.identification.rse import Bound
from nlsid_core.identification.simulation_error import SimulationError
from nlsid_core.identification.stability import StabilityProof, prove_stability
from nlsid_core.identification.state_affine import StateAffineRows
from nlsid_core.models import StateAffineModel

RENEWALS = 10  # of the set in the last step
STOP = 1e-4  # relative decrease of J that ends the iteration


@dataclass(frozen=True, eq=False)
class CertifiedIterate:
    """A minimiser with its bound J, and the set around it."""

    point: Point
    inside: BoundedSet | MatrixSet

    @property
    def J(self) -> float:
        """The bound on the simulation error, scaled."""
        return self.point.J


def certified_simulation_error(
    problem: StateAffineRows, *, iterations: int = 40
) -> Iterator[CertifiedIterate]:
    """Yield the minimisers of the bounds inside the certified set, first to last.

    Raises ShapeError for degrees that there is no such set for: 2 at most for G_0 of one output
    beside constant lagged coefficients, 1 for all others, in few inputs.
    """
    inside = _set_of(problem).start(problem)
    theta, linearised = problem.rows.identity, None
    previous = np.inf
    for _ in range(iterations):
        bound = Bound(problem.rows, linearised)
        found = minimise(bound, theta, inequalities=inside.inequalities(), extra=inside.extra)
        theta = linearised = found.point.theta
        inside = inside.renewed(theta, found.extra)
        yield CertifiedIterate(found.point, inside)
        if previous * (1.0 - STOP) <= found.point.J:
            return
        previous = found.point.J


def descend_certified(
    problem: StateAffineRows, model: StateAffineModel, proof: StabilityProof
) -> StateAffineModel:
    """The last step: a local minimum of the simulation error itself inside the certified set.

    From a model of the problem's class with its proof; the result is proved too and its simulation
    error on the problem's data is never above the model's. The set is renewed while that goes on
    lowering it. Raises ShapeError as `certified_simulation_error` does.
    """
    inside: BoundedSet | MatrixSet = _set_of(problem).of_proof(problem, model, proof)
    objective, best = SimulationError(problem.rows), model
    theta = _left_parameters(model)
    J = objective.at(theta).J
    for _ in range(RENEWALS):
        inequalities, z = inside.inequalities(), np.concatenate([theta, inside.extra])
        if not np.isfinite(sum(part.barrier(z) for part in inequalities)):
            break  # proved at a rate slower than the set's
        found = Descent(objective, inequalities, len(theta)).path(z)
        if found.point.J >= J * (1.0 - STOP):
            break
        theta, J = found.point.theta, found.point.J
        lower = problem.model(theta, found.point.p)
        if prove_stability(lower) is None:
            break
        best = lower
        inside = inside.renewed(theta, found.extra)
    return best


def _set_of(problem: StateAffineRows) -> type[BoundedSet] | type[MatrixSet]:
    return BoundedSet if problem.is_bounded_by_leading else MatrixSet


def _left_parameters(model: StateAffineModel) -> FloatArray:
    return np.concatenate([g.coefficients.ravel() for g in model.G])
