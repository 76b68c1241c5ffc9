"""`Network`: models that are filters and maps of bounded slope, joined as a structure says."""

from dataclasses import dataclass
from typing import Generic, Literal, TypeVar, get_args

from nlsid_core.errors import OptionError
from nlsid_core.identification.methods.options import Method, Sem
from nlsid_core.models.cell_network import MAX_MAPS
from nlsid_core.options import require_one_of, require_whole

MOST_ORDER, MOST_PHASES, MOST_KNOTS, MOST_STARTS = 100, 4, 1000, 1000
MOST_CELLS, MOST_INTERVALS, MOST_LAGS = 3, 30, 8
MOST_IMITATED = MOST_START_SAMPLES = 10_000

Begin = Literal["measured", "rest"]
Limit = Literal["top", "friction", "none"]


@dataclass(frozen=True)
class FilterMapFilter:
    """A filter, a static map, a filter, of one input and one output.

    orders: of the two filters, each 0 to 100; (n, 0) are Wiener, (0, n) Hammerstein models. phases:
    1 to 4; several presume an input without power near half the sampling frequency. intervals: of
    knots, 1 to 1000. starts: random ones, 1 to 1000. begin: how trials begin, "measured" (in
    motion, from the first measured outputs) or "rest" (from zero states). Source:
    `theory-cascades-and-moments.md`.
    """

    orders: tuple[int, int] = (3, 3)
    phases: int = 1
    intervals: int = 24
    starts: int = 12
    begin: Begin = "measured"

    def __post_init__(self) -> None:
        if len(self.orders) != 2 or min(self.orders) < 0 or not 1 <= max(self.orders) <= MOST_ORDER:
            allowed = f"two whole numbers from 0 to {MOST_ORDER}, not both zero"
            raise OptionError("orders", self.orders, allowed)
        require_whole(self, "phases", 1, MOST_PHASES)
        require_whole(self, "intervals", 1, MOST_KNOTS)
        require_whole(self, "starts", 1, MOST_STARTS)
        require_one_of(self, "begin", get_args(Begin))


@dataclass(frozen=True)
class CellRow:
    """Scalar states in a row, each contracting by a map of its own; the last is the output.

    cells: 1 to 3, the others hidden. intervals: between the knots of a map, 1 to 30. limit: of the
    states, "top" (cells flow over into the next), "friction" (dry, of the output) or "none".
    """

    cells: int = 2
    intervals: int = 6
    limit: Limit = "top"

    def __post_init__(self) -> None:
        require_whole(self, "cells", 1, MOST_CELLS)
        require_whole(self, "intervals", 1, MOST_INTERVALS)
        require_one_of(self, "limit", get_args(Limit))


@dataclass(frozen=True)
class Feedback:
    """A filter with feedback through a static map of its output, of any number of inputs.

    lags: of output and inputs, 1 to 8. intervals: of the map's spline, 1 to 30 (1 is a cubic).
    stages: of the unrolled equation, 1 to 8; each is one map of the proof.
    imitated: inputs that nobody recorded, on which the stages do as the loop does, 0 to 10000.
    """

    lags: int = 3
    intervals: int = 4
    stages: int = 4
    imitated: int = 96

    def __post_init__(self) -> None:
        require_whole(self, "lags", 1, MOST_LAGS)
        require_whole(self, "intervals", 1, MOST_INTERVALS)
        require_whole(self, "stages", 1, MAX_MAPS)
        require_whole(self, "imitated", 0, MOST_IMITATED)


@dataclass(frozen=True)
class Follower:
    """One output that goes after one input, late, with inertia and a limit of its speed."""


S = TypeVar("S", bound=FilterMapFilter | CellRow | Feedback | Follower, covariant=True)


@dataclass(frozen=True)
class Network(Generic[S]):
    """Filters and static maps in a structure that makes every such model stable.

    structure: `FilterMapFilter`, `CellRow`, `Feedback` or `Follower`, with its options.
    start_samples: at the start of a trial, that show the first state of cells or of a loop and are
    not scored, 1 to 10000. seed: of what is drawn at random, starts or inputs.
    """

    structure: S
    start_samples: int = 20
    seed: int = 0

    def __post_init__(self) -> None:
        require_whole(self, "start_samples", 1, MOST_START_SAMPLES)
        require_whole(self, "seed", 0, 2**31)
        lags = self.structure.lags if isinstance(self.structure, Feedback) else 0
        if self.start_samples < lags:
            raise OptionError("start_samples", self.start_samples, f"at least the {lags} lags")

    @property
    def methods(self) -> tuple[Method, ...]:
        """The only one for such models."""
        return (Sem(certified=True),)

    @property
    def comparators(self) -> tuple[Method, ...]:
        """None is quick enough to run beside it."""
        return ()
