"""A signal with what is to be done to it, `/imu:orientation.yaw|unwrap|derivative(0.2 s)`.

The path is what `bags.signals.signal` reads; each operation after a `|` acts on the whole recording
of the signal, from left to right:

- `unit(U)`: the recorded number is in U. `to(U)`: convert it to U.
- `unwrap`: an angle in rad without jumps of a turn.
- `derivative(T s)`: d/dt by the stated filter, see `derivative`.
"""

import re
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from rosbags.typesys.store import Typestore

from bags.recordings.names import did_you_mean
from bags.signals.signal import ANGLES, QUATERNION, SignalPath, numeric_paths
from bags.signals.units import UNITS, conversion, implied_unit, per_second
from nlsid_core._types import FloatArray, IntArray
from nlsid_core.errors import BagError

OPERATIONS: Final = ("unit", "to", "unwrap", "derivative")
MIN_SAMPLES: Final = 3  # two give a slope without any smoothing
BLOCK: Final = 2**20  # samples of neighbourhoods laid side by side at once

_OPERATION: Final = re.compile(r"\s*([a-z]+)\s*(?:\(([^()|]{1,40})\))?\s*", re.ASCII)
_SECONDS: Final = re.compile(r"(\d+(?:\.\d*)?(?:e-?\d+)?)\s*(ms|s)", re.ASCII)


@dataclass(frozen=True)
class Operation:
    """One step after the path: its name and its argument, a unit or a time in s."""

    name: str
    unit: str = ""
    window: float = 0.0

    def __str__(self) -> str:
        argument = self.unit or (f"{self.window:g} s" if self.window else "")
        return f"{self.name}({argument})" if argument else self.name


@dataclass(frozen=True)
class Expression:
    """A path and the operations on it; `str` gives the text it is written as."""

    path: SignalPath
    operations: tuple[Operation, ...] = ()

    @classmethod
    def parse(cls, text: str) -> "Expression":
        """Read `path|operation|...`; BagError says what is wrong with it."""
        path, *operations = text.split("|")
        return cls(
            SignalPath.parse(path.rstrip() if operations else path),
            tuple(_operation(part, text) for part in operations),
        )

    def __str__(self) -> str:
        return "|".join(map(str, (self.path, *self.operations)))

    def of(self, path: SignalPath) -> "Expression":
        """The same operations on another path."""
        return replace(self, path=path)

    def unit(self, msgtype: str, types: Typestore) -> str:
        """The unit of the result ("" if nothing implies one); BagError if one cannot be converted.

        The path must fit `msgtype` (`SignalPath.check`).
        """
        unit = _path_unit(self.path, msgtype, types)
        for operation in self.operations:
            if operation.name == "unit":
                unit = operation.unit
            elif operation.name == "to":
                self._conversion(unit, operation.unit)
                unit = operation.unit
            elif operation.name == "derivative":
                unit = per_second(unit)
        return unit

    def apply(self, values: FloatArray, stamp_ns: IntArray, unit: str) -> FloatArray:
        """(N,) results from (N,) recorded values in `unit` at `stamp_ns` (N,), increasing."""
        for operation in self.operations:
            if operation.name == "unit":
                unit = operation.unit
            elif operation.name == "to":
                factor, shift = self._conversion(unit, operation.unit)
                values, unit = values * factor + shift, operation.unit
            elif operation.name == "unwrap":
                values = np.unwrap(values)
            else:
                try:
                    values = derivative(values, stamp_ns, operation.window)
                except BagError as error:
                    raise BagError(f"{self}: {error}") from error
                unit = per_second(unit)
        return values

    def recorded_unit(self, msgtype: str, types: Typestore) -> str:
        """The unit of the number at the path, before any operation."""
        return _path_unit(self.path, msgtype, types)

    def _conversion(self, of: str, to: str) -> tuple[float, float]:
        try:
            return conversion(of, to)
        except BagError as error:
            raise BagError(f"{self}: {error}") from error


def derivative(values: FloatArray, stamp_ns: IntArray, window: float) -> FloatArray:
    """(N,) per s: at each stamp the slope of the least-squares line through its neighbourhood.

    The neighbourhood is the samples within window/2 s on either side, so the filter has no delay;
    at a uniform rate it passes a frequency f with gain 3 (sin φ - φ cos φ)/φ³, φ = π f·window
    (-3 dB at 0.58/window, first zero at 1.43/window). It does without a uniform rate. Near the ends
    the neighbourhood is one-sided: there it is a line through that side, delayed by its half.

    Raises BagError if stamps do not increase, or where fewer than 3 samples are within the window.

    Source: A. Savitzky, M. Golay, Anal. Chem. 36 (1964) 1627, first derivative, order 2, for
    samples that need not be equidistant.
    """
    if len(values) and (np.diff(stamp_ns) <= 0).any():
        raise BagError("stamps do not increase, so there is no derivative")
    half_ns = round(window * 0.5e9)
    low = np.searchsorted(stamp_ns, stamp_ns - half_ns, side="left")
    high = np.searchsorted(stamp_ns, stamp_ns + half_ns, side="right")
    if len(few := np.flatnonzero(high - low < MIN_SAMPLES)):
        raise BagError(
            f"{high[few[0]] - low[few[0]]} samples within {window:g} s of message {few[0]}, "
            f"a slope needs {MIN_SAMPLES}; take a longer window"
        )
    slopes = np.empty(len(values))
    for count in np.unique(high - low):
        rows = np.flatnonzero(high - low == count)
        for block in np.array_split(rows, 1 + len(rows) * count // BLOCK):
            near = low[block, None] + np.arange(count)
            t = (stamp_ns[near] - stamp_ns[block, None]) / 1e9
            t -= t.mean(axis=1, keepdims=True)
            rise = values[near] - values[block, None]
            slopes[block] = (t * rise).sum(axis=1) / (t * t).sum(axis=1)
    return slopes


def _operation(part: str, text: str) -> Operation:
    match = _OPERATION.fullmatch(part)
    name = match[1] if match else part.strip()
    if match is None or name not in OPERATIONS:
        near = did_you_mean(name, OPERATIONS)
        raise BagError(f"'{part}' in '{text}' is not one of: {', '.join(OPERATIONS)}{near}")
    argument = (match[2] or "").strip()
    if name == "unwrap":
        if argument:
            raise BagError(f"'{part}' in '{text}': unwrap takes no argument")
        return Operation(name)
    if name == "derivative":
        seconds = _SECONDS.fullmatch(argument)
        window = float(seconds[1]) * UNITS[seconds[2]].scale if seconds else 0.0
        if not 0.0 < window < 1e6:
            raise BagError(
                f"'{part}' in '{text}': state the filter's window, e.g. derivative(0.2 s)"
            )
        return Operation(name, window=window)
    if name == "to" and argument not in UNITS:
        near = did_you_mean(argument, UNITS)
        raise BagError(f"'{part}' in '{text}': known units are {', '.join(UNITS)}{near}")
    if not argument:
        raise BagError(f"'{part}' in '{text}': state the unit, e.g. unit(rad)")
    return Operation(name, unit=argument)


def _path_unit(path: SignalPath, msgtype: str, types: Typestore) -> str:
    wanted = ".".join(step.field + ("[*]" if step.picks else "") for step in path.steps)
    paths = {found: owners for found, _, owners in numeric_paths(msgtype, types)}
    if wanted not in paths and path.steps[-1].field in ANGLES:
        return implied_unit([(QUATERNION, path.steps[-1].field)])
    return implied_unit(paths.get(wanted, ()))
