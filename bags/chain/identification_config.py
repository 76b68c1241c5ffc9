"""The section `identification`: its keys are the options of a model class and of its method.

    model: state_affine        # which class; its options stand beside it
    lags: 2
    method: rse                # which method of the class; its options stand beside it, too
    certified: true
    iterations: 5

Types, defaults and limits are those of the dataclasses in `nlsid_core.identification`; what a name
of `model` opens of them is in `templates`.
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, get_type_hints

from pydantic import (
    ConfigDict,
    Field,
    PlainValidator,
    ValidationError,
    create_model,
)
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from bags.chain.sections import no_such_key
from bags.chain.templates import TEMPLATES
from bags.recordings.names import did_you_mean
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import OptionError
from nlsid_core.identification import (
    METHODS,
    Attempt,
    Fit,
    Method,
    Model,
    ModelClass,
    Search,
    identify,
    methods_of,
)
from nlsid_core.identification.rates import rate_of_memory
from nlsid_core.progress import Progress, silent

DEFAULT = "linear"  # the model of a section that names none
RANGES = ("input_range", "output_range")  # options of which [low, high] is one signal's range
ONE_BY_ONE = ("linear", "block_cascade", "follower")  # models of one response and one excitation
OWN = {  # of every section
    "transient": Annotated[int, Field(ge=0)],
    "max_rate": Annotated[float, Field(gt=0.0, lt=1.0)],
    "allow_unproved": bool,
}

Wrong = tuple[tuple[int | str, ...], object, str]  # where, what was found, what should be there


@dataclass(frozen=True, eq=False)
class IdentificationConfig:
    """What to identify, and how. given: the section itself, as a mapping."""

    model_class: ModelClass
    method: Method
    given: Mapping[str, object]
    search: Search

    def identify(
        self,
        train: Dataset,
        *,
        test: Dataset | None = None,
        progress: Progress = silent,
    ) -> Fit[Model]:
        """`nlsid_core.identification.identify` with these options."""
        return identify(
            train,
            self.model_class,
            method=self.method,
            test=test,
            search=self.search,
            progress=progress,
        )

    @property
    def model(self) -> str:
        """What the section calls the class."""
        return str(self.given.get("model", DEFAULT))


def section_of(attempt: Attempt, train: Dataset) -> dict[str, Any]:
    """The section that asks for this attempt with these training trials."""
    first = train.trajectories[0]
    single = first.y.shape[1] == first.u.shape[1] == 1
    names = [name for name in TEMPLATES if single or name not in ONE_BY_ONE]
    found = ((name, TEMPLATES[name].values(attempt.model_class)) for name in names)
    name, values = next((name, values) for name, values in found if values is not None)
    method = {f.name: getattr(attempt.method, f.name) for f in fields(attempt.method)}
    section = {"model": name, **values, "method": attempt.method.word, **method}
    if attempt.memory != 1.0:
        section["max_rate"] = rate_of_memory(train, attempt.memory)
    return {key: _as_yaml(value) for key, value in section.items()}


def _as_yaml(value: Any) -> Any:
    return [_as_yaml(part) for part in value] if isinstance(value, tuple) else value


def _read(section: object) -> IdentificationConfig:
    """The section as the dataclasses that it names; ValidationError or ValueError if it is none."""
    if isinstance(section, IdentificationConfig):
        return section
    if not isinstance(section, dict):
        raise ValueError("should be keys and values, such as `lags: 4`")
    name = section.get("model", DEFAULT)
    template = TEMPLATES.get(name) if isinstance(name, str) else None
    if template is None:
        near = did_you_mean(str(name), TEMPLATES)
        raise ValueError(f"there is no such model; there are: {', '.join(TEMPLATES)}{near}")

    options = {key: kind for method in METHODS.values() for key, kind in _options(method).items()}
    hints = {"model": str, **template.hints(), "method": str, **options, **OWN}
    given = _values(hints, section, template.needed)
    model_class = _made(template.make, _of(given, template.keys), section, template.keys)

    methods = methods_of(model_class)
    words = list(dict.fromkeys(method.word for method in methods))
    word = given.get("method", words[0])
    if word not in words:
        what = "is not for this model class:" if word in METHODS else "should be"
        raise _error((("method",), word, f"{what} {_listed(words)}"))

    usual = next(method for method in methods if method.word == word)
    names = _options(type(usual))
    _values({key: hints[key] for key in ("model", *template.keys, "method", *names, *OWN)}, section)
    method = _made(lambda values: replace(usual, **values), _of(given, names), section, {})
    if method.name not in [one.name for one in methods]:
        what = f"should be {str(not method.certified).lower()} for this model class"
        raise _error((("certified",), method.certified, what))
    return IdentificationConfig(model_class, method, section, Search(**_of(given, OWN)))


Identification = Annotated[IdentificationConfig, PlainValidator(_read)]


def _options(kind: type[Any]) -> dict[str, Any]:
    """The types of a dataclass's fields."""
    hints = get_type_hints(kind)
    return {option.name: hints[option.name] for option in fields(kind)}


def _of(given: Mapping[str, Any], keys: Iterable[str]) -> dict[str, Any]:
    return {key: given[key] for key in keys if key in given}


def _values(
    hints: Mapping[str, Any], given: Mapping[str, object], needed: Sequence[str] = ()
) -> dict[str, Any]:
    """The values as the types say; a list is a tuple, and nothing else is converted."""
    kinds: dict[str, Any] = {key: (kind, None) for key, kind in hints.items()}
    kinds |= {key: (hints[key], ...) for key in needed}
    section = create_model("section", __config__=ConfigDict(strict=True, extra="forbid"), **kinds)
    single = {key: [given[key]] for key in RANGES if _is_range(given.get(key))}
    try:
        found: Any = section.model_validate_json(json.dumps({**given, **single}, default=str))
    except ValidationError as error:
        raise _error(*(_said(details, hints) for details in error.errors())) from error
    return dict(found.model_dump(exclude_unset=True))


def _is_range(value: object) -> bool:
    return isinstance(value, list) and not any(isinstance(part, list | tuple) for part in value)


def _said(details: ErrorDetails, known: Iterable[str]) -> Wrong:
    where, message = details["loc"], details["msg"]
    if details["type"] == "extra_forbidden":
        message = no_such_key(str(where[0]), known)
    return where, details["input"], message


def _made(
    make: Callable[[Any], Any],
    values: Mapping[str, Any],
    section: Mapping[str, object],
    names: Mapping[str, str],
) -> Any:
    """What is made of these values of the section. names: options inside, by their keys."""
    try:
        return make(values)
    except OptionError as error:
        key = next((key for key, option in names.items() if option == error.key), error.key)
        raise _error(((key,), section.get(key), f"should be {error.allowed}")) from error


def _listed(known: Sequence[str]) -> str:
    return " or ".join(", ".join(f"'{name}'" for name in known).rsplit(", ", 1))


def _error(*wrong: Wrong) -> ValidationError:
    details = [
        InitErrorDetails(type=PydanticCustomError("option", said), loc=where, input=found)
        for where, found, said in wrong
    ]
    return ValidationError.from_exception_data("identification", details)
