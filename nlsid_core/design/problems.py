"""What `design` solves: a frozen dataclass for each kind of funnel, checked when it is made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

from nlsid_core.data.trajectory import Dataset
from nlsid_core.design.continuous.problem import ContinuousTracking
from nlsid_core.design.levels import LevelKind
from nlsid_core.design.sampled.motion import Feedback
from nlsid_core.errors import OptionError
from nlsid_core.funnels.sampled import DisturbanceAssumption
from nlsid_core.models import StableModel
from nlsid_core.models.state_map import StateModel
from nlsid_core.options import require_at_least, require_one_of, require_positive, require_ranges
from nlsid_core.policies.sampled import SampledPolicy


@dataclass(frozen=True, eq=False)
class OutputTube:
    """Tubes around the simulation of a stable model of any class, for ever; and around a plan.

    train: the trials that observer and storage are chosen on. calibration: others, on which the
    level is measured (None: every second recording of `train`, of a single one windows).
    reaction_time: s, how far ahead the forecast is to be narrow (None: ten samples). safety_factor:
    of the innovations' amplitude over the largest measured, at least 1. false_alarms: in place of
    the factor, the probability that a next trial, exchangeable with the calibration's, alarms
    without a fault, at most (None: 1/(m + 1) of m trials, and the factor). horizon: s, for a second
    tube that rests on the innovations' energy over so long (None: none). box: (low, high) of every
    output, then every input, for implicit models whose increments are known on a box only (None:
    the range of the training trials and a tenth of it on both sides). level: "constant", or
    "commands" for one that follows them; "auto" does if that is a fifth narrower on average over
    `train` and these are four trials or more.

    profile: of a linear model, (s, output) corners of a plan that a policy tracks, for `horizon` s,
    else up to the last corner (None: no policy); its level is constant. inlet: allowed initial
    error of the output beside the plan, in its unit. lqr_weights: of output and input, positive;
    None is K = 0.
    Source: docs/certificate_tube.md.
    """

    model: StableModel
    train: Dataset
    calibration: Dataset | None = None
    reaction_time: float | None = None
    safety_factor: float = 1.2
    false_alarms: float | None = None
    horizon: float | None = None
    box: Sequence[tuple[float, float]] | None = None
    level: LevelKind = "auto"
    profile: Sequence[tuple[float, float]] | None = None
    inlet: float = 0.0
    lqr_weights: tuple[float, float] | None = (1.0, 1.0)

    def __post_init__(self) -> None:
        for key in ("reaction_time", "horizon", "false_alarms"):
            if getattr(self, key) is not None:
                require_positive(self, key)
        require_at_least(self, "safety_factor", 1.0)
        require_at_least(self, "inlet", 0.0)
        if self.profile is not None and len(self.profile) < 2:
            raise OptionError("profile", self.profile, "two or more corners (s, output)")
        if self.profile is not None and self.level == "commands":
            raise OptionError("level", self.level, "constant, or auto, with a profile")
        if self.profile is None and self.inlet > 0.0:
            raise OptionError("inlet", self.inlet, "0 without a profile: the start of a plan")
        if self.lqr_weights is not None and not all(weight > 0 for weight in self.lqr_weights):
            raise OptionError("lqr_weights", self.lqr_weights, "two numbers above 0, or None")
        require_ranges(self, "box")
        require_one_of(self, "level", get_args(LevelKind))


@dataclass(frozen=True, eq=False)
class SampledTracking:
    """The largest inlet and the tube around a policy's motion, sample by sample.

    feedback: the LQR that the policy was made with. assumption: about the disturbance, as `assume`
    measures it on runs of the policy. goal: the radius at the end, in the LQR's norm (None: the
    largest that the box of the data allows).
    """

    model: StateModel
    policy: SampledPolicy
    feedback: Feedback
    assumption: DisturbanceAssumption
    goal: float | None = None

    def __post_init__(self) -> None:
        if self.goal is not None:
            require_positive(self, "goal")


Problem = OutputTube | SampledTracking | ContinuousTracking
