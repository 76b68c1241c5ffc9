"""The YAML configuration of one robot's tracking funnel: from its recordings to its monitor."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from bags.chain.config import RobotConfig
from bags.chain.sections import (
    Key,
    NonNegative,
    Positive,
    Section,
    SignalConfig,
    read_yaml,
    yaml_sections,
)

Numbers = Annotated[tuple[float, ...], Field(min_length=1, strict=False)]


class StateSignals(Section):
    """The measured state and the inputs."""

    states: Annotated[
        tuple[SignalConfig, ...],
        Field(min_length=1, strict=False),
        Key("what is measured: positions, then rates"),
    ]
    inputs: Annotated[
        tuple[SignalConfig, ...], Field(min_length=1, strict=False), Key("what drives the robot")
    ]

    @property
    def roles(self) -> tuple[tuple[SignalConfig, ...], tuple[SignalConfig, ...]]:
        """States and inputs."""
        return self.states, self.inputs


class StateIdentification(Section):
    """Which model of the measured state."""

    validation: Annotated[
        tuple[str, ...],
        Field(min_length=1, strict=False),
        Key("bags that choose the degrees", example=["arm_4_0"]),
    ]
    degrees: Annotated[
        tuple[Annotated[tuple[int, ...], Field(strict=False)], ...] | None,
        Field(strict=False),
        Key(
            "classes to try, the highest power of each state and input (null: a few)",
            example=[[1, 1, 1], [3, 1, 1]],
        ),
    ] = None


class MotionConfig(Section):
    """The motion to follow: from `start` to `goal` in `duration`."""

    start: Annotated[Numbers, Key("states at the start", "the states' units", [0.0, 0.0])]
    goal: Annotated[Numbers, Key("states at the end", "the states' units", [0.2, 0.0])]
    duration: Annotated[Positive, Key("of the motion", "s", 1.0)]
    state_weight: Annotated[
        Positive, Key("of the states' squared error, relative to the box of the data", "", 1.0)
    ] = 1.0
    input_weight: Annotated[
        Positive, Key("of the inputs' square, relative to the box of the data", "", 0.3)
    ] = 0.3


class DisturbanceConfig(Section):
    """What is assumed of the disturbance."""

    safety_factor: Annotated[
        float,
        Field(ge=1.0, allow_inf_nan=False),
        Key("over the largest of the commissioning runs", example=1.2),
    ] = 1.3


class SimulationConfig(Section):
    """A robot of `bags.chain.plants` to record instead of a real one."""

    robot: Annotated[str, Key("which", example="arm")]
    peak: Annotated[Numbers, Key("largest torques", "N·m", [4.6, 2.3])]
    groups: Annotated[int, Field(ge=1, le=100), Key("different excitations", "", 4)] = 4
    repeats: Annotated[int, Field(ge=2, le=100), Key("of each excitation", "", 4)] = 4
    seconds: Annotated[Positive, Key("of each excitation", "s", 60.0)] = 60.0
    runs: Annotated[int, Field(ge=1, le=10_000), Key("of the policy, to commission it", "", 30)] = (
        30
    )
    spread: Annotated[
        NonNegative, Key("of the runs' starts, of what the box of the data allows", "", 0.5)
    ] = 0.5
    seed: Annotated[int, Field(ge=0), Key("of what is random", "", 0)] = 0


class TrackingConfig(RobotConfig):
    """One robot's configuration file where its state is measured and it tracks a motion."""

    signals: Annotated[StateSignals, Key("the measured state and the inputs")]
    identification: Annotated[StateIdentification, Key("which model of the measured state")]
    motion: Annotated[MotionConfig, Key("the motion to follow")]
    disturbance: Annotated[DisturbanceConfig, Key("what is assumed of the disturbance")] = (
        DisturbanceConfig()
    )
    simulation: Annotated[SimulationConfig | None, Key("only for a robot that is simulated")] = None


def is_tracking(path: Path | str) -> bool:
    """Whether a configuration is of a measured state and a motion; DataError if it is no YAML."""
    return "motion" in yaml_sections(path)


def load_tracking_config(path: Path | str) -> TrackingConfig:
    """Read and check a configuration; DataError lists every wrong key with where it stands."""
    return read_yaml(path, TrackingConfig).beside(path)
