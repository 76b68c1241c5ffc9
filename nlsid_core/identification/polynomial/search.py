"""How polynomial equations are found, by the set that is searched and the method."""

from collections.abc import Callable
from typing import Any

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import Infeasible
from nlsid_core.identification.methods.options import Rie, Sem
from nlsid_core.identification.polynomial import explicit
from nlsid_core.identification.polynomial.implicit_descent import (
    MONOTONE,
    minimise_certified_implicit,
    minimise_equation,
)
from nlsid_core.identification.polynomial.implicit_rie import (
    Model,
    Proof,
    implicit_equation_error,
    kept_in_set,
    least_squares_coefficients,
    minimise_implicit_rie,
    prove_in_set,
    prove_kept,
    refuse_large_program,
)
from nlsid_core.identification.polynomial.implicit_rows import ImplicitRows, build_implicit_rows
from nlsid_core.identification.polynomial.moments import rows_without_bias
from nlsid_core.identification.polynomial.options import Polynomial
from nlsid_core.identification.starts import as_implicit, linear_start
from nlsid_core.identification.trail import NOTHING, Task, Trail, by_error, least_error, tried
from nlsid_core.models import MonotoneEquation

Coefficients = tuple[FloatArray, FloatArray]  # scaled e and f of an implicit model


def search(train: Dataset, model_class: Polynomial, task: Task) -> Trail[Any]:
    """Candidates of the methods that are asked for."""
    if model_class.form is None:
        return explicit.search(train, model_class, task)
    return _implicit(train, model_class, task)


def _implicit(train: Dataset, model_class: Polynomial, task: Task) -> Trail[Model]:
    """Implicit models in a stable set of thesis Chapter 2 or 3."""
    rows = build_implicit_rows(train, model_class)
    refuse_large_program(rows)
    trail: Trail[Model] = Trail(
        task,
        lambda model: prove_in_set(model, rows),
        "mean squared simulation error in squared spreads of the outputs, at most",
    )

    def bounded(method: Rie) -> tuple[Model, Proof]:
        untested, used = method.accept_untested_repeats, rows
        if model_class.form == "3.8" and (train.repeats() or untested):
            used = rows_without_bias(
                train, model_class, transient=task.transient, accept_untested_repeats=untested
            )
        found = minimise_implicit_rie(used, slowest=task.searched_rate)
        trail.solved(method, found.bound)
        return found.model, found.proof

    trail.add("least_squares", lambda _: implicit_equation_error(rows))
    trail.add_proved("rie", bounded)
    trail.add("sem", lambda method: _anywhere(rows, task, method))
    trail.add_proved("sem_certified", lambda method: _inside(rows, task, method))
    return trail


def _starts(rows: ImplicitRows, task: Task) -> tuple[Callable[[], Coefficients], ...]:
    """Where the searches for the least simulation error begin."""
    made = rows.model_class

    def bounded() -> Coefficients:
        found = minimise_implicit_rie(rows, slowest=task.searched_rate)
        return found.e, found.f

    def straight() -> Coefficients:
        found = linear_start(rows.dataset, made.lags, made.delays)
        if found is None:
            raise Infeasible("no linear model to start from")
        return as_implicit(found, rows)

    return bounded, lambda: least_squares_coefficients(rows), straight


def _anywhere(rows: ImplicitRows, task: Task, method: Sem) -> MonotoneEquation:
    """The best of the local minima of the simulation error, which may have no proof."""

    def minimised(start: Coefficients) -> MonotoneEquation | None:
        return minimise_equation(rows, start, steps=method.iterations)

    starts = _starts(rows, task)
    found = [one for start in starts if (one := tried(start, minimised)) is not None]
    return least_error(found, rows.dataset)


def _inside(rows: ImplicitRows, task: Task, method: Sem) -> tuple[Model, Proof]:
    """The best proved one of the local minima of the simulation error in the set, of all starts."""

    def minimised(start: Coefficients) -> Coefficients | None:
        return minimise_certified_implicit(
            rows, start, slowest=task.searched_rate, steps=method.iterations
        )

    starts = _starts(rows, task)
    found = [one for start in starts if (one := tried(start, minimised)) is not None]
    models: list[Model] = [kept_in_set(rows, *one, MONOTONE) for one in found]
    for model in by_error(models, rows.dataset):
        if (proof := prove_kept(model, rows)) is not None:
            return model, proof
    raise Infeasible(NOTHING)
