"""The two families of models, `Polynomial` and `Network`: what they have in common."""

from dataclasses import fields, is_dataclass
from typing import Any

from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError
from nlsid_core.identification.methods.options import Method
from nlsid_core.identification.network import search as networks
from nlsid_core.identification.network.options import Network
from nlsid_core.identification.polynomial import search as polynomials
from nlsid_core.identification.polynomial.options import Polynomial
from nlsid_core.identification.trail import Task, Trail

ModelClass = Polynomial | Network[Any]


def searched(train: Dataset, model_class: ModelClass, task: Task) -> Trail[Any]:
    """Candidates of the methods that are asked for."""
    if isinstance(model_class, Polynomial):
        return polynomials.search(train, model_class, task)
    return networks.search(train, model_class, task)


def methods_of(model_class: object) -> tuple[Method, ...]:
    """The methods for models of this class, the default first, with their default options.

    Raises DataError if it is no model class.
    """
    if not isinstance(model_class, Polynomial | Network):
        raise DataError(f"{model_class!r} is no model class; there are: Polynomial, Network")
    return model_class.methods


def describe(model_class: ModelClass) -> str:
    """The class in words, with the options that are not the default: `polynomial, lags 2`."""
    return ", ".join([type(model_class).__name__.lower(), *_options(model_class)])


def _options(part: Any) -> list[str]:
    """Name and value of every option, and of their own options."""
    found: list[str] = []
    for option in fields(part):
        value = getattr(part, option.name)
        if is_dataclass(value):
            named = [] if option.name == "degrees" else [_words(type(value).__name__)]
            found += [*named, *_options(value)]
        elif value != option.default or option.name in ("lags", "cells", "orders"):
            found.append(f"{option.name.replace('_', ' ')} {value}")
    return found


def _words(name: str) -> str:
    """`FilterMapFilter` as people write it."""
    return "".join(f" {c.lower()}" if c.isupper() else c for c in name).strip()
