"""docs/configuration.md, made from the sections' own types: every key, unit, default and range.

python -m docs.site.configuration > docs/configuration.md
"""

import json
from collections.abc import Iterator
from dataclasses import MISSING, fields
from typing import Any, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MinLen
from pydantic.fields import FieldInfo

from bags.chain.config import Config
from bags.chain.identification_config import IdentificationConfig
from bags.chain.sections import Section, sections_in
from bags.chain.templates import TEMPLATES, Template, option_texts
from bags.chain.tracking_config import TrackingConfig
from nlsid_core.identification import METHODS, methods_of

HEAD = """# The configuration of a robot, key by key

Made by `python -m docs.site.configuration`; a test keeps it true. Words are in the
[glossary](glossary.md). `nlsid identify` says all that is wrong with a file at once. A key
without a default has to be given; a key that is not here is refused.
"""
LIMITS = (
    (Gt, "gt", "> "),
    (Ge, "ge", "≥ "),
    (Lt, "lt", "< "),
    (Le, "le", "≤ "),
    (MinLen, "min_length", "at least "),
)
COLUMNS = ("key", "what", "unit", "default", "range", "example")
IDENTIFICATION = """
`model` names the class, `method` one of its methods; the options of both stand beside them.

| key | what | default |
|---|---|---|
| `model` | the class of models | `linear` |
| `method` | how it is fitted | the first of the class's |
| `transient` | samples at the start of each trial that are not scored | `0` |
| `max_rate` | slowest rate a sample that counts, in (0, 1) | exp(-1/samples of the longest trial) |
| `allow_unproved` | write a model without a proof of stability too | `false` |
"""


def page() -> str:
    """The whole page."""
    lines = [HEAD]
    for title, kind in (
        ("nlsid identify", Config),
        ("a measured state and its motion", TrackingConfig),
    ):
        lines.append(f"## The file of `{title}`\n")
        for name, section in _sections("", kind):
            lines += [*_section(name, section), ""]
        if kind is Config:
            lines += ["### identification", IDENTIFICATION, *_identification(), ""]
    return "\n".join(lines).rstrip() + "\n"


def _sections(name: str, kind: type[Section]) -> Iterator[tuple[str, type[Section]]]:
    """The section and those in it, by their dotted names; of lists of one kind the first only."""
    yield name, kind
    seen = []
    for key, field in kind.model_fields.items():
        for inner in sections_in(field.annotation):
            if inner not in seen:
                seen.append(inner)
                yield from _sections(f"{name}.{key}".lstrip("."), inner)


def _section(name: str, section: type[Section]) -> Iterator[str]:
    if name:
        yield f"### {name}\n"
        yield f"{section.__doc__}\n"
    yield f"| {' | '.join(COLUMNS)} |"
    yield "|" + "---|" * len(COLUMNS)
    for key, known in section.keys().items():
        field = section.model_fields[key]
        example = "" if known.example is None else f"`{json.dumps(known.example)}`"
        cells = (f"`{key}`", known.text, known.unit, _default(field), _range(field), example)
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    if field.default is None:
        return "`null`"
    return _written(field.default)


def _written(value: Any) -> str:
    if isinstance(value, Section):
        return "all defaults"
    return f"`{json.dumps(value, default=str)}`"


def _range(field: FieldInfo) -> str:
    """What is allowed, of the type and of the limits beside it."""
    limits = [*field.metadata, *_limits(field.annotation)]
    said = []
    for kind, attribute, sign in LIMITS:
        said += [
            f"{sign}{getattr(limit, attribute):g}" for limit in limits if isinstance(limit, kind)
        ]
    return " or ".join(_words(field.annotation)) + (f", {', '.join(said)}" if said else "")


def _limits(annotation: Any) -> Iterator[Any]:
    for limit in getattr(annotation, "__metadata__", ()):
        yield from getattr(limit, "metadata", (limit,))
    for part in get_args(annotation) if type(None) in get_args(annotation) else ():
        yield from _limits(part)


def _words(annotation: Any) -> list[str]:
    """The types that a value may have, in words."""
    if sections_in(annotation):
        return ["a list of sections"] if get_origin(annotation) is tuple else ["a section"]
    plain = {float: "a number", int: "a whole number", str: "text", bool: "true or false"}
    if annotation in plain:
        return [plain[annotation]]
    if annotation is type(None):
        return ["null"]
    origin = get_origin(annotation)
    if isinstance(getattr(annotation, "__value__", None), type):
        return _words(annotation.__value__)
    if hasattr(annotation, "__metadata__"):
        return _words(get_args(annotation)[0])
    if str(origin) == "typing.Literal":
        return [f"`{value}`" for value in get_args(annotation)]
    if origin is tuple:
        return ["a list"]
    if origin is dict:
        return ["keys with lists"]
    if annotation is IdentificationConfig:
        return ["a section"]
    if get_args(annotation):
        return [word for part in get_args(annotation) for word in _words(part)]
    return ["a path" if annotation.__name__ == "Path" else "a section"]


def _identification() -> Iterator[str]:
    for name, template in TEMPLATES.items():
        made = methods_of(template.make({}))
        words = ", ".join(f"`{word}`" for word in dict.fromkeys(method.word for method in made))
        certified = ", `certified`" if any(getattr(m, "certified", False) for m in made) else ""
        yield f"#### model: {name}\n"
        yield f"{template.says}. Methods: {words}{certified}.\n"
        rows = template_rows(template)
        if rows:
            yield "| key | what | type | default |"
            yield "|---|---|---|---|"
            yield from (
                f"| `{key}` | {text} | {what} | {value} |" for key, text, what, value in rows
            )
            yield ""
    yield "#### Options of methods\n"
    yield "| method | key | what | type | default |"
    yield "|---|---|---|---|---|"
    for method in METHODS.values():
        for key, text, kind_, default in option_rows(method):
            yield f"| `{method.word}` | `{key}` | {text} | {kind_} | {default} |"


def template_rows(template: Template) -> list[tuple[str, str, str, str]]:
    """(key, what its option's docstring says, type, default) of each key of a template."""
    known = {row[0]: row for kind in (template.family, template.part) for row in option_rows(kind)}
    found = []
    for key, option in template.keys.items():
        _, text, kind, _ = known[option]
        default = "required" if key in template.needed else _written(template.default(key))
        found.append((key, text, kind, default))
    return found


def option_rows(kind: Any) -> list[tuple[str, str, str, str]]:
    """(key, what its docstring says, type, default) of each option of a class or a method."""
    texts = option_texts(kind)
    found = []
    for option in fields(kind):
        default = "required" if option.default is MISSING else _written(option.default)
        shown = option.type if isinstance(option.type, str) else _type(option.type)
        what, type_ = (text.replace("|", "\\|") for text in (texts[option.name], f"`{shown}`"))
        found.append((option.name, what, type_, default))
    return found


def _type(annotation: Any) -> str:
    text = annotation.__name__ if isinstance(annotation, type) else str(annotation)
    return text.replace("typing.", "")


if __name__ == "__main__":
    print(page(), end="")
