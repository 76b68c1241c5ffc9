"""`Polynomial`: models that are polynomial equations between outputs and inputs."""

from dataclasses import dataclass
from typing import Literal, get_args

from nlsid_core.errors import DataError, OptionError
from nlsid_core.identification.methods.options import LeastSquares, Method, Rie, Rse, Sem
from nlsid_core.models.state_affine import OutOfRange
from nlsid_core.options import (
    require_delays,
    require_one_of,
    require_ranges,
    require_whole,
)

MOST_LAGS = 100
HIGHEST_DEGREE = 5  # in the inputs; the number of terms grows with that power of the inputs
CERTIFIABLE_DEGREE = 2  # of the newest output's coefficient: then two ends bound the hull
CERTIFIABLE_AFFINE = 1  # of every coefficient if the others depend on inputs too

Ranges = tuple[tuple[float, float], ...]
StableSet = Literal["2.11", "2.13", "2.19", "3.8"]


@dataclass(frozen=True)
class Degrees:
    """How high the powers in e(y(t)) = f(past outputs, inputs) go.

    left: of e, odd, 1 to 9. past: of f in past outputs, 1 to 5. inputs: of f in the inputs alone, 0
    to 5. leading: in the inputs, of the coefficient of y(t), 0 to 5. lagged: in the inputs, of the
    coefficients of past outputs, 0 to 5; in the sets of Chapter 2 above 0 is any product of past
    outputs and inputs up to the degree `past`.
    """

    left: int = 1
    past: int = 1
    inputs: int = 1
    leading: int = 0
    lagged: int = 0

    def __post_init__(self) -> None:
        require_one_of(self, "left", (1, 3, 5, 7, 9))  # an even e would not be increasing
        require_whole(self, "past", 1, HIGHEST_DEGREE)
        for key in ("inputs", "leading", "lagged"):
            require_whole(self, key, 0, HIGHEST_DEGREE)


@dataclass(frozen=True)
class Polynomial:
    """A polynomial equation of the newest output, past outputs and inputs.

    lags: n, 1 to 100 samples of past outputs. delays: of the inputs, each 0 to 100 samples (None: 0
    … n). degrees: of the equation, see `Degrees`.
    input_range: (low, high) of each input in its unit, where the model is proved (None: the range
    in the data, or everywhere in a set). output_range: the same of each output, for a set (None:
    everywhere). on_out_of_range: what the model does with an input beyond it, "clip" or "refuse".
    set: of stable models to search, by its number in the thesis: "2.11", "2.13" for one lag, "2.19"
    for linear models, "3.8" for equations that are monotone in y(t) and affine in the rest (None:
    for a linear left side those of Chapter 4, else "3.8" or "2.11", whichever has such equations).
    Raises OptionError, which names an option, its value and what is allowed, or DataError for a
    combination that no model can satisfy. Source: thesis (2.4), (2.7), (3.14), (4.1).
    """

    lags: int = 1
    delays: tuple[int, ...] | None = None
    degrees: Degrees = Degrees()
    input_range: Ranges | None = None
    output_range: Ranges | None = None
    on_out_of_range: OutOfRange = "clip"
    set: StableSet | None = None

    def __post_init__(self) -> None:
        require_whole(self, "lags", 1, MOST_LAGS)
        require_delays(self, "delays", MOST_LAGS)
        require_ranges(self, "input_range")
        require_ranges(self, "output_range")
        require_one_of(self, "on_out_of_range", get_args(OutOfRange))
        require_one_of(self, "set", (None, *get_args(StableSet)))
        if self.form == "3.8":
            self._refuse_curved()
        elif self.form:
            self._refuse_outside_the_set()
        elif self.delays is not None:
            require_delays(self, "delays", self.lags)

    @property
    def form(self) -> StableSet | None:
        """The set that is searched; None for equations that are linear in every output."""
        if self.set is not None or self.degrees.left == 1:
            return self.set
        d = self.degrees
        affine = (d.left, d.past, d.inputs, d.leading, d.lagged) == (3, 1, 1, 0, 0)
        everywhere = self.input_range is None and self.output_range is None
        return "3.8" if affine and everywhere else "2.11"

    @property
    def is_linear(self) -> bool:
        """No option but the lags is set, so that with one input it is a difference equation."""
        return self == Polynomial(self.lags)

    @property
    def box(self) -> Ranges | None:
        """(low, high) of every output, then every input, where a set holds; None: everywhere."""
        if self.output_range is None or self.input_range is None:
            return None
        return (*self.output_range, *self.input_range)

    @property
    def methods(self) -> tuple[Method, ...]:
        """Those for such models, the default first."""
        if self.form == "3.8":
            return (Rie(), LeastSquares(), Sem(), Sem(certified=True))
        if self.form:
            return (Rie(), LeastSquares(), Sem(certified=True))
        found = (Rse(), LeastSquares(), Sem(), Rse(certified=True), Sem(certified=True))
        lagged, leading = self.degrees.lagged, self.degrees.leading
        most = CERTIFIABLE_AFFINE if lagged else CERTIFIABLE_DEGREE
        return found if max(lagged, leading) <= most else found[:3]

    @property
    def comparators(self) -> tuple[Method, ...]:
        """Those that run beside what is asked for, because they are quick."""
        if self.is_linear:
            return (LeastSquares(), Rse(), Sem())
        return (LeastSquares(), Rie()) if self.form else (LeastSquares(), Rse())

    def window(self, inputs: int) -> tuple[tuple[int, int], ...]:
        """(input, delay) of each entry of w."""
        delays = tuple(range(self.lags + 1)) if self.delays is None else self.delays
        return tuple((i, d) for d in delays for i in range(inputs))

    @property
    def history(self) -> int:
        """Samples before the first row."""
        return max(self.lags, *(self.delays or (0,)))

    def _refuse_curved(self) -> None:
        """Only e may be curved."""
        d = self.degrees
        if d.left > 3:
            raise OptionError("left", d.left, "1 or 3 in set 3.8")
        if (d.past, d.inputs, d.leading, d.lagged) != (1, 1, 0, 0):
            raise DataError("set 3.8 has equations that are affine in past outputs and inputs")

    def _refuse_outside_the_set(self) -> None:
        """Combinations that no model of Chapter 2 has."""
        d, name = self.degrees, self.form
        if self.lags > 1 and name != "2.11":
            raise DataError(f"set {name} is for 1 lag; 2.11 is for more")
        if d.leading or d.inputs == 0:
            raise DataError(f"set {name} has no factor of y(t) that depends on inputs, which f has")
        if (self.input_range is None) != (self.output_range is None):
            raise DataError(f"set {name} needs input_range and output_range, or neither")
        everywhere = self.output_range is None
        if name == "2.19" and ((d.left, d.past) != (1, 1) or not everywhere):
            raise DataError("set 2.19 is linear: degrees left 1 and past 1, and no ranges")
        if everywhere:
            self._refuse_growth()

    def _refuse_growth(self) -> None:
        """Without a box f must not grow faster than the set allows."""
        d, growth = self.degrees, 2 * (self.degrees.past - 1)  # of |f - f̂|² for one gap
        if d.lagged:
            raise DataError("a product of outputs and inputs is stable in ranges only: give them")
        if d.past > 1 and self.form == "2.11":
            raise DataError(f"degree {d.past} in past outputs needs ranges in set 2.11")
        if d.left < growth + 1:
            raise DataError(
                f"degree {d.past} in past outputs needs the degree left {growth + 1}, or ranges in "
                f"set {self.form}, not {d.left}"
            )
