"""`ModelClass`: what `identify` searches, a noun that says which models and nothing of how."""

import re
from dataclasses import MISSING, fields
from typing import Any, Protocol, TypeVar

from nlsid_core.identification.prediction import Model

M = TypeVar("M", bound=Model, covariant=True)


class ModelClass(Protocol[M]):
    """A set of models of one kind; the dataclasses whose names end in Class."""

    @property
    def kind(self) -> type[M]:
        """What a model of the class is."""
        ...


def describe(model_class: Any) -> str:
    """The class in words, with the options that are not the default: `state affine, lags 2`."""
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(model_class).__name__.removesuffix("Class"))
    options = [
        f"{option.name.replace('_', ' ')} {getattr(model_class, option.name)}"
        for option in fields(model_class)
        if option.default is MISSING or getattr(model_class, option.name) != option.default
    ]
    return ", ".join([name.lower(), *options])
