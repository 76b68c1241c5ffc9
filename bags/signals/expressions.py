"""A signal with what is to be done to it, `/imu:orientation.yaw|unwrap|derivative(0.2 s)`.

The path is what `bags.signals.signal` reads. Operations after a `|` change the numbers,
from left to right, and use no later sample, so that a monitor gives the same numbers:

- `unit(U)`: the recorded number is in U. `to(U)`: convert it to U.
- `unwrap`: an angle without jumps of a turn, 360 where its unit is deg (see `unit`), else 2π; it
  begins within half a turn of 0.
- `derivative(T s)`: the slope over the last T s, see `derivative`.
- `washout(T s)`: what it moved, fading with time constant T.

These say when the signal is sampled (`bags.signals.sampling`):

- `clock(log)`: its stamps are the times of logging (live: of arrival), not the header's.
- `hold(T s)`: a sample takes the latest value, if that is at most T s old.
- `linear(T s)`: a sample is interpolated between values at most T s apart.
- `lag(T s)`: of what drives, a sample takes what a first-order lag of time constant T makes of the
  held values, beginning at the first of them.

What drives may be a product, `A * B`, of signals with operations of their own: the product of their
values in a sample.
"""

import math
import re
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from rosbags.typesys.store import Typestore

from bags.recordings.names import did_you_mean
from bags.signals.signal import SignalPath
from bags.signals.units import UNITS, conversion, implied_unit, per_second
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.errors import BagError

OPERATIONS: Final = (
    "unit",
    "to",
    "unwrap",
    "derivative",
    "washout",
    "clock",
    "hold",
    "linear",
    "lag",
)
TIMED: Final = ("derivative", "washout", "hold", "linear", "lag")  # these take a time
SAMPLING: Final = ("clock", "hold", "linear", "lag")
SIGNAL_CLOCKS: Final = ("header", "log")
TURNS: Final = {"deg": 360.0, "rev": 1.0}  # a whole turn by the number's unit; others are rad
LONGEST: Final = 1e6  # s, of a time behind a path
MIN_SAMPLES: Final = 3  # two give a slope without any smoothing
BLOCK: Final = 2**20  # samples of neighbourhoods laid side by side at once

_OPERATION: Final = re.compile(r"\s*([a-z]+)\s*(?:\(([^()|]{1,40})\))?\s*", re.ASCII)
_SECONDS: Final = re.compile(r"(\d+(?:\.\d*)?(?:e-?\d+)?)\s*(ms|s)", re.ASCII)
_TIMES: Final = re.compile(r"\s+\*\s+", re.ASCII)
MOST_FACTORS: Final = 4


@dataclass(frozen=True)
class Operation:
    """One step after the path: its name and its argument, a unit (or clock) or a time in s."""

    name: str
    unit: str = ""
    window: float = 0.0

    def __str__(self) -> str:
        seconds = repr(self.window).removesuffix(".0")
        argument = self.unit or (f"{seconds} s" if self.window else "")
        return f"{self.name}({argument})" if argument else self.name


