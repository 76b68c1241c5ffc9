"""The numbers of signals into a stamped message of their topic's type."""

from typing import Any

import numpy as np
from rclpy.clock import Clock

from bags.recordings.message_types import is_stamped
from bags.signals.signal import SignalPath
from bags.signals.vector import SignalVector
from nlsid_core.arrays import ArrayLike
from nlsid_core.errors import BagError
from nlsid_ros.message_classes import installed_types, message_class


class SignalMessage:
    """Makes messages of `msgtype` that carry numbers at `path`, e.g. a commanded speed.

    Raises BagError if the type has no header stamp or no number there.
    """

    def __init__(self, path: SignalPath | SignalVector, msgtype: str) -> None:
        path.check(msgtype, installed_types(msgtype))
        if not is_stamped(msgtype, installed_types(msgtype)):
            raise BagError(f"{msgtype} has no header stamp, so {path} could not be paired")
        self.path, self.kind = path, message_class(msgtype)
        self._paths = path.paths if isinstance(path, SignalVector) else (path,)

    def make(self, stamp_ns: int, values: ArrayLike) -> Any:
        """A message stamped `stamp_ns`; all that is not the signal is zero."""
        message = self.kind()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        for path, value in zip(
            self._paths, np.broadcast_to(values, len(self._paths)).tolist(), strict=True
        ):
            _make_room(path, message)
            path.assign(message, value)
        return message


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


def frame_of(message: Any) -> str:
    """The frame that a message is in, and the one that moves if it names it."""
    child = getattr(message, "child_frame_id", "")
    return f"{message.header.frame_id}, {child}" if child else str(message.header.frame_id)


def off_clock(stamp_ns: int, clock: Clock, most: float) -> str:
    """Why a stamp is not of now, give or take `most` s; empty if it is."""
    age = (clock.now().nanoseconds - stamp_ns) * 1e-9
    if abs(age) <= most:
        return ""
    way = "before" if age > 0 else "after"
    return f"a response is stamped {abs(age):.3g} s {way} this node's clock; {most:g} s are allowed"


def stamp_ns_of(message: Any) -> int:
    """The header stamp in ns."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)
