"""What a search is asked for, and the candidates it makes, each proved and timed."""

import logging
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
from scipy.linalg import LinAlgError

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, Infeasible, NlsidError, SolverError
from nlsid_core.identification.fit import (
    Candidate,
    History,
    Proof,
    Step,
    rate_text,
    stated_rate,
)
from nlsid_core.identification.methods.banded import Rows
from nlsid_core.identification.methods.options import Method
from nlsid_core.identification.methods.rse import Iterate, affordable_steps, robust_simulation_error
from nlsid_core.identification.methods.simulation_error import SimulationError
from nlsid_core.identification.prediction import Model
from nlsid_core.identification.rates import searched_rate
from nlsid_core.identification.validation import simulation_percent
from nlsid_core.progress import Progress, silent

T = TypeVar("T", bound=Model)
S = TypeVar("S")
R = TypeVar("R")
log = logging.getLogger(__name__)
NOTHING = "no start of the search leads to a model that can be used"
STEPS_A_BOUND = 10  # of Newton's method, to its minimum, as a rule
FEW_STEPS = 2  # towards it in a large problem: a new bound brings more than the end of the last
FEWEST_BOUNDS = 6  # from every start, however large the problem is


@dataclass(frozen=True, eq=False)
class Task:
    """method: the one asked for; comparators: what runs beside it; max_rate: the slowest that is
    allowed, and proofs of which count. See `identify`.
    """

    method: Method
    comparators: tuple[Method, ...]
    max_rate: float
    transient: int = 0
    progress: Progress = silent

    @property
    def searched_rate(self) -> float:
        """The slowest rate that a search keeps, so that its proof is fast enough."""
        return searched_rate(self.max_rate)

    def wanted(self, name: str) -> Any:
        """The method of this name that was asked for, with its options; None if none was."""
        asked = (self.method, *self.comparators)
        return next((method for method in asked if method.name == name), None)


class Trail(Generic[T]):
    """Candidates as they are made. A comparator that fails is left out and logged."""

    def __init__(self, task: Task, prove: Callable[[T], Proof | None], value: str) -> None:
        self.task, self.prove = task, prove
        self.candidates: list[Candidate[T]] = []
        self.history = History(value)

    def add(self, name: str, make: Callable[[Any], T]) -> None:
        """Make the candidate of the method of this name, if it is asked for."""

        def proved(method: Method) -> tuple[T, Proof | None]:
            model = make(method)
            return model, self.prove(model)

        self.add_proved(name, proved)

    def add_proved(self, name: str, make: Callable[[Any], tuple[T, Proof | None]]) -> None:
        """The same where the proof comes with the model."""
        method = self.task.wanted(name)
        if method is None:
            return
        self.task.progress(method.title, 0.1 * len(self.candidates))
        started = time.process_time()
        try:
            model, proof = make(method)
        except (NlsidError, LinAlgError) as reason:
            if method is self.task.method and isinstance(reason, NlsidError):
                raise
            if method is self.task.method:
                raise SolverError(f"{method.title}: {reason}") from reason
            log.warning("no comparison with %s: %s", method.name, reason)
            return
        self._keep(method, model, proof, time.process_time() - started)

    def follow(
        self,
        rows: Rows,
        model: Callable[[Iterate], T],
        starts: Iterable[tuple[str, FloatArray]] = (),
        within: Callable[[FloatArray], FloatArray] | None = None,
    ) -> None:
        """The iterates of the robust simulation error; the best is a candidate.

        starts: left parameters with their names, at which a first bound is made exact; from each
        it is iterated too, and the iterate of the least simulation error is kept. In a large
        problem, by `affordable_steps`, no bound is taken to its minimum.
        within: the nearest left parameters that are allowed, at which an iterate that is not is
        taken.
        """
        method = self.task.wanted("rse")
        if method is None:
            return
        begun, iterations, steps = (("", None), *starts), method.iterations, None
        affordable = affordable_steps(rows) // len(begun)
        if iterations * STEPS_A_BOUND > affordable:
            steps = FEW_STEPS
            iterations = min(iterations, max(FEWEST_BOUNDS, affordable // steps))
            log.info(
                "a large problem: %d bounds from each start, %d Newton steps towards the "
                "minimum of each",
                iterations,
                steps,
            )
        error = SimulationError(rows)
        started, best, failure = time.process_time(), None, SolverError("no iterate")
        for start, theta in begun:
            path: list[Step] = []
            try:
                for last in robust_simulation_error(
                    rows, start=theta, iterations=iterations, steps=steps
                ):
                    path.append(Step(f"iterate {len(path) + 1} {start}".rstrip(), last.J))
                    done = 0.2 + 0.4 * len(path) / iterations
                    self.task.progress(f"robust simulation error, iterate {len(path)}", done)
                allowed = last.theta if within is None else within(last.theta)
                reached = error.at(allowed)
                if not np.array_equal(allowed, last.theta):
                    last = replace(last, theta=allowed, p=reached.p, J=reached.J)
                    path.append(Step("at the slowest rate allowed", reached.J))
            except (SolverError, LinAlgError) as reason:
                failure = SolverError(str(reason))
                continue
            if best is None or best[0] > reached.J:
                best = reached.J, last, tuple(path)
        if best is None:
            raise failure
        self.history = History(self.history.value, best[2])
        seconds, found = time.process_time() - started, model(best[1])
        self._keep(method, found, self.prove(found), seconds)

    def solved(self, method: Method, bound: float) -> None:
        """The history of a fit that one program made, if it is the method asked for."""
        if method is self.task.method:
            self.history = History(self.history.value, (Step(method.title, bound),))

    def _keep(self, method: Method, model: T, proof: Proof | None, seconds: float) -> None:
        remark = ""
        if proof is not None and self.task.max_rate < proof.rate < 1.0:
            period = model.period
            remark = (
                f"proved only at {stated_rate(proof, period)} a sample, slower than the max_rate "
                f"of {rate_text(self.task.max_rate, period)}"
            )
            proof = None
        self.candidates.append(
            Candidate(method, model, proof, seconds, self.task.transient, remark)
        )


def tried(start: Callable[[], S], minimised: Callable[[S], R | None]) -> R | None:
    """What a search makes of a start; None if there is no start, or it leads to nothing."""
    try:
        return minimised(start())
    except (DataError, SolverError, LinAlgError) as reason:
        log.info("no model from this start: %s", reason)
        return None


def least_error(models: Sequence[T], train: Dataset) -> T:
    """The model that simulates the training data best; Infeasible if there is none."""
    if not models:
        raise Infeasible(NOTHING)
    return by_error(models, train)[0]


def by_error(models: Sequence[T], train: Dataset) -> list[T]:
    """The models, the one that simulates the training data best first."""
    return sorted(models, key=lambda model: simulation_percent(model, train))
