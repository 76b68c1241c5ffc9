"""The numbers of signals into a stamped message of their topic's type."""

import math
import re
import struct
import time
from collections.abc import Mapping
from copy import deepcopy
from functools import lru_cache
from typing import Any, Final

import numpy as np
from builtin_interfaces.msg import Time
from rclpy.exceptions import InvalidTopicNameException
from rclpy.serialization import serialize_message
from rclpy.validate_topic_name import validate_topic_name
from sensor_msgs.msg import JointState

from bags.recordings.cdr import ENCAPSULATION
from bags.recordings.message_types import is_stamped
from bags.signals.message_reader import SignalVector
from bags.signals.signal import SignalPath, numeric_paths
from nlsid_core import files
from nlsid_core.arrays import ArrayLike
from nlsid_core.errors import BagError, DocumentError
from nlsid_ros import qos
from nlsid_ros.message_classes import installed_types, message_class
from nlsid_ros.running import ManagedNode

_FLOATS: Final = re.compile(r"(sequence<)?(double|float)")
_STAMP: Final = struct.Struct("<iI")
_NAN: Final = struct.pack("<d", math.nan)
ZERO: Final = "zero"
REFUSED: Final = "refused"
OTHERS: Final = "zero, refused, a JSON object of fields, or a topic whose last message has them"
LEAST_PATIENCE: Final = 0.1  # s without a response,
PATIENT_PERIODS: Final = 4.0  # and of the design: a slow robot's come seldom
BASE_PATIENCE: Final = 0.5  # s without a command after which a base stops by itself
OTHERS_PATIENCE: Final = 1.0  # s without a message on that topic
SAID: Final = 6  # fields that are named


class SignalMessage:
    """Makes messages of `msgtype` that carry numbers at `path`, e.g. a commanded speed.

    others: what all other fields are: `zero`; `refused`, if there may be none; a JSON object of
    fields; or a topic of the same type, whose last message they are of (`listen`). Raises BagError
    if the type has no header stamp or no number there, or `others` does not fit it.
    """

    def __init__(self, path: SignalVector, msgtype: str, others: str = ZERO) -> None:
        types = installed_types(msgtype)
        path.check(msgtype, types)
        if not is_stamped(msgtype, types):
            raise BagError(f"{msgtype} has no header stamp, so {path} could not be paired")
        self.path, self.kind = path, message_class(msgtype)
        mine = {_plain(p) for p in path.paths}
        self.rest = [
            name
            for name, *_ in numeric_paths(msgtype, types)
            if _plain(name) not in mine and "[" not in name and not name.startswith("header.")
        ]
        self._base = other_fields(msgtype, others)
        self._topic = others if others.startswith("/") else ""
        self._heard, self._unfit = -math.inf, ""
        if others == REFUSED and self.rest:
            raise BagError(
                f"{msgtype} has fields that are not the signal ({self.rest_said}); say what "
                f"they are: others {OTHERS}"
            )
        self.is_zero = others == ZERO and bool(self.rest)

    @property
    def rest_said(self) -> str:
        """The fields that are not the signal, for people."""
        more = f" and {len(self.rest) - SAID} more" if len(self.rest) > SAID else ""
        return ", ".join(self.rest[:SAID]) + more

    def listen(self, node: ManagedNode) -> None:
        """Take the other fields from the topic that was named, or say that they are zero."""
        if self._topic:
            topic = node.signal_topic(self._topic)
            if topic == node.signal_topic(self.path.topic):
                raise BagError(f"others is {topic}, which the commands themselves are sent to")
            node.create_subscription(self.kind, topic, self._on_other, qos.SENSOR)
        elif self.is_zero:
            node.get_logger().warning(
                f"published as zero beside {self.path}: {self.rest_said} (parameter others: "
                f"{OTHERS})"
            )

    def _on_other(self, message: Any) -> None:
        """Take the fields of a message, if all that are numbers are finite; else keep those before,
        with which the robot is brought to rest.
        """
        numbers = {name: SignalPath.parse(f"/others:{name}").value(message) for name in self.rest}
        unfit = [
            f"{name} is {value}" for name, value in numbers.items() if not math.isfinite(value)
        ]
        self._unfit = f"on {self._topic}, {', '.join(unfit)}" if unfit else ""
        self._base, self._heard = self._base if unfit else message, time.monotonic()

    def lacking(self) -> str:
        """Why the other fields are not known, empty if they are."""
        if self._unfit:
            return self._unfit
        if not self._topic or time.monotonic() - self._heard <= OTHERS_PATIENCE:
            return ""
        return f"nothing on {self._topic} for {OTHERS_PATIENCE:g} s, which has the other fields"

    def make(self, stamp_ns: int, values: ArrayLike) -> Any:
        """A message stamped `stamp_ns`; all that is not the signal is as `others` says."""
        message = self.kind() if self._base is None else deepcopy(self._base)
        message.header.stamp = stamp_of(stamp_ns)
        numbers = np.broadcast_to(values, len(self.path.paths)).tolist()
        for path, value in zip(self.path.paths, numbers, strict=True):
            _make_room(path, message)
            path.assign(message, value)
        return message


