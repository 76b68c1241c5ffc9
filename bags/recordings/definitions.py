"""Definitions of message types for a bag: standard ones, and custom ones from their .msg texts."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final, NamedTuple

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from bags.recordings.message_types import (
    completed,
    defining,
    fields_of,
    is_stamped,
    refuse_what_code_cannot_be,
    standard_types,
    types_in_bag,
)
from nlsid_core.errors import BagError

MAX_MSG_BYTES: Final = 2**20


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
    """Type name -> definition of each type whose .msg text is given.

    What the texts use and do not define is taken from the standard types. Raises BagError if a text
    is not a message definition or uses a type that is not known.
    """
    parsed: Typesdict = {}
    for msgtype, text in texts.items():
        with defining(f"'{msgtype}'"):
            parsed.update(get_types_from_msg(text, msgtype))
    found = {}
    for msgtype in texts:
        with defining(f"'{msgtype}'"):
            used = completed({msgtype: parsed[msgtype]}, parsed)
            refuse_what_code_cannot_be(used)
            types = get_typestore(Stores.EMPTY)
            types.register(used)
            text = types.generate_msgdef(msgtype, ros_version=2)[0]
            found[msgtype] = Definition(msgtype, text, types.hash_rihs01(msgtype))
    return found


def types_from(msgtype: str, texts: Mapping[str, str]) -> Typestore:
    """What the .msg `texts`, by their types' names, define of `msgtype`; as `definitions_from`."""
    text = definitions_from(texts)[msgtype].text
    return types_in_bag(msgtype, MessageDefinition(MessageDefinitionFormat.MSG, text))


def texts_of(definitions: Mapping[str, Definition]) -> list[tuple[str, str]]:
    """(type, text), sorted: what a manifest's key has of them, not where they were read."""
    return sorted((name, found.text) for name, found in definitions.items())


def read_definitions(paths: Iterable[Path]) -> dict[str, Definition]:
    """Definitions from .msg files, packages' folders (with `msg` in it) and folders of packages.

    A file's type is named by its place: PACKAGE/msg/Type.msg. Raises BagError if a path holds none,
    and as `definitions_from`; OS errors pass through.
    """
    texts = {}
    for path in paths:
        files = [path] if path.is_file() else [*path.glob("msg/*.msg"), *path.glob("*/msg/*.msg")]
        if not files:
            raise BagError(
                f"{path} holds no message definitions; give a PACKAGE/msg/Type.msg file, a "
                "package's share folder, or a folder of those"
            )
        for file in map(Path.resolve, files):
            package, folder, kind = file.parts[-3:]
            if folder != "msg" or file.suffix != ".msg":
                raise BagError(f"{file}: a definition's place is PACKAGE/msg/Type.msg")
            if file.stat().st_size > MAX_MSG_BYTES:
                raise BagError(f"{file}: more than {MAX_MSG_BYTES} bytes; not a definition")
            texts[f"{package}/msg/{Path(kind).stem}"] = file.read_text(encoding="utf-8")
    return definitions_from(texts)
