"""What policies of every kind have in common, so that one controller runs them all."""

from typing import Any, Protocol, TypeAlias

from nlsid_core.arrays import FloatArray
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.policies.sampled import SampledPolicy
from nlsid_core.policies.tube import TubePolicy

AnyPolicy: TypeAlias = TubePolicy | SampledPolicy | ContinuousPolicy


class Policy(Protocol):
    """A plan and the feedback around it; `when`: a sample, or s of a continuous policy.

    Of a tube, `TubePolicy.plan(model)`, since the plan is the model's own solution.
    """

    @property
    def planned(self) -> FloatArray:
        """The inputs of the plan, one row for each moment."""

    @property
    def last(self) -> float:
        """The last moment that has an input."""

    def __call__(self, when: Any, x: FloatArray, /) -> Any:
        """The input at `when` for the state x (n,): a number, or an array of several."""

    def covers(self, when: float, x: FloatArray) -> tuple[Any, Any]:
        """The least and greatest input that the proof covers at `when` for the state x."""
