"""How a continuous policy is applied: how often, how old its input is, how wrong its state."""

import math
from dataclasses import dataclass, field

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.errors import DataError
from nlsid_core.running.grid import TOLERANCE

ROUNDING = 1e-12  # relative, of a few hundred rounded operations
ON_TIME = 1.0 + 1e-9  # of the hold: rounding of stamps


@dataclass(frozen=True, eq=False)
class Held:
    """period: s between samples. What the proof allows: hold, s, how old the input is at most, 0 if
    it is about a policy that acts continuously; error, (n,) bounds on how much each state is
    measured wrong, empty for none.

    Raises DataError if the hold does not cover such samples, some of them late.
    """

    period: float
    hold: float = 0.0
    error: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if not self.period > 0.0:
            raise DataError(f"the period should be s above 0, is {self.period}")
        needed = (1.0 + TOLERANCE) * self.period
        if self.hold and needed > self.hold * ON_TIME:
            raise DataError(
                f"samples come every {self.period:g} s, and the funnel is proved for inputs of at "
                f"most {self.hold:g} s, which leaves no {TOLERANCE:g} periods for one that is "
                f"late: sample every {slowest(self.hold):.12g} s, or design it with "
                f"hold={needed:.12g}"
            )

    @classmethod
    def of_claim(cls, claim: Json, period: float) -> "Held":
        """What the claim of a continuous funnel says; DocumentError if it is none."""
        stated = {"hold": 0.0, "error": []} | claim
        hold = files.member(stated, "hold", (int, float), source="claim")
        error = files.array(stated, "error", (None,), source="claim")
        return cls(period, float(hold), error)

    @property
    def tolerance(self) -> float:
        """How much of a period off the grid a sample may be: any, where the proof has a hold."""
        return math.inf if self.hold else TOLERANCE

    def overdue(self, age: float, t: float) -> str:
        """How an input that is `age` s old at t (s) is older than is proved; empty if it is not."""
        if not self.hold or age <= self.hold * ON_TIME:
            return ""
        return f"the input was held for {age:.6g} s at t = {t:g} s; proved for {self.hold:g} s"

    @property
    def assuming(self) -> str:
        """What is assumed of an input that is held for a period, in words."""
        wrong = ", ".join(f"x{i} within {e:g}" for i, e in enumerate(self.error.tolist()) if e)
        measured = f"; measured to: {wrong}" if wrong else ""
        if not self.hold:
            here = f"here each input is held for {self.period:g} s"
            return f"the policy is applied continuously; {here}{measured}"
        return f"each input is at most {self.hold:g} s old{measured}"

    def reach(self, P: FloatArray) -> float:
        """How much an error can add to |x|_P, at most, for P (n, n); rounded up."""
        if not len(self.error):
            return 0.0
        return float(np.sqrt(self.error @ np.abs(P) @ self.error)) * (1.0 + ROUNDING)


def slowest(hold: float) -> float:
    """The longest period (s) of samples, some of them late, that a hold (s) covers."""
    return hold / (1.0 + TOLERANCE)
