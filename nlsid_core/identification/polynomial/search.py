"""How polynomial equations are found, by the set that is searched and the method."""

import logging
from collections.abc import Callable, Sequence
from typing import Any

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, Infeasible, SolverError
from nlsid_core.identification.fit import Proof
from nlsid_core.identification.methods.options import Rie, Sem
from nlsid_core.identification.polynomial import explicit
from nlsid_core.identification.polynomial.implicit_descent import minimise_certified_implicit
from nlsid_core.identification.polynomial.implicit_rie import (
    implicit_equation_error,
    least_squares_coefficients,
    minimise_implicit_rie,
    prove_in_set,
    refuse_large_program,
)
from nlsid_core.identification.polynomial.implicit_rows import ImplicitRows, build_implicit_rows
from nlsid_core.identification.polynomial.moment_rie import MomentFit, minimise_moment_rie
from nlsid_core.identification.polynomial.moments import (
    offsets_of,
    plain_moments,
    refuse_unexcited,
)
from nlsid_core.identification.polynomial.monotone import (
    identify_from_repeats,
    least_squares_equation,
    minimise_monotone_simulation_error,
)
from nlsid_core.identification.polynomial.monotone_descent import minimise_certified
from nlsid_core.identification.polynomial.options import Polynomial
from nlsid_core.identification.proofs.stability import prove_stability
from nlsid_core.identification.proofs.stable_sets import ImplicitProof
from nlsid_core.identification.starts import as_implicit, as_monotone, linear_start
from nlsid_core.identification.trail import Task, Trail, least_error, tried
from nlsid_core.identification.validation import simulation_percent
from nlsid_core.models import ImplicitModel, MonotoneEquation

Coefficients = tuple[FloatArray, FloatArray]  # scaled e and f of an implicit model
log = logging.getLogger(__name__)


def search(train: Dataset, model_class: Polynomial, task: Task) -> Trail[Any]:
    """Candidates of the methods that are asked for."""
    if model_class.form is None:
        return explicit.search(train, model_class, task)
    return (_monotone if model_class.form == "3.8" else _implicit)(train, model_class, task)


def _monotone(train: Dataset, model_class: Polynomial, task: Task) -> Trail[MonotoneEquation]:
    """Monotone equations through moments, of repeated experiments if there are any."""
    offsets = offsets_of(train.trajectories)
    plain = plain_moments(train.trajectories, model_class, offsets, executor=task.executor)
    template = train.trajectories[0]
    refuse_unexcited(plain, model_class, template, offsets)
    unit, said = template.y_units[0], "" if train.repeats() else ", which noise biases"
    trail: Trail[MonotoneEquation] = Trail(
        task,
        prove_stability,
        f"mean squared simulation error by the moments{said}, at most [{unit}²]",
    )

    def without_bias(method: Rie) -> MomentFit:
        return identify_from_repeats(
            train,
            model_class,
            transient=task.transient,
            executor=task.executor,
            accept_untested_repeats=method.accept_untested_repeats,
            slowest=task.searched_rate,
        )

    def biased() -> MomentFit:
        return minimise_moment_rie(
            plain, model_class, template, offsets, slowest=task.searched_rate
        )

    def equation_error() -> MonotoneEquation:
        return least_squares_equation(plain, model_class, template, offsets)

    def bounded(method: Rie) -> tuple[MonotoneEquation, Proof]:
        repeated = bool(train.repeats()) or method.accept_untested_repeats
        fit = without_bias(method) if repeated else biased()
        trail.solved(method, fit.bound)
        return fit.model, fit.proof

    trail.add("least_squares", lambda _: equation_error())
    trail.add_proved("rie", bounded)

    def straight() -> MonotoneEquation:
        found = linear_start(train, model_class.lags, model_class.delays)
        if found is None:
            raise Infeasible("no linear model to start from")
        return as_monotone(found, model_class)

    starts = (equation_error, lambda: biased().model, straight)
    trail.add("sem", lambda _: _best_minimum(starts, train))

    def inside(method: Sem) -> MonotoneEquation:
        def minimised(start: MonotoneEquation) -> MonotoneEquation | None:
            return minimise_certified(
                start,
                plain,
                model_class,
                train.trajectories,
                slowest=task.searched_rate,
                steps=method.iterations,
            )

        begun = (*starts, lambda: _best_minimum(starts, train))
        found = [model for start in begun if (model := tried(start, minimised)) is not None]
        return least_error([m for m in found if prove_stability(m) is not None], train)

    trail.add("sem_certified", inside)
    return trail


def _best_minimum(
    starts: Sequence[Callable[[], MonotoneEquation]], train: Dataset
) -> MonotoneEquation:
    """The better of the local minima of the simulation error; DataError if every start diverges."""
    found, reason = [], DataError("no start")
    for start in starts:
        try:
            found.append(minimise_monotone_simulation_error(start(), train.trajectories))
        except (DataError, SolverError) as refusal:
            reason = DataError(str(refusal))
    if not found:
        raise reason
    return min(found, key=lambda model: simulation_percent(model, train))


def _implicit(train: Dataset, model_class: Polynomial, task: Task) -> Trail[ImplicitModel]:
    """Implicit models in a stable set of thesis Chapter 2."""
    rows = build_implicit_rows(train, model_class)
    refuse_large_program(rows)
    trail: Trail[ImplicitModel] = Trail(
        task,
        lambda model: prove_in_set(model, rows),
        "mean squared simulation error in squared spreads of the outputs, at most",
    )

    def bounded(method: Rie) -> tuple[ImplicitModel, Proof]:
        found = minimise_implicit_rie(rows, slowest=task.searched_rate)
        trail.solved(method, found.bound)
        return found.model, found.proof

    trail.add("least_squares", lambda _: implicit_equation_error(rows))
    trail.add_proved("rie", bounded)
    trail.add_proved("sem_certified", lambda method: _inside(rows, task, method))
    return trail


def _inside(rows: ImplicitRows, task: Task, method: Sem) -> tuple[ImplicitModel, ImplicitProof]:
    """The best of the local minima of the simulation error in the set, from all starts at hand."""
    made = rows.model_class

    def bounded() -> Coefficients:
        found = minimise_implicit_rie(rows, slowest=task.searched_rate)
        return found.e, found.f

    def straight() -> Coefficients:
        found = linear_start(rows.dataset, made.lags, made.delays)
        if found is None:
            raise Infeasible("no linear model to start from")
        return as_implicit(found, rows)

    def minimised(start: Coefficients) -> tuple[ImplicitModel, ImplicitProof] | None:
        return minimise_certified_implicit(
            rows, start, slowest=task.searched_rate, steps=method.iterations
        )

    starts = (bounded, lambda: least_squares_coefficients(rows), straight)
    found = [one for start in starts if (one := tried(start, minimised)) is not None]
    best = least_error([model for model, _ in found], rows.dataset)
    return next(one for one in found if one[0] is best)
