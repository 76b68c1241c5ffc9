"""How a proof lets a continuous policy be applied: how old its input is, how wrong its state."""

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
    """hold: s, how old the input is at most; 0 if the proof is about a policy that acts
    continuously. error: (n,) bounds on how much each state is measured wrong; empty for none.
    """

    hold: float = 0.0
    error: FloatArray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of_claim(cls, claim: Json) -> "Held":
        """What the claim of a continuous funnel says; DocumentError if it is none."""
        hold = files.member(claim, "hold", (int, float), source="claim") if "hold" in claim else 0
        if "error" not in claim:
            return cls(float(hold))
        return cls(float(hold), files.array(claim, "error", (None,), source="claim"))

    @classmethod
    def given(cls, held: "Held | None") -> "Held":
        """`held`; DataError if it is None, of a continuous funnel, whose file does not say it."""
        if held is None:
            raise DataError(
                "a continuous funnel does not say how its policy may be applied, its claim does: "
                "give `held`, Held.of_claim(design.claim)"
            )
        return held

    def refuse(self, period: float) -> None:
        """DataError if the hold does not cover samples so many s apart, some of them late."""
        needed = (1.0 + TOLERANCE) * period
        if self.hold and needed > self.hold * ON_TIME:
            raise DataError(
                f"samples come every {period:g} s, and the funnel is proved for inputs of at most "
                f"{self.hold:g} s, which leaves no {TOLERANCE:g} periods for one that is late: "
                f"sample every {slowest(self.hold):.12g} s, or design it with hold={needed:.12g}"
            )

    def overdue(self, age: float, t: float) -> str:
        """How an input that is `age` s old at t (s) is older than is proved; empty if it is not."""
        if not self.hold or age <= self.hold * ON_TIME:
            return ""
        return f"the input was held for {age:.6g} s at t = {t:g} s; proved for {self.hold:g} s"

    def assuming(self, period: float) -> str:
        """What is assumed of an input that is held for a period, in words."""
        wrong = ", ".join(f"x{i} within {e:g}" for i, e in enumerate(self.error.tolist()) if e)
        measured = f"; measured to: {wrong}" if wrong else ""
        if not self.hold:
            held = f"the policy is applied continuously; here each input is held for {period:g} s"
            return held + measured
        return f"each input is at most {self.hold:g} s old{measured}"

    def reach(self, P: FloatArray) -> float:
        """How much an error can add to |x|_P, at most, for P (n, n); rounded up."""
        if not len(self.error):
            return 0.0
        return float(np.sqrt(self.error @ np.abs(P) @ self.error)) * (1.0 + ROUNDING)


def slowest(hold: float) -> float:
    """The longest period (s) of samples, some of them late, that a hold (s) covers."""
    return hold / (1.0 + TOLERANCE)
