"""`ModelClass`: what `identify` searches, a noun that says which models and nothing of how."""

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
    """The class with the options that are not the default: `StateAffineClass(lags=2)`."""
    options = [
        f"{option.name}={getattr(model_class, option.name)}"
        for option in fields(model_class)
        if option.default is MISSING or getattr(model_class, option.name) != option.default
    ]
    return f"{type(model_class).__name__}({', '.join(options)})"
