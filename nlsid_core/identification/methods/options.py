"""The four methods of `identify`, each with its options.

A method's `word` is what configurations call it, its `name` is what programs and files do, and its
`title` is shown to people.
"""

from dataclasses import dataclass
from typing import ClassVar

from nlsid_core.options import require_whole

MOST_ITERATIONS = 1000
CERTIFIED = "_certified"  # at the end of the name of a method that keeps a proof


@dataclass(frozen=True)
class LeastSquares:
    """Minimise the sum of squares of the equation error.

    Noise in the outputs biases it. Source: thesis Section 1.1.1.
    """

    word: ClassVar[str] = "least_squares"
    name: ClassVar[str] = "least_squares"
    title: ClassVar[str] = "least squares"


@dataclass(frozen=True)
class Rie:
    """Minimise the robust identification error, a convex bound on the simulation error.

    A monotone equation is found through moments, and where experiments are repeated these have no
    bias of noise. accept_untested_repeats: do not test whether repeats are repeats. The bias is
    then removed only if they repeat one excitation all the same.
    Source: thesis (2.28), Proposition 4.4, (3.6), Section 3.4 and Lemma 3.12.
    """

    accept_untested_repeats: bool = False
    word: ClassVar[str] = "rie"
    name: ClassVar[str] = "rie"
    title: ClassVar[str] = "robust identification error"


@dataclass(frozen=True)
class Iterated:
    """A search in steps; `certified` keeps it among models that are stable for every input."""

    iterations: int = 40
    certified: bool = False
    word: ClassVar[str] = ""
    plain: ClassVar[str] = ""

    def __post_init__(self) -> None:
        require_whole(self, "iterations", 1, MOST_ITERATIONS)

    @property
    def name(self) -> str:
        """What programs and files call it."""
        return self.word + CERTIFIED * self.certified

    @property
    def title(self) -> str:
        """What people read."""
        return self.plain + ", stable for every input" * self.certified


@dataclass(frozen=True)
class Rse(Iterated):
    """Minimise the robust simulation error: bounds that are made exact by iterating.

    iterations: of bounds, 1 to 1000 at most; it stops earlier once the bound no longer falls.
    certified: keep every iterate in a convex set of models that are stable for every input.
    Source: thesis (4.1)-(4.3), Section 4.4 and Lemma 2.11.
    """

    word: ClassVar[str] = "rse"
    plain: ClassVar[str] = "robust simulation error"


@dataclass(frozen=True)
class Sem(Iterated):
    """Minimise the simulation error from several starts: the best of the local minima they reach.

    iterations: of its own steps from each start, or of the bounds of `Rse` that it starts from, 1
    to 1000 at most. certified: search among models that are stable for every input.
    Source: thesis Definition 2.2, Section 1.1.1 and Chapter 2.
    """

    word: ClassVar[str] = "sem"
    plain: ClassVar[str] = "simulation error minimisation"


Method = LeastSquares | Rie | Rse | Sem
METHODS: dict[str, type[Method]] = {kind.word: kind for kind in (LeastSquares, Rie, Rse, Sem)}
