"""A signal: one number in the messages of one topic, named `topic:field.path[index]`."""

import keyword
import re
from dataclasses import dataclass
from typing import Any, Final

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc
from rosbags.typesys.store import Typestore

from bags.message_types import fields_of
from nlsid_core.errors import BagError

_TOPIC: Final = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)
_STEP: Final = re.compile(r"([A-Za-z]\w*)(?:\[(\d{1,9})\])?", re.ASCII)
_FORM: Final = "a signal is written topic:field.path[index], e.g. /joint_states:position[0]"


@dataclass(frozen=True)
class Step:
    """One field on the way to the number, and an element of it if it is an array."""

    field: str
    index: int | None = None

    def __str__(self) -> str:
        return self.field if self.index is None else f"{self.field}[{self.index}]"


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
            raise BagError(f"'{text}' has no ':'; {_FORM}")
        if not _TOPIC.fullmatch(topic):
            raise BagError(f"'{topic}' in '{text}' is not an absolute topic name; {_FORM}")
        steps = []
        for part in path.split("."):
            match = _STEP.fullmatch(part)
            if not match:
                raise BagError(f"'{part}' in '{text}' is not a field; {_FORM}")
            steps.append(Step(match[1], None if match[2] is None else int(match[2])))
        return cls(topic, tuple(steps))

    def __str__(self) -> str:
        return f"{self.topic}:{'.'.join(map(str, self.steps))}"

    def check(self, msgtype: str, types: Typestore) -> None:
        """BagError unless messages of `msgtype` have a number here; it lists the fields they have.

        The length of a dynamic array is only known message by message: see `value`.
        """
        current: FieldDesc = (Nodetype.NAME, msgtype)
        for step in self.steps:
            if current[0] != Nodetype.NAME:
                raise BagError(f"{self}: {_describe(current)} has no field '{step.field}'")
            owner = str(current[1])
            fields = fields_of(owner, types)
            if step.field not in fields:
                raise BagError(
                    f"{self}: Field '{step.field}' does not exist on '{owner}'; "
                    f"it has: {', '.join(fields)}"
                )
            current = self._element(step, fields[step.field], owner)
        if current[0] == Nodetype.NAME:
            fields = fields_of(str(current[1]), types)
            raise BagError(
                f"{self} is {_describe(current)}, not a number; it has: {', '.join(fields)}"
            )
        if current[1][0] in ("string", "wstring"):
            raise BagError(f"{self} is {_describe(current)}, not a number")

    def value(self, message: Any) -> float:
        """The number in a decoded message of the checked type (of rosbags' or of rclpy).

        Raises BagError if a dynamic array is too short.
        """
        for step in self.steps:
            message = getattr(message, _attribute(step))
            if step.index is not None:
                if step.index >= len(message):
                    raise BagError(f"{self}: '{step.field}' has {len(message)} elements")
                message = message[step.index]
        return float(message)

    def assign(self, message: Any, value: float) -> None:
        """Put `value` in a decoded message's place of this signal; BagError as `value`."""
        self.value(message)
        *outer, last = self.steps
        for step in outer:
            message = getattr(message, _attribute(step))
            if step.index is not None:
                message = message[step.index]
        if last.index is None:
            setattr(message, _attribute(last), value)
        else:
            getattr(message, _attribute(last))[last.index] = value

    def _element(self, step: Step, found: FieldDesc, owner: str) -> FieldDesc:
        """The type of `step`, with its index applied."""
        if found[0] not in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            if step.index is not None:
                raise BagError(
                    f"{self}: '{step.field}' on '{owner}' is {_describe(found)}, not an array; "
                    f"leave out [{step.index}]"
                )
            return found
        element, length = found[1]
        if step.index is None:
            raise BagError(
                f"{self}: '{step.field}' on '{owner}' is an array; name one element, "
                f"e.g. {step.field}[0]"
            )
        if found[0] == Nodetype.ARRAY and step.index >= int(str(length)):
            raise BagError(
                f"{self}: '{step.field}' on '{owner}' has {length} elements, "
                f"[0] to [{int(str(length)) - 1}]"
            )
        return element


def _attribute(step: Step) -> str:
    """The decoded message's attribute: both decoders append _ to a field that is a keyword."""
    return f"{step.field}_" if keyword.iskeyword(step.field) else step.field


def _describe(description: FieldDesc) -> str:
    if description[0] == Nodetype.NAME:
        return f"a '{description[1]}'"
    return f"a {description[1][0]}"
