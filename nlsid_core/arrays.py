"""Array aliases used in signatures, and members of dataclasses that are arrays."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nlsid_core.errors import DataError, ShapeError

FloatArray: TypeAlias = NDArray[np.floating[Any]]  # float64 in fact; NumPy's stubs say less
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
Json: TypeAlias = dict[str, Any]

__all__ = [
    "ArrayLike",
    "BoolArray",
    "FloatArray",
    "IntArray",
    "Json",
    "freeze",
    "keep",
    "objects",
    "objects_at",
]


Shape: TypeAlias = tuple[int | None, ...]


def objects(entries: Sequence[object]) -> NDArray[Any]:
    """An array (n,) of these objects, arrays among them too."""
    array = np.empty(len(entries), dtype=object)
    array[:] = entries
    return array


def objects_at(shape: tuple[int, ...], entry: Callable[[tuple[int, ...]], object]) -> NDArray[Any]:
    """An array of this shape with the object that `entry` gives for each index."""
    array = np.empty(shape, dtype=object)
    for index in np.ndindex(*shape):
        array[index] = entry(index)
    return array


def freeze(owner: object, what: str, shapes: Mapping[str, Shape]) -> None:
    """Make members of a frozen dataclass read-only float64 copies of these shapes (None: any size).

    Raises ShapeError or DataError, in which `what` names the owner, if one does not fit or is not
    finite.
    """
    for name, shape in shapes.items():
        values = np.array(getattr(owner, name), dtype=np.float64)
        if values.ndim != len(shape) or any(
            size not in (None, given) for size, given in zip(shape, values.shape, strict=True)
        ):
            wanted = ", ".join("any" if size is None else str(size) for size in shape)
            raise ShapeError(f"{what}: {name} should have shape ({wanted}), has {values.shape}")
        if not np.isfinite(values).all():
            raise DataError(f"{what}: {name} holds NaN or infinity")
        keep(owner, {name: values})


def keep(owner: object, members: Mapping[str, NDArray[Any]]) -> None:
    """Set members of a frozen dataclass to these arrays, from now on read-only."""
    for name, values in members.items():
        values.setflags(write=False)
        object.__setattr__(owner, name, values)
