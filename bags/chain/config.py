"""The YAML configuration of one robot: which signals, which split, which model, which tube."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from bags.chain.identification_config import ONE_BY_ONE, Identification
from bags.chain.sections import (
    Corner,
    Key,
    Names,
    NonNegative,
    Positive,
    Section,
    SignalConfig,
    read_yaml,
)
from bags.signals.expressions import parse_factors
from bags.signals.sampling import Grid, Sampler
from nlsid_core.errors import BagError, DataError
from nlsid_core.running.comparison import Centre


def _listed(value: object) -> object:
    """A single signal stands for a list with that signal."""
    return [value] if isinstance(value, dict) else value


Signals = Annotated[
    tuple[SignalConfig, ...], BeforeValidator(_listed), Field(min_length=1, strict=False)
]
Clock = Literal["header", "log"]
Files = Annotated[tuple[Annotated[Path, Field(strict=False)], ...], Field(strict=False)]


class SignalsConfig(Section):
    """The responses that are modelled and the excitations that drive them: one, or a list."""

    response: Annotated[Signals, Key("what is measured and modelled")]
    excitation: Annotated[Signals, Key("what drives the robot")]

    @property
    def roles(self) -> tuple[tuple[SignalConfig, ...], tuple[SignalConfig, ...]]:
        """Responses and excitations."""
        return self.response, self.excitation

    @property
    def topics(self) -> tuple[str, ...]:
        """What the signals are read from, each topic once."""
        return tuple(
            dict.fromkeys(
                factor.path.topic
                for signal in (*self.response, *self.excitation)
                for factor in parse_factors(signal.path)
            )
        )


class GridConfig(Section):
    """How the numbers in messages become samples (`bags.signals.sampling`)."""

    period: Annotated[Positive, Key("between samples", unit="s", example=0.025)]
    max_gap: Annotated[
        Positive,
        Key("without a response that is still filled in or resampled over", unit="s", example=0.1),
    ]
    resample: Annotated[
        Literal["none", "last", "linear"],
        Key(
            "`none`: responses are samples as they come, a period apart; `last` or `linear`: they "
            "are put on a grid of the period, the latest value or one on the line between two",
            example="linear",
        ),
    ] = "none"
    hold: Annotated[
        Positive | None,
        Key("for which a command is held (null: as long as max_gap)", unit="s", example=0.5),
    ] = None
    split_gaps: Annotated[
        bool,
        Key(
            "cut a trial where a signal is missing for longer, or is NaN, and count what is "
            "skipped, instead of refusing it",
            example=True,
        ),
    ] = False

    def rules(self, clock: str) -> Grid:
        """The same as the reader's noun, with the clock."""
        return Grid(clock=clock, **self.model_dump())


class RobotConfig(Section):
    """What every configuration file says of its robot and of its messages."""

    robot: Annotated[str, Key("what people call it", example="F1TENTH car, speed")]
    clock: Annotated[
        Clock,
        Key(
            "the signals' stamps: their messages' `header`, or, where some have none, `log`, the "
            "times of logging, live of arrival",
            example="log",
        ),
    ] = "header"
    definitions: Annotated[
        Files,
        Key(
            ".msg files or packages' folders that define types which the bags do not, seen from "
            "the configuration",
            example=["my_msgs/msg/Command.msg"],
        ),
    ] = ()
    grid: Annotated[GridConfig, Key("how the numbers in messages become samples")]

    def beside(self, path: Path | str) -> Self:
        """The same with the paths in it as they are seen from its file."""
        found = tuple(Path(path).parent / given for given in self.definitions)
        return self.model_copy(update={"definitions": found})


class SplitConfig(Section):
    """What the model is not fitted to: bags by name."""

    test: Annotated[Names, Key("bags that only score the models", example=["trial_05"])] = ()
    calibration: Annotated[
        Names,
        Key(
            "bags that scale the level of the tube; without any, every second training trial does",
            example=["trial_07"],
        ),
    ] = ()
    share: Annotated[
        Annotated[float, Field(gt=0.0, lt=1.0)] | None,
        Key("instead of test bags, the end of every bag of this share of it", example=0.2),
    ] = None

    @model_validator(mode="after")
    def _one_of_them(self) -> "SplitConfig":
        if self.test and self.share is not None:
            raise ValueError("name test bags or give a share, not both")
        return self


