"""`TubeRun`: a robot held against tubes around its model's own simulation, for as long as it runs.

Each tube has an observer, x̂⁺ = f(x̂, w) + L e, and a number, E⁺ = ρE + e'Re; the simulation x⁺ =
f(x, w) is common to them. A sample without a measurement is a step with e = 0, and nothing is said
of it. The simulation needs every input: where one is not known, as of a sample that never came, is
refused by the model or leaves the box, a new run starts. A level that follows the commands is a few
more numbers of state. Beside the tubes there may be CUSUM of the innovation, an alarm that nothing
rests on. Source: docs/certificate_tube.md.
"""

import copy
import math
from collections.abc import Sequence
from itertools import chain, repeat
from operator import add, gt, mul, sub, truediv
from typing import Any, NamedTuple

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, SolverError
from nlsid_core.funnels.factor import MOST_ROUNDING, STEPS, UNIT, refuse_coarse
from nlsid_core.funnels.level import CommandLevel, LevelMeter
from nlsid_core.funnels.tube import Tube, TubeFunnel
from nlsid_core.models import StableModel
from nlsid_core.running.detectors import CusumMeter
from nlsid_core.running.forecast import OUTWARD, Forecast, linear_form, reach
from nlsid_core.running.grid import OTHER_PACE, TOLERANCE, early
from nlsid_core.running.reading import Level, Reading, Status, Trend, unsaid
from nlsid_core.running.stepping import Rows, Stepper

FOLLOW = 0.1  # part of a stamp's error by which the next one is expected later: clocks drift
ROUNDING = 1e-9  # relative, of |o| and of E beside a half-width and a level
TINY, LEAST = 1e-100, 1e-300  # g, and what it makes, where no command opens a level: not 0
STARTING = "waiting for the first"
PACE = 0.01  # of what a gap is too long, by which the mean follows: over some 100 samples
COARSE = "float64 cannot tell where the simulation is"
BEYOND = "commanded beyond training"
CLEARLY = 0.01  # of the range in training, by which a command is beyond it
WATCHED = "watched as well, not needed for the tube's sentence"


