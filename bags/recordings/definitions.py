"""Definitions of message types for a bag: standard ones, and custom ones from their texts.

A service's events and an action's feedback are messages, too: their texts are made of the parts of
.srv and .action files.
"""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final, NamedTuple

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.interfaces.typing import Typesdict
from rosbags.typesys.store import Typestore

from bags.recordings.message_types import (
    completed,
    defining,
    fields_of,
    is_stamped,
    parse,
    registered,
    standard_types,
    types_in_bag,
)
from nlsid_core.errors import BagError

MAX_MSG_BYTES: Final = 2**20
PLACES: Final = ("msg/*.idl", "msg/*.msg", "srv/*.srv", "action/*.action")  # in a package
PARTS: Final = {"srv": ("Request", "Response"), "action": ("Goal", "Result", "Feedback")}
RECORDED: Final = {
    "srv": (
        "Event",
        "service_msgs/ServiceEventInfo info\n"
        "{0}_Request[<=1] request\n{0}_Response[<=1] response\n",
    ),
    "action": ("FeedbackMessage", "unique_identifier_msgs/UUID goal_id\n{0}_Feedback feedback\n"),
}
_IDL: Final = re.compile(r"^\s*module\s+\w+\s*\{", re.MULTILINE)
_NEXT_PART: Final = re.compile(r"^---\s*$", re.MULTILINE)


class Definition(NamedTuple):
    """A message type, the `ros2msg` text that defines it and all it uses, and its RIHS01 hash."""

    msgtype: str
    text: str
    type_hash: str

    @property
    def is_stamped(self) -> bool:
        """Whether its messages start with a std_msgs/Header."""
        embedded = MessageDefinition(MessageDefinitionFormat.MSG, self.text)
        return is_stamped(self.msgtype, types_in_bag(self.msgtype, embedded))


def standard_definition(msgtype: str) -> Definition:
    """The definition of a standard type; BagError if it is none."""
    types = standard_types()
    fields_of(msgtype, types)
    return Definition(
        msgtype, types.generate_msgdef(msgtype, ros_version=2)[0], types.hash_rihs01(msgtype)
    )


def definitions_from(texts: Mapping[str, str]) -> dict[str, Definition]:
    """Type name -> definition of each type whose .msg or .idl text is given.

    What the texts use and do not define is taken from the standard types. Raises BagError if a text
    is not a message definition or uses a type that is not known.
    """
    parsed, found = _parsed(texts), {}
    for msgtype in texts:
        with defining(f"'{msgtype}'"):
            types = registered(completed({msgtype: parsed[msgtype]}, parsed))
            text = types.generate_msgdef(msgtype, ros_version=2)[0]
            type_hash = types.hash_rihs01(msgtype) if "/msg/" in msgtype else ""
            found[msgtype] = Definition(msgtype, text, type_hash)
    return found


def types_from(texts: Mapping[str, str]) -> Typestore:
    """What .msg `texts`, by their types' names, define; they leave out nothing that they use."""
    with defining(", ".join(texts)):
        return registered(_parsed(texts))


def _parsed(texts: Mapping[str, str]) -> Typesdict:
    """What .msg or .idl texts, by their types' names, define themselves."""
    parsed: Typesdict = {}
    for msgtype, text in texts.items():
        form = MessageDefinitionFormat.IDL if _IDL.search(text) else MessageDefinitionFormat.MSG
        with defining(f"'{msgtype}'"):
            parsed.update(parse(msgtype, MessageDefinition(form, text)))
    return parsed


def texts_of(definitions: Mapping[str, Definition]) -> list[tuple[str, str]]:
    """(type, text), sorted: what a manifest's key has of them, not where they were read."""
    return sorted((name, found.text) for name, found in definitions.items())


def read_definitions(paths: Iterable[Path]) -> dict[str, Definition]:
    """Definitions from files, packages' folders (with `msg` in it) and folders of packages.

    A file's type is named by its place: PACKAGE/msg/Type.msg, or .idl; PACKAGE/srv/Type.srv defines
    Type_Event, PACKAGE/action/Type.action Type_FeedbackMessage. Raises BagError if a path holds
    none, and as `definitions_from`; OS errors pass through.
    """
    texts: dict[str, str] = {}
    for path in paths:
        inside = [file for place in PLACES for up in ("", "*/") for file in path.glob(up + place)]
        files = [path] if path.is_file() else inside
        if not files:
            raise BagError(
                f"{path} holds no message definitions; give a PACKAGE/msg/Type.msg file, a "
                "package's share folder, or a folder of those"
            )
        for file in map(Path.resolve, files):
            if not any(file.match(f"*/{place}") for place in PLACES):
                raise BagError(f"{file}: a definition's place is PACKAGE/msg/Type.msg")
            if file.stat().st_size > MAX_MSG_BYTES:
                raise BagError(f"{file}: more than {MAX_MSG_BYTES} bytes; not a definition")
            with defining(f"'{file}'"):
                texts |= _texts(file)
    return definitions_from(texts)


def _texts(file: Path) -> dict[str, str]:
    """The texts in a file by the names of their types; ValueError if it lacks a part."""
    package, folder, _ = file.parts[-3:]
    text = file.read_text(encoding="utf-8")
    if folder not in PARTS:
        return {f"{package}/msg/{file.stem}": text}
    parts = zip(PARTS[folder], _NEXT_PART.split(text), strict=True)
    texts = {f"{package}/msg/{file.stem}_{part}": inside for part, inside in parts}
    name, whole = RECORDED[folder]
    return {
        **texts,
        f"{package}/{folder}/{file.stem}_{name}": whole.format(f"{package}/{file.stem}"),
    }