class LqrConfig(Section):
    """Weights of the output's error and of the input's deviation."""

    output_weight: Annotated[Positive, Key("of the output's squared error", example=1.0)] = 1.0
    input_weight: Annotated[Positive, Key("of the input's squared deviation", example=1.0)] = 1.0


class FunnelConfig(Section):
    """The tube that `nlsid funnel` designs: around the model's simulation, and around a plan."""

    horizon: Annotated[
        Positive | None,
        Key(
            "a second tube beside the one that lasts for ever, on the energy of a disturbance over "
            "so long; and how long the plan of `profile` is (null: to its last corner)",
            unit="s",
            example=2.9,
        ),
    ] = None
    reaction_time: Annotated[
        Positive | None,
        Key(
            "how far ahead the forecast is to be narrow (null: ten samples)",
            unit="s",
            example=0.5,
        ),
    ] = None
    level: Annotated[
        Literal["auto", "constant", "commands"],
        Key(
            "whether the tube is wider while commands move it (`commands`) or as wide always "
            "(`constant`, which fixed tolerances need); `auto`: `commands` where that is a fifth "
            "narrower on average over four training trials or more; without `profile`",
            example="constant",
        ),
    ] = "auto"
    safety_factor: Annotated[
        float,
        Field(ge=1.0, allow_inf_nan=False),
        Key("on the disturbance's amplitude, over the largest that was measured", example=1.5),
    ] = 1.2
    inlet: Annotated[
        NonNegative,
        Key(
            "allowed initial error beside the plan of `profile`",
            unit="the response's unit",
            example=0.02,
        ),
    ] = 0.0
    policy: Annotated[
        LqrConfig | None,
        BeforeValidator(lambda value: None if value == "none" else value),
        Key("with `profile`: weights of an LQR, or `none` for K = 0", example="none"),
    ] = LqrConfig()
    profile: Annotated[
        Annotated[tuple[Corner, ...], Field(min_length=2, strict=False)] | None,
        Key(
            "corners [time, output] of a plan that a policy tracks, for `model: linear`; without "
            "it the tube is around the model's own simulation only, for every class of models",
            unit="[s, the response's unit]",
            example=[[0.0, 0.0], [2.9, 0.35]],
        ),
    ] = None

    @model_validator(mode="after")
    def _profile_to_track(self) -> "FunnelConfig":
        if self.profile is None:
            if "policy" in self.model_fields_set and self.policy is not None:
                raise ValueError(
                    "an LQR policy tracks a profile: give `profile`, or leave out `policy` for a "
                    "tube around the model's simulation"
                )
            if self.inlet:
                raise ValueError("inlet is for a plan: give `profile`, or leave it out")
            return self
        if self.level == "commands":
            raise ValueError("around a plan the level is constant: level is for no `profile`")
        times = [time for time, _ in self.profile]
        if any(later <= time for time, later in pairwise(times)):
            raise ValueError(f"profile: times should increase; they are {times}")
        return self


class MonitorConfig(Section):
    """What the monitor compares with."""

    nominal: Annotated[
        Literal["command", "profile"],
        Key(
            "what the tube is around: the model driven by the received commands, or the policy's "
            "plan",
            example="command",
        ),
    ] = "command"

    @property
    def nominal_source(self) -> Centre:
        """The same as the core's noun."""
        return Centre(self.nominal)


class Config(RobotConfig):
    """One robot's configuration file."""

    signals: Annotated[SignalsConfig, Key("which numbers are modelled, and which drive them")]
    split: Annotated[SplitConfig, Key("what the model is not fitted to")] = SplitConfig()
    identification: Annotated[
        Identification, Key("the class of models and the method", example={"lags": 4})
    ]
    funnel: Annotated[FunnelConfig | None, Key("the tube, for `nlsid funnel`")] = None
    monitor: Annotated[MonitorConfig, Key("how a robot is held against it")] = MonitorConfig()


