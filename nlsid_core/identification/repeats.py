"""Are claimed repeats of one experiment repeats? A test on the inputs and one on the responses.

With the same excitation and independent noise, the difference of two responses is noise: it does
not correlate with the excitation at any lag. The correlation of two independent stationary signals
has variance Σ_k ρ_d(k) ρ_u(k)/N (Bartlett); the largest over the lags is compared with the quantile
that all lags together exceed with probability LEVEL.
Source: Bartlett, "On the theoretical specification and sampling properties of autocorrelated
time-series", 1946; thesis assumptions (A1) and (A3).
"""

from dataclasses import dataclass
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


@dataclass(frozen=True)
class RepeatTest:
    """input_difference: rms over spread. correlation: the largest of the response difference with
    the excitation, in standard deviations, at `lag` samples; limit: what chance explains.
    """

    first: str
    second: str
    input_difference: float
    correlation: float
    lag: int
    limit: float

    @property
    def passed(self) -> bool:
        """True if nothing contradicts that these are repeats."""
        return self.input_difference <= INPUT_TOLERANCE and self.correlation <= self.limit

    def __str__(self) -> str:
        if self.input_difference > INPUT_TOLERANCE:
            return (
                f"{self.first} and {self.second} are not repeats: their excitations differ by "
                f"{self.input_difference:.0%} of their spread (at most {INPUT_TOLERANCE:.0%})"
            )
        if self.correlation > self.limit:
            return (
                f"{self.first} and {self.second} are not repeats: the difference of their "
                f"responses correlates with the excitation {self.lag} samples before, "
                f"{self.correlation:.1f} standard deviations (chance explains {self.limit:.1f})"
            )
        return f"{self.first} and {self.second}: nothing contradicts that they are repeats"


def compare_repeats(first: Trajectory, second: Trajectory, *, transient: int = 0) -> RepeatTest:
    """Compare two trials over their common samples, the first `transient` left out.

    Raises DataError if they are shorter than SHORTEST samples or have a constant excitation.
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
    input_difference = float(np.max(np.sqrt(np.mean((u - other) ** 2, axis=0)) / spread))
    difference = first.y[rows] - second.y[rows]
    crossed, deviation = cross_correlation([difference], [(u + other) / 2], LAGS)
    scores = np.abs(crossed) / deviation[:, :, None]
    lag = int(np.argmax(scores.max(axis=(0, 1)))) - LAGS
    limit = NormalDist().inv_cdf(1.0 - LEVEL / (2.0 * scores.size))
    correlation = float(scores.max())
    return RepeatTest(first.name, second.name, input_difference, correlation, lag, limit)


def refuse_false_repeats(data: Dataset, *, transient: int = 0) -> tuple[RepeatTest, ...]:
    """Compare every pair of every group; DataError names the first pair that is not a repeat."""
    tests = []
    for members in data.repeats().values():
        for first, second in combinations(members, 2):
            test = compare_repeats(first, second, transient=transient)
            if not test.passed:
                raise DataError(str(test))
            tests.append(test)
    return tuple(tests)
