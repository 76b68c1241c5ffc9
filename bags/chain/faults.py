"""Faulty copies of a bag: what a broken sensor would have recorded, to see that it is caught."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from bags.recordings.bag import Bag
from bags.recordings.message_types import decode, header_stamp_ns, is_stamped
from bags.recordings.writer import whole_bag
from bags.signals.signal import SignalPath
from bags.signals.timing import seconds
from nlsid_core.errors import BagError

Fault = Callable[[float, float], float]  # (s since the signal's first message, value) -> value


def scaled(_t: float, value: float) -> float:
    """The sensor reads 60 % of the truth."""
    return 0.6 * value


def held_at_zero(t: float, value: float) -> float:
    """The sensor reads zero from 1 s on."""
    return 0.0 if t >= 1.0 else value


FAULTS: Final[Mapping[str, Fault]] = {"scaled by 0.6": scaled, "zero after 1 s": held_at_zero}
ONSETS: Final[Mapping[str, float]] = {
    "scaled by 0.6": 0.0,
    "zero after 1 s": 1.0,
}  # s from the signal's first message


def write_faulty_copy(bag: Path | str, out: Path | str, signal: str, fault: Fault) -> None:
    """Copy `bag` to the new folder `out` with `fault` applied to one signal (`topic:field`).

    Raises BagError if the bag or the signal cannot be read, or if `out` exists.
    """
    path = SignalPath.parse(signal)
    with Bag(bag) as source:
        msgtype, types = source.types_on(path.topic)
        path.check(msgtype, types)
        if not is_stamped(msgtype, types):
            raise BagError(f"{bag}: messages on {path.topic} ({msgtype}) have no header stamp")
        first: int | None = None
        with whole_bag(out, custom=source.custom) as writer:
            for message in source.messages():
                data = message.data
                stamp = message.log_time_ns
                if message.topic == path.topic:
                    stamp = header_stamp_ns(data)
                    first = stamp if first is None else first
                    decoded = decode(data, msgtype, types)
                    path.assign(decoded, fault(seconds(stamp, first), path.value(decoded)))
                    data = bytes(types.serialize_cdr(decoded, msgtype))
                writer.write(
                    message.topic,
                    message.msgtype,
                    data,
                    log_time_ns=message.log_time_ns,
                    publish_time_ns=stamp,
                )
