"""Array aliases used in signatures, and members of dataclasses that are arrays."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nlsid_core.errors import DataError

FloatArray: TypeAlias = NDArray[np.floating[Any]]  # float64 in fact; NumPy's stubs say less
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
Json: TypeAlias = dict[str, Any]

__all__ = ["ArrayLike", "BoolArray", "FloatArray", "IntArray", "Json", "freeze"]


def freeze(owner: object, what: str, names: tuple[str, ...]) -> None:
    """Make members of a frozen dataclass read-only float64 copies; DataError if not finite."""
    for name in names:
        values = np.array(getattr(owner, name), dtype=np.float64)
        if not np.isfinite(values).all():
            raise DataError(f"{what}: {name} holds NaN or infinity")
        values.setflags(write=False)
        object.__setattr__(owner, name, values)
