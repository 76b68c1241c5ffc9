"""ROS 2 message types: their fields, their definition text, and the stamp in a serialised message.

Standard types come from the definitions of each release that rosbags ships, so no ROS is needed.
A bag's own definition is used where it differs: the data were written with it.
"""

import re
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache, lru_cache
from typing import Final

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.interfaces.typing import Fielddefs, FieldDesc, Typesdict
from rosbags.typesys import (
    Stores,
    TypesysError,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)
from rosbags.typesys.store import Typestore

from nlsid_core.errors import BagError

HEADER: Final = "std_msgs/msg/Header"
CHILD_FRAME: Final = ("child_frame_id", (Nodetype.BASE, ("string", 0)))  # after the header
JAZZY: Final = "ros2_jazzy"
NOETIC: Final = "ros1_noetic"
IDL_SEPARATOR: Final = "=" * 80 + "\n"
ROS1_DIFFERS: Final = (HEADER, "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
MAX_FIXED_ARRAY: Final = 2**16  # numbers
MAX_UNROLLED: Final = 1024  # strings or messages: rosbags writes lines of code for each of them
MAX_ELEMENTS: Final = 2**16  # of a whole message, arrays in arrays multiplied out

_TYPE_NAME: Final = re.compile(r"[A-Za-z]\w*(/[A-Za-z]\w*){1,3}", re.ASCII)
_FIELD_NAME: Final = re.compile(r"[A-Za-z]\w*", re.ASCII)


@cache
def standard_types(release: str = JAZZY) -> Typestore:
    """The message types of a release's common interfaces; of Jazzy's if the release is unknown."""
    if release != JAZZY and release not in {store.value for store in Stores}:
        return standard_types()
    return get_typestore(Stores(release))


def fields_of(msgtype: str, types: Typestore) -> Mapping[str, FieldDesc]:
    """Field name -> field type of `msgtype`; BagError if the type is not known."""
    if msgtype not in types.fielddefs:
        raise BagError(
            f"message type '{msgtype}' is not known: it is no ROS 2 Jazzy common interface and "
            "nothing defines it here; give its .msg, .idl, .srv or .action file (--definitions, or "
            "`definitions` in a configuration)"
        )
    return dict(types.fielddefs[msgtype][1])


def is_stamped(msgtype: str, types: Typestore) -> bool:
    """Whether messages of `msgtype` start with a std_msgs/Header."""
    fields: Fielddefs = types.fielddefs[msgtype][1]
    return bool(fields) and fields[0] == ("header", (Nodetype.NAME, HEADER))


def header_stamp_ns(data: bytes) -> int:
    """The header stamp in ns of a CDR message whose type starts with a header (see `is_stamped`).

    Raises BagError if `data` is too short or not plain CDR.
    """
    if len(data) < 12 or data[0] != 0 or data[1] > 1:
        raise BagError(f"not a CDR message with a header: it starts with {data[:12].hex(' ')}")
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] else ">iI", data, 4)
    return int(seconds) * 10**9 + int(nanoseconds)


def header_frames(data: bytes, msgtype: str, types: Typestore) -> str:
    """The frame that a CDR message with a header is in, and the one that moves if it names it.

    Raises BagError if `data` is too short.
    """
    frame, end = _string(data, 12)
    if types.fielddefs[msgtype][1][1:2] != [CHILD_FRAME]:
        return frame
    child, _ = _string(data, end + -end % 4)
    return f"{frame}, {child}" if child else frame


def _string(data: bytes, at: int) -> tuple[str, int]:
    """The string at an offset of a CDR message, and where it ends."""
    end = at + 4 + int.from_bytes(data[at : at + 4], "little" if data[1] else "big")
    if end > len(data):
        raise BagError(f"not a CDR message with a header: it has only {len(data)} bytes")
    return data[at + 4 : end].rstrip(b"\0").decode("utf-8", "replace"), end


def decode(data: bytes, msgtype: str, types: Typestore) -> object:
    """The message in CDR `data`, its fields as attributes; BagError if it is damaged."""
    try:
        return types.deserialize_cdr(data, msgtype)
    except Exception as error:  # rosbags' generated decoders raise what the bytes make them raise
        raise BagError(f"not a '{msgtype}': {type(error).__name__}: {str(error)[:200]}") from error


def ros2_definition(msgtype: str, embedded: MessageDefinition) -> MessageDefinition:
    """A ROS 1 definition as ROS 2 writes it: no `seq` in the header, `time` as a message.

    Raises BagError if it cannot be used.
    """
    standard, noetic = standard_types().fielddefs, standard_types(NOETIC).fielddefs
    with defining(f"'{msgtype}' in the bag"):
        if msgtype in noetic and not embedded.data.strip():
            parsed = {msgtype: noetic[msgtype]}
        else:
            parsed = parse(msgtype, embedded)
        parsed = completed(parsed, noetic) | {name: standard[name] for name in ROS1_DIFFERS}
        text, _ = registered(parsed).generate_msgdef(msgtype, ros_version=2)
    return MessageDefinition(MessageDefinitionFormat.MSG, text)


