"""What a search is asked for, and the candidates it makes, each proved and timed."""

import logging
import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from nlsid_core.errors import NlsidError
from nlsid_core.identification.fit import FINAL, FIRST, Candidate, History, Proof, Step
from nlsid_core.identification.prediction import Model
from nlsid_core.identification.rows import Rows
from nlsid_core.identification.rse import Iterate, robust_simulation_error
from nlsid_core.trajectory import Dataset

Progress = Callable[[str, float], None]
T = TypeVar("T", bound=Model)
log = logging.getLogger(__name__)


def silent(_what: str, _fraction: float) -> None:
    """Progress that nobody looks at."""


@dataclass(frozen=True, eq=False)
class Task:
    """method: the one asked for; comparators: what runs beside it. See `identify`."""

    method: str
    comparators: frozenset[str]
    validation: Dataset | None = None
    iterations: int = 40
    transient: int = 0
    accept_untested_repeats: bool = False
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    executor: Executor | None = None
    progress: Progress = silent

    def wants(self, method: str) -> bool:
        """Whether it is asked for."""
        return method == self.method or method in self.comparators


class Trail(Generic[T]):
    """Candidates as they are made. A comparator that fails is left out and logged."""

    def __init__(self, task: Task, prove: Callable[[T], Proof | None], value: str) -> None:
        self.task, self.prove = task, prove
        self.candidates: list[Candidate[T]] = []
        self.history = History(value)

    def add(self, method: str, make: Callable[[], T]) -> None:
        """Make one candidate, if it is asked for."""

        def proved() -> tuple[T, Proof | None]:
            model = make()
            return model, self.prove(model)

        self.add_proved(method, proved)

    def add_proved(self, method: str, make: Callable[[], tuple[T, Proof | None]]) -> None:
        """The same where the proof comes with the model."""
        if not self.task.wants(method):
            return
        self.task.progress(method, 0.1 * len(self.candidates))
        started = time.perf_counter()
        try:
            model, proof = make()
        except NlsidError as reason:
            if method == self.task.method:
                raise
            log.warning("no comparison with %s: %s", method, reason)
            return
        self._keep(method, model, proof, time.perf_counter() - started)

    def follow(self, rows: Rows, model: Callable[[Iterate], T]) -> None:
        """The iterates of the robust simulation error; the first and the last are candidates."""
        task = self.task
        if not (task.wants(FIRST) or task.wants(FINAL)):
            return
        iterations = task.iterations if task.wants(FINAL) else 1
        steps: list[Step] = []
        started, last = time.perf_counter(), None
        for last in robust_simulation_error(rows, iterations=iterations):
            steps.append(Step(f"iterate {len(steps) + 1}", last.J))
            if len(steps) == 1 and task.wants(FIRST):
                seconds, found = time.perf_counter() - started, model(last)
                self._keep(FIRST, found, self.prove(found), seconds)
            done = 0.2 + 0.4 * len(steps) / iterations
            task.progress(f"robust simulation error, iterate {len(steps)}", done)
        assert last is not None, "there is at least one iterate"
        self.history = History(self.history.value, tuple(steps))
        if task.wants(FINAL):
            seconds, found = time.perf_counter() - started, model(last)
            self._keep(FINAL, found, self.prove(found), seconds)

    def _keep(self, method: str, model: T, proof: Proof | None, seconds: float) -> None:
        self.candidates.append(Candidate(method, model, proof, seconds, self.task.transient))
