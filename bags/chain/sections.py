"""Sections of YAML configurations: strict, and explained when they are wrong."""

from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from nlsid_core.errors import DataError
from nlsid_core.models import Signal

MAX_CONFIG_BYTES = 2**20  # a configuration is a page of text
UNKNOWN_KEY = "unknown_key"

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Corner = Annotated[tuple[float, float], Field(strict=False)]
Names = Annotated[tuple[str, ...], Field(strict=False)]


class Section(BaseModel):
    """A part of the file: unknown keys are errors, values are not coerced across types."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, content: Any) -> Any:
        if isinstance(content, dict):
            known = list(cls.model_fields)
            for key in content:
                if key not in known:
                    raise PydanticCustomError(
                        UNKNOWN_KEY,
                        "there is no such key{meant}; there are: {known}",
                        unknown_key(str(key), known),
                    )
        return content


def unknown_key(key: str, known: Sequence[str]) -> dict[str, str]:
    """What an error of type UNKNOWN_KEY says: the key, those there are, and the nearest of them."""
    nearest = get_close_matches(key, known, n=1)
    meant = f"; do you mean '{nearest[0]}'" if nearest else ""
    return {"key": key, "known": ", ".join(known), "meant": meant}


class SignalConfig(Section):
    """A signal: its name and unit for people, and `topic:field.path[index]`."""

    name: str
    unit: str = ""
    path: str

    def signal(self) -> Signal:
        """The same as the core's noun."""
        return Signal(self.name, self.unit, self.path)


AnySection = TypeVar("AnySection", bound=Section)


def read_yaml(path: Path | str, kind: type[AnySection]) -> AnySection:
    """A YAML file as a section of `kind`; DataError lists every wrong key with where it stands.

    OS errors pass through.
    """
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
        raise DataError(f"{path}: not a valid configuration:\n{problems(error)}") from error


def problems(error: ValidationError, *, prefix: Sequence[str] = ()) -> str:
    """A line for each wrong key: where it stands, what is allowed there, what was found."""
    return "\n".join(f"  {_problem(details, prefix)}" for details in error.errors())


def _problem(details: ErrorDetails, prefix: Sequence[str]) -> str:
    where = [str(part) for part in (*prefix, *details["loc"])]
    found = details["input"]
    if details["type"] == UNKNOWN_KEY:
        key = details["ctx"]["key"]
        where.append(key)
        found = found[key]
    message = details["msg"].removeprefix("Value error, ")
    said = f"{'.'.join(where)}: {message}"
    return said if message == "Field required" else f"{said} (found {found!r:.60})"
