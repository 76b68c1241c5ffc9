"""The YAML configuration of one robot: which signals, which split, which model, which tube."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from bags.chain.identification_config import Identification
from bags.chain.sections import (
    Corner,
    Names,
    NonNegative,
    Positive,
    Section,
    SignalConfig,
    read_yaml,
)
from nlsid_core.running.comparison import Centre


def _listed(value: object) -> object:
    """One signal is a list of one."""
    return [value] if isinstance(value, dict) else value


Signals = Annotated[
    tuple[SignalConfig, ...], BeforeValidator(_listed), Field(min_length=1, strict=False)
]
Clock = Literal["header", "log"]
Files = Annotated[tuple[Annotated[Path, Field(strict=False)], ...], Field(strict=False)]
Values = Annotated[tuple[object, ...], Field(min_length=1, strict=False)]


class SignalsConfig(Section):
    """The responses that are modelled and the excitations that drive them: one, or a list."""

    response: Signals
    excitation: Signals


class GridConfig(Section):
    """period: s between samples. max_gap: s without a response that is still filled in.

    resample: `none`, responses are samples as they come, a period apart; `last` or `linear`, they
    are put on a grid of the period, the latest value or one on the line between two values at most
    max_gap apart (`bags.signals.sampling`). hold: s for which a command is held (default: max_gap).
    split_gaps: cut a trial where a signal is missing for longer, or is NaN, and count what is
    skipped, instead of refusing it.
    """

    period: Positive
    max_gap: Positive
    resample: Literal["none", "last", "linear"] = "none"
    hold: Positive | None = None
    split_gaps: bool = False


class SplitConfig(Section):
    """What the model is not fitted to, by name of the bag.

    test: only scores; validation: chooses orders; calibration: scales the level of the tube (none:
    every second training trial does). share: instead of test bags, the end of every bag of this
    share of it.
    """

    test: Names = ()
    validation: Names = ()
    calibration: Names = ()
    share: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None

    @model_validator(mode="after")
    def _one_of_them(self) -> "SplitConfig":
        if self.test and self.share is not None:
            raise ValueError("name test bags or give a share, not both")
        return self


class LqrConfig(Section):
    """Weights of the output's error and of the input's deviation."""

    output_weight: Positive = 1.0
    input_weight: Positive = 1.0


def _none_word(value: object) -> object:
    return None if value == "none" else value


class FunnelConfig(Section):
    """The tube: see `nlsid_core.funnels.design_tube`. policy: None is K = 0."""

    horizon: Positive
    safety_factor: float = Field(default=1.5, ge=1.0, allow_inf_nan=False)
    inlet: NonNegative = 0.0
    policy: Annotated[LqrConfig | None, BeforeValidator(_none_word)] = LqrConfig()
    profile: tuple[Corner, ...] = Field(min_length=2, strict=False)


class MonitorConfig(Section):
    """nominal: what the tube is around; stale_after, command_wait: s, for the live monitor."""

    nominal: Literal["command", "profile"] = "command"
    stale_after: Positive = 0.1
    command_wait: NonNegative = 0.02

    @property
    def nominal_source(self) -> Centre:
        """The same as the core's noun."""
        return Centre(self.nominal)


class Config(Section):
    """One robot's configuration file.

    clock: the stamps of the signals, `header` or, where some have none, `log`: the times at which
    they were logged. definitions: .msg files or packages' folders that define types which the bags
    do not, seen from the configuration. select: values of the identification's options for
    `nlsid select` to try. compare: what `nlsid compare` scores (default: the identification).
    funnel: for `nlsid funnel`.
    """

    robot: str
    signals: SignalsConfig
    clock: Clock = "header"
    definitions: Files = ()
    grid: GridConfig
    split: SplitConfig = SplitConfig()
    identification: Identification
    select: dict[str, Values] | None = None
    compare: Annotated[tuple[Identification, ...], Field(strict=False)] = ()
    funnel: FunnelConfig | None = None
    monitor: MonitorConfig = MonitorConfig()


def load_config(path: Path | str) -> Config:
    """Read and check a configuration; DataError lists every wrong key with where it stands.

    OS errors pass through.
    """
    config = read_yaml(path, Config)
    folder = Path(path).parent
    return config.model_copy(
        update={"definitions": tuple(folder / given for given in config.definitions)}
    )
