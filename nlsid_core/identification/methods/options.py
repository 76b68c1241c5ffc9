"""The methods of `identify`, each with its options, and what a class of models is.

A method's `name` is what programs, configurations and files call it; its `title` is shown to
people, and stands here only.
"""

import re
from dataclasses import MISSING, dataclass, fields
from typing import Any, ClassVar, Protocol, TypeVar

from nlsid_core.identification.prediction import Model
from nlsid_core.options import require_whole

MOST_ITERATIONS = 1000
MOST_LAGS = 100

M = TypeVar("M", bound=Model, covariant=True)


class ModelClass(Protocol[M]):
    """A set of models of one kind, with its options: the dataclasses whose names end in Class."""

    @property
    def kind(self) -> type[M]:
        """What a model of the class is."""
        ...


@dataclass(frozen=True)
class LeastSquares:
    """Minimise the sum of squares of the equation error.

    Noise in the outputs biases it, and nothing makes the model stable, except for a class that
    holds stable models only. Source: thesis Section 1.1.1.
    """

    name: ClassVar[str] = "least_squares"
    title: ClassVar[str] = "least squares"


@dataclass(frozen=True)
class Rie:
    """Minimise the robust identification error, a convex bound on the simulation error.

    Source: thesis (2.28); for state-affine models Proposition 4.4, for monotone equations (3.6).
    """

    name: ClassVar[str] = "rie"
    title: ClassVar[str] = "robust identification error"


@dataclass(frozen=True)
class MomentRie:
    """`Rie` through moments of repeated experiments, in which the bias of noise is removed.

    accept_untested_repeats: do not test whether repeats are repeats. The bias is then removed only
    if they repeat one excitation all the same. Source: thesis Section 3.4 and Lemma 3.12.
    """

    accept_untested_repeats: bool = False
    name: ClassVar[str] = "moment_rie"
    title: ClassVar[str] = "robust identification error, bias of noise removed"


@dataclass(frozen=True)
class FirstRse:
    """Minimise the first bound of the robust simulation error. Source: thesis (4.1)-(4.3)."""

    name: ClassVar[str] = "rse_first"
    title: ClassVar[str] = "robust simulation error, first iterate"


@dataclass(frozen=True)
class Iterated:
    """iterations: 1 to 1000 at most."""

    iterations: int = 40

    def __post_init__(self) -> None:
        require_whole(self, "iterations", 1, MOST_ITERATIONS)


@dataclass(frozen=True)
class Rse(Iterated):
    """Minimise the robust simulation error: bounds that are made exact by iterating.

    A linear model is iterated from several starts, and the best on the training data is kept.
    iterations: of bounds, 1 to 1000 at most; it stops earlier once the bound no longer falls.
    Source: thesis (4.1)-(4.3), Section 4.4.
    """

    name: ClassVar[str] = "rse"
    title: ClassVar[str] = "robust simulation error, final iterate"


@dataclass(frozen=True)
class CertifiedRse(Iterated):
    """`Rse` with every iterate inside a convex set of models that are stable for every input.

    iterations: as of `Rse`. Source: thesis Lemma 2.11 and (4.1)-(4.3).
    """

    name: ClassVar[str] = "rse_certified"
    title: ClassVar[str] = "robust simulation error, stable for every input"


@dataclass(frozen=True)
class Sem:
    """Minimise the simulation error from several starts: the best of the local minima they reach.

    Source: thesis Definition 2.2 and Section 1.1.1.
    """

    name: ClassVar[str] = "sem"
    title: ClassVar[str] = "simulation error minimisation"


@dataclass(frozen=True)
class CertifiedSem(Iterated):
    """`Sem` inside a convex set of stable models, from several starts, of which the best is kept.

    iterations: of `Rse` or `CertifiedRse`, one of its starts, for linear and state-affine models;
    else of its own steps from each start. Source: thesis Definition 2.2, Chapter 2, (4.1)-(4.3).
    """

    name: ClassVar[str] = "sem_certified"
    title: ClassVar[str] = "simulation error minimisation, stable for every input"


Method = LeastSquares | Rie | MomentRie | FirstRse | Rse | CertifiedRse | Sem | CertifiedSem
METHODS: dict[str, type[Method]] = {
    kind.name: kind
    for kind in (LeastSquares, Rie, MomentRie, FirstRse, Rse, CertifiedRse, Sem, CertifiedSem)
}


def alike(kind: type[Method], other: Method) -> Method:
    """A method of this kind with the options that it shares with the other."""
    shared = {f.name for f in fields(kind)} & {f.name for f in fields(other)}
    return kind(**{name: getattr(other, name) for name in shared})


def describe(model_class: Any) -> str:
    """The class in words, with the options that are not the default: `state affine, lags 2`."""
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(model_class).__name__.removesuffix("Class"))
    options = [
        f"{option.name.replace('_', ' ')} {getattr(model_class, option.name)}"
        for option in fields(model_class)
        if option.default is MISSING or getattr(model_class, option.name) != option.default
    ]
    return ", ".join([name.lower(), *options])
