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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Annotated, Any, get_type_hints

from pydantic import Field, PlainValidator, TypeAdapter, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from bags.chain.sections import UNKNOWN_KEY
from bags.chain.templates import TEMPLATES
from bags.recordings.names import did_you_mean
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, OptionError
from nlsid_core.identification import (
    METHODS,
    Attempt,
    Fit,
    Method,
    Model,
    ModelClass,
    identify,
    methods_of,
)
from nlsid_core.identification.rates import rate_of_memory
from nlsid_core.progress import Progress, silent

DEFAULT = "linear"  # the model of a section that names none
RANGES = (
    "input_range",
    "output_range",
)  # options of which one [low, high] is the range of one signal
ONE_BY_ONE = ("linear", "block_cascade", "follower")  # models of one response and one excitation
OWN = {  # of every section
    "transient": Annotated[int, Field(ge=0)],
    "max_rate": Annotated[float, Field(gt=0.0, lt=1.0)],
    "allow_unproved": bool,
}


@dataclass(frozen=True, eq=False)
class IdentificationConfig:
    """What to identify, and how. transient: samples at the start of each trial not scored.

    max_rate: the slowest rate a sample of the models that are searched (None: the time constant is
    the length of the longest training trial).
    allow_unproved: write a model without a proof of stability too; nothing is certified then.
    given: the section itself, as a mapping.
    """

    model_class: ModelClass
    method: Method
    given: Mapping[str, object]
    transient: int = 0
    max_rate: float | None = None
    allow_unproved: bool = False

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
            transient=self.transient,
            max_rate=self.max_rate,
            allow_unproved=self.allow_unproved,
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
    """The section as the dataclasses that it names; ValidationError says all that is wrong."""
    if isinstance(section, IdentificationConfig):
        return section
    if not isinstance(section, dict):
        raise _error(_wrong((), section, "should be keys and values, such as `lags: 4`"))
    left = dict(section)
    name = left.pop("model", DEFAULT)
    template = TEMPLATES.get(name) if isinstance(name, str) else None
    if template is None:
        near = did_you_mean(str(name), TEMPLATES)
        what = f"there is no such model; there are: {', '.join(TEMPLATES)}{near}"
        raise _error(_wrong((), section, what))
    wrong: list[InitErrorDetails] = []
    own = _values(OWN, {key: left.pop(key) for key in OWN if key in left}, wrong)
    word = left.pop("method", None)
    options = {key: left.pop(key) for key in template.keys if key in left}
    wrong.extend(
        _wrong((k,), options, "Field required") for k in template.needed if k not in options
    )
    model_class = _made(template.make, template.hints(), options, template.keys, wrong)
    methods = () if model_class is None else methods_of(model_class)
    known = list(dict.fromkeys(one.word for one in methods)) or list(METHODS)
    chosen = known[0] if word is None else word
    if not isinstance(chosen, str) or chosen not in known:
        what = "is not for this model class:" if chosen in [*METHODS] else "should be"
        wrong.append(_wrong(("method",), chosen, f"{what} {_listed(known)}"))
        raise _error(*wrong)
    usual = next((one for one in methods if one.word == chosen), METHODS[chosen]())
    names = _names(usual)
    method = _made(
        partial(_changed, usual),
        get_type_hints(type(usual)),
        {key: left.pop(key) for key in names if key in left},
        {},
        wrong,
    )
    if method is not None and methods and method.name not in [one.name for one in methods]:
        what = f"should be {str(not method.certified).lower()} for this model class"
        wrong.append(_wrong(("certified",), method.certified, what))
    if model_class is None and word is None:  # then the method, and its keys, are not known
        left = {k: v for k, v in left.items() if not any(k in _names(m) for m in METHODS.values())}
    keys = ", ".join(["model", *template.keys, "method", *names, *OWN])
    for key in left:
        details = {"key": str(key), "known": keys}
        wrong.append(_wrong((), section, "there is no such key", UNKNOWN_KEY, details))
    if wrong or model_class is None or method is None:
        raise _error(*wrong)
    return IdentificationConfig(model_class, method, section, **own)


def _changed(method: Method, values: Mapping[str, Any]) -> Method:
    return replace(method, **values)


Identification = Annotated[IdentificationConfig, PlainValidator(_read)]


def _made(
    make: Callable[[Mapping[str, Any]], Any],
    hints: Mapping[str, Any],
    given: dict[str, object],
    names: Mapping[str, str],
    wrong: list[InitErrorDetails],
) -> Any:
    """What is made of these options, each of the type that its field declares; None if wrong.

    names: what an option is called inside, by its key.
    """
    before = len(wrong)
    values = _values(hints, given, wrong)
    if len(wrong) > before:
        return None
    try:
        return make(values)
    except OptionError as error:
        keys = {option: key for key, option in names.items()}
        key = keys.get(error.key, error.key)
        wrong.append(_wrong((key,), given.get(key), f"should be {error.allowed}"))
    except DataError as error:
        wrong.append(_wrong((), given, str(error)))
    return None


def _values(
    hints: Mapping[str, Any], given: Mapping[str, object], wrong: list[InitErrorDetails]
) -> dict[str, Any]:
    """The values as the types say; a list is a tuple, and nothing else is converted."""
    values = {}
    for key, value in given.items():
        if key in RANGES and isinstance(value, list) and not any(map(_is_list, value)):
            value = [value]
        try:
            adapter: TypeAdapter[Any] = TypeAdapter(hints[key])
            values[key] = adapter.validate_json(json.dumps(value, default=str), strict=True)
        except ValidationError as error:
            first = error.errors()[0]
            where = [part for part in first["loc"] if isinstance(part, int)]
            wrong.append(_wrong((key, *where), value, first["msg"]))
    return values


def _is_list(value: object) -> bool:
    return isinstance(value, list | tuple)


def _names(kind: Any) -> list[str]:
    return [option.name for option in fields(kind)]


def _listed(known: Sequence[str]) -> str:
    return " or ".join(", ".join(f"'{name}'" for name in known).rsplit(", ", 1))


def _wrong(
    where: tuple[str | int, ...],
    found: object,
    message: str,
    kind: str = "wrong_option",
    details: dict[str, Any] | None = None,
) -> InitErrorDetails:
    error = PydanticCustomError(kind, message, details)
    return InitErrorDetails(type=error, loc=where, input=found)


def _error(*wrong: InitErrorDetails) -> ValidationError:
    return ValidationError.from_exception_data("identification", list(wrong))
