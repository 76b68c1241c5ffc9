"""rclpy's message class for a type name such as `nav_msgs/msg/Odometry`, and the type's fields."""

import importlib
import re
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, Final

from bags.recordings.definitions import (
    Definition,
    read_definitions,
    standard_definition,
    types_from,
)
from nlsid_core.errors import BagError

_NAME = re.compile(r"([a-z][a-z0-9_]*)/msg/([A-Za-z][A-Za-z0-9]*)", re.ASCII)
_SEQUENCE = re.compile(r"sequence<(.+?)(?:, (\d+))?>")
_ARRAY = re.compile(r"(.+)\[(\d+)\]")
HASHED: Final = "RIHS01_"  # how a known hash begins; a middleware that does not tell says INVALID
_WRITTEN: Final = {"float": "float32", "double": "float64", "boolean": "bool", "octet": "byte"}


def message_class(msgtype: str) -> Any:
    """The class; BagError if the name is malformed or its package is not installed."""
    match = _NAME.fullmatch(msgtype)
    if match is None:
        raise BagError(f"'{msgtype}' is not a message type; one is written package/msg/Type")
    try:
        return getattr(importlib.import_module(f"{match[1]}.msg"), match[2])
    except (ImportError, AttributeError) as error:
        raise BagError(f"message type {msgtype} is not installed: {error}") from error


@cache
def installed_types(msgtype: str) -> Any:
    """The type store of `msgtype` and of the types in it, as they are installed.

    The standard definitions are not asked: to read them all takes longer than to describe one.
    Raises BagError if the type is not installed.
    """
    texts: dict[str, str] = {}
    _describe(msgtype, texts)
    return types_from(texts)


def definition_of(msgtype: str, type_hash: str, given: Mapping[str, Definition]) -> Definition:
    """The definition with the hash that a publisher states: given, standard or installed.

    Raises BagError if none has it.
    """
    known = ""
    for look in (given.__getitem__, standard_definition, _installed):
        with suppress(KeyError, BagError):
            found = look(msgtype)
            if found.type_hash == type_hash or not type_hash.startswith(HASHED):
                return found
            known = f"published with hash {type_hash}, known is {found.type_hash}"
    raise BagError(
        f"message type '{msgtype}' is {known or 'not known'}; give its "
        f"{msgtype.split('/')[-1]}.msg file or its package's share folder in the parameter "
        "definitions"
    )


def _installed(msgtype: str) -> Definition:
    """The definition by the texts of its package and of those that it uses, where they lie."""
    texts = []
    for name in installed_types(msgtype).fielddefs:
        package, kind = name.split("/")[0], name.split("/")[-1]
        code = Path(str(importlib.import_module(package).__file__))
        places = [prefix / "share" / package / "msg" / f"{kind}.msg" for prefix in code.parents]
        texts += [place for place in places if place.is_file()][:1]
    return read_definitions(texts)[msgtype]


def _describe(msgtype: str, texts: dict[str, str]) -> None:
    """The .msg text of a type and of those in it."""
    lines = []
    for name, kind in message_class(msgtype).get_fields_and_field_types().items():
        written, suffix = kind, ""
        if found := _SEQUENCE.fullmatch(kind):
            written, suffix = found[1], f"[<={found[2]}]" if found[2] else "[]"
        elif found := _ARRAY.fullmatch(kind):
            written, suffix = found[1], f"[{found[2]}]"
        written = re.sub(r"^(w?string)<(\d+)>$", r"\1<=\2", written)
        if "/" in written:
            package, _, inner = written.partition("/")
            written = f"{package}/msg/{inner}"
            if written not in texts:
                _describe(written, texts)
            written = f"{package}/{inner}"
        lines.append(f"{_WRITTEN.get(written, written)}{suffix} {name}")
    texts[msgtype] = "\n".join(lines) + "\n"
