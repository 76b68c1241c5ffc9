"""`CommandLevel`: how much room a tube has at every sample, from the commands up to then.

    g(k) = Σ_i weights_i G_i(k),   G(k) = fading G(k-1) + v(k)²,   G = 0 before the run
v = (s - centre)/scale, or the change of s since the last sample over scale, s the product of some
inputs; no inputs: s = 1. Source: docs/certificate_tube.md, "A level that follows the commands".
"""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import mul
from typing import Any

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray, Json, keep
from nlsid_core.errors import DataError, DocumentError, ShapeError

VALUE, CHANGE = "value", "change"


@dataclass(frozen=True)
class Term:
    """One G. inputs: whose product is s; of: `value` or `change`; fading: in [0, 1)."""

    inputs: tuple[int, ...]
    of: str = VALUE
    centre: float = 0.0
    scale: float = 1.0
    fading: float = 0.0

    def __post_init__(self) -> None:
        known = self.of in (VALUE, CHANGE) and all(i >= 0 for i in self.inputs)
        if not (known and self.scale > 0.0 and 0.0 <= self.fading < 1.0):
            raise DataError(f"a term of a level by commands does not make sense: {self}")

    def values(self, u: FloatArray) -> FloatArray:
        """v² (N,) for inputs u (N, n_u) of one run."""
        s = np.prod(u[:, list(self.inputs)], axis=1)
        v = np.diff(s, prepend=s[:1]) if self.of == CHANGE else s - self.centre
        return np.asarray((v / self.scale) ** 2)

    def document(self) -> Json:
        """The JSON form."""
        return {
            "inputs": list(self.inputs),
            "of": self.of,
            "centre": self.centre,
            "scale": self.scale,
            "fading": self.fading,
        }


@dataclass(frozen=True, eq=False)
class CommandLevel:
    """g: weights (len(terms),), not negative. Raises ShapeError, DataError."""

    terms: tuple[Term, ...]
    weights: FloatArray

    def __post_init__(self) -> None:
        weights = np.array(self.weights, dtype=np.float64)
        if weights.shape != (len(self.terms),) or not self.terms:
            raise ShapeError(f"weights {weights.shape} for {len(self.terms)} terms of a level")
        if not ((weights >= 0.0).all() and weights.sum() > 0.0):
            raise DataError("a level's weights should not be negative, nor all 0")
        keep(self, {"weights": weights})

    @property
    def inputs(self) -> int:
        """How many inputs it needs at least."""
        return 1 + max((i for term in self.terms for i in term.inputs), default=-1)

    def along(self, u: FloatArray) -> FloatArray:
        """g (N,) at every sample of one run with inputs u (N, n_u)."""
        meter = LevelMeter(self)
        return np.array([meter.update(now) for now in u.tolist()])

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {
            "terms": [term.document() for term in self.terms],
            "weights": [self.weights.tolist()],
        }

    @classmethod
    def from_document(cls, document: Any, *, source: str) -> "CommandLevel":
        """Raises DocumentError if the document is not one."""
        if not isinstance(document, dict):
            raise DocumentError(f"{source} should be an object")
        entries = files.member(document, "terms", list, source=source)
        terms = tuple(_term(entry, f"{source} terms[{i}]") for i, entry in enumerate(entries))
        (weights,) = files.array(document, "weights", (1, len(terms)), source=source)
        return cls(terms, weights)


def _term(document: Any, source: str) -> Term:
    if not isinstance(document, dict):
        raise DocumentError(f"{source} should be an object")
    inputs = files.member(document, "inputs", list, source=source)
    if not all(type(i) is int for i in inputs):
        raise DocumentError(f"{source}: inputs should be whole numbers")
    numbers = {key: files.number(document, key, source=source) for key in ("centre", "scale")}
    return Term(
        tuple(inputs),
        files.member(document, "of", str, source=source),
        **numbers,
        fading=files.number(document, "fading", source=source),
    )


class LevelMeter:
    """g of one run, sample by sample: a number for each term is all that it keeps."""

    def __init__(self, level: CommandLevel) -> None:
        self._terms = [
            (term.inputs, term.of == CHANGE, term.centre, term.scale, term.fading)
            for term in level.terms
        ]
        self._weights: list[float] = level.weights.tolist()
        self.restart()

    def restart(self) -> None:
        """A new run."""
        self._G = [0.0] * len(self._terms)
        self._before: list[float] | None = None

    def update(self, u: Sequence[float]) -> float:
        """g at the next sample, whose inputs are u."""
        G, before, products = self._G, self._before, []
        for i, (factors, change, centre, scale, fading) in enumerate(self._terms):
            s = 1.0
            for j in factors:
                s *= u[j]
            products.append(s)
            if change:
                centre = s if before is None else before[i]
            v = (s - centre) / scale
            G[i] = fading * G[i] + v * v
        self._before = products
        return float(sum(map(mul, self._weights, G)))
