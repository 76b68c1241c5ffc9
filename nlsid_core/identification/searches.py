"""How the models of each class are found: which methods there are, and the search itself."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from scipy.linalg import LinAlgError

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, Infeasible, SolverError
from nlsid_core.identification.fit import History, Proof, Step
from nlsid_core.identification.methods.options import (
    CertifiedRse,
    CertifiedSem,
    FirstRse,
    LeastSquares,
    Method,
    MomentRie,
    Rie,
    Rse,
    Sem,
)
from nlsid_core.identification.methods.rse import robust_simulation_error
from nlsid_core.identification.methods.simulation_error import SimulationError
from nlsid_core.identification.network.cascade import BlockCascadeClass, identify_block_cascade
from nlsid_core.identification.network.cascade_fit import MAX_RADIUS
from nlsid_core.identification.network.cells import CellClass, identify_cells
from nlsid_core.identification.network.feedback import (
    FeedbackClass,
    identify_feedback,
    identify_unproved,
)
from nlsid_core.identification.polynomial.certified import (
    certified_simulation_error,
    descend_certified,
)
from nlsid_core.identification.polynomial.implicit_descent import minimise_certified_implicit
from nlsid_core.identification.polynomial.implicit_rie import (
    implicit_equation_error,
    least_squares_coefficients,
    minimise_implicit_rie,
    prove_in_set,
    refuse_large_program,
)
from nlsid_core.identification.polynomial.implicit_rows import (
    ImplicitClass,
    ImplicitRows,
    build_implicit_rows,
)
from nlsid_core.identification.polynomial.linear import (
    LinearClass,
    build_regression,
    least_squares,
    minimise_simulation_error,
)
from nlsid_core.identification.polynomial.linear_states import (
    LinearStateClass,
    identify_linear_states,
)
from nlsid_core.identification.polynomial.moment_rie import MomentFit, minimise_moment_rie
from nlsid_core.identification.polynomial.moments import (
    MonotoneClass,
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
from nlsid_core.identification.polynomial.rie import robust_identification_error
from nlsid_core.identification.polynomial.rows import (
    StateAffineClass,
    StateAffineRows,
    build_state_affine_rows,
)
from nlsid_core.identification.prediction import Model
from nlsid_core.identification.proofs.stability import prove_stability
from nlsid_core.identification.proofs.stable_sets import ImplicitProof
from nlsid_core.identification.starts import (
    as_implicit,
    as_monotone,
    linear_start,
    reflected,
    stable_starts,
)
from nlsid_core.identification.trail import Task, Trail
from nlsid_core.identification.validation import hold_out, simulation_percent
from nlsid_core.models import (
    BlockCascade,
    CellNetwork,
    DifferenceEquation,
    ImplicitModel,
    MonotoneEquation,
    StateAffineModel,
)

T = TypeVar("T", bound=Model)
S = TypeVar("S")
R = TypeVar("R")
Coefficients = tuple[FloatArray, FloatArray]  # scaled e and f of an implicit model
log = logging.getLogger(__name__)
BOUND = "bound on the simulation error"
MOST_ENTRIES = 1_500_000  # of the equation errors; above it, searches that are not asked for wait
CERTIFIABLE_DEGREE = 2  # of G_0, at most: a quadratic is bounded on a box by the S-procedure
CERTIFIABLE_AFFINE = 1  # of every G_k if the lagged ones depend on the input: corners decide


def linear(train: Dataset, model_class: LinearClass, task: Task) -> Trail[DifferenceEquation]:
    """Difference equations of one input and one output."""
    regression = build_regression(train, model_class.lags)
    trail: Trail[DifferenceEquation] = Trail(task, prove_stability, BOUND)
    trail.add(LeastSquares, lambda _: least_squares(regression))
    radius = task.searched_rate
    starts = tuple(stable_starts(train, model_class.lags, radius))
    trail.follow(
        regression.rows,
        lambda i: regression.model(i.theta, i.p),
        starts,
        lambda theta: reflected(theta, radius),
    )

    def minimised(iterations: int, *, stable: bool) -> DifferenceEquation:
        """The best of the local minima from every start and its robust simulation error."""
        thetas = [theta for _, theta in starts]
        for theta in (None, *thetas):
            try:
                *_, last = robust_simulation_error(
                    regression.rows, start=theta, iterations=iterations
                )
            except SolverError:
                log.info("the robust simulation error gives no start")
                continue
            thetas.append(reflected(last.theta, radius))
            if not stable:
                thetas.append(last.theta)

        def reached(theta: FloatArray) -> DifferenceEquation | None:
            start = regression.model(theta, SimulationError(regression.rows).at(theta).p)
            if stable and prove_stability(start) is None:
                return None
            return minimise_simulation_error(regression, start, stable=stable, radius=radius)

        found = (_tried(theta.copy, reached) for theta in thetas)
        return _least_error([model for model in found if model is not None], train)

    trail.add(Sem, lambda _: minimised(Rse().iterations, stable=False))
    trail.add(CertifiedSem, lambda method: minimised(method.iterations, stable=True))
    return trail


def state_affine(
    train: Dataset, model_class: StateAffineClass, task: Task
) -> Trail[StateAffineModel]:
    """State-affine models, of several inputs and outputs."""
    problem = build_state_affine_rows(train, model_class, slowest=task.searched_rate)
    if problem.rows.errors.size > MOST_ENTRIES:
        beside = [m for m in task.comparators if isinstance(m, LeastSquares)]
        left_out = ", ".join(m.name for m in task.comparators if m not in beside)
        if left_out:
            log.warning("%d rows of %d unknowns: no comparison with %s; ask for one to have it",
                        *problem.rows.errors.shape, left_out)  # fmt: skip
        task = replace(task, comparators=tuple(beside))
    trail: Trail[StateAffineModel] = Trail(task, prove_stability, BOUND)
    trail.add(LeastSquares, lambda _: state_affine_equation_error(problem))
    trail.add(Rie, lambda _: robust_identification_error(problem)[0])
    radius, n_y = task.searched_rate, len(problem.y_scale[0])
    constant = not (model_class.leading_degree or model_class.lagged_degree)
    trail.follow(
        problem.rows,
        lambda i: problem.model(i.theta, i.p),
        [
            (name, problem.embedded(theta))
            for name, theta in stable_starts(train, model_class.lags, radius)
        ],
        (lambda theta: reflected(theta, radius, n_y)) if constant else None,
    )
    trail.add(CertifiedRse, lambda method: _certified(problem, trail, method))

    def last_step(method: CertifiedSem) -> StateAffineModel:
        """From the best proved model at hand, and from the certified iterates where they are few
        unknowns or there is no other start.
        """
        at_hand = [c.model for c in trail.candidates if c.proof is not None]
        starts = [_least_error(at_hand, train, problem.weights)] if at_hand else []
        if problem.is_bounded_by_leading or not starts:
            starts.append(_certified(problem, trail, method))
        proofs = [(start, prove_stability(start)) for start in starts]
        reached = [
            descend_certified(problem, start, proof, steps=method.iterations)
            for start, proof in proofs
            if proof is not None
        ]
        if not reached:
            raise Infeasible("no proof for the last certified iterate, where the last step starts")
        return _least_error(reached, train, problem.weights)

    trail.add(CertifiedSem, last_step)
    return trail


def block_cascade(
    train: Dataset, model_class: BlockCascadeClass, task: Task
) -> Trail[BlockCascade]:
    """Wiener, Hammerstein and Wiener-Hammerstein models of one input and one output."""
    fitted, judged = (train, task.validation) if task.validation else hold_out(train)
    trail: Trail[BlockCascade] = Trail(
        task, lambda _: None, f"validation error, rms [{_unit(train)}]"
    )

    def search(_: Sem) -> tuple[BlockCascade, Proof]:
        found = identify_block_cascade(
            fitted,
            judged,
            model_class,
            whole=train if task.validation is None else None,
            transient=task.transient,
            slowest=min(MAX_RADIUS, task.searched_rate),
            progress=task.progress,
        )
        *choices, last = found.choices
        steps = [Step(str(choice), choice.validation_rms) for choice in choices]
        steps.append(Step(f"{last}, minimised further", last.validation_rms))
        if found.again is not None:
            steps.append(Step("fitted to all trials, training error", found.again))
        trail.history = History(trail.history.value, tuple(steps))
        return replace(found.model, bags=train.bags), found.proof

    trail.add_proved(Sem, search)
    return trail


def cells(train: Dataset, model_class: CellClass, task: Task) -> Trail[CellNetwork]:
    """Scalar states in a row that contract, saturate and flow over; one output."""
    trail: Trail[CellNetwork] = Trail(task, lambda _: None, f"training error, rms [{_unit(train)}]")

    def search(method: CertifiedSem) -> tuple[CellNetwork, Proof]:
        model, proof, steps = identify_cells(
            train, model_class, transient=task.transient, slowest=task.searched_rate,
            steps=method.iterations,
        )  # fmt: skip
        trail.history = History(trail.history.value, steps)
        return model, proof

    trail.add_proved(CertifiedSem, search)
    return trail


def feedback(train: Dataset, model_class: FeedbackClass, task: Task) -> Trail[CellNetwork]:
    """Filters with feedback through a static map, unrolled; the loop itself for comparison."""
    trail: Trail[CellNetwork] = Trail(
        task, prove_stability, f"held-back error, rms [{_unit(train)}]"
    )
    fitted, judged = hold_out(train)

    def search(method: CertifiedSem) -> tuple[CellNetwork, Proof]:
        model, proof, steps = identify_feedback(
            train, fitted, judged, model_class, transient=task.transient,
            slowest=min(MAX_RADIUS, task.searched_rate), steps=method.iterations,
            progress=task.progress,
        )  # fmt: skip
        trail.history = History(trail.history.value, steps)
        return model, proof

    trail.add(Sem, lambda _: identify_unproved(train, model_class, transient=task.transient))
    trail.add_proved(CertifiedSem, search)
    return trail


def monotone(train: Dataset, model_class: MonotoneClass, task: Task) -> Trail[MonotoneEquation]:
    """Monotone equations through moments, of repeated experiments if there are any."""
    offsets = offsets_of(train.trajectories)
    plain = plain_moments(train.trajectories, model_class, offsets, executor=task.executor)
    template = train.trajectories[0]
    refuse_unexcited(plain, model_class, template, offsets)
    trail: Trail[MonotoneEquation] = Trail(
        task,
        prove_stability,
        f"mean squared simulation error by the moments, at most [{_unit(train)}²]",
    )

    def solved(method: Method, fit: MomentFit) -> tuple[MonotoneEquation, Proof]:
        trail.solved(method, fit.bound)
        return fit.model, fit.proof

    def without_bias(method: MomentRie) -> MomentFit:
        return identify_from_repeats(
            train, model_class, transient=task.transient, executor=task.executor,
            accept_untested_repeats=method.accept_untested_repeats, slowest=task.searched_rate,
        )  # fmt: skip

    def biased() -> MomentFit:
        return minimise_moment_rie(
            plain, model_class, template, offsets, slowest=task.searched_rate
        )

    def equation_error() -> MonotoneEquation:
        return least_squares_equation(plain, model_class, template, offsets)

    trail.add(LeastSquares, lambda _: equation_error())
    trail.add_proved(Rie, lambda method: solved(method, biased()))
    if train.repeats() or isinstance(task.method, MomentRie):
        trail.add_proved(MomentRie, lambda method: solved(method, without_bias(method)))

    def straight() -> MonotoneEquation:
        found = linear_start(train, model_class.lags, model_class.delays)
        if found is None:
            raise Infeasible("no linear model to start from")
        return as_monotone(found, model_class)

    starts = (equation_error, lambda: biased().model, straight)
    trail.add(Sem, lambda _: _best_minimum(starts, train))

    def inside(method: CertifiedSem) -> MonotoneEquation:
        def minimised(start: MonotoneEquation) -> MonotoneEquation | None:
            return minimise_certified(
                start, plain, model_class, train.trajectories,
                slowest=task.searched_rate, steps=method.iterations,
            )  # fmt: skip

        begun = (*starts, lambda: _best_minimum(starts, train))
        found = [model for start in begun if (model := _tried(start, minimised)) is not None]
        return _least_error([m for m in found if prove_stability(m) is not None], train)

    trail.add(CertifiedSem, inside)
    return trail


def _tried(start: Callable[[], S], minimised: Callable[[S], R | None]) -> R | None:
    """What a search makes of a start; None if there is no start, or it leads to nothing."""
    try:
        return minimised(start())
    except (DataError, SolverError, LinAlgError) as reason:
        log.info("no model from this start: %s", reason)
        return None


def _least_error(models: Sequence[T], train: Dataset, weights: FloatArray | None = None) -> T:
    """The model that simulates the training data best; Infeasible if there is none.

    weights: (n_y,), as of `simulation_percent`.
    """
    if not models:
        raise Infeasible("no start of the search leads to a model that can be used")
    return min(models, key=lambda model: simulation_percent(model, train, weights=weights))


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


def implicit(train: Dataset, model_class: ImplicitClass, task: Task) -> Trail[ImplicitModel]:
    """Implicit models in a stable set of thesis Chapter 2."""
    rows = build_implicit_rows(train, model_class)
    refuse_large_program(rows)
    trail: Trail[ImplicitModel] = Trail(
        task,
        lambda model: prove_in_set(model, rows),
        "mean squared simulation error in squared spreads of the outputs, at most",
    )

    def search(method: Rie) -> tuple[ImplicitModel, Proof]:
        found = minimise_implicit_rie(rows, slowest=task.searched_rate)
        trail.solved(method, found.bound)
        return found.model, found.proof

    trail.add(LeastSquares, lambda _: implicit_equation_error(rows))
    trail.add_proved(Rie, search)
    trail.add_proved(CertifiedSem, lambda method: _inside(rows, task, method))
    return trail


def _inside(
    rows: ImplicitRows, task: Task, method: CertifiedSem
) -> tuple[ImplicitModel, ImplicitProof]:
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
    found = [one for start in starts if (one := _tried(start, minimised)) is not None]
    best = _least_error([model for model, _ in found], rows.dataset)
    return next(one for one in found if one[0] is best)


def linear_states(train: Dataset, _: LinearStateClass, task: Task) -> Trail[ImplicitModel]:
    """Linear models of measured states, least squares over all stable ones."""
    trail: Trail[ImplicitModel] = Trail(task, lambda _: None, "equation error")

    def search(_: LeastSquares) -> tuple[ImplicitModel, Proof]:
        found = identify_linear_states(train, slowest=task.searched_rate)
        return found.model, found.proof

    trail.add_proved(LeastSquares, search)
    if task.wanted(CertifiedSem) is not None:
        rows = build_implicit_rows(train, ImplicitClass(1, (1,), "2.19", 1))
        trail.add_proved(CertifiedSem, lambda method: _inside(rows, task, method))
    return trail


@dataclass(frozen=True)
class Offer:
    """The methods of a class, the default first, and those that run beside what is asked for.

    needs_validation: the search chooses by validation trials, or by some of the training trials.
    """

    search: Callable[[Dataset, Any, Task], Trail[Any]]
    methods: tuple[type[Method], ...]
    comparators: tuple[type[Method], ...]
    needs_validation: bool = False


OFFERS: dict[type, Offer] = {
    LinearClass: Offer(
        linear, (Rse, LeastSquares, FirstRse, Sem, CertifiedSem), (LeastSquares, FirstRse, Rse, Sem)
    ),
    StateAffineClass: Offer(
        state_affine,
        (Rse, LeastSquares, Rie, FirstRse, CertifiedRse, CertifiedSem),
        (LeastSquares, Rie, FirstRse, Rse),
    ),
    BlockCascadeClass: Offer(block_cascade, (Sem,), (), needs_validation=True),
    CellClass: Offer(cells, (CertifiedSem,), ()),
    FeedbackClass: Offer(feedback, (CertifiedSem, Sem), (Sem,)),
    MonotoneClass: Offer(
        monotone,
        (MomentRie, Rie, LeastSquares, Sem, CertifiedSem),
        (LeastSquares, Rie, MomentRie),
    ),
    ImplicitClass: Offer(implicit, (Rie, LeastSquares, CertifiedSem), (LeastSquares, Rie)),
    LinearStateClass: Offer(linear_states, (LeastSquares, CertifiedSem), ()),
}


def methods_of(model_class: object) -> tuple[type[Method], ...]:
    """The methods for models of this class, the default first.

    Raises DataError if it is no model class.
    """
    offer = OFFERS.get(type(model_class))
    if offer is None:
        names = ", ".join(known.__name__ for known in OFFERS)
        raise DataError(f"{model_class!r} is no model class; there are: {names}")
    refused: tuple[type[Method], ...] = ()
    if isinstance(model_class, StateAffineClass):
        most = CERTIFIABLE_AFFINE if model_class.lagged_degree else CERTIFIABLE_DEGREE
        if max(model_class.lagged_degree, model_class.leading_degree) > most:
            refused = (CertifiedRse, CertifiedSem)
    return tuple(method for method in offer.methods if method not in refused)


def state_affine_equation_error(problem: StateAffineRows) -> StateAffineModel:
    """Least squares on the equation error with G_0 normalised to 1 at its constant term."""
    rows = problem.rows
    fixed = rows.identity != 0.0
    free = np.array([not f and D != 0 for f, D in zip(fixed, rows.offsets, strict=True)])
    columns = np.column_stack([rows.errors[:, free], -rows.Q])
    found = np.linalg.lstsq(columns, -(rows.errors @ rows.identity), rcond=None)[0]
    theta: FloatArray = rows.identity.copy()
    theta[free] = found[: int(free.sum())]
    return problem.model(theta, found[int(free.sum()) :])


def _certified(
    problem: StateAffineRows, trail: Trail[StateAffineModel], method: CertifiedRse | CertifiedSem
) -> StateAffineModel:
    steps: list[Step] = []
    for iterate in certified_simulation_error(problem, iterations=method.iterations):
        steps.append(Step(f"certified iterate {len(steps) + 1}", iterate.J))
        last = iterate
    if isinstance(trail.task.method, CertifiedRse | CertifiedSem):
        trail.history = History(trail.history.value, tuple(steps))
    return problem.model(last.point.theta, last.point.p)


def _unit(train: Dataset) -> str:
    return train.trajectories[0].y_units[0]
