"""Repeats of one excitation."""

from collections.abc import Iterable
from typing import Final

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Trajectory

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


def by_excitation(trials: Iterable[Trajectory]) -> list[list[Trajectory]]:
    """The trials of each excitation, in the order in which excitations come first.

    Trials with the same `group` are of one, and those whose inputs are the same.
    """
    found: list[list[Trajectory]] = []
    for trial in trials:
        known = next((same for same in found if _is_repeat(same[0], trial)), None)
        if known is None:
            found.append([trial])
        else:
            known.append(trial)
    return found


def _is_repeat(first: Trajectory, second: Trajectory) -> bool:
    if first.group or second.group:
        return first.group == second.group
    varying = [i for i in range(first.u.shape[1]) if np.ptp(first.u[:, i]) > 0.0]
    return bool(varying) and all(same_excitation(first.u[:, i], second.u[:, i]) for i in varying)
