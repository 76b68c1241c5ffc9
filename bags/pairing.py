"""The grid rule live: pair each response with the excitation that acted on it, as events arrive.

`bags.grid` does this on a recording; here messages come one by one and topics in any order. A
response stamped t is certain once every excitation has been seen at or after t (topics are in
order, so nothing older is still to come), or once the caller stops waiting.
"""

import math
from bisect import bisect_right, insort
from collections.abc import Sequence
from typing import Final, NamedTuple

HISTORY: Final = 2**16  # excitations kept while no response comes: a minute at 1 kHz


class Sample(NamedTuple):
    """A response and the excitations that were in force at its stamp (NaN: none yet)."""

    stamp_ns: int
    y: tuple[float, ...]
    u: tuple[float, ...]


class Pairing:
    """Pairs one response topic with the values of one or more excitations.

    Nothing is dropped silently. `late_excitations` counts those that came after a sample they are
    stamped before was released (the sample had an older one, or should have waited longer);
    `duplicate_responses` and `late_responses` count responses that could not be released, because
    their stamp was there already or a later one had been released.
    """

    def __init__(self, excitations: int = 1) -> None:
        self.late_excitations = 0
        self.late_responses = 0
        self.duplicate_responses = 0
        self._released_ns: int | None = None
        self._waiting: list[tuple[int, tuple[float, ...]]] = []
        self._histories = [_History() for _ in range(excitations)]

    def response(self, stamp_ns: int, y: Sequence[float]) -> list[Sample]:
        """Feed a response; the samples that are certain now, in order of stamps."""
        at = bisect_right(self._waiting, stamp_ns, key=_stamp)
        if stamp_ns == self._released_ns or (at and self._waiting[at - 1][0] == stamp_ns):
            self.duplicate_responses += 1
        elif self._released_ns is not None and stamp_ns < self._released_ns:
            self.late_responses += 1
        else:
            self._waiting.insert(at, (stamp_ns, tuple(y)))
        return self._release(self._certain_until())

    def excitation(self, stamp_ns: int, u: float, index: int = 0) -> list[Sample]:
        """Feed excitation number `index`; the samples that are certain now, in order of stamps."""
        if self._released_ns is not None and stamp_ns <= self._released_ns:
            self.late_excitations += 1
        self._histories[index].add(stamp_ns, u)
        return self._release(self._certain_until())

    def flush(self, until_ns: int) -> list[Sample]:
        """Stop waiting for responses stamped up to `until_ns`: release them with what is known."""
        return self._release(max(until_ns, self._certain_until()))

    def _certain_until(self) -> float:
        return min(history.newest_ns for history in self._histories)

    def _release(self, until_ns: float) -> list[Sample]:
        ready = bisect_right(self._waiting, until_ns, key=_stamp)
        samples = []
        for stamp_ns, y in self._waiting[:ready]:
            u = tuple(history.latest(stamp_ns) for history in self._histories)
            samples.append(Sample(stamp_ns, y, u))
            self._released_ns = stamp_ns
        del self._waiting[:ready]
        return samples


class _History:
    """The values of one excitation that may still be needed; of equal stamps the last counts."""

    def __init__(self) -> None:
        self.newest_ns: float = -math.inf
        self._values: list[tuple[int, float]] = []

    def add(self, stamp_ns: int, value: float) -> None:
        insort(self._values, (stamp_ns, value), key=_stamp)
        if len(self._values) > HISTORY:
            del self._values[0]
        self.newest_ns = max(self.newest_ns, stamp_ns)

    def latest(self, stamp_ns: int) -> float:
        """The value in force at `stamp_ns`; older ones are forgotten, as stamps only increase."""
        after = bisect_right(self._values, stamp_ns, key=_stamp)
        if not after:
            return math.nan
        del self._values[: after - 1]
        return self._values[0][1]


def _stamp(entry: tuple[int, object]) -> int:
    return entry[0]
