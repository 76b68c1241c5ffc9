"""A signal: one number in the messages of one topic, named `topic:field.path[index]`.

An element of an array is named by its index, `position[0]`; by the string beside it,
`position[name=elbow]`; a message in an array by a string in it, `transforms[child_frame_id=base]`,
where other messages of the topic may be without it; or as every one of them, `position[*]`. A
geometry_msgs/Quaternion also has the angles `roll`, `pitch` and `yaw`.
"""

import keyword
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc
from rosbags.typesys.store import Typestore

from bags.recordings.cdr import Step
from bags.recordings.message_types import fields_of
from bags.recordings.names import did_you_mean
from nlsid_core.arrays import FloatArray
from nlsid_core.errors import BagError

QUATERNION: Final = "geometry_msgs/msg/Quaternion"
NO_FIELD: Final = "structure_needs_at_least_one_member"  # what a type without fields has in CDR
ANGLES: Final = ("roll", "pitch", "yaw")

_TOPIC: Final = re.compile(r"/?\w[\w.-]*(/\w[\w.-]*)*")  # not of ROS only: speed, /a-1
_STEP: Final = re.compile(
    r"([A-Za-z]\w*)(?:\[(?:(\d{1,9})|(\*)|([A-Za-z]\w*)=([^\]=]{1,200}))\])?", re.ASCII
)
_FORM: Final = "a signal is written topic:field.path[index], e.g. /joint_states:position[0]"
_MAX_DEPTH: Final = 16  # of message types in message types, when listing paths


