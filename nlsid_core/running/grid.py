"""`Grid`: which sample a stamp is, held against the run's start and not against the last stamp."""

import math

TOLERANCE = 0.25  # of a period: a stamp this far off the grid is still that sample
OTHER_PACE = 0.01  # of the period: two clocks differ by a tenth of it


def early(t: float, last: float, period: float) -> str:
    """What is wrong with a sample at t that came before it was due, after one at `last` (all s)."""
    if t > last:
        return (
            f"the sample at t = {t:g} s is {t - last:.3g} s after the one before; the model is one "
            f"of samples {period:g} s apart (another rate than the model's is resampled by "
            "grid.resample)"
        )
    return f"the sample at t = {t:g} s came a second time, or time went back"


class Grid:
    """Stamps of a run whose sample k is due at start + k·period (s); `k`: the next one's number.

    Without an announced start the first stamp is that of sample `first`. tolerance: of a period,
    how far off a later sample may be; infinite: they may come at any time, in order.
    """

    def __init__(self, period: float, *, first: int = 0, tolerance: float = TOLERANCE) -> None:
        self.period, self.first = period, first
        self._tolerance = tolerance * period
        self.begin()

    def begin(self, start: float | None = None, *, at: int | None = None) -> None:
        """A new run: `start`: s, the announced stamp of sample 0; at: the next sample's number."""
        self.start = math.nan if start is None else start
        self.k = self.first if at is None else at
        self._last = -math.inf if start is None or at is None else start

    def take(self, t: float) -> str:
        """Count the sample stamped t (s); why it is not the next one, empty if it is."""
        near = TOLERANCE * self.period if self.k == self.first else self._tolerance
        if self._last < t < math.inf and abs(t - self.start - self.k * self.period) <= near:
            self.k += 1
            self._last = t
            return ""
        if not math.isfinite(t):
            return f"stamp is {t}"
        if math.isnan(self.start):
            self.start = t - self.k * self.period
            return self.take(t)
        return self._fault(t)

    def _fault(self, t: float) -> str:
        if t <= self._last:
            return early(t, self._last, self.period)
        place = (t - self.start) / self.period
        seen = round(place)
        if abs(place - seen) > TOLERANCE:
            return (
                f"the sample at t = {t:g} s is {place - self.k:+.2g} periods of {self.period:g} s "
                f"from when the next one, sample {self.k}, is due; {TOLERANCE:g} are allowed"
            )
        if seen < self.k:
            return early(t, self._last, self.period)
        return f"sample {self.k} of the run is missing: sample {seen} is next, at t = {t:g} s"
