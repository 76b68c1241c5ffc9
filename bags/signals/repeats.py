"""Repeats of one excitation, found by correlation."""

from typing import Final

import numpy as np

from bags.signals.delays import correlation
from nlsid_core.arrays import FloatArray

SAME: Final = 0.98  # correlation from which two stretches are one excitation; noise lowers it
LEAST_PERIOD: Final = 8  # samples; a shorter one is the signal's own smoothness


def find_period(values: FloatArray) -> int | None:
    """The samples after which (N,) `values` repeat; None unless they do at least once, whole.

    The first peak of the autocorrelation, each lag normalised by the energy of its overlap, that
    reaches SAME after the first zero crossing.
    """
    x = values - values.mean()
    if len(x) < 2 * LEAST_PERIOD or not x @ x > 0:
        return None
    raw = correlation(x, x)
    energy = np.cumsum(x * x)
    head = energy[::-1]  # of x[:N - lag]
    tail = energy[-1] - np.concatenate([[0.0], energy[:-1]])  # of x[lag:]
    longest = len(x) // 2
    with np.errstate(invalid="ignore", divide="ignore"):
        r = (raw / np.sqrt(head * tail))[: longest + 1]
    crossed = np.flatnonzero(r < 0)
    start = max(LEAST_PERIOD, int(crossed[0]) if len(crossed) else len(r))
    above = np.flatnonzero(r[start:] >= SAME) + start
    if not len(above):
        return None
    run = above[: 1 + int(np.argmax(np.append(np.diff(above) > 1, True)))]
    return int(run[np.argmax(r[run])])


def same_excitation(first: FloatArray, second: FloatArray) -> bool:
    """Whether two recordings on one grid are of one excitation, up to their first samples' offset.

    They are if their lengths differ by at most 2 % and the common part correlates to SAME, values
    against values (not about the mean: a step of another height is another excitation).
    """
    n = min(len(first), len(second))
    if n < LEAST_PERIOD or abs(len(first) - len(second)) > 0.02 * n + 1:
        return False
    a, b = first[:n], second[:n]
    scale = max(float(np.abs(a).max()), float(np.abs(b).max()))
    if not scale > 0:
        return False
    close = float(np.sqrt(np.mean((a - b) ** 2))) <= 0.05 * float(max(a.std(), b.std()))
    return close and float(a.std()) > 0