@dataclass(frozen=True)
class Expression:
    """A path and the operations on it; `str` gives the text it is written as."""

    path: SignalPath
    operations: tuple[Operation, ...] = ()

    @classmethod
    @lru_cache(maxsize=256)
    def parse(cls, text: str) -> "Expression":
        """Read `path|operation|...`; BagError says what is wrong with it."""
        path, *parts = text.split("|")
        signal = SignalPath.parse(path.rstrip() if parts else path)
        operations = tuple(_operation(part, text) for part in parts)
        names = [operation.name for operation in operations]
        once = (("clock",), ("hold", "linear"), ("lag",))
        if any(sum(names.count(name) for name in group) > 1 for group in once):
            raise BagError(f"'{text}' says twice when the signal is sampled")
        if "lag" in names and "linear" in names:
            raise BagError(f"'{text}': a lag is of held values; leave out linear")
        return cls(signal, operations)

    def __str__(self) -> str:
        return "|".join(map(str, (self.path, *self.operations)))

    def operation(self, *names: str) -> Operation | None:
        """The one operation of these names, None if there is none."""
        return next((found for found in self.operations if found.name in names), None)

    @property
    def clock(self) -> str:
        """`header` or `log`; empty if the text does not say."""
        found = self.operation("clock")
        return "" if found is None else found.unit

    @property
    def numbers(self) -> "Expression":
        """The expression without what says when it is sampled."""
        kept = tuple(found for found in self.operations if found.name not in SAMPLING)
        return replace(self, operations=kept)

    def sampled(self, name: str, *, unit: str = "", window: float = 0.0) -> "Expression":
        """With one more operation that says when it is sampled, unless it says that already."""
        kinds = ("clock",) if name == "clock" else ("hold", "linear")
        if self.operation(*kinds) is not None:
            return self
        return replace(self, operations=(*self.operations, Operation(name, unit, window)))

    @property
    def washed_out(self) -> float | None:
        """T in s if each sample is a message and what it recorded washed out by `washout(T s)`.

        None where more was done to the number than units and `unwrap` before the washout: what a
        slope, or a signal that was washed out already, moved is no displacement.
        """
        steps = [found for found in self.operations if found.name not in ("unit", "to", "clock")]
        names = [found.name for found in steps if found.name != "unwrap"]
        return steps[-1].window if names == ["washout"] == [steps[-1].name] else None

    def unit(self, msgtype: str, types: Typestore) -> str:
        """The unit of the result ("" if nothing implies one); BagError if one cannot be converted.

        The path must fit `msgtype` (`SignalPath.check`).
        """
        return self.unit_of(self.recorded_unit(msgtype, types))

    def unit_of(self, unit: str) -> str:
        """The unit of the result of numbers recorded in `unit`; BagError as `unit`."""
        return self._steps(unit)[1]

    def apply(self, values: FloatArray, stamp_ns: IntArray, unit: str) -> FloatArray:
        """(N,) results from (N,) recorded values in `unit` at `stamp_ns` (N,), increasing.

        NaN where a derivative has too few samples before it.
        """
        for step in self._steps(unit)[0]:
            try:
                values = step.all(values, stamp_ns)
            except BagError as error:
                raise BagError(f"{self}: {error}") from error
        return values

    def running(self, unit: str) -> "Running":
        """The same, one message after the other, of numbers in `unit`."""
        return Running(self._steps(unit)[0])

    def _steps(self, unit: str) -> "tuple[list[_Step], str]":
        """What is done to numbers in `unit`, and the unit of the result."""
        steps: list[_Step] = []
        for operation in self.operations:
            if operation.name == "unit":
                unit = operation.unit
            elif operation.name == "to":
                steps.append(_Scaled(*self._conversion(unit, operation.unit)))
                unit = operation.unit
            elif operation.name == "unwrap":
                steps.append(_Unwrapped(turn_of(unit)))
            elif operation.name == "derivative":
                steps.append(_Slope(operation.window))
                unit = per_second(unit)
            elif operation.name == "washout":
                steps.append(_Washout(operation.window))
        return steps, unit

    def recorded_unit(self, msgtype: str, types: Typestore) -> str:
        """The unit of the number at the path, before any operation."""
        return implied_unit(self.path.check(msgtype, types))

    def _conversion(self, of: str, to: str) -> tuple[float, float]:
        try:
            return conversion(of, to)
        except BagError as error:
            raise BagError(f"{self}: {error}") from error


def factors(text: str) -> tuple[str, ...]:
    """The signals that `A * B` multiplies, one for a text without ` * `."""
    found = tuple(_TIMES.split(text.strip()))
    if len(found) > MOST_FACTORS:
        raise BagError(f"'{text}' has {len(found)} factors; at most {MOST_FACTORS} are read")
    return found if len(found) > 1 else (text,)


def product(texts: Iterable[str]) -> str:
    """The text whose `factors` these are."""
    return " * ".join(texts)


def parse_factors(text: str) -> tuple[Expression, ...]:
    """Each factor of a signal's text; BagError says what is wrong with one."""
    return tuple(Expression.parse(factor) for factor in factors(text))


class Running:
    """An expression's operations on one message after the other: bit for bit what `apply` gives."""

    def __init__(self, steps: "Sequence[_Step]") -> None:
        self._steps = steps

    @property
    def remembers(self) -> bool:
        """Whether a result depends on earlier messages, so that they have to come in order."""
        return any(not isinstance(step, _Scaled) for step in self._steps)

    def update(self, stamp_ns: int, value: float) -> float:
        """The result for the next message, NaN if too few came before it."""
        for step in self._steps:
            value = step.update(stamp_ns, value)
        return value


class _Step(ABC):
    """An operation on all numbers (N,) with their stamps at once, or on one after the other."""

    def all(self, values: FloatArray, stamp_ns: IntArray) -> FloatArray:
        found = map(self.update, stamp_ns.tolist(), values.tolist())
        return np.fromiter(found, np.float64, len(values))

    @abstractmethod
    def update(self, stamp_ns: int, value: float) -> float: ...


@dataclass
class _Scaled(_Step):
    factor: float
    shift: float

    def update(self, _stamp_ns: int, value: float) -> float:
        return value * self.factor + self.shift


class _Unwrapped(_Step):
    def __init__(self, turn: float) -> None:
        self._turn, self._turns, self._last = turn, 0.0, 0.0

    def update(self, _stamp_ns: int, value: float) -> float:
        if math.isfinite(step := (value - self._last) / self._turn):
            self._turns += round(step)
            self._last = value
        return value - self._turn * self._turns


class _Slope(_Step):
    def __init__(self, window: float) -> None:
        self._window = window
        self._window_ns = round(window * 1e9)
        self._first_ns: int | None = None
        self._near: deque[tuple[int, float]] = deque()

    def all(self, values: FloatArray, stamp_ns: IntArray) -> FloatArray:
        return derivative(values, stamp_ns, self._window)

    def update(self, stamp_ns: int, value: float) -> float:
        if self._first_ns is None:
            self._first_ns = stamp_ns
        near = self._near
        near.append((stamp_ns, value))
        while near[0][0] < stamp_ns - self._window_ns:
            near.popleft()
        if stamp_ns - self._first_ns < self._window_ns or len(near) < MIN_SAMPLES:
            return float("nan")
        stamps = np.array([stamp for stamp, _ in near], dtype=np.int64)
        values = np.array([value for _, value in near], dtype=np.float64)
        return float(_slopes(stamps[None] - stamp_ns, values[None])[0])