class TubeRun:
    """Samples (t, y, u) of one run against a funnel of its model; `update` once per sample.

    lags: samples that start a run. Raises DataError on a funnel that is not one of the model.
    """

    def __init__(self, model: StableModel, funnel: TubeFunnel) -> None:
        self._stepper = Stepper(model)
        self.period, self.lags = model.period, funnel.settling
        if self.lags < self._stepper.lags:
            raise DataError(f"a run of this model starts after {self._stepper.lags} samples")
        self._tubes = tubes = funnel.tubes
        p, n = len(self._stepper.y), self._stepper.order
        if any(tube.L.shape != (n, p) for tube in tubes):
            raise DataError("the funnel is not one of this model")
        self._limits = list(map(Limits.of, tubes))
        self._follow: dict[int, CommandLevel] = {
            j: tube.follows for j, tube in enumerate(tubes) if tube.follows is not None
        }
        if any(level.inputs > len(self._stepper.u) for level in self._follow.values()):
            raise DataError("the funnel's level follows inputs that the model does not have")
        self._trained: Rows = [] if funnel.commands is None else funnel.commands.tolist()
        if self._trained and len(self._trained) != len(self._stepper.u):
            raise DataError("the funnel's commands are not those of this model")
        self._cusum = funnel.cusum
        self._deviation = [] if self._cusum is None else self._cusum.deviation.tolist()
        self._signals = (*self._stepper.y, *self._stepper.u)
        self._names = [signal.name for signal in self._stepper.y]
        y_box, u_box = funnel.y_box, funnel.u_box
        self._box: tuple[Rows, Rows, Rows] | None = None  # of outputs, inputs and states
        if y_box is not None and u_box is not None:
            self._box = y_box.tolist(), u_box.tolist(), y_box.tolist() * (n // p)
        self._assuming = assuming(tubes)
        self._linear, self._reach = linear_form(model), np.zeros((0, len(tubes), p))
        self._carried = self._linear.carried if self._linear is not None else None
        self.restart()

    def restart(self) -> None:
        """A new run."""
        self._due = self._last = math.nan
        self._pace = 0.0  # by what part samples come more slowly than they should, on average
        self._begin()

    def _begin(self, why: str = "") -> None:
        """Collect a start again; the grid of time goes on. why: what ended the run before it."""
        self._ended = why
        self._start: list[tuple[list[float], list[float]]] = []
        self._x: Rows | None = None  # of each observer, and of the simulation
        self._spent = [0.0] * len(self._tubes)
        self._largest = [0.0] * self._stepper.order
        self._hidden = [[0.0] * len(self._names) for _ in self._tubes]
        self._k = 0
        self._meters = {j: LevelMeter(level) for j, level in self._follow.items()}
        self._g = [1.0] * len(self._tubes)
        self._u_before: list[float] | None = None
        self._beyond = ""
        alarm = self._cusum
        self._sums = None if alarm is None else CusumMeter(len(self._names), alarm.drift)
        self._trend = Trend()

    def update(self, t: float, y: Any, u: Any) -> Reading:
        """What is said of the sample at t (s): outputs y (p,) and inputs u (n_u,), or numbers.

        NaN, or None for u, is a sample without a measurement.
        """
        measured = _floats(y)
        applied = [math.nan] * len(self._stepper.u) if u is None else _floats(u)
        if fault := self._take(t):
            return self._unknown(t, measured, fault)
        if fault := self._fault(t, measured, applied):
            return self._unknown(t, measured, self._without(t, applied, fault) or fault)
        self._compare_with_training(t, applied)
        if self._x is None:
            return self._collect(t, measured, applied)
        return self._judge(t, measured, applied)

    def missing(self, t: float, reason: str, *, doubted: bool = False) -> Reading:
        """The reading at t (s) where no sample came; the run goes on with the next one.

        doubted: the last sample may not be the robot's: a new run starts.
        """
        if doubted:
            self._begin(reason)
        return Reading(t, Status.UNKNOWN, reason=reason)

    def unmeasured(self, t: float, u: Any, reason: str) -> Reading:
        """The reading at t (s) where nobody measured the outputs: a step with e = 0 under u."""
        nothing = [math.nan] * len(self._names)
        fault = self._take(t) or self._without(t, _floats(u), reason)
        return self._unknown(t, nothing, fault or reason)

    def forecast(self, u: FloatArray) -> Forecast:
        """What the outputs can be under the inputs u (h, n_u) of the next samples.

        By a second simulation from the present estimate, and by the tubes; the run goes on as if it
        were not there.
        """
        if len(u) > len(self._reach):
            self._reach = np.stack(
                [reach(t, self._linear, 2 * len(u)) for t in self._tubes], axis=1
            )
        x, stepper = self._x or [], self._stepper.ahead()
        g, meters = self._g, copy.deepcopy(self._meters)
        ended = "" if x else "no run has begun"
        found: list[tuple[FloatArray, FloatArray]] = []
        rho, spent = np.array([limits.rho for limits in self._limits]), np.array(self._spent)
        total = np.zeros(len(rho))
        for now, reached in zip(u.tolist() if x else [], self._reach, strict=False):
            outputs, x, ended = self._advance(stepper, x, now)
            g = _followed(meters, g, now)
            limits = list(map(Limits.at, self._limits, g))
            spent = rho * spent
            total = rho * total + np.maximum(g, 1.0)
            level, most = (
                np.array([getattr(each, name) for each in limits]) for name in ("level", "single")
            )
            left = np.minimum(
                level * (1.0 + OUTWARD) - spent * (1.0 - OUTWARD), most * total * (1.0 + OUTWARD)
            )
            lasting = self._lasting(self._k + len(found) + 1)
            if not (lasting and (left[lasting] >= 0.0).all()):
                ended = ended or "what the tube assumes is broken, or over"
            if ended:
                break
            widths = np.array([each.widths for each in limits])
            centres = np.vstack([np.array(outputs)[lasting], [outputs[-1]] * len(lasting)])
            room = np.vstack([np.sqrt(left[lasting, None] * reached[lasting]), widths[lasting]])
            room = room * (1.0 + OUTWARD) + np.tile(
                np.array(self._hides(outputs[-1]))[lasting], (2, 1)
            )
            found.append(((centres - room).max(axis=0), (centres + room).min(axis=0)))
        bounds = np.reshape(found, (len(found), 2, len(self._names)))
        t = self.period * np.arange(1, len(found) + 1)
        return Forecast(t, bounds[:, 0], bounds[:, 1], ended)

    def _take(self, t: float) -> str:
        """Count the sample stamped t; a new run starts where some before it did not come."""
        if not math.isfinite(t):
            return f"stamp is {t}"
        if math.isnan(self._due):
            self._due = t
        late = (t - self._due) / self.period
        if not math.isfinite(late):
            return f"stamp is {t}"
        lost = round(late)
        if lost < 0:
            return early(t, self._last, self.period)
        if self._last < t:
            since = (t - self._last) / self.period
            self._pace += PACE * (since - max(1, round(since)) - self._pace)
        if abs(late - lost) > TOLERANCE:
            self._due, self._last = t + self.period, t
            off = (
                f"the sample at t = {t:g} s is {late - lost:+.2g} periods of {self.period:g} s off "
                f"the grid; {TOLERANCE:g} are allowed"
            )
            self._begin(off)
            return f"{off}; a new run starts"
        self._last = t
        self._due += (lost + 1) * self.period + FOLLOW * (late - lost) * self.period
        if abs(self._pace) > OTHER_PACE:
            mean = (1.0 + self._pace) * self.period
            paced = f"samples come every {mean:.5g} s on average, not every {self.period:g} s"
            self._begin(paced)
            return f"{paced}, at t = {t:g} s"
        if lost:
            missing = "1 sample is" if lost == 1 else f"{lost} samples are"
            self._begin(f"{missing} missing before t = {t:g} s")
        return ""

    def _fault(self, t: float, y: list[float], u: list[float]) -> str:
        if len(y) != len(self._names) or len(u) != len(self._stepper.u):
            return f"{len(y)} outputs and {len(u)} inputs at t = {t:g} s"
        for value, signal in zip((*y, *u), self._signals, strict=True):
            if not math.isfinite(value):
                return f"no {signal.name} at t = {t:g} s ({unsaid(value)}): nothing is claimed"
        return ""

    def _compare_with_training(self, t: float, u: list[float]) -> None:
        """Remember the first input that leaves the range or the pace that it had in training."""
        signals, before = self._stepper.u, self._u_before or u
        self._u_before = u
        for signal, now, last, (least, most, fastest) in zip(
            signals, u, before, self._trained, strict=False
        ):
            room, change = CLEARLY * (most - least), abs(now - last)
            inside = least - room <= now <= most + room
            if self._beyond or (inside and change <= fastest + room):
                continue
            said = f"changed by {change:.4g} in a sample" if inside else f"{now:.4g}"
            trained = f"{least:.4g} to {most:.4g}, changes to {fastest:.4g}"
            self._beyond = (
                f"; {BEYOND} from t = {t:g} s on: {signal.name} {said}, in training {trained}"
            )

    def _without(self, t: float, u: list[float], fault: str) -> str:
        """A step with e = 0 under the input u at t (s), or a new run if that is not known.

        fault: why nothing was measured. Why the model ends the run, empty if it does not.
        """
        known = len(u) == len(self._stepper.u) and all(map(math.isfinite, u))
        if self._x is None or not known:
            self._begin(fault)
            return ""
        self._compare_with_training(t, u)
        _, after, refused = self._advance(self._stepper, self._x, u)
        if refused:
            self._begin(refused)
            return refused
        self._x, self._k = after, self._k + 1
        self._spent = [of.rho * spent for of, spent in zip(self._limits, self._spent, strict=True)]
        self._g = _followed(self._meters, self._g, u)
        return ""

    def _collect(self, t: float, y: list[float], u: list[float]) -> Reading:
        if self._box is not None and not _within([u], self._box[1]):
            away = f"outside the box in which the tube is proved, at t = {t:g} s"
            self._begin(away)
            return self._unknown(t, y, away)
        self._g = _followed(self._meters, self._g, u)
        self._start.append((y, u))
        if len(self._start) >= self.lags:
            ys, us = (np.array(part) for part in zip(*self._start, strict=True))
            self._x = [self._stepper.begin(ys, us).tolist()] * (len(self._tubes) + 1)
            self._start = []
        why = f" of a new run: {self._ended}" if self._ended else ""
        return self._unknown(t, y, f"{STARTING} {self.lags} samples{why}")

    def _advance(self, stepper: Stepper, x: Rows, u: list[float]) -> tuple[Rows, Rows, str]:
        """Outputs and next states, and why there are none or nothing is known of them."""
        try:
            outputs, after = stepper.advance_few(x, u)
        except (DataError, SolverError) as error:
            return x, x, str(error)
        if self._box is not None and not all(map(_within, (outputs, [u], x), self._box)):
            return outputs, after, "outside the box in which the tube is proved"
        return outputs, after, ""

    def _judge(self, t: float, y: list[float], u: list[float]) -> Reading:
        assert self._x is not None
        outputs, after, refused = self._advance(self._stepper, self._x, u)
        if refused:
            refused = f"{refused}, at t = {t:g} s"
            self._begin(refused)
            return self._unknown(t, y, f"{refused}; a new run starts")
        g = self._g = _followed(self._meters, self._g, u)
        limits = list(map(Limits.at, self._limits, g)) if self._follow else self._limits
        *predicted, simulated = outputs
        deviation = list(map(sub, y, simulated))
        innovations = [list(map(sub, y, each)) for each in predicted]
        self._spent = list(map(Limits.spend, limits, self._spent, innovations))
        hidden = self._hides(simulated)
        away = list(map(Limits.sizes, limits, repeat(deviation), hidden))
        self._x = [*map(Limits.corrected, limits, after, innovations), after[-1]]
        self._k += 1
        followed = all(map(math.isfinite, g))
        if not (followed and all(map(math.isfinite, chain(self._spent, simulated, *self._x)))):
            what = "the model's state" if followed else "the level that follows the commands"
            reason = f"{what} is not finite at t = {t:g} s"
            self._begin(reason)
            if all(map(math.isfinite, simulated)) and max(map(max, away)) > 1.0:
                return Reading(
                    t,
                    Status.OUTSIDE,
                    -math.inf,
                    math.inf,
                    0.0,
                    measured=tuple(y),
                    level=Level.NONE,
                    reason=f"outside the tube; {reason}",
                )
            return self._unknown(t, y, reason)
        for hides, each in zip(hidden, limits, strict=True):
            if not max(map(truediv, hides, each.widths)) <= MOST_ROUNDING:
                most, least = f"{max(hides):.2g}", f"{min(each.widths):.2g}"
                return self._unknown(
                    t,
                    y,
                    f"{COARSE}: rounding can hide {most} beside a half-width of {least}, at t = "
                    f"{t:g} s",
                )
        alarm = self._alarm(innovations[0])
        lasting = self._lasting(self._k)
        if not lasting:
            over = f"the proof covers {self._tubes[0].samples} samples; they are over"
            return self._unknown(t, y, over)._replace(alarm=alarm)
        nearest = max(lasting, key=lambda j: max(away[j]))
        size = max(away[nearest])
        share, reason = self._used(t, lasting, limits, innovations)
        status = Status.ASSUMPTION_VIOLATED if reason else Status.INSIDE
        if not size <= 1.0:
            status = Status.OUTSIDE
            kept = "although the assumption was kept: what runs is not what was proved"
            reason = f"outside the tube; {reason}" if reason else f"outside {kept}"
        moved = [limits[j].widths for j in lasting] if self._follow else []
        return Reading(
            t,
            status,
            1.0 - size,
            share,
            self._trend.exit_after(t, 1.0 - size),
            self._names[away[nearest].index(size)],
            tuple(simulated),
            tuple(y),
            Level.TUBE if size <= 1.0 else Level.NONE,
            reason,
            self._assuming + self._beyond,
            [*deviation, *innovations[0]],
            alarm,
            tuple(map(min, zip(*moved, strict=True))),
        )

    def _used(
        self, t: float, lasting: list[int], limits: "list[Limits]", innovations: Rows
    ) -> tuple[float, str]:
        """The largest share that is used of the lasting tubes' assumptions; what is exceeded."""
        spent, most = max((self._spent[j] / limits[j].level, j) for j in lasting)
        peak, sharpest = max((limits[j].sharpest(innovations[j]), j) for j in lasting)
        used = max(spent, peak)
        if not spent <= 1.0:
            unit = self._tubes[most].energy_unit(self._stepper.y)
            return used, (
                f"innovation energy {self._spent[most]:.4g}{unit} above the level "
                f"{limits[most].level:.4g}{unit} at t = {t:g} s"
            )
        if not peak <= 1.0:
            assumed = self._tubes[sharpest].peak
            beside = "" if assumed is not None and assumed.direct.any() else f" ({WATCHED})"
            return used, (
                f"one sample's innovation is {math.sqrt(peak):.4g} times what is "
                f"assumed{beside}, at t = {t:g} s"
            )
        return used, ""

    def _hides(self, simulated: list[float]) -> list[list[float]]:
        """(tubes, p) what rounding can hide of the outputs' distance from these simulated (p,)."""
        assert self._x is not None
        reached = list(map(abs, self._x[-1]))
        if any(map(gt, reached, self._largest)):
            largest = np.maximum(self._largest, 1.1 * np.array(reached))  # so that this is seldom
            none = np.zeros(len(simulated))
            hidden = np.array([tube.hidden(largest, none) for tube in self._tubes])
            if self._linear is not None and self._carried is not None:
                hidden = np.minimum(hidden, self._carried @ self._linear.rounded(largest))
            hidden[np.isnan(hidden)] = math.inf  # of states near the largest float
            self._largest, self._hidden = largest.tolist(), hidden.tolist()
        own = [STEPS * UNIT * abs(each) for each in simulated]
        return [list(map(add, each, own)) for each in self._hidden]

    def _alarm(self, innovation: list[float]) -> str:
        """What CUSUM says of the first observer; empty if it does not alarm."""
        cusum, sums = self._cusum, self._sums
        if cusum is None or sums is None:
            return ""
        reached = sums.update(list(map(truediv, innovation, self._deviation)))
        if reached <= cusum.threshold:
            return ""
        return (
            f"cusum alarm: the innovations add up to {reached:.4g} standard deviations on one "
            f"side, above {cusum.threshold:.4g}; nothing is proved of this"
        )

    def _lasting(self, k: int) -> list[int]:
        """The tubes whose proof covers k samples."""
        return [j for j, tube in enumerate(self._tubes) if k <= (tube.samples or k)]

    def _unknown(self, t: float, y: list[float], reason: str) -> Reading:
        return Reading(t, Status.UNKNOWN, measured=tuple(y), reason=reason)


def refuse_far(model: StableModel, funnel: TubeFunnel, trials: Dataset) -> None:
    """DataError if a run on such trials (y, u) could not be judged in float64."""
    for trial in trials:
        refuse_coarse(np.spacing(np.abs(trial.y).max(axis=0)), funnel.half_widths, trial.name)
        run = TubeRun(model, funnel)
        for k in range(min(len(trial), run.lags + 1)):
            reading = run.update(k * model.period, trial.y[k], trial.u[k])
        if reading.reason.startswith(COARSE):
            raise DataError(f"{trial.name}: {reading.reason}; measure from a place nearby")


class Limits(NamedTuple):
    """What one tube's samples are held against, as floats; all is rounded towards an alarm.

    columns: of L. up: by what e'Re is multiplied, so that it is never below its exact value. peak:
    (p,), and single: the most that one sample spends under it; inf where nothing is assumed of one
    sample.
    """

    rho: float
    columns: Rows
    R: Rows
    up: float
    level: float
    peak: list[float]
    single: float
    widths: list[float]

    @classmethod
    def of(cls, tube: Tube) -> "Limits":
        """Those of a tube."""
        R, p = tube.R, len(tube.R)
        spread = float(np.linalg.norm(np.abs(R), 2) * np.linalg.norm(np.linalg.inv(R), 2))
        peak = np.full(p, math.inf) if tube.peak is None else tube.peak.at_most
        return cls(
            tube.rho * (1.0 + 8.0 * UNIT),
            tube.L.T.tolist(),
            R.tolist(),
            1.0 + 8.0 * (p * p + 4) * UNIT * spread,
            tube.level * (1.0 - ROUNDING),
            (peak * (1.0 - ROUNDING)).tolist(),
            math.inf if tube.peak is None else float(peak @ np.abs(R) @ peak),
            (tube.half_widths * (1.0 - ROUNDING)).tolist(),
        )

    def spend(self, spent: float, e: list[float]) -> float:
        """E after an innovation e."""
        weighted = [sum(map(mul, row, e)) for row in self.R]
        return self.rho * spent + self.up * float(sum(map(mul, weighted, e)))

    def corrected(self, after: list[float], e: list[float]) -> list[float]:
        """The observer's next state: the model's, and L e."""
        each = zip(self.columns, e, strict=True)
        first, *others = [list(map(mul, column, repeat(by))) for column, by in each]
        for other in others:
            first = list(map(add, first, other))
        return list(map(add, after, first))

    def sharpest(self, e: list[float]) -> float:
        """The largest of an innovation's squares beside what is assumed of one sample."""
        largest = max(map(abs, map(truediv, e, self.peak)))
        return float(largest * largest)

    def sizes(self, deviation: list[float], hidden: list[float]) -> list[float]:
        """(p,) how far out of the tube the outputs can be: 1 on its boundary."""
        return list(map(truediv, map(add, map(abs, deviation), hidden), self.widths))

    def at(self, g: float) -> "Limits":
        """Those where the commands give the level this much room."""
        room, sample = max(g, TINY), math.sqrt(max(g, 1.0))
        return self._replace(
            level=max(self.level * room, LEAST),
            peak=[each * sample for each in self.peak],
            widths=[max(each * math.sqrt(room), LEAST) for each in self.widths],
        )


def _followed(meters: dict[int, LevelMeter], g: list[float], u: list[float]) -> list[float]:
    """The factors of the tubes' levels at the next sample, whose inputs are u (n_u,)."""
    return [meters[j].update(u) if j in meters else each for j, each in enumerate(g)]


def _floats(values: Any) -> list[float]:
    """One number, or those of a vector."""
    if isinstance(values, (float, int)):  # a union would be made at every sample
        return [float(values)]
    return np.array(values, dtype=np.float64).ravel().tolist()


def _within(rows: Rows, box: Rows) -> bool:
    """Whether the numbers of every row are in the box: the least and the greatest of each."""
    return all(lo <= v <= hi for row in rows for v, (lo, hi) in zip(row, box, strict=True))


def assuming(tubes: Sequence[Tube]) -> str:
    """What they assume, in letters."""
    return "; ".join(tube.assumption for tube in tubes)
