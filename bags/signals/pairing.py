"""The grid rule live: pair each response with the excitation that acted on it, as events arrive.

`bags.signals.grid` does this on a recording; here messages come one by one and topics in any order.
A response stamped t is certain once an excitation has been seen at or after t (a topic is in order,
so nothing older is still to come), or once the caller stops waiting.
"""

import math
from bisect import bisect_right, insort
from typing import Any, Final, NamedTuple

HISTORY: Final = 2**16  # excitations kept while no response comes: a minute at 1 kHz


class Sample(NamedTuple):
    """A response and the excitation that was in force at its stamp (NaN: none yet).

    Both are what was fed: numbers, or arrays of them.
    """

    stamp_ns: int
    y: Any
    u: Any


class Pairing:
    """Pairs the responses of one topic with the excitations of another.

    Nothing is dropped silently. `late` counts excitations that came after a sample stamped at or
    after them was released (it had an older one, or should have waited longer).
    `duplicate_responses` and `late_responses` count responses that could not be released, because
    their stamp was there already or a later one had been released.
    """

    def __init__(self) -> None:
        self.late = 0
        self.late_responses = 0
        self.duplicate_responses = 0
        self._released_ns = -math.inf
        self._newest_ns = -math.inf
        self._waiting: list[tuple[int, Any]] = []
        self._excitations: list[tuple[int, Any]] = []

    def response(self, stamp_ns: int, y: Any) -> list[Sample]:
        """Feed a response; the samples that are certain now, in order of stamps."""
        at = bisect_right(self._waiting, stamp_ns, key=_stamp)
        if stamp_ns == self._released_ns or (at and self._waiting[at - 1][0] == stamp_ns):
            self.duplicate_responses += 1
        elif stamp_ns < self._released_ns:
            self.late_responses += 1
        else:
            self._waiting.insert(at, (stamp_ns, y))
        return self._release(self._newest_ns)

    def excitation(self, stamp_ns: int, u: Any) -> list[Sample]:
        """Feed an excitation; the samples that are certain now, in order of stamps.

        Of two with one stamp the later one fed counts.
        """
        if stamp_ns <= self._released_ns:
            self.late += 1
        insort(self._excitations, (stamp_ns, u), key=_stamp)
        if len(self._excitations) > HISTORY:
            del self._excitations[0]
        self._newest_ns = max(self._newest_ns, stamp_ns)
        return self._release(self._newest_ns)

    def flush(self, until_ns: int | None = None) -> list[Sample]:
        """Stop waiting: release responses stamped up to `until_ns` (None: all) as things are."""
        return self._release(math.inf if until_ns is None else max(until_ns, self._newest_ns))

    def _release(self, until_ns: float) -> list[Sample]:
        ready = bisect_right(self._waiting, until_ns, key=_stamp)
        samples = [
            Sample(stamp_ns, y, self._held(stamp_ns)) for stamp_ns, y in self._waiting[:ready]
        ]
        if samples:
            self._released_ns = samples[-1].stamp_ns
            del self._waiting[:ready]
        return samples

    def _held(self, stamp_ns: int) -> Any:
        """The excitation in force; older ones are forgotten, as released stamps only increase."""
        after = bisect_right(self._excitations, stamp_ns, key=_stamp)
        if not after:
            return math.nan
        del self._excitations[: after - 1]
        return self._excitations[0][1]


def _stamp(entry: tuple[int, Any]) -> int:
    return entry[0]
