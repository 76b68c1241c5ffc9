"""The YAML configuration of one robot: which signals, which split, which model, which tube."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from nlsid_core.errors import DataError
from nlsid_core.identification import LinearClass, ModelClass, StateAffineClass
from nlsid_core.models import Signal
from nlsid_core.monitor import Nominal

MAX_CONFIG_BYTES = 2**20  # a configuration is a page of text

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Corner = Annotated[tuple[float, float], Field(strict=False)]


class _Section(BaseModel):
    """A part of the file: unknown keys are errors, values are not coerced across types."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


Section = TypeVar("Section", bound=_Section)


class SignalConfig(_Section):
    """A signal: its name and unit for people, and `topic:field.path[index]`."""

    name: str
    unit: str = ""
    path: str

    def signal(self) -> Signal:
        """The same as the core's noun."""
        return Signal(self.name, self.unit, self.path)


class SignalsConfig(_Section):
    """The response that is modelled and the excitation that drives it."""

    response: SignalConfig
    excitation: SignalConfig


class GridConfig(_Section):
    """period: s between samples. max_gap: s without a response that is still interpolated."""

    period: Positive
    max_gap: Positive


class SplitConfig(_Section):
    """What is only used to score: the bags named, or else the share of every bag at its end."""

    test: tuple[str, ...] = Field(default=(), strict=False)
    share: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None

    @model_validator(mode="after")
    def _one_of_them(self) -> "SplitConfig":
        if self.test and self.share is not None:
            raise ValueError("name test bags or give a share, not both")
        return self


class IdentificationConfig(_Section):
    """lags n of the difference equation; the most iterates of the robust simulation error.

    model: `linear`, or `state_affine` with polynomial degrees in the window of inputs (see
    `StateAffineClass`); input_range: to which that model clips its input (default: the data's).
    method: which candidate is kept.
    """

    lags: int = Field(ge=1, le=100)
    iterations: int = Field(default=40, ge=1, le=1000)
    model: Literal["linear", "state_affine"] = "linear"
    method: Literal["least_squares", "rie", "rse_first", "rse", "rse_certified", "sem"] = "rse"
    leading_degree: int = Field(default=0, ge=0, le=5)
    lagged_degree: int = Field(default=0, ge=0, le=5)
    right_degree: int = Field(default=1, ge=0, le=5)
    input_range: Corner | None = None

    @property
    def model_class(self) -> ModelClass:
        """The same as the core's noun."""
        if self.model == "linear":
            return LinearClass(self.lags)
        return StateAffineClass(
            self.lags,
            leading_degree=self.leading_degree,
            lagged_degree=self.lagged_degree,
            right_degree=self.right_degree,
            u_range=None if self.input_range is None else (self.input_range,),
        )


class LqrConfig(_Section):
    """Weights of the output's error and of the input's deviation."""

    output_weight: Positive = 1.0
    input_weight: Positive = 1.0


def _none_word(value: object) -> object:
    return None if value == "none" else value


class FunnelConfig(_Section):
    """The tube: see `nlsid_core.funnels.design_tube`. policy: None is K = 0."""

    horizon: Positive
    safety_factor: float = Field(default=1.5, ge=1.0, allow_inf_nan=False)
    inlet: NonNegative = 0.0
    policy: Annotated[LqrConfig | None, BeforeValidator(_none_word)] = LqrConfig()
    profile: tuple[Corner, ...] = Field(min_length=2, strict=False)


class MonitorConfig(_Section):
    """nominal: what the tube is around; stale_after, command_wait: s, for the live monitor."""

    nominal: Literal["command", "profile"] = "command"
    stale_after: Positive = 0.1
    command_wait: NonNegative = 0.02

    @property
    def nominal_source(self) -> Nominal:
        """The same as the core's noun."""
        return Nominal(self.nominal)


class Config(_Section):
    """One robot's configuration file."""

    robot: str
    signals: SignalsConfig
    grid: GridConfig
    split: SplitConfig = SplitConfig()
    identification: IdentificationConfig
    funnel: FunnelConfig
    monitor: MonitorConfig = MonitorConfig()


def load_config(path: Path | str) -> Config:
    """Read and check a configuration; DataError lists every wrong key with where it stands.

    OS errors pass through.
    """
    return read_yaml(path, Config)


def read_yaml(path: Path | str, kind: type[Section]) -> Section:
    """A YAML file as a configuration of `kind`; see `load_config`."""
    path = Path(path)
    if path.stat().st_size > MAX_CONFIG_BYTES:
        raise DataError(f"{path}: larger than {MAX_CONFIG_BYTES} bytes; not a configuration")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not valid YAML: {error}") from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: expected sections (robot, signals, grid, ...), found none")
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        problems = [
            f"  {_where(problem['loc'])}: {problem['msg']} (found {problem['input']!r:.60})"
            for problem in error.errors()
        ]
        raise DataError("\n".join([f"{path}: not a valid configuration:", *problems])) from error


def _where(location: Sequence[int | str]) -> str:
    return ".".join(str(part) for part in location)