class _Washout(_Step):
    """What each step of the numbers added, fading with time constant `window` s.

    q = 0 at the first finite value p, then q⁺ = exp(-Δt/window) q + (p⁺ - p): a first-order high
    pass, -3 dB near 1/(2π window). What adds up its command for ever, a position, becomes a signal
    of a stable model. Nothing is lost: Σ q⁺ - exp(-Δt/window) q is p again, but for its start. NaN
    where the numbers are, which the next step bridges.

    Source: B. L. Stevens, F. L. Lewis, Aircraft Control and Simulation (washout filter).
    """

    def __init__(self, window: float) -> None:
        self._window_ns = window * 1e9
        self._last: tuple[int, float] | None = None
        self._moved = 0.0

    def all(self, values: FloatArray, stamp_ns: IntArray) -> FloatArray:
        _require_increasing(stamp_ns, "washout")
        return super().all(values, stamp_ns)

    def update(self, stamp_ns: int, value: float) -> float:
        if not math.isfinite(value):
            return float("nan")
        if self._last is not None:
            before_ns, before = self._last
            left = math.exp((before_ns - stamp_ns) / self._window_ns)
            self._moved = left * self._moved + (value - before)
        self._last = stamp_ns, value
        return self._moved


def derivative(values: FloatArray, stamp_ns: IntArray, window: float) -> FloatArray:
    """(N,) per s: at each stamp the slope of the least-squares line through the last `window` s.

    It uses nothing later, so a monitor can have it at once, and is delayed by window/2: at a
    uniform rate it passes a frequency f with gain 3 (sin φ - φ cos φ)/φ³, φ = π f·window (-3 dB at
    0.58/window, first zero at 1.43/window). It does without a uniform rate. NaN until the window
    is full, and where it has fewer than 3 samples.

    Raises BagError if stamps do not increase, or if no window has 3 samples.

    Source: A. Savitzky, M. Golay, Anal. Chem. 36 (1964) 1627, first derivative, order 2, for
    samples that need not be equidistant.
    """
    _require_increasing(stamp_ns, "derivative")
    window_ns = round(window * 1e9)
    low = np.searchsorted(stamp_ns, stamp_ns - window_ns, side="left")
    count = np.arange(1, len(stamp_ns) + 1) - low
    usable = (count >= MIN_SAMPLES) & (stamp_ns - stamp_ns[:1] >= window_ns)
    if not usable.any():
        most = int(count.max(initial=0))
        raise BagError(
            f"at most {most} samples within {window:g} s, a slope needs {MIN_SAMPLES} of them in "
            "a window that lies inside the recording; take another window"
        )
    slopes = np.full(len(values), np.nan)
    for width in np.unique(count[usable]):
        rows = np.flatnonzero(usable & (count == width))
        for block in np.array_split(rows, 1 + len(rows) * width // BLOCK):
            near = low[block, None] + np.arange(width)
            slopes[block] = _slopes(stamp_ns[near] - stamp_ns[block, None], values[near])
    return slopes


def _require_increasing(stamp_ns: IntArray, operation: str) -> None:
    if (np.diff(stamp_ns) <= 0).any():
        raise BagError(f"stamps do not increase, so there is no {operation}")


def _slopes(before_ns: IntArray, values: FloatArray) -> FloatArray:
    """(rows,) per s: slopes of the lines through `values` (rows, count) at `before_ns` from now."""
    t = before_ns / 1e9
    t -= t.mean(axis=1, keepdims=True)
    rise = values - values[:, -1:]
    return np.asarray((t * rise).sum(axis=1) / (t * t).sum(axis=1))


def turn_of(unit: str) -> float:
    """A whole turn in `unit`; numbers whose unit nobody states are in rad."""
    return TURNS.get(unit, 2.0 * np.pi)


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
    if name == "clock":
        if argument not in SIGNAL_CLOCKS:
            raise BagError(f"'{part}' in '{text}': clock(header) or clock(log)")
        return Operation(name, unit=argument)
    if name in TIMED:
        seconds = _SECONDS.fullmatch(argument)
        if seconds is None:
            raise BagError(f"'{part}' in '{text}': state a time, e.g. {name}(0.2 s)")
        window = float(seconds[1]) * UNITS[seconds[2]].scale
        if not 0.0 < window < LONGEST:
            raise BagError(f"'{part}' in '{text}': the time should be above 0 and below 1e6 s")
        return Operation(name, window=window)
    if name == "to" and argument not in UNITS:
        near = did_you_mean(argument, UNITS)
        raise BagError(f"'{part}' in '{text}': known units are {', '.join(UNITS)}{near}")
    if not argument:
        raise BagError(f"'{part}' in '{text}': state the unit, e.g. unit(rad)")
    return Operation(name, unit=argument)
