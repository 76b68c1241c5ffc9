"""Models of a measured state: an explicit polynomial map, or a trapezoidal step of a mechanism."""

from typing import TypeAlias

from nlsid_core.arrays import Json
from nlsid_core.models import trapezoidal
from nlsid_core.models.state_map import StateModel
from nlsid_core.models.trapezoidal import TrapezoidalModel

MeasuredState: TypeAlias = StateModel | TrapezoidalModel


def read_measured_state(document: Json, *, source: str = "model") -> MeasuredState:
    """The model of the document, by its kind; DocumentError says what is wrong with it."""
    if document.get("kind") == trapezoidal.KIND:
        return TrapezoidalModel.from_document(document, source=source)
    return StateModel.from_document(document, source=source)
