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


AnySection = TypeVar("AnySection", bound=Section)


def read_yaml(path: Path | str, kind: type[AnySection]) -> AnySection:
    """A YAML file as a section of `kind`; DataError lists every wrong key with where it stands.

    OS errors pass through.
    """
    content = yaml_sections(path)
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        wrong = "\n".join(f"  {_problem(details, kind)}" for details in error.errors())
        raise DataError(f"{path}: not a valid configuration:\n{wrong}") from error


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


def sections_in(annotation: Any) -> list[type[Section]]:
    """The sections that a value of this type may be, in lists and unions too."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return [annotation]
    return [found for part in get_args(annotation) for found in sections_in(part)]


def _problem(details: ErrorDetails, kind: type[Section]) -> str:
    where = [str(part) for part in details["loc"]]
    found, message = details["input"], details["msg"].removeprefix("Value error, ")
    names = [part for part in details["loc"] if isinstance(part, str)]
    known = _keys_at(kind, names[:-1])
    is_unknown = details["type"] == "extra_forbidden"
    if is_unknown:
        message = no_such_key(names[-1], known)
    elif names and names[-1] in known and (unit := known[names[-1]].unit):
        message = f"{message}, in {unit}"
    said = f"{'.'.join(where)}: {message}"
    return said if is_unknown or message == "Field required" else f"{said} (found {found!r:.60})"


def no_such_key(key: str, known: Iterable[str]) -> str:
    """Say that there is no such key, which there are, and which is nearest."""
    known = list(known)
    return f"there is no such key; there are: {', '.join(known)}{did_you_mean(key, known)}"


def _keys_at(kind: type[Section], names: Sequence[str]) -> dict[str, Key]:
    """The keys of the section that these keys lead to, each in the one before; none if it is none.

    Of several that a key may have the first.
    """
    section = kind
    for name in names:
        field = section.model_fields.get(name)
        inside = sections_in(field.annotation) if field else []
        if not inside:
            return {}
        section = inside[0]
    return section.keys()