@lru_cache(maxsize=256)
def types_in_bag(msgtype: str, embedded: MessageDefinition) -> Typestore:
    """The types a bag's messages of `msgtype` were written with.

    Raises BagError if the embedded definition cannot be used, or if there is none and the type is
    not standard.
    """
    standard = standard_types()
    if embedded.format == MessageDefinitionFormat.NONE:
        fields_of(msgtype, standard)
        return standard
    with defining(f"'{msgtype}' in the bag"):
        parsed = completed(parse(msgtype, embedded))
        if msgtype in parsed and all(
            name in standard.fielddefs and standard.fielddefs[name][1] == fields
            for name, (_, fields) in parsed.items()
        ):
            return standard
        types = registered(parsed)
        types.get_msgdef(msgtype)
    return types


def are_same(first: Typestore, second: Typestore) -> bool:
    """Whether two results of `types_in_bag` define the same, however their texts differ."""
    return first is second or first.fielddefs == second.fielddefs


@contextmanager
def defining(what: str) -> Iterator[None]:
    """Turn what a definition that cannot be used raises into a BagError that names it."""
    try:
        yield
    except (TypesysError, ValueError, LookupError, RecursionError, SyntaxError) as error:
        raise BagError(
            f"the definition of {what} cannot be used: {type(error).__name__}: "
            f"{' '.join(str(error).split())[:200]}"
        ) from error


def parse(msgtype: str, embedded: MessageDefinition) -> Typesdict:
    """What a definition defines; `msgtype` is called as it is, also in a package's `srv`."""
    lines = embedded.data.lstrip("\ufeff").splitlines(keepends=False)
    if embedded.format == MessageDefinitionFormat.MSG:
        (_, defined), *others = get_types_from_msg("\n".join(lines), msgtype).items()
        return {msgtype: defined, **dict(others)}
    text = "".join(f"{line}\n" for line in lines if not line.lstrip().startswith("#"))
    if not text.startswith(IDL_SEPARATOR + "IDL: "):
        return get_types_from_idl(text)
    types: Typesdict = {}
    for part in text.split(IDL_SEPARATOR)[1:]:
        types.update(get_types_from_idl(part.partition("\n")[2]))
    return types


def completed(parsed: Typesdict, others: Typesdict | None = None) -> Typesdict:
    """With the types that the definitions use and leave out: from `others`, else standard ones."""
    known = {**standard_types().fielddefs, **(others or {})}
    todo, complete = list(parsed), dict(parsed)
    while todo:
        for _, description in complete[todo.pop()][1]:
            if description[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                description = description[1][0]
            name = str(description[1])
            if description[0] == Nodetype.NAME and name not in complete and name in known:
                complete[name] = known[name]
                todo.append(name)
    return complete


def _elements(name: str, types: Typesdict, sizes: dict[str, int]) -> int:
    """How many fields a message has, those of messages in it and in fixed arrays multiplied out."""
    if name not in sizes:
        total = 0
        for _, description in types[name][1] if name in types else ():
            times = int(str(description[1][1])) if description[0] == Nodetype.ARRAY else 1
            if description[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                description = description[1][0]
            if description[0] == Nodetype.NAME:
                total += times * _elements(str(description[1]), types, sizes)
            total += 1
        if total > MAX_ELEMENTS:
            raise ValueError(f"'{name}' has more than {MAX_ELEMENTS} fields")
        sizes[name] = total
    return sizes[name]


def registered(used: Typesdict) -> Typestore:
    """A store of these types and no others; ValueError if they cannot be code."""
    refuse_what_code_cannot_be(used)
    types = get_typestore(Stores.EMPTY)
    types.register(used)
    return types


def refuse_what_code_cannot_be(types: Typesdict) -> None:
    """rosbags turns definitions into code: from a bag only plain names and sane sizes reach it."""
    for name, (constants, fields) in types.items():
        if not _TYPE_NAME.fullmatch(name):
            raise ValueError(f"{name!r} is not a type name")
        for field in [*(entry[0] for entry in fields), *(entry[0] for entry in constants)]:
            if not _FIELD_NAME.fullmatch(field):
                raise ValueError(f"{field!r} is not a field name")
        for _, description in fields:
            if description[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                is_array, (element, length) = description[0] == Nodetype.ARRAY, description[1]
                numbers = element[0] == Nodetype.BASE and element[1][0] != "string"
                most = MAX_FIXED_ARRAY if numbers else MAX_UNROLLED
                if is_array and not (isinstance(length, int) and 0 <= length <= most):
                    raise ValueError(f"an array of {length} elements; at most {most} are read")
                description = element
            if description[0] == Nodetype.NAME and not _TYPE_NAME.fullmatch(str(description[1])):
                raise ValueError(f"{description[1]!r} is not a type name")
    sizes: dict[str, int] = {}
    for name in types:
        _elements(name, types, sizes)
