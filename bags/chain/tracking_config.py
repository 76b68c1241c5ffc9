"""The YAML configuration of one robot's tracking funnel: from its recordings to its monitor."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from bags.chain.config import Clock, GridConfig
from bags.chain.sections import NonNegative, Positive, Section, SignalConfig, read_yaml

Numbers = Annotated[tuple[float, ...], Field(min_length=1, strict=False)]


class StateSignals(Section):
    """The measured state (positions, then rates) and the inputs."""

    states: Annotated[tuple[SignalConfig, ...], Field(min_length=1, strict=False)]
    inputs: Annotated[tuple[SignalConfig, ...], Field(min_length=1, strict=False)]


class StateIdentification(Section):
    """validation: bags that choose the degrees. refuse_above: % of error in free run.

    degrees: classes to try, the highest power of each state and input (default: a few).
    biased_without_repeats: least squares where no excitation was repeated. implicit: a trapezoidal
    step of a mechanism instead of an explicit map.
    """

    validation: Annotated[tuple[str, ...], Field(min_length=1, strict=False)]
    refuse_above: Positive = 25.0
    degrees: Annotated[
        tuple[Annotated[tuple[int, ...], Field(strict=False)], ...] | None, Field(strict=False)
    ] = None
    biased_without_repeats: bool = False
    implicit: bool = False


class MotionConfig(Section):
    """From `start` to `goal` (states) in `duration` s, or near given `samples`.

    samples: a CSV file, headed by the states' names in their order, one row a period; a relative
    path is seen from the configuration. Weights are relative to the box of the data.
    """

    start: Numbers | None = None
    goal: Numbers | None = None
    duration: Positive | None = None
    samples: Path | None = Field(default=None, strict=False)
    state_weight: Positive = 1.0
    input_weight: Positive = 0.3

    @model_validator(mode="after")
    def _one_of_two(self) -> "MotionConfig":
        ends = (self.start, self.goal, self.duration)
        if self.samples is not None and any(part is not None for part in ends):
            raise ValueError("give samples, or start, goal and duration, not both")
        if self.samples is None and any(part is None for part in ends):
            raise ValueError("give start, goal and duration, or samples")
        return self


class DisturbanceConfig(Section):
    """form of the assumption, rate if it is fading; safety_factor over the largest run."""

    form: Literal["response", "peak", "energy", "fading"] = "response"
    safety_factor: float = Field(default=1.3, ge=1.0, allow_inf_nan=False)
    rate: float = Field(default=1.0, gt=0.0, le=1.0)


class SimulationConfig(Section):
    """A robot of `bags.chain.plants` to record: peak torques in N·m, seconds of each excitation.

    runs: of the policy, to commission it, from starts up to `spread` of what the data box allows.
    """

    robot: str
    peak: Numbers
    groups: int = Field(default=4, ge=1, le=100)
    repeats: int = Field(default=4, ge=2, le=100)
    seconds: Positive = 60.0
    runs: int = Field(default=30, ge=1, le=10_000)
    spread: NonNegative = 0.5
    seed: int = Field(default=0, ge=0)


class TrackingConfig(Section):
    """One robot's configuration file for `nlsid track`."""

    robot: str
    signals: StateSignals
    clock: Clock = "header"
    grid: GridConfig
    identification: StateIdentification
    motion: MotionConfig
    disturbance: DisturbanceConfig = DisturbanceConfig()
    simulation: SimulationConfig | None = None


def load_tracking_config(path: Path | str) -> TrackingConfig:
    """Read and check a configuration; DataError lists every wrong key with where it stands."""
    config = read_yaml(path, TrackingConfig)
    given = config.motion.samples
    if given is None:
        return config
    motion = config.motion.model_copy(update={"samples": Path(path).parent / given})
    return config.model_copy(update={"motion": motion})
