"""Where a run starts: the first outputs from which a model is nearest to its first samples.

Measured outputs are noisy, and a model that forgets slowly carries their noise along. So the first
outputs η are unknowns and data at once: with ŷ(η) the simulation from them, in units of each
output's deviation, |y - η|² over these and |y - ŷ(η)|² over the samples after them are minimised.
"""

from collections.abc import Callable

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import SolverError

STEPS = 10  # of Gauss and Newton; a model that is affine in its past outputs needs one
DIFFERENCE = 1e-4  # of an output's deviation
FOUND = 1e-6  # relative fall of the squared error, below which there is nothing left to gain

# First outputs (B, n, p) -> outputs (B, k, p) that begin with them.
Simulated = Callable[[FloatArray], FloatArray]


def nearest_start(simulated: Simulated, y: FloatArray, n: int) -> FloatArray:
    """The first outputs (n, p) whose simulation is nearest to the samples y (k, p), k >= n.

    The measured ones where there are no more samples, or no step comes nearer.
    """
    p = y.shape[1]
    start = y[:n]
    if n == 0 or len(y) == n:
        return start
    unit = np.maximum(y.std(axis=0), np.finfo(float).tiny)
    moves = DIFFERENCE * unit * np.eye(n * p).reshape(-1, n, p)
    moves = np.concatenate([np.zeros((1, n, p)), moves])
    least, tried = np.inf, start
    for _ in range(STEPS):
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                left = ((y - simulated(tried + moves)) / unit).reshape(len(moves), -1)
                error = float(left[0] @ left[0])
        except SolverError:
            break
        if not (np.isfinite(left).all() and error < least):
            break
        gained = least - error
        least, start = error, tried
        if gained <= FOUND * error:
            break
        slopes = (left[1:] - left[0]).T / DIFFERENCE
        step = np.linalg.lstsq(slopes, -left[0], rcond=None)[0]
        tried = start + unit * step.reshape(n, p)
    return start
