"""What funnels of every kind have in common, so that one monitor serves them all."""

from typing import Protocol, TypeAlias

from nlsid_core.arrays import FloatArray, Json
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.funnels.sampled import SampledFunnel
from nlsid_core.funnels.tube import TubeFunnel

AnyFunnel: TypeAlias = SampledFunnel | ContinuousFunnel | TubeFunnel


class Funnel(Protocol):
    """An ellipsoid around a motion at each moment `when`: a sample, or s of a continuous funnel."""

    @property
    def made_for(self) -> tuple[str, str]:
        """The digests of the model or vector field, and of the policy."""

    @property
    def last(self) -> float:
        """The last moment that the proof covers."""

    def size(self, when: float, deviation: FloatArray) -> float:
        """How far out a deviation is: 0 on the motion, 1 on the boundary, rounded up.

        At most 1 only if the deviation is in the set in exact arithmetic; NaN stays NaN.
        """

    def start_size(self, x_bar: FloatArray) -> float:
        """How far out of what may start a deviation is: 1 on the boundary, rounded up."""

    def widths(self, when: float) -> FloatArray:
        """The largest deviation in the set on each axis, in the signals' units."""

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
