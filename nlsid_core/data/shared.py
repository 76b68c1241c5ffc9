"""Samples that two trials share, whatever their files and stamps say.

One recording that was imported twice, or cut, has another digest but the same numbers. Trials are
compared where the responses change, so that rest says nothing: LEAST changes in a row with the same
responses, the same excitations and as many samples between them are no accident.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from nlsid_core.data.trajectory import Trajectory

LEAST: Final = 32  # changes of the responses in a row
CELL: Final = 1e-7  # of a signal's range: far above the rounding of a grid, far below noise
SHIFT: Final = 0.6180339887  # of a cell, so that round numbers are not on the border of one


@dataclass(frozen=True)
class SharedStretch:
    """`samples` consecutive samples from `start` of one trial on are those of `other` from its own.

    name, other: of the trials. start, other_start: s.
    """

    name: str
    start: float
    other: str
    other_start: float
    samples: int

    def __str__(self) -> str:
        return (
            f"{self.name} has {self.samples} samples from {self.start:g} s on that are the same as "
            f"those of {self.other} from {self.other_start:g} s on"
        )


def shared_stretch(
    others: Iterable[Trajectory], trials: Iterable[Trajectory]
) -> SharedStretch | None:
    """A stretch that one of `trials` shares with another of them or with one of `others`.

    All are on one grid. It sees copies whose offset is whole samples, not copies that were
    resampled elsewhere on the grid, scaled or had noise added. None if there is no such stretch.
    """
    first = len(others := tuple(others))
    every = (*others, *trials)
    values = [np.column_stack([trial.y, trial.u]) for trial in every]
    span = np.ptp(np.concatenate(values), axis=0)
    cell = CELL * np.where(span > 0.0, span, 1.0)
    codes = [np.floor(part / cell + SHIFT).astype(np.int64) for part in values]
    hashes, starts, owners = [], [], []
    for index, (trial, code) in enumerate(zip(every, codes, strict=True)):
        found, rows = _windows(code, trial.y.shape[1])
        hashes.append(found)
        starts.append(rows)
        owners.append(np.full(len(rows), index))
    window, begin, owner = (np.concatenate(part) for part in (hashes, starts, owners))
    order = np.argsort(window, kind="stable")  # of equal windows the calibration trials come last
    window, begin, owner = window[order], begin[order], owner[order]
    twice = (window[1:] == window[:-1]) & (owner[1:] != owner[:-1]) & (owner[1:] >= first)
    for i in np.flatnonzero(twice).tolist():
        one, two = int(owner[i + 1]), int(owner[i])
        own, at = int(begin[i + 1]), int(begin[i])
        back: int = min(own, at)
        before = _same(codes[one][own - back : own][::-1], codes[two][at - back : at][::-1])
        samples = before + _same(codes[one][own:], codes[two][at:])
        if samples >= LEAST:
            own, at = own - before, at - before
            return SharedStretch(
                every[one].name,
                float(every[one].t[own]),
                every[two].name,
                float(every[two].t[at]),
                samples,
            )
    return None


def _same(first: np.ndarray, second: np.ndarray) -> int:
    """How many rows are the same from the first on."""
    n = min(len(first), len(second))
    return int(np.argmin(np.append((first[:n] == second[:n]).all(axis=1), False)))


def _windows(code: np.ndarray, responses: int) -> tuple[np.ndarray, np.ndarray]:
    """A number for each LEAST changes of the responses in a row, and the row where they begin."""
    changes = 1 + np.flatnonzero((np.diff(code[:, :responses], axis=0) != 0).any(axis=1))
    if len(changes) < LEAST + 1:
        return np.zeros(0, dtype=np.uint64), np.zeros(0, dtype=np.int64)
    gaps = np.diff(changes)[:, None]
    rows = np.column_stack([code[changes[:-1]], gaps]).astype(np.uint64)
    weights = np.random.default_rng(0).integers(2**63, size=(2, max(LEAST, rows.shape[1])))
    odd = 2 * weights.astype(np.uint64) + 1
    mixed = (rows * odd[0, : rows.shape[1]]).sum(axis=1, dtype=np.uint64)
    mixed = (mixed ^ (mixed >> np.uint64(29))) * odd[0, 0]
    sums = sliding_window_view(mixed ^ (mixed >> np.uint64(32)), LEAST) @ odd[1, :LEAST]
    return sums, changes[: len(sums)]
