"""What the names of `identification.model` stand for: structures of the two families of models.

A name opens some options of its family under the keys of the configuration, and fixes others.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any, get_type_hints

from nlsid_core.identification import (
    CellRow,
    Degrees,
    Feedback,
    FilterMapFilter,
    Follower,
    ModelClass,
    Network,
    Polynomial,
)


@dataclass(frozen=True)
class Template:
    """One name.

    says: in a sentence, what such models are. part: whose options are the structure. keys: the
    option that each key of the configuration sets, of the part or of its family. fixed: options
    that are not the family's default; a key may change them. needed: keys that have to be given.
    """

    says: str
    part: type[Any]
    keys: Mapping[str, str]
    fixed: Mapping[str, object] = field(default_factory=dict)
    needed: tuple[str, ...] = ()

    @property
    def family(self) -> type[Any]:
        """The class of the models."""
        return Polynomial if self.part is Degrees else Network

    def hints(self) -> dict[str, Any]:
        """The type of each key's values."""
        known = get_type_hints(self.family) | get_type_hints(self.part)
        return {key: known[option] for key, option in self.keys.items()}

    def make(self, values: Mapping[str, object]) -> ModelClass:
        """The class with these values of keys; raises as the family does."""
        options = {**self.fixed, **{self.keys[key]: value for key, value in values.items()}}
        own = {option.name for option in fields(self.part)}
        inner = {name: value for name, value in options.items() if name in own}
        outer = {name: value for name, value in options.items() if name not in own}
        place = "degrees" if self.part is Degrees else "structure"
        made: ModelClass = self.family(**{place: self.part(**inner)}, **outer)
        return made

    def values(self, model_class: ModelClass) -> dict[str, object] | None:
        """The keys that make this class, those that are the default left out; None if none do."""
        parts: list[Any] = [getattr(model_class, "degrees", None)]
        parts += [getattr(model_class, "structure", None), model_class]
        given = {
            key: getattr(next(part for part in parts if hasattr(part, option)), option)
            for key, option in self.keys.items()
            if any(hasattr(part, option) for part in parts)
        }
        if self.family is not type(model_class) or self.make(given) != model_class:
            return None
        kept = (key for key in given if key in self.needed or given[key] != self.default(key))
        return {key: given[key] for key in kept}

    def texts(self) -> dict[str, str]:
        """What the docstrings of the family and of the structure say of each key's option."""
        known = option_texts(self.family) | option_texts(self.part)
        return {key: known[option] for key, option in self.keys.items()}

    def default(self, key: str) -> object:
        """What the key is where it is not given."""
        made: Any = self.make({})
        for part in (getattr(made, "degrees", None), getattr(made, "structure", None), made):
            if hasattr(part, self.keys[key]):
                return getattr(part, self.keys[key])
        raise KeyError(key)


def option_texts(kind: type[Any]) -> dict[str, str]:
    """What the docstring of a class or of a method says of each of its options."""
    text = re.sub(r"\s+", " ", kind.__doc__ or "")
    names = [option.name for option in fields(kind)]
    ends = "|".join([*(rf"[,;.]? {name}: " for name in names), r" Raises ", r" Source: ", "$"])
    found = {name: re.search(rf"\b{name}: (.*?)(?:{ends})", text) for name in names}
    return {name: said[1].rstrip(".;, ") if said else "" for name, said in found.items()}


def _same(*options: str, ends: str = "") -> dict[str, str]:
    """Keys that are called as the options are, and then `ends`."""
    return {f"{option}{ends}": option for option in options}


TEMPLATES: Mapping[str, Template] = MappingProxyType(
    {
        "linear": Template(
            "Linear difference equations of one input and one output",
            Degrees,
            _same("lags"),
            needed=("lags",),
        ),
        "state_affine": Template(
            "Linear in the outputs, polynomial in the inputs",
            Degrees,
            _same("lags", "delays")
            | _same("leading", "lagged", "inputs", ends="_degree")
            | _same("input_range", "on_out_of_range"),
            needed=("lags",),
        ),
        "monotone": Template(
            "e(y) affine in past outputs and in inputs, e increasing",
            Degrees,
            _same("lags", "delays") | _same("left", ends="_degree"),
            {"left": 3, "set": "3.8"},
            ("lags",),
        ),
        "implicit": Template(
            "e(y(t)) = f(past outputs, inputs), in a stable set",
            Degrees,
            _same("lags", "delays", "set")
            | _same("left", "past", "inputs", "lagged", ends="_degree")
            | _same("output_range", "input_range"),
            {"left": 3, "set": "2.11"},
        ),
        "linear_states": Template(
            "Stable linear models whose state is the measured outputs: x⁺ = A x + B u + c",
            Degrees,
            {},
            {"lags": 1, "delays": (1,), "set": "2.19"},
        ),
        "block_cascade": Template(
            "A filter, a static map, a filter, of one input and one output",
            FilterMapFilter,
            _same("orders", "phases", "intervals", "starts", "begin", "seed"),
        ),
        "cells": Template(
            "Scalar states in a row, each contracting by a map of its own; the last is the output",
            CellRow,
            _same("cells", "intervals", "limit", "start_samples"),
        ),
        "feedback": Template(
            "A filter with feedback through a static map of its output",
            Feedback,
            _same("lags", "intervals", "stages", "imitated", "start_samples", "seed"),
        ),
        "follower": Template(
            "An output that goes after its input, late, with inertia and a limit of its speed",
            Follower,
            _same("start_samples"),
        ),
    }
)
