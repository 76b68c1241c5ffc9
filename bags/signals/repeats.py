"""Repeats of one excitation."""

from typing import Final

import numpy as np

from nlsid_core.arrays import FloatArray

LEAST: Final = 8  # samples; fewer say nothing


def same_excitation(first: FloatArray, second: FloatArray) -> bool:
    """Whether two recordings on one grid are of one excitation, up to their first samples' offset.

    They are if their lengths differ by at most 2 % and the common part by at most 5 % of its
    standard deviation: a step of another height is another excitation.
    """
    n = min(len(first), len(second))
    if n < LEAST or abs(len(first) - len(second)) > 0.02 * n + 1:
        return False
    a, b = first[:n], second[:n]
    close = float(np.sqrt(np.mean((a - b) ** 2))) <= 0.05 * float(max(a.std(), b.std()))
    return close and float(a.std()) > 0
