"""Array aliases used in signatures."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
Json: TypeAlias = dict[str, Any]

__all__ = ["ArrayLike", "FloatArray", "IntArray", "Json"]
