"""What every model document shares: its header and the signals it is about."""

from dataclasses import dataclass
from math import inf
from typing import Any, Literal

from nlsid_core import files
from nlsid_core.arrays import Json
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.errors import DataError, DocumentError

FORMAT = "nlsid/model"


@dataclass(frozen=True)
class Signal:
    """A signal's name, unit, and `topic:field.path` it is read from (empty: not from a topic)."""

    name: str
    unit: str = ""
    path: str = ""

    @property
    def label(self) -> str:
        """The name and the unit, if it has one."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def document(self) -> Json:
        """The JSON form."""
        return {"name": self.name, "unit": self.unit, "path": self.path}

    @classmethod
    def from_document(cls, document: Json, *, source: str) -> "Signal":
        """Raises DocumentError if a part is missing."""
        return cls(
            *(files.member(document, key, str, source=source) for key in ("name", "unit", "path"))
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Recorded:
    """A model of recorded signals: one sample is `period` s.

    bags names (name, digest) the recordings, and training is the digest of the data file made of
    them.
    """

    period: float
    bags: tuple[tuple[str, str], ...] = ()
    training: str = ""

    def require_period(self) -> None:
        """Raise DataError unless the period is positive."""
        if not 0.0 < self.period < inf:
            raise DataError(f"period {self.period} s is not positive")


def signals_of(trial: Trajectory, letter: Literal["y", "u"]) -> tuple[Signal, ...]:
    """The responses or the excitations of a trajectory."""
    columns = (getattr(trial, f"{letter}_{key}") for key in ("names", "units", "paths"))
    return tuple(Signal(*labels) for labels in zip(*columns, strict=True))


def objects(document: Json, key: str, *, source: str) -> list[Json]:
    """The objects of the list `document[key]`. Raises DocumentError if it is none."""
    entries: list[Json] = files.member(document, key, list, source=source)
    if not all(isinstance(entry, dict) for entry in entries):
        raise DocumentError(f"{source}: {key} should be a list of objects")
    return entries


def signals(document: Json, key: str, *, source: str) -> tuple[Signal, ...]:
    """The signals of the list `document[key]`. Raises DocumentError if it is none."""
    entries = objects(document, key, source=source)
    return tuple(Signal.from_document(entry, source=f"{source} {key}") for entry in entries)


def head(model: Any, kind: str, equation: str = "") -> Json:
    """The members that the document of a model of recorded signals begins with."""
    y, u = (
        [part.document() for part in side] if isinstance(side, tuple) else side.document()
        for side in (model.y, model.u)
    )
    stated = {"equation": equation} if equation else {}
    return {
        "format": FORMAT,
        "version": files.VERSION,
        "kind": kind,
        **stated,
        "period": model.period,
        "y": y,
        "u": u,
    }


def tail(model: Any) -> Json:
    """Those that it ends with: what the model was made of."""
    bags = [{"name": name, "digest": digest} for name, digest in model.bags]
    return {"training": model.training, "bags": bags}


def recorded(document: Json, *, several: tuple[str, ...], source: str) -> dict[str, Any]:
    """The fields of `head` and `tail`; several: which of y and u are lists of signals.

    Raises DocumentError if one is missing or wrong.
    """
    sides = {
        key: signals(document, key, source=source)
        if key in several
        else Signal.from_document(files.member(document, key, dict, source=source), source=source)
        for key in ("y", "u")
    }
    bags = files.member(document, "bags", list, source=source)
    return {
        "period": files.number(document, "period", source=source),
        "training": files.member(document, "training", str, source=source),
        "bags": tuple(files.named_digests(bags, source=source)),
        **sides,
    }


def window_of(document: Json, *, source: str) -> tuple[tuple[int, int], ...]:
    """The (input, delay) pairs of `document["window"]`; DocumentError if they are none."""
    window = files.array(document, "window", (None, 2), source=source)
    if (window % 1.0).any():
        raise DocumentError(f"{source}: window should hold integers")
    return tuple((int(i), int(d)) for i, d in window)
