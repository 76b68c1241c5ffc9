"""How an option of a frozen dataclass is checked when it is made: `OptionError` or nothing."""

from numbers import Real

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import DataError, OptionError


def require_whole(owner: object, key: str, low: int, high: int) -> None:
    """OptionError unless the option is a whole number from `low` to `high`."""
    value = getattr(owner, key)
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise OptionError(key, value, f"a whole number from {low} to {high}")


def require_one_of(owner: object, key: str, allowed: tuple[object, ...]) -> None:
    """OptionError unless the option is one of these."""
    value = getattr(owner, key)
    if value not in allowed:
        raise OptionError(key, value, f"one of {', '.join(map(str, allowed))}")


def require_delays(owner: object, key: str, most: int) -> None:
    """OptionError unless the option is None or some whole numbers from 0 to `most`."""
    value = getattr(owner, key)
    if value is not None and not (value and all(0 <= delay <= most for delay in value)):
        raise OptionError(key, value, f"one or more whole numbers from 0 to {most}")


def require_ranges(owner: object, key: str) -> None:
    """OptionError unless the option is None or some (low, high) with low < high."""
    value = getattr(owner, key)
    if value is not None and not (value and all(low < high for low, high in value)):
        raise OptionError(key, value, "one or more (low, high) with low < high")


def require_positive(owner: object, key: str) -> None:
    """OptionError unless the option is a finite number above 0."""
    value = getattr(owner, key)
    if not is_number(value) or not 0.0 < value < float("inf"):
        raise OptionError(key, value, "a finite number above 0")


def require_at_least(owner: object, key: str, least: float) -> None:
    """OptionError unless the option is a finite number that is not below `least`."""
    value = getattr(owner, key)
    if not is_number(value) or not least <= value < float("inf"):
        raise OptionError(key, value, f"a finite number, at least {least:g}")


def numbers(value: object, name: str) -> FloatArray:
    """The value as an array of float64; DataError unless it is made of real numbers."""
    try:
        if np.array(value).dtype.kind not in "USc":  # texts of digits are none
            return np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        pass
    raise DataError(f"{name} should be numbers, of one shape, is {value!r}")


def is_number(value: object) -> bool:
    """Whether it is one real number, of Python or of NumPy; True and False are none."""
    return isinstance(value, Real) and not isinstance(value, bool)
