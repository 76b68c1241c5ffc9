"""What `design` solves: a frozen dataclass for each kind of funnel, checked when it is made."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

from nlsid_core.arrays import ArrayLike
from nlsid_core.data.trajectory import Dataset
from nlsid_core.design.continuous.setting import Goal
from nlsid_core.design.continuous.tvlqr import GAINS
from nlsid_core.design.levels import LevelKind
from nlsid_core.design.sampled.motion import Feedback
from nlsid_core.dynamics import Nominal, VectorField
from nlsid_core.errors import OptionError
from nlsid_core.funnels.sampled import DisturbanceAssumption
from nlsid_core.models import StableModel
from nlsid_core.models.measured_state import MeasuredState
from nlsid_core.options import require_at_least, require_one_of, require_positive, require_ranges
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.policies.sampled import SampledPolicy

Shape = Literal["rho", "P"]
Objective = Literal["volume", "reference"]


@dataclass(frozen=True, eq=False)
class OutputTube:
    """Tubes around the simulation of a stable model of any class, for ever; and around a plan.

    train: the trials that observer and storage are chosen on. calibration: others, on which the
    level is measured (None: every second recording of `train`, of a single one windows).
    reaction_time: s, how far ahead the forecast is to be narrow (None: ten samples). safety_factor:
    of the innovations' amplitude over the largest measured, at least 1. horizon: s, for a second
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
    safety_factor: float = 1.5
    horizon: float | None = None
    box: Sequence[tuple[float, float]] | None = None
    level: LevelKind = "auto"
    profile: Sequence[tuple[float, float]] | None = None
    inlet: float = 0.0
    lqr_weights: tuple[float, float] | None = (1.0, 1.0)

    def __post_init__(self) -> None:
        for key in ("reaction_time", "horizon"):
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
    measures it on runs of the policy. goal, start: radii at the end and at the start, in the LQR's
    norm (None: the largest that the box of the data allows, and the inlet's).
    """

    model: MeasuredState
    policy: SampledPolicy
    feedback: Feedback
    assumption: DisturbanceAssumption
    goal: float | None = None
    start: float | None = None

    def __post_init__(self) -> None:
        for key in ("goal", "start"):
            if getattr(self, key) is not None:
                require_positive(self, key)


@dataclass(frozen=True, eq=False)
class ContinuousTracking:
    """The largest funnel around a nominal motion that ends in a goal, proved for every t.

    dynamics: a VectorField, or a function of some of t, x, u, w, named so; one that is no
    polynomial is expanded on every interval around what the funnel needs there, see
    `dynamics.taylor`. uncertain: rows (low, high) of the w of such a function. goal: half-widths
    (n,) of an ellipsoid around the nominal's end, its matrix, or a `Goal` (None: the largest set
    that the closed loop keeps at the end). policy: None is a time-varying LQR with Q (n, n) and
    R (m, m) (None: on the goal's scale, see `default_weights`), and P(t) its cost-to-go; for a
    given policy P(t) solves the Lyapunov equation with Q. gain: how the LQR's K varies between
    knots: "constant", "linear" or "cubic". limits: rows (input, low, high), or one
    pair (low, high) for each input, at which inputs saturate; the proof then covers every mode.

    hold: s, how old the input that is applied may be: the time between samples, and any delay
    ("largest": the longest that is found to be provable, to a factor √2; None: the policy is
    assumed to act continuously). K is then linear between knots. error: (n,)
    bounds of how much each state is measured wrong (None: not at all).


    shape "rho": P(t) stays and ρ(t) is swept backward. shape "P": P(t) itself is searched from
    there, for objective "volume" or for "reference", the thesis's. Source: thesis Chapters 5, 6.
    """

    dynamics: VectorField | Callable[..., Any]
    nominal: Nominal
    goal: Goal | ArrayLike | None = None
    policy: ContinuousPolicy | None = None
    shape: Shape = "rho"
    objective: Objective = "volume"
    Q: ArrayLike | None = None
    R: ArrayLike | None = None
    gain: str = "constant"
    limits: ArrayLike | None = None
    uncertain: ArrayLike | None = None
    hold: float | Literal["largest"] | None = None
    error: ArrayLike | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.nominal, Nominal):
            raise OptionError("nominal", self.nominal, "a Nominal, such as plan_motion returns")
        if not isinstance(self.policy, ContinuousPolicy | None):
            raise OptionError("policy", self.policy, "a ContinuousPolicy, or None for an LQR")
        require_one_of(self, "shape", get_args(Shape))
        require_one_of(self, "objective", get_args(Objective))
        require_one_of(self, "gain", GAINS)


Problem = OutputTube | SampledTracking | ContinuousTracking
