"""The section `identification`: its keys are the options of a model class and of its method.

    model: state_affine        # which class; its options stand beside it
    lags: 2
    method: rse_certified      # which method of the class; its options stand beside it, too
    iterations: 5

Names, types, defaults and limits are those of the dataclasses in `nlsid_core.identification`.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from itertools import product
from typing import Annotated, Any, get_type_hints

from pydantic import Field, PlainValidator, TypeAdapter, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from bags.chain.sections import UNKNOWN_KEY, problems, unknown_key
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, OptionError
from nlsid_core.identification import (
    METHODS,
    BlockCascadeClass,
    Fit,
    ImplicitClass,
    LinearClass,
    LinearStateClass,
    Method,
    Model,
    ModelClass,
    MonotoneClass,
    StateAffineClass,
    identify,
    methods_of,
)
from nlsid_core.identification.methods import alike

CLASSES: dict[str, type] = {
    "linear": LinearClass,
    "state_affine": StateAffineClass,
    "block_cascade": BlockCascadeClass,
    "monotone": MonotoneClass,
    "implicit": ImplicitClass,
    "linear_states": LinearStateClass,
}
RANGES = ("input_range", "box")  # options of which one [low, high] is the range of one signal
OWN = {"transient": Annotated[int, Field(ge=0)], "allow_unproved": bool}  # of every section

Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class IdentificationConfig:
    """What to identify, and how. transient: samples at the start of each trial not scored.

    allow_unproved: write a model without a proof of stability too; nothing is certified then.
    given: the section itself, as a mapping.
    """

    model_class: ModelClass[Model]
    method: Method
    given: Mapping[str, object]
    transient: int = 0
    allow_unproved: bool = False

    def identify(
        self,
        train: Dataset,
        *,
        validation: Dataset | None = None,
        test: Dataset | None = None,
        progress: Progress | None = None,
    ) -> Fit[Model]:
        """`nlsid_core.identification.identify` with these options."""
        return identify(
            train,
            self.model_class,
            method=self.method,
            validation=validation,
            test=test,
            transient=self.transient,
            allow_unproved=self.allow_unproved,
            progress=progress,
        )

    def every_method(self) -> tuple[Method, ...]:
        """This method, then every other one of the class, with the options that they share."""
        others = [k for k in methods_of(self.model_class) if not isinstance(self.method, k)]
        return (self.method, *(alike(kind, self.method) for kind in others))

    def each(self, options: Mapping[str, Sequence[object]]) -> "list[IdentificationConfig]":
        """This section with every combination of the options' values; DataError names a wrong one.

        The last option varies fastest.
        """
        own = [option.name for option in fields(type(self.model_class))]  # type: ignore[arg-type]
        for key in options:
            if key not in own:
                raise DataError(
                    f"select.{key}: a {self.given.get('model', 'linear')} model has no such "
                    f"option; there are: {', '.join(own)}"
                )
        made = []
        for values in product(*options.values()):
            changed = dict(zip(options, values, strict=True))
            try:
                made.append(_read({**self.given, **changed}))
            except ValidationError as error:
                raise DataError(problems(error, prefix=["select"]).strip()) from error
        return made


def _read(section: object) -> IdentificationConfig:
    """The section as the dataclasses that it names; ValidationError says what is wrong where."""
    if isinstance(section, IdentificationConfig):
        return section
    if not isinstance(section, dict):
        raise _wrong((), section, "should be keys and values, such as `lags: 4`")
    left = dict(section)
    name = left.pop("model", "linear")
    kind = CLASSES.get(name) if isinstance(name, str) else None
    if kind is None:
        raise _wrong((), section, f"there is no such model; there are: {', '.join(CLASSES)}")
    own = {key: left.pop(key) for key in OWN if key in left}
    method_name = left.pop("method", None)
    of_class = {f.name: left.pop(f.name) for f in fields(kind) if f.name in left}
    model_class = _made(kind, of_class)
    known = {method.name: method for method in methods_of(model_class)}
    chosen = next(iter(known)) if method_name is None else method_name
    if chosen not in METHODS:
        raise _wrong(("method",), chosen, f"should be {_listed(known)}")
    if chosen not in known:
        raise _wrong(("method",), chosen, f"is not for this model class: {_listed(known)}")
    of_method = {f.name: left.pop(f.name) for f in fields(known[chosen]) if f.name in left}
    for key in left:
        keys = ["model", *_names(kind), "method", *_names(known[chosen]), *OWN]
        said = "there is no such key{meant}; there are: {known}"
        raise _wrong((), section, said, UNKNOWN_KEY, unknown_key(str(key), keys))
    return IdentificationConfig(
        model_class, _made(known[chosen], of_method), section, **_values(OWN, own)
    )


Identification = Annotated[IdentificationConfig, PlainValidator(_read)]


def _made(kind: Any, given: dict[str, object]) -> Any:
    """An instance with these options, each of the type that its field declares."""
    hints = {key: hint for key, hint in get_type_hints(kind).items() if key in given}
    required = [f.name for f in fields(kind) if f.default is MISSING and f.name not in given]
    if required:
        raise _wrong((required[0],), given, "Field required")
    try:
        return kind(**_values(hints, given))
    except OptionError as error:
        raise _wrong((error.key,), given[error.key], f"should be {error.allowed}") from error
    except DataError as error:
        raise _wrong((), given, str(error)) from error


def _values(hints: Mapping[str, Any], given: Mapping[str, object]) -> dict[str, Any]:
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
            raise _wrong((key, *where), value, first["msg"]) from error
    return values


def _is_list(value: object) -> bool:
    return isinstance(value, list | tuple)


def _names(kind: Any) -> list[str]:
    return [option.name for option in fields(kind)]


def _listed(known: Mapping[str, object]) -> str:
    return " or ".join(", ".join(f"'{name}'" for name in known).rsplit(", ", 1))


def _wrong(
    where: tuple[str | int, ...],
    found: object,
    message: str,
    kind: str = "wrong_option",
    details: dict[str, Any] | None = None,
) -> ValidationError:
    error = PydanticCustomError(kind, message, details)
    line = InitErrorDetails(type=error, loc=where, input=found)
    return ValidationError.from_exception_data("identification", [line])
