"""A signal's number into a stamped message of its topic's type."""

from typing import Any

from bags.recordings.message_types import is_stamped, standard_types
from bags.signals.signal import SignalPath
from nlsid_core.errors import BagError
from nlsid_ros.message_classes import message_class


class SignalMessage:
    """Makes messages of `msgtype` that carry one number at `path`, e.g. a commanded speed.

    Raises BagError if the type has no header stamp or no number there.
    """

    def __init__(self, path: SignalPath, msgtype: str) -> None:
        path.check(msgtype, standard_types())
        if not is_stamped(msgtype, standard_types()):
            raise BagError(f"{msgtype} has no header stamp, so {path} could not be paired")
        self.path, self.kind = path, message_class(msgtype)

    def make(self, stamp_ns: int, value: float) -> Any:
        """A message stamped `stamp_ns`; all that is not the signal is zero."""
        message = self.kind()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        owner = message
        for step in self.path.steps:
            part = getattr(owner, step.field)
            if step.index is not None:
                if len(part) <= step.index:  # a dynamic array has to be long enough first
                    setattr(owner, step.field, [0.0] * (step.index + 1))
                break
            owner = part
        self.path.assign(message, value)
        return message


def stamp_ns_of(message: Any) -> int:
    """The header stamp in ns."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)