def _plain(path: SignalPath | str) -> str:
    """A field without its topic and indices."""
    return re.sub(r"\[[^]]*\]", "", str(path).rpartition(":")[2])


def other_fields(msgtype: str, others: str) -> Any:
    """A message of `msgtype` with the constant fields of `others`; None if it states none.

    Raises BagError if it is not OTHERS, or a field is not of its type, or not finite.
    """
    if others.startswith("/"):
        try:
            validate_topic_name(others)
        except InvalidTopicNameException as error:
            raise BagError(f"others is no topic: {str(error).splitlines()[0]}") from error
    elif others.startswith("{"):
        source = f"others, fields of {msgtype}"
        try:
            content = files.parse_document(others, source=source)
        except DocumentError as error:
            raise BagError(str(error)) from error
        return _filled(message_class(msgtype), content, source)
    elif others not in (ZERO, REFUSED):
        raise BagError(f"others is '{others}'; it should be {OTHERS}")
    return None


def _filled(kind: Any, content: Any, source: str) -> Any:
    """A message of these fields."""
    if not isinstance(content, dict):
        raise BagError(f"{source}: {content!r} should be an object of its fields")
    known, empty, fields = kind.get_fields_and_field_types(), kind(), {}
    for name, value in content.items():
        if name not in known:
            raise BagError(f"{source}: there is no '{name}'; there are: {', '.join(known)}")
        part = getattr(empty, name)
        if hasattr(part, "get_fields_and_field_types"):
            fields[name] = _filled(type(part), value, f"{source}: {name}")
        else:
            fields[name] = _floats(value) if _FLOATS.match(known[name]) else value
    try:
        kind(check_fields=True, **fields)  # types, lengths, and ranges of numbers
    except (AssertionError, TypeError, ValueError, OverflowError) as error:
        raise BagError(f"{source}: {str(error).partition(' and each ')[0]}") from error
    return kind(**fields)


def _floats(value: Any) -> Any:
    """A whole number as the float that is meant, and so those in a list."""
    if isinstance(value, list):
        return list(map(_floats, value))
    return float(value) if type(value) is int else value


def _make_room(path: SignalPath, message: Any) -> None:
    """Lengthen the dynamic array on the way to the signal, if there is one."""
    owner = message
    for step in path.steps:
        part = getattr(owner, step.field)
        if step.index is not None:
            if len(part) <= step.index:
                setattr(owner, step.field, [*part, *[0.0] * (step.index + 1 - len(part))])
            return
        owner = part


def patience(stale_after: float, period: float) -> float:
    """s to wait for a response: as given, or where that is 0 some periods (s), not too few."""
    return stale_after or max(LEAST_PATIENCE, PATIENT_PERIODS * period)


def base_stopped(silent: float, period: float) -> bool:
    """Whether a base has stopped by itself, as no command of a period (s) went out for `silent` s:
    what moved it before would set it in motion again.
    """
    return silent > max(BASE_PATIENCE, PATIENT_PERIODS * period)


def off_clock(stamp_ns: int, clock_ns: int, most: float, what: str = "a response") -> str:
    """Why the stamp of `what` is not of now, `clock_ns`, give or take `most` s; empty if it is."""
    age = (clock_ns - stamp_ns) * 1e-9
    if abs(age) <= most:
        return ""
    if stamp_ns == 0:
        return f"{what} is stamped 0: its publisher does not fill in the time"
    way = "before" if age > 0 else "after"
    return f"{what} is stamped {abs(age):.3g} s {way} this node's clock; {most:g} s are allowed"


def stamp_of(stamp_ns: int) -> Time:
    """A stamp as messages have it."""
    sec, nanosec = divmod(stamp_ns, 10**9)
    return Time(sec=sec, nanosec=nanosec)


def numbers_at(stamp_ns: int, numbers: Mapping[str, float], frame: str = "") -> bytes:
    """A serialised JointState of named numbers at a stamp, as a publisher takes it."""
    blank, at = _blank(tuple(numbers), frame)
    data = bytearray(blank)
    _STAMP.pack_into(data, ENCAPSULATION, *divmod(stamp_ns, 10**9))
    struct.pack_into(f"<{len(numbers)}d", data, at, *numbers.values())
    return bytes(data)


@lru_cache(maxsize=16)
def _blank(names: tuple[str, ...], frame: str) -> tuple[bytes, int]:
    """A serialised JointState of these names, and where its positions are."""
    message = JointState(name=names, position=[math.nan] * len(names))
    message.header.frame_id = frame
    data = serialize_message(message)
    at = data.index(_NAN)  # which no text has
    # No velocity and no effort are 8 bytes; rclpy's message has bytes of memory after them.
    return data[: at + 8 * len(names) + 8], at


def stamp_ns_of(message: Any) -> int:
    """The header stamp in ns."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)
