"""Models of a measured state: an explicit polynomial map, or a trapezoidal step of a mechanism."""

from typing import TypeAlias

from nlsid_core.models.state_map import StateModel
from nlsid_core.models.trapezoidal import TrapezoidalModel

MeasuredState: TypeAlias = StateModel | TrapezoidalModel
