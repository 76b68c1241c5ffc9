"""Whether the messages of a signal come from several publishers, told from a recording alone.

A bag does not say who sent a message. Two publishers show in counts of what was sent that go back
and forth, and in values that jump from one curve to another and back: each curve is smooth, the two
together are not. Which message is on which curve the stamps say, as each publisher sends evenly; or
every second message is. Up to four that send in turn are told where their stamps are uneven. One
publisher that takes the place of another shows in none of these.
"""

from bisect import bisect_left
from typing import Final

import numpy as np

from nlsid_core.arrays import BoolArray, FloatArray, IntArray

WINDOW: Final = 48  # messages looked at together
LOOKS: Final = 200  # windows at most, evenly over the recording
BACK: Final = 3  # times a count goes back in a window; that of one that is restarted does once
EVEN: Final = 0.15  # of the time between messages of one publisher: it varies by less
UNEVEN: Final = 0.3  # of the median time between messages of all: it varies by more
LEAST: Final = 6  # messages of each publisher in a window
SMOOTH: Final = 10.0  # times less do squared second differences of the curves add up to; noise: 1
TURNS: Final = (2, 3, 4)  # publishers that send in turn
MOSTLY: Final = 0.5  # of the windows that move as much have two curves, where there are two
LONGER: Final = 1.5  # times as long; where one publisher is gone, messages come more seldom
DISTINCT: Final = 24  # values in a window; fewer are those of a coarse sensor, which flickers


def counted_in_turn(sequence: IntArray) -> str:
    """Say that the counts (N,) in messages as recorded are of several publishers; else empty.

    They are all equal, or 0, where none was recorded.
    """
    step = np.diff(sequence)
    back = np.flatnonzero((step < 0) | ((step == 0) & step.any() & (sequence[1:] > 0)))
    if not (back[BACK - 1 :] - back[: max(len(back) - BACK + 1, 0)] <= WINDOW).any():
        return ""
    return f"the counts in its messages do not rise {len(back)} times: several publishers send them"


def two_curves(stamp_ns: IntArray, values: FloatArray) -> str:
    """Say that measured values (N,), stamped in ns (N,), are on two curves; else empty."""
    back = np.count_nonzero(np.diff(stamp_ns) < 0)
    if len(values) < WINDOW or 0 < back < BACK:
        return ""  # too few to tell; or a clock was set, which is told elsewhere
    order = np.argsort(stamp_ns, kind="stable")
    step = max(WINDOW // 2, (len(values) - WINDOW) // LOOKS)
    starts = range(0, len(values) - WINDOW + 1, step)
    windows = [order[start : start + WINDOW] for start in starts]
    found = np.array([_has_two_curves(stamp_ns[rows], values[rows]) for rows in windows])
    if not found.any() or np.mean(found[_alike(stamp_ns, values, windows, found)]) < MOSTLY:
        return ""
    return (
        f"its values jump from one curve to another and back in {found.sum()} of {len(found)} "
        f"stretches of {WINDOW} messages: several publishers send them"
    )


def _alike(
    stamp_ns: IntArray, values: FloatArray, windows: list[IntArray], found: BoolArray
) -> BoolArray:
    """Windows that move as much as those with two curves, with messages about as often.

    Two publishers make two curves in most of these. One whose counter flickers between two numbers,
    or that rings at half its rate, does so now and then.
    """
    moved = np.array([np.ptp(values[rows]) for rows in windows])
    lasts = np.array([np.ptp(stamp_ns[rows]) for rows in windows])
    return np.asarray(
        (moved >= np.median(moved[found])) & (lasts <= LONGER * np.median(lasts[found]))
    )


def _has_two_curves(stamp_ns: IntArray, values: FloatArray) -> bool:
    """Whether two smooth curves make the values of one window, stamps ascending."""
    if len(np.unique(values)) < DISTINCT:
        return False
    together = _roughness(stamp_ns, values)
    return any(
        together > SMOOTH * sum(_roughness(stamp_ns[sender], values[sender]) for sender in senders)
        for senders in _ways_to_part(stamp_ns)
    )


def _roughness(stamp_ns: IntArray, values: FloatArray) -> float:
    """How far values are from the lines between their neighbours, squared and summed up.

    In time or in order, whichever is less: stamps may be those of arrival, in bursts.
    """
    share = np.diff(stamp_ns)[:-1] / np.maximum(stamp_ns[2:] - stamp_ns[:-2], 1)
    in_time = values[1:-1] - values[:-2] - share * (values[2:] - values[:-2])
    in_order = np.diff(values, 2) / 2.0
    return float(min(np.sum(in_time**2), np.sum(in_order**2)))


def _ways_to_part(stamp_ns: IntArray) -> list[list[BoolArray]]:
    """Which messages each publisher may have sent: evenly, or in turn."""
    first = _evenly_sent(stamp_ns)
    if first is not None:
        return [[first, ~first]]
    turns = TURNS[:1] if _is_even(stamp_ns, UNEVEN) else TURNS
    number = np.arange(len(stamp_ns))
    return [[number % turn == k for k in range(turn)] for turn in turns]


def _evenly_sent(stamp_ns: IntArray) -> BoolArray | None:
    """Which messages one publisher sent, if it and another did so evenly, and both did not.

    The time between its messages is that from the first or second message to one soon after it.
    """
    if _is_even(stamp_ns, UNEVEN):
        return None
    for start in (0, 1):
        for end in range(start + 1, start + LEAST + 1):
            mine = _every(stamp_ns, start, int(stamp_ns[end] - stamp_ns[start]))
            both = min(mine.sum(), (~mine).sum()) >= LEAST
            if both and _is_even(stamp_ns[mine], EVEN) and _is_even(stamp_ns[~mine], EVEN):
                return mine
    return None


def _every(stamp_ns: IntArray, start: int, period_ns: int) -> BoolArray:
    """The messages that come every `period_ns` from `start` on, until one is not in time."""
    mine = np.zeros(len(stamp_ns), dtype=bool)
    stamps, at = stamp_ns.tolist(), start
    while at < len(stamps):
        mine[at] = True
        due = stamps[at] + period_ns
        after = max(bisect_left(stamps, due), at + 1)
        near = [k for k in (after - 1, after) if at < k < len(stamps)]
        at = min(near, key=lambda k: abs(stamps[k] - due), default=len(stamps))
        if at < len(stamps) and abs(stamps[at] - due) > 3.0 * EVEN * period_ns:
            break
    return mine


def _is_even(stamp_ns: IntArray, most: float) -> bool:
    """Whether the times between messages are within `most` of their median, but for one in ten."""
    steps = np.diff(stamp_ns)
    median = float(np.median(steps))
    return float(np.quantile(np.abs(steps - median), 0.9)) <= most * median
