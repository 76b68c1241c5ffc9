"""Are claimed repeats of one experiment repeats? A test on the inputs and one on the responses.

With the same excitation and independent noise, the difference of two responses is noise: it does
not correlate with the excitation at any lag. The correlation of two independent stationary signals
has variance Σ_k ρ_d(k) ρ_u(k)/N (Bartlett); the largest over the lags is compared with the quantile
that all lags together exceed with probability LEVEL.
Source: Bartlett, "On the theoretical specification and sampling properties of autocorrelated
time-series", 1946; thesis assumptions (A1) and (A3).
"""

from itertools import combinations
from statistics import NormalDist

import numpy as np

from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError
from nlsid_core.identification.validation import cross_correlation

LEVEL = 1e-4  # probability of calling repeats different when they are not, per pair
INPUT_TOLERANCE = 0.05  # difference of the inputs over their spread: more is another excitation
LAGS = 20  # before and after, at which the response's difference is compared with the excitation
SHORTEST = 4 * LAGS  # samples: below, correlations at these lags mean nothing


def compare_repeats(first: Trajectory, second: Trajectory, *, transient: int = 0) -> str:
    """Say why two trials are not repeats, over their common samples after the first `transient`.

    Empty if nothing contradicts that they are. Raises DataError if they are shorter than SHORTEST
    samples or have a constant excitation.
    """
    N = min(len(first), len(second))
    if N - transient < SHORTEST:
        raise DataError(
            f"{first.name} and {second.name}: {N - transient} common samples; comparing repeats "
            f"needs {SHORTEST}"
        )
    rows = slice(transient, N)
    u, other = first.u[rows], second.u[rows]
    spread = u.std(axis=0)
    if not (spread > 0).all():
        raise DataError(f"{first.name}: a constant excitation; repeats of it cannot be compared")
    apart = float(np.max(np.sqrt(np.mean((u - other) ** 2, axis=0)) / spread))
    not_repeats = f"{first.name} and {second.name} are not repeats"
    if apart > INPUT_TOLERANCE:
        return (
            f"{not_repeats}: their excitations differ by {apart:.0%} of their spread (at most "
            f"{INPUT_TOLERANCE:.0%})"
        )
    difference = first.y[rows] - second.y[rows]
    crossed, deviation = cross_correlation([difference], [(u + other) / 2], LAGS)
    scores = np.abs(crossed) / deviation[:, :, None]
    lag = int(np.argmax(scores.max(axis=(0, 1)))) - LAGS
    limit = NormalDist().inv_cdf(1.0 - LEVEL / (2.0 * scores.size))
    if scores.max() <= limit:
        return ""
    return (
        f"{not_repeats}: the difference of their responses correlates with the excitation {lag} "
        f"samples before, {scores.max():.1f} standard deviations (chance explains {limit:.1f})"
    )


def refuse_false_repeats(data: Dataset, *, transient: int = 0) -> None:
    """Compare every pair of every group; DataError names the first pair that is not a repeat."""
    for members in data.repeats().values():
        for first, second in combinations(members, 2):
            if said := compare_repeats(first, second, transient=transient):
                raise DataError(said)
