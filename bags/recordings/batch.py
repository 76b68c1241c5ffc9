"""A batch: messages of one topic, still serialised, in one buffer."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from nlsid_core.arrays import IntArray

BATCH_BYTES: Final = 4 * 2**20
BATCH_MESSAGES: Final = 4096


@dataclass(frozen=True, eq=False)
class Batch:
    """N messages in `buffer`, in the order of recording.

    start, size: (N,) bytes, where each message's data lie. log_ns, publish_ns: (N,) ns.
    sequence: (N,) as the recorder counted them, 0 where it did not.
    """

    buffer: bytes
    start: IntArray
    size: IntArray
    log_ns: IntArray
    publish_ns: IntArray
    sequence: IntArray

    def __len__(self) -> int:
        return len(self.start)

    def data(self, i: int) -> bytes:
        """Message i, serialised."""
        start = int(self.start[i])
        return self.buffer[start : start + int(self.size[i])]

    def select(self, rows: IntArray) -> "Batch":
        """The messages `rows` (indices or a mask), of the same buffer."""
        columns = (self.start, self.size, self.log_ns, self.publish_ns, self.sequence)
        return Batch(self.buffer, *(column[rows] for column in columns))


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
        for k in np.flatnonzero(log_ns < before):
            self.back.append((self._count + int(k), int(before[k]), int(log_ns[k])))
        self._newest[channel] = int(log_ns[-1])
        self._count += len(log_ns)


class BatchBuilder:
    """Collects single messages of one topic into batches of bounded size."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._log_ns: list[int] = []
        self._bytes = 0

    def add(self, data: bytes, log_ns: int) -> None:
        """Append one message, logged and published at `log_ns`."""
        self._parts.append(data)
        self._log_ns.append(log_ns)
        self._bytes += len(data)

    @property
    def full(self) -> bool:
        """Whether it is time to take the batch."""
        return self._bytes >= BATCH_BYTES or len(self._parts) >= BATCH_MESSAGES

    def take(self) -> Iterator[Batch]:
        """The batch collected so far, if there is one; collecting starts anew."""
        if not self._parts:
            return
        size = np.array([len(part) for part in self._parts], dtype=np.int64)
        start = np.concatenate([[0], np.cumsum(size)[:-1]])
        log_ns = np.array(self._log_ns, dtype=np.int64)
        buffer = b"".join(self._parts)
        self._parts, self._log_ns, self._bytes = [], [], 0
        yield Batch(buffer, start, size, log_ns, log_ns, np.zeros(len(size), dtype=np.int64))
