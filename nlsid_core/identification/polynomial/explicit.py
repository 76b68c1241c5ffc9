"""How equations that are linear in every output are found: robust and exact simulation error.

Source: thesis Chapter 4 and Section 1.1.1.
"""

import logging
from functools import partial
from typing import Any

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import Infeasible, SolverError
from nlsid_core.identification.fit import History, Step
from nlsid_core.identification.methods.newton import Descent
from nlsid_core.identification.methods.options import LeastSquares, Rse, Sem
from nlsid_core.identification.methods.rse import robust_simulation_error
from nlsid_core.identification.methods.simulation_error import SimulationError
from nlsid_core.identification.polynomial.certified import (
    certified_simulation_error,
    descend_certified,
)
from nlsid_core.identification.polynomial.options import Polynomial
from nlsid_core.identification.polynomial.rows import StateAffineRows, build_state_affine_rows
from nlsid_core.identification.proofs.stability import prove_stability
from nlsid_core.identification.starts import SLOWEST_POLE, poles_of, reflected, stable_starts
from nlsid_core.identification.trail import Task, Trail, least_error, tried
from nlsid_core.models import StateAffineModel

BOUND = "bound on the simulation error"
POLE_ROUNDING = 1e-9  # of a pole that was put on the radius

Model = Any  # a DifferenceEquation or a StateAffineModel
log = logging.getLogger(__name__)


def search(train: Dataset, model_class: Polynomial, task: Task) -> Trail[Model]:
    """Candidates of the methods that are asked for."""
    problem = build_state_affine_rows(train, model_class, slowest=task.searched_rate)
    trail: Trail[Model] = Trail(task, prove_stability, BOUND)
    radius, n_y = task.searched_rate, len(problem.y_scale[0])
    is_solved = {task.method, *task.comparators} == {LeastSquares()}  # without an iteration
    found = () if is_solved else stable_starts(train, model_class.lags, radius)
    starts = [(name, problem.embedded(theta)) for name, theta in found]
    trail.add("least_squares", lambda _: equation_error(problem))
    trail.follow(
        problem.rows,
        lambda i: problem.model(i.theta, i.p),
        starts,
        (lambda theta: reflected(theta, radius, n_y)) if problem.is_constant else None,
    )
    thetas = [theta for _, theta in starts]
    trail.add("sem", lambda method: _minima(problem, thetas, method))
    trail.add("rse_certified", lambda method: _certified(problem, trail, method))
    if model_class.is_linear and n_y == 1:
        trail.add("sem_certified", lambda method: _minima(problem, thetas, method))
    else:
        trail.add("sem_certified", lambda method: _last_step(problem, trail, method))
    return trail


def equation_error(problem: StateAffineRows) -> Model:
    """Least squares on the equation error with G_0 normalised to 1 at its constant term.

    Source: thesis Section 3.2.
    """
    rows = problem.rows
    fixed = rows.identity != 0.0
    free = np.array([not f and D != 0 for f, D in zip(fixed, rows.offsets, strict=True)])
    columns = np.column_stack([rows.errors[:, free], -rows.Q])
    found = np.linalg.lstsq(columns, -(rows.errors @ rows.identity), rcond=None)[0]
    theta: FloatArray = rows.identity.copy()
    theta[free] = found[: int(free.sum())]
    return problem.model(theta, found[int(free.sum()) :])


def minimise_simulation_error(
    problem: StateAffineRows, theta: FloatArray, *, stable: bool = False
) -> Model:
    """A local minimum of Σ (y - ŷ)² from left parameters θ, never above its value there.

    stable: of coefficients that do not depend on inputs, with all poles within the problem's
    slowest rate, as those of θ are.
    """
    inside = partial(_is_stable, problem) if stable else None
    objective = SimulationError(problem.rows, inside=inside)
    point = Descent(objective, (), len(theta)).to_minimum(theta).point
    return problem.model(point.theta, point.p)


def _is_stable(problem: StateAffineRows, theta: FloatArray) -> bool:
    """Every pole is within the radius, up to rounding."""
    if not theta[0]:
        return False
    radius = min(problem.slowest, SLOWEST_POLE) + POLE_ROUNDING
    return bool((np.abs(poles_of(theta, len(problem.y_scale[0]))) <= radius).all())


def _minima(problem: StateAffineRows, starts: list[FloatArray], method: Sem) -> Model:
    """The best of the local minima from every start and its robust simulation error."""
    thetas, n_y, stable = list(starts), len(problem.y_scale[0]), method.certified
    for theta in (None, *starts):
        try:
            *_, last = robust_simulation_error(
                problem.rows, start=theta, iterations=method.iterations
            )
        except SolverError:
            log.info("the robust simulation error gives no start")
            continue
        if problem.is_constant:
            thetas.append(reflected(last.theta, problem.slowest, n_y))
        if not stable:
            thetas.append(last.theta)

    def reached(theta: FloatArray) -> Model | None:
        start = problem.model(theta, SimulationError(problem.rows).at(theta).p)
        if stable and prove_stability(start) is None:
            return None
        found = minimise_simulation_error(problem, theta, stable=stable)
        return start if stable and prove_stability(found) is None else found

    found: list[Model] = []
    for theta in thetas:
        model = tried(theta.copy, reached)
        if model is not None:
            found.append(model)
    return least_error(found, problem.dataset)


def _certified(problem: StateAffineRows, trail: Trail[Model], method: Rse | Sem) -> Model:
    """The last iterate inside the convex sets of models that are stable for every input."""
    steps: list[Step] = []
    for iterate in certified_simulation_error(problem, iterations=method.iterations):
        steps.append(Step(f"certified iterate {len(steps) + 1}", iterate.J))
        last = iterate
    if trail.task.method.name.endswith("_certified"):
        trail.history = History(trail.history.value, tuple(steps))
    return problem.model(last.point.theta, last.point.p)


def _last_step(problem: StateAffineRows, trail: Trail[Model], method: Sem) -> Model:
    """A minimum of the simulation error from the best proved model at hand, and from the certified
    iterates where they are few unknowns or there is no other start.
    """
    train = problem.dataset
    at_hand = [c.model for c in trail.candidates if c.proof is not None]
    starts = [least_error(at_hand, train)] if at_hand else []
    if problem.is_bounded_by_leading or not starts:
        starts.append(_certified(problem, trail, method))
    proofs = [(start, prove_stability(start)) for start in starts]
    reached = [
        descend_certified(problem, start, proof, steps=method.iterations)
        for start, proof in proofs
        if proof is not None and isinstance(start, StateAffineModel)
    ]
    if not reached:
        raise Infeasible("no proof for the last certified iterate, where the last step starts")
    return least_error(reached, train)
