"""Sections of YAML configurations: strict, and explained when they are wrong."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from bags.recordings.names import did_you_mean
from nlsid_core.errors import DataError
from nlsid_core.models import Signal

MAX_CONFIG_BYTES = 2**20  # a configuration is a page of text


@dataclass(frozen=True)
class Key:
    """What a key is for, its unit, and a value it may have: for docs/configuration.md and people.

    A section's keys carry one each, in their `Annotated` types.
    """

    text: str
    unit: str = ""
    example: object = None


Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Corner = Annotated[tuple[float, float], Field(strict=False)]
Names = Annotated[tuple[str, ...], Field(strict=False)]


class Section(BaseModel):
    """A part of the file: unknown keys are errors, values are not coerced across types."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    @classmethod
    def keys(cls) -> dict[str, Key]:
        """What each key is for; StopIteration if one does not say."""
        return {
            name: next(entry for entry in field.metadata if isinstance(entry, Key))
            for name, field in cls.model_fields.items()
        }


class SignalConfig(Section):
    """A signal, for people and where it is found."""

    name: Annotated[str, Key("what people call it", example="speed")]
    unit: Annotated[str, Key("what its numbers are in, for people", example="m/s")] = ""
    path: Annotated[
        str,
        Key(
            "`topic:field.path[index]`, or `[name=elbow]`, and what is done to it, `|unwrap`, "
            "`|derivative(0.2 s)`, `|washout(2 s)`; of an excitation also "
            "`|lag(0.1 s)` and the product `A * B` of two",
            example="/odom:twist.twist.linear.x",
        ),
    ]

    def signal(self) -> Signal:
        """The same as the core's noun."""
        return Signal(self.name, self.unit, self.path)


AnySection = TypeVar("AnySection", bound=Section)


def read_yaml(path: Path | str, kind: type[AnySection]) -> AnySection:
    """A YAML file as a section of `kind`; DataError lists every wrong key with where it stands.

    OS errors pass through.
    """
    content = yaml_sections(path)
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        raise DataError(f"{path}: not a valid configuration:\n{problems(error, kind)}") from error


def yaml_sections(path: Path | str) -> dict[str, Any]:
    """The sections of a YAML file, unread; DataError if it has none, OS errors pass through."""
    path = Path(path)
    if path.stat().st_size > MAX_CONFIG_BYTES:
        raise DataError(f"{path}: larger than {MAX_CONFIG_BYTES} bytes; not a configuration")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not valid YAML: {error}") from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: expected sections (robot, signals, grid, ...), found none")
    return content


def problems(error: ValidationError, kind: type[Section]) -> str:
    """A line for each wrong key: where it stands, what is allowed there, what was found.

    kind: the section that the error is about, whose keys and units are then said.
    """
    return "\n".join(f"  {_problem(details, kind)}" for details in error.errors())


def sections_in(annotation: Any) -> list[type[Section]]:
    """The sections that a value of this type may be, in lists and unions too."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return [annotation]
    return [found for part in get_args(annotation) for found in sections_in(part)]


def _problem(details: ErrorDetails, kind: type[Section]) -> str:
    where = [str(part) for part in details["loc"]]
    found, message = details["input"], details["msg"].removeprefix("Value error, ")
    if details["type"] == "extra_forbidden":
        section, _ = _stands_in(kind, details["loc"])
        message = no_such_key(where[-1], section.model_fields if section else ())
    else:
        section, key = _stands_in(kind, details["loc"])
        if section is not None and (unit := _unit(section, key)):
            message = f"{message}, in {unit}"
    said = f"{'.'.join(where)}: {message}"
    is_of_key = message == "Field required" or details["type"] == "extra_forbidden"
    return said if is_of_key else f"{said} (found {found!r:.60})"


def no_such_key(key: str, known: Iterable[str]) -> str:
    """Say that there is no such key, which there are, and which is nearest."""
    known = list(known)
    return f"there is no such key; there are: {', '.join(known)}{did_you_mean(key, known)}"


def _stands_in(
    kind: type[Section] | None, where: Sequence[str | int]
) -> tuple[type[Section] | None, str]:
    """The section in which the last key of `where` stands, and the key; None if it is in none."""
    section, key = kind, ""
    for name in (part for part in where if isinstance(part, str)):
        if key and section is not None:
            inside = sections_in(section.model_fields[key].annotation)
            section = inside[0] if inside else None
        if section is None or (name not in section.model_fields and name != where[-1]):
            return None, name
        key = name
    return section, key


def _unit(section: type[Section], key: str) -> str:
    field = section.model_fields.get(key)
    found = [entry for entry in (field.metadata if field else ()) if isinstance(entry, Key)]
    return found[0].unit if found else ""
