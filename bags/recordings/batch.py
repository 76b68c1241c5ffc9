"""A batch: messages of one topic, still serialised, in one buffer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from nlsid_core.arrays import IntArray
from nlsid_core.errors import BagError

Buffer = bytes | bytearray
BATCH_BYTES: Final = 4 * 2**20  # of messages that a file without chunks gives at once


@dataclass(frozen=True, eq=False)
class Batch:
    """N messages in `buffer`, in the order of recording.

    start, size: (N,) bytes, where each message's data lie. log_ns, publish_ns: (N,) ns.
    sequence: (N,) as the recorder counted them, 0 where it did not. unreadable: of messages that
    cannot be unpacked or translated, why.
    """

    buffer: Buffer
    start: IntArray
    size: IntArray
    log_ns: IntArray
    publish_ns: IntArray
    sequence: IntArray
    unreadable: Mapping[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.start)

    def data(self, i: int) -> bytes:
        """Message i, serialised; BagError if it is unreadable."""
        if i in self.unreadable:
            raise BagError(self.unreadable[i])
        start = int(self.start[i])
        return bytes(self.buffer[start : start + int(self.size[i])])

    def select(self, rows: IntArray) -> "Batch":
        """The messages `rows` (indices or a mask), of the same buffer."""
        columns = (self.start, self.size, self.log_ns, self.publish_ns, self.sequence)
        start, size, log_ns, publish_ns, sequence = (column[rows] for column in columns)
        return Batch(self.buffer, start, size, log_ns, publish_ns, sequence)


class LogOrder:
    """Whether the log times of one or several channels go back inside a file: a clock was set.

    back: for each place, how many messages are before it, the log time before it and at it (ns).
    Messages by log time would hide it: those of two times come in turn.
    """

    def __init__(self) -> None:
        self.back: list[tuple[int, int, int]] = []
        self._newest: dict[int, int] = {}
        self._count = 0

    def add(self, channel: int, log_ns: IntArray) -> None:
        """The next messages of a channel of one file: log_ns (N,), N > 0, as recorded."""
        before = np.concatenate([[self._newest.get(channel, log_ns[0])], log_ns[:-1]])
        self.back += [
            (self._count + int(k), int(before[k]), int(log_ns[k]))
            for k in np.flatnonzero(log_ns < before)
        ]
        self._newest[channel] = int(log_ns[-1])
        self._count += len(log_ns)


def batch_of(buffer: Buffer, start: IntArray, size: IntArray, log_ns: IntArray) -> Batch:
    """A batch whose messages have one time each, and were not counted."""
    return Batch(buffer, start, size, log_ns, log_ns, np.zeros(len(size), dtype=np.int64))


def joined(parts: Sequence[bytes], log_ns: Sequence[int] | IntArray) -> Batch:
    """A batch of single messages."""
    size = np.array([len(part) for part in parts], dtype=np.int64)
    return batch_of(b"".join(parts), np.cumsum(size) - size, size, np.array(log_ns, np.int64))