@dataclass(frozen=True)
class SignalPath:
    """Where a signal is found: a topic and the fields that lead to one number in its messages."""

    topic: str
    steps: tuple[Step, ...]

    @classmethod
    def parse(cls, text: str) -> "SignalPath":
        """Read `topic:field.path[index]`; BagError says what is wrong with it."""
        topic, colon, path = text.partition(":")
        if not colon:
            raise BagError(
                (f"'{text}' has no ':'" if text else "it is read from no topic") + f"; {_FORM}"
            )
        if not _TOPIC.fullmatch(topic):
            raise BagError(f"'{topic}' in '{text}' is not a topic's name; {_FORM}")
        steps, at = [], 0
        while True:
            match = _STEP.match(path, at)
            end = match.end() if match else at
            if match is None or (end < len(path) and path[end] != "."):
                part = path[at:].partition(".")[0]
                raise BagError(f"'{part}' in '{text}' is not a field; {_FORM}")
            index = None if match[2] is None else int(match[2])
            key = None if match[4] is None else (match[4], match[5])
            steps.append(Step(match[1], index, key, every=match[3] is not None))
            if end == len(path):
                return cls(topic, tuple(steps))
            at = end + 1

    def __str__(self) -> str:
        return f"{self.topic}:{'.'.join(map(str, self.steps))}"

    @property
    def every(self) -> bool:
        """Whether it stands for several signals: see `expand`."""
        return any(step.every for step in self.steps)

    @property
    def framed(self) -> bool:
        """Whether it leads through a named message of an array, so that it may be absent."""
        return any(step.key is not None for step in self.steps[:-1])

    def check(self, msgtype: str, types: Typestore) -> tuple[tuple[str, str], ...]:
        """Find the (message type, field) on the way to the number in messages of `msgtype`.

        BagError if there is no number here; it names the nearest that are. The length of a dynamic
        array is only known message by message: see `value`.
        """
        current: FieldDesc = (Nodetype.NAME, msgtype)
        way: list[tuple[str, str]] = []
        for step in self.steps:
            if current[0] != Nodetype.NAME:
                raise BagError(f"{self}: {_describe(current)} has no field '{step.field}'")
            owner = str(current[1])
            way.append((owner, step.field))
            if owner == QUATERNION and step is self.steps[-1] and step.field in ANGLES:
                if step.picks:
                    raise BagError(f"{self}: '{step.field}' is an angle, not an array")
                return tuple(way)
            fields = fields_of(owner, types)
            if step.field not in fields:
                near = did_you_mean(
                    str(self), (f"{self.topic}:{p}" for p, *_ in numeric_paths(msgtype, types))
                )
                raise BagError(
                    f"{self}: Field '{step.field}' does not exist on '{owner}'; "
                    f"it has: {', '.join(fields)}{near}"
                )
            current = self._element(step, fields, owner, types)
        if current[0] == Nodetype.NAME:
            fields = fields_of(str(current[1]), types)
            raise BagError(
                f"{self} is {_describe(current)}, not a number; it has: {', '.join(fields)}"
            )
        if current[1][0] in ("string", "wstring"):
            raise BagError(f"{self} is {_describe(current)}, not a number")
        return tuple(way)

    def expand(self, message: Any) -> list["SignalPath"]:
        """The signals that `[*]` stands for in a decoded message; each holds on to that length."""
        paths = [self]
        for depth, step in enumerate(self.steps):
            if step.every:
                paths = [
                    replace(path, steps=(*path.steps[:depth], element, *path.steps[depth + 1 :]))
                    for path in paths
                    for element in _elements(path.steps[:depth], step, message)
                ]
        return paths

    def targets(self, msgtype: str, types: Typestore) -> list[tuple[Step, ...]]:
        """The numbers in a message that `combine` makes this signal's value of."""
        if not self._is_angle(msgtype, types):
            return [self.steps]
        return [(*self.steps[:-1], Step(letter)) for letter in "xyzw"]

    def combine(self, numbers: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """(N,) values from the targets' numbers: themselves, or the angle of the quaternions."""
        if len(numbers) == 1:
            return numbers[0]
        return quaternion_angle(self.steps[-1].field, np.array(numbers, dtype=float))

    def value(self, message: Any) -> float:
        """The number in a decoded message of the checked type (of rosbags' or of rclpy).

        NaN if no message in an array has the name. Raises BagError if a dynamic array is too short
        or lacks the element that is named beside it.
        """
        for step in self.steps:
            if step.field in ANGLES and not hasattr(message, step.field):
                parts = [[getattr(message, letter)] for letter in "xyzw"]
                return float(quaternion_angle(step.field, np.array(parts, dtype=np.float64))[0])
            owner, message = message, getattr(message, attribute(step.field))
            if step.picks:
                place = self._place(step, owner, message)
                if place < 0:
                    return math.nan
                message = message[place]
        return float(message)

    def assign(self, message: Any, value: float) -> None:
        """Put `value` in a decoded message's place of this signal; BagError as `value`."""
        self.value(message)
        *outer, last = self.steps
        for step in outer:
            owner, message = message, getattr(message, attribute(step.field))
            if step.picks:
                message = message[self._place(step, owner, message)]
        if last.field in ANGLES and not hasattr(message, last.field):
            raise BagError(f"{self} is made of four numbers; assign to those")
        if not last.picks:
            kind = type(getattr(message, attribute(last.field)))
            setattr(message, attribute(last.field), kind(value))
        else:
            array = getattr(message, attribute(last.field))
            if isinstance(array, np.ndarray) and not array.flags.writeable:
                array = array.copy()  # a decoded message's array is a view of its bytes
                setattr(message, attribute(last.field), array)
            array[self._place(last, message, array)] = value

    def _is_angle(self, msgtype: str, types: Typestore) -> bool:
        if self.steps[-1].field not in ANGLES:
            return False
        owner: FieldDesc = (Nodetype.NAME, msgtype)
        for step in self.steps[:-1]:
            owner = fields_of(str(owner[1]), types)[step.field]
            if owner[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                owner = owner[1][0]
        return owner == (Nodetype.NAME, QUATERNION)

    def _place(self, step: Step, owner: Any, array: Any) -> int:
        """The index that `step` names in `array`, a field of `owner`; -1 if no element has it."""
        if step.every:
            raise BagError(f"{self} is several signals; name one element")
        if step.length is not None and len(array) != step.length:
            raise BagError(
                f"{self}: '{step.field}' has {len(array)} elements, the first message has "
                f"{step.length}"
            )
        if step.key is not None:
            key = attribute(step.key[0])
            if not hasattr(owner, key):  # it is in the elements
                inside = [getattr(element, key) for element in array]
                return inside.index(step.key[1]) if step.key[1] in inside else -1
            names = list(getattr(owner, key))
            if step.key[1] not in names:
                raise BagError(
                    f"{self}: '{step.key[0]}' has no '{step.key[1]}'; it has: {', '.join(names)}"
                )
            place = names.index(step.key[1])
        else:
            assert step.index is not None
            place = step.index
        if place >= len(array):
            raise BagError(f"{self}: '{step.field}' has {len(array)} elements")
        return place

    def _element(self, step: Step, fields: Any, owner: str, types: Typestore) -> FieldDesc:
        """The type of `step`, with its index applied."""
        found: FieldDesc = fields[step.field]
        if found[0] not in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            if step.picks:
                raise BagError(
                    f"{self}: '{step.field}' on '{owner}' is {_describe(found)}, not an array; "
                    f"leave out {str(step)[len(step.field) :]}"
                )
            return found
        element, length = found[1]
        if not step.picks:
            raise BagError(
                f"{self}: '{step.field}' on '{owner}' is an array; name one element, "
                f"e.g. {step.field}[0]"
            )
        if found[0] == Nodetype.ARRAY and step.index is not None and step.index >= int(str(length)):
            raise BagError(
                f"{self}: '{step.field}' on '{owner}' has {length} elements, "
                f"[0] to [{int(str(length)) - 1}]"
            )
        if step.key is not None:
            inside = {} if element[0] != Nodetype.NAME else fields_of(str(element[1]), types)
            if inside.get(step.key[0]) != (Nodetype.BASE, ("string", 0)):
                self._check_key(step.key[0], step.field, fields, owner)
        return element

    def _check_key(self, key: str, field: str, fields: Any, owner: str) -> None:
        names = [
            name
            for name in list(fields)[: list(fields).index(field)]
            if fields[name][0] in (Nodetype.ARRAY, Nodetype.SEQUENCE)
            and fields[name][1][0] == (Nodetype.BASE, ("string", 0))
        ]
        if key not in names:
            raise BagError(
                f"{self}: '{key}' on '{owner}' is not an array of strings before '{field}'; "
                f"there is: {', '.join(names) or 'none'}"
            )


def numeric_paths(
    msgtype: str, types: Typestore, *, depth: int = _MAX_DEPTH
) -> Iterator[tuple[str, str, tuple[tuple[str, str], ...]]]:
    """(field path, number type, (owner type, field) on the way) of every number in a message.

    An array is one path, with `[*]`; raises BagError if a type is not known.
    """
    for name, found in fields_of(msgtype, types).items():
        is_array = found[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE)
        element: Any = found[1][0] if is_array else found
        path = f"{name}[*]" if is_array else name
        if element[0] == Nodetype.BASE:
            if element[1][0] not in ("string", "wstring") and name != NO_FIELD:
                yield path, str(element[1][0]), ((msgtype, name),)
        elif depth:
            for inner, kind, owners in numeric_paths(str(element[1]), types, depth=depth - 1):
                yield f"{path}.{inner}", kind, ((msgtype, name), *owners)


def quaternion_angle(angle: str, xyzw: FloatArray) -> FloatArray:
    """(N,) rad from (4, N) quaternions of any length; NaN where all four numbers are zero.

    Rotation by roll about x, then pitch about the fixed y, then yaw about the fixed z axis.
    Source: REP 103 for the order; J. Diebel, Representing Attitude (2006), equation 290.
    """
    x, y, z, w = xyzw
    square = x * x + y * y + z * z + w * w
    with np.errstate(invalid="ignore", divide="ignore"):
        if angle == "roll":
            found = np.arctan2(2 * (w * x + y * z), w * w - x * x - y * y + z * z)
        elif angle == "yaw":
            found = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
        else:
            found = np.arcsin(np.clip(2 * (w * y - z * x) / square, -1.0, 1.0))
    return np.where(square > 0.0, found, math.nan)


def _elements(before: Sequence[Step], step: Step, message: Any) -> list[Step]:
    for earlier in before:
        message = getattr(message, attribute(earlier.field))
        if earlier.index is not None:
            message = message[earlier.index]
    length = len(getattr(message, attribute(step.field)))
    return [Step(step.field, index, length=length) for index in range(length)]


def attribute(field: str) -> str:
    """The decoded message's attribute: both decoders append _ to a field that is a keyword."""
    return f"{field}_" if keyword.iskeyword(field) else field


def _describe(description: FieldDesc) -> str:
    if description[0] == Nodetype.NAME:
        return f"a '{description[1]}'"
    return f"a {description[1][0]}"
