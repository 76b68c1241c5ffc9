"""`Fit`: what `identify` returns, every method's model with its proof and scores."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from nlsid_core.arrays import Json
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import Infeasible
from nlsid_core.identification.methods.options import Method
from nlsid_core.identification.prediction import Model
from nlsid_core.identification.validation import (
    Validation,
    simulation_percent,
    unscored,
    validate,
)
from nlsid_core.models.difference_equation import DifferenceEquation
from nlsid_core.shown import BLUE, card, line

M = TypeVar("M", bound=Model, covariant=True)


class Proof(Protocol):
    """An exact proof of incremental stability, as the checker decides it."""

    @property
    def rate(self) -> float:
        """Two solutions with the same input approach each other by it, or faster, a sample.

        1 where their difference is proved square summable and no rate is.
        """
        ...

    def document(self, model: Any, file: str) -> Json:
        """The proof file's content for the model it was made for, stored in `file` beside it."""
        ...


def stated_rate(proof: Proof, period: float) -> str:
    """The rate a sample, rounded up, and its time constant at `period` (s): `0.9500 (0.49 s)`."""
    return "proved, no rate" if proof.rate >= 1.0 else rate_text(proof.rate, period)


def rate_text(rate: float, period: float) -> str:
    """A rate below 1 as `stated_rate` writes it."""
    digits = 4 if rate <= 0.999 else 7
    rounded = max(math.ceil(rate * 10**digits), 1) / 10**digits
    if rounded >= 1.0:
        return f"{rate!r} ({-period / math.log(rate):.2g} s)"
    return f"{rounded:.{digits}f} ({-period / math.log(rounded):.2g} s)"


@dataclass(frozen=True, eq=False)
class Candidate(Generic[M]):
    """One method's model, its stability proof if there is one, and the seconds it took.

    seconds: of processor time. transient: samples at the start of each trial that its scores leave
    out. remark: why there is no proof, where that is known.
    """

    method: Method
    model: M
    proof: Proof | None
    seconds: float
    transient: int = 0
    remark: str = ""

    def error_percent(self, dataset: Dataset) -> float:
        """100·‖y - ŷ‖/‖y - mean(y)‖ of the simulation over `dataset`."""
        return simulation_percent(self.model, dataset, transient=unscored(dataset, self.transient))

    @property
    def unproved(self) -> str:
        """What is said in the place of a proof."""
        return f"not proved: {self.remark}" if self.remark else "not proved"

    def validate(self, dataset: Dataset) -> Validation:
        """Simulation and prediction errors and the tests of the residuals over `dataset`."""
        return validate(self.model, dataset, transient=unscored(dataset, self.transient))


@dataclass(frozen=True)
class Step:
    """One step of a search: an iterate or a choice that was tried, and the value it reached."""

    what: str
    value: float


@dataclass(frozen=True, eq=False)
class History:
    """The steps of the search that made a fit, and what their values are."""

    value: str
    steps: tuple[Step, ...] = ()

    def __str__(self) -> str:
        if not self.steps:
            return "solved directly"
        first, last = self.steps[0], self.steps[-1]
        if len(self.steps) == 1:
            return f"{self.value} {last.value:.4g}"
        return f"{self.value} {first.value:.4g} -> {last.value:.4g} in {len(self.steps)} steps"


@dataclass(frozen=True, eq=False, repr=False)
class Fit(Generic[M]):
    """What `identify` found: every candidate in order, the chosen one, and their errors.

    scored: the datasets by name ("train", "test", those given). max_rate: the slowest rate a
    sample that was searched, and proofs of which count. fit[name] is the candidate of the method
    called so.
    """

    candidates: tuple[Candidate[M], ...]
    method: Method
    history: History
    scored: Mapping[str, Dataset] = field(default_factory=dict)
    max_rate: float = 1.0

    def __getitem__(self, method: str) -> Candidate[M]:
        return next(c for c in self.candidates if c.method.name == method)

    @cached_property
    def errors(self) -> dict[str, dict[str, float]]:
        """Simulation error in % by name of the dataset and of the method."""
        return {
            name: {c.method.name: c.error_percent(dataset) for c in self.candidates}
            for name, dataset in self.scored.items()
        }

    @property
    def chosen(self) -> Candidate[M]:
        """The candidate that was asked for."""
        return self[self.method.name]

    @property
    def model(self) -> M:
        """The chosen model."""
        return self.chosen.model

    @property
    def proof(self) -> Proof:
        """The chosen model's proof; Infeasible if an unproved model was allowed and chosen."""
        if self.chosen.proof is None:
            raise Infeasible(f"the model of {self.method.title} has no proof of stability")
        return self.chosen.proof

    @property
    def slowest(self) -> str:
        """The slowest rate that was allowed, in words."""
        return f"slowest rate allowed: {rate_text(self.max_rate, self.model.period)} a sample"

    def __str__(self) -> str:
        columns = list(self.errors)
        width = max(20, *(len(c.method.title) for c in self.candidates))
        header = f"  {'simulation error [%]':{width}s}" + "".join(f"{n:>8s}" for n in columns)
        header += f"{'time':>11s}  proved rate a sample (time constant)"
        rows: list[str] = []
        for c in self.candidates:
            scores = "".join(f"{self.errors[name][c.method.name]:8.2f}" for name in columns)
            state = stated_rate(c.proof, c.model.period) if c.proof else c.unproved
            mark = "*" if c.method == self.method else " "
            rows.append(f"{mark} {c.method.title:{width}s}{scores}{c.seconds:9.3f} s  {state}")
        equation = [self.model.equation] if isinstance(self.model, DifferenceEquation) else []
        return "\n".join(
            [str(self.model), *equation, str(self.history), self.slowest, header, *rows]
        )

    __repr__ = __str__

    def _repr_html_(self) -> str:
        """The same, and how the search went down."""
        values = np.array([step.value for step in self.history.steps] or [0.0])
        return card(str(self), line(np.arange(0.0, len(values)), values, BLUE))