def load_config(path: Path | str) -> Config:
    """Read and check a configuration; DataError lists every wrong key with where it stands.

    What no later step could use is refused too (`refusals`). OS errors pass through.
    """
    config = read_yaml(path, Config)
    if found := refusals(config):
        said = "\n".join(f"  {what}" for what in found)
        raise DataError(f"{path}: a later step could not use it:\n{said}")
    return config.beside(path)


def refusals(config: Config) -> list[str]:
    """What a step after this one would refuse, each with the key, the reason and what to do."""
    return [*_signal_refusals(config), *_time_refusals(config), *_model_refusals(config)]


def signal_texts(config: Config) -> tuple[list[str], list[str]]:
    """Responses and excitations as the steps read them, with clock, holding and resampling."""
    rules = config.grid.rules(config.clock)
    rules = replace(rules, hold=rules.hold or rules.max_gap)
    return (
        [rules.path(signal.path, response=True) for signal in config.signals.response],
        [rules.path(signal.path, response=False) for signal in config.signals.excitation],
    )


def _signal_refusals(config: Config) -> Iterator[str]:
    named = {"response": config.signals.response, "excitation": config.signals.excitation}
    seen: dict[str, str] = {}
    sound = True
    for role, signals in named.items():
        for place, signal in enumerate(signals):
            where = f"signals.{role}" + (f".{place}" if len(signals) > 1 else "")
            for what, text in (("path", signal.path), ("name", signal.name)):
                if text in seen:
                    yield f"{where}.{what}: '{text}' is that of {seen[text]} too"
                seen[text] = where
            try:
                several = any(factor.path.every for factor in parse_factors(signal.path))
            except BagError as error:
                sound = False
                yield f"{where}.path: {error}"
                continue
            if several:
                sound = False
                yield f"{where}.path: {signal.path} is several signals; name one element for each"
    if sound:
        try:
            Sampler(*signal_texts(config), period=config.grid.period)
        except BagError as error:
            yield f"signals: {error}"


def _time_refusals(config: Config) -> Iterator[str]:
    period, max_gap = config.grid.period, config.grid.max_gap
    if max_gap < period:
        yield (
            f"grid.max_gap: {max_gap:g} s is shorter than the period, {period:g} s, so that every "
            "sample would be in a gap; give at least 1.5 periods"
        )
    horizon = None if config.funnel is None else config.funnel.horizon
    if horizon is not None and round(horizon / period) < 1:
        yield (
            f"funnel.horizon: {horizon:g} s is not one sample of {period:g} s; give the length of "
            "a run"
        )


def _model_refusals(config: Config) -> Iterator[str]:
    counts = len(config.signals.response), len(config.signals.excitation)
    said = f"{counts[0]} responses and {counts[1]} excitations"
    model = config.identification.model
    if model in ONE_BY_ONE and counts != (1, 1):
        yield (
            f"identification.model: {model} has one response and one excitation, not {said}; take "
            "state_affine or implicit, or leave out signals"
        )
    elif model in ("cells", "feedback") and counts[0] != 1:
        yield (
            f"identification.model: {model} has one response, not {said}; take state_affine or "
            "implicit, or leave out signals"
        )
    elif (
        config.funnel is not None
        and config.funnel.profile is not None
        and (model != "linear" or counts != (1, 1))
    ):
        yield (
            "funnel.profile: a plan is tracked by `model: linear` with one response and one "
            f"excitation, not by {model} with {said}; leave out `profile` for a tube "
            "around the model's simulation, or give a measured state a `motion`"
        )
    if config.funnel is not None and config.funnel.profile is not None:
        for key, value in (("clock", config.clock), ("grid.resample", config.grid.resample)):
            if value not in ("header", "none"):
                yield (
                    f"funnel.profile: a plan is driven by commands that carry the stamps of the "
                    f"responses they answer, not with `{key}: {value}`; leave out `profile` for a "
                    "tube around the model's simulation"
                )
    for key, needed in (("input_range", counts[1]), ("output_range", counts[0])):
        given = getattr(config.identification.model_class, key, None)
        if given is not None and len(given) != needed:
            yield (
                f"identification.{key}: {len(given)} pairs [low, high] for {said}; it needs "
                f"{needed}"
            )
