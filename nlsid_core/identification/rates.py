"""How slowly a model may forget: the slowest rate that a search allows, and why.

Within a trial of N samples a time constant of more than N samples cannot be told from an
integrator: the trial is explained as well by a pole at 1, and longer trials are explained by
neither. So unless it is given the slowest rate is exp(-1/N) a sample of the longest training trial.
"""

import math

from nlsid_core.data.trajectory import Dataset

ROOM = 1.1  # of 1 - rate, that a search keeps so that an exact proof is not slower


def rate_of_memory(train: Dataset, trials: float = 1.0) -> float:
    """The rate whose time constant is so many times the longest trial."""
    return math.exp(-1.0 / (trials * max(map(len, train))))


def searched_rate(max_rate: float) -> float:
    """The rate that a search keeps, so that its model is proved at `max_rate` or faster."""
    return max(1.0 - ROOM * (1.0 - max_rate), 0.5 * max_rate)
