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
from typing import Any

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, SolverError
from nlsid_core.funnels.factor import MOST_ROUNDING, STEPS, UNIT, refuse_coarse
from nlsid_core.funnels.level import CommandLevel, LevelMeter
from nlsid_core.funnels.tube import Tube, TubeFunnel
from nlsid_core.models import StableModel
from nlsid_core.running.detectors import CusumMeter
from nlsid_core.running.forecast import OUTWARD, linear_form, reach
from nlsid_core.running.grid import OTHER_PACE, TOLERANCE, early
from nlsid_core.running.reading import Level, Reading, Status, Trend, unsaid
from nlsid_core.running.stepping import Stepper

FOLLOW = 0.1  # part of a stamp's error by which the next one is expected later: clocks drift
ROUNDING = 1e-9  # relative, of |o| and of E beside a half-width and a level
TINY = 1e-100  # g where no command opens a level: its square root times a width is a number
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
        # Products and sums are rounded up, so that E is never below its exact value.
        self._rho = np.array([tube.rho for tube in tubes]) * (1.0 + 8.0 * UNIT)
        self._R = np.array([tube.R for tube in tubes])
        spread = max(
            np.linalg.norm(np.abs(R), 2) * np.linalg.norm(np.linalg.inv(R), 2) for R in self._R
        )
        self._up = 1.0 + 8.0 * (p * p + 4) * UNIT * float(spread)
        self._single_R = self._R[:, 0, 0] * self._up if p == 1 else None
        self._L = np.array([tube.L for tube in tubes])
        self._level = np.array([tube.level for tube in tubes]) * (1.0 - ROUNDING)
        unwatched = np.full(p, math.inf)
        peaks = [unwatched if tube.peak is None else tube.peak.at_most for tube in tubes]
        self._peak = np.array(peaks) * (1.0 - ROUNDING)
        self._single = np.array(
            [
                math.inf
                if tube.peak is None
                else tube.peak.at_most @ np.abs(tube.R) @ tube.peak.at_most
                for tube in tubes
            ]
        )
        self._widths = np.array([tube.half_widths for tube in tubes]) * (1.0 - ROUNDING)
        self._unmoved = np.ones(len(tubes))
        self._follow: dict[int, CommandLevel] = {
            j: tube.follows for j, tube in enumerate(tubes) if tube.follows is not None
        }
        if any(level.inputs > len(self._stepper.u) for level in self._follow.values()):
            raise DataError("the funnel's level follows inputs that the model does not have")
        self._trained = funnel.commands
        if self._trained is not None and len(self._trained) != len(self._stepper.u):
            raise DataError("the funnel's commands are not those of this model")
        self._cusum = funnel.cusum
        self._signals = (*self._stepper.y, *self._stepper.u)
        self._names = [signal.name for signal in self._stepper.y]
        y_box, u_box = funnel.y_box, funnel.u_box
        self._box: tuple[FloatArray, FloatArray, FloatArray] | None = None
        if y_box is not None and u_box is not None:
            self._box = y_box.T, u_box.T, np.tile(y_box, (n // p, 1)).T
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
        self._start: list[tuple[FloatArray, FloatArray]] = []
        self._x: FloatArray | None = None
        self._spent = np.zeros(len(self._tubes))
        self._largest, self._hidden = np.zeros(self._stepper.order), np.zeros_like(self._widths)
        self._k = 0
        self._meters = {j: LevelMeter(level) for j, level in self._follow.items()}
        self._g: dict[int, float] = {}
        self._u_before: FloatArray | None = None
        self._beyond = ""
        alarm = self._cusum
        self._sums = None if alarm is None else CusumMeter(len(self._names), alarm.drift)
        self._trend = Trend()

    def update(self, t: float, y: Any, u: Any) -> Reading:
        """What is said of the sample at t (s): outputs y (p,) and inputs u (n_u,), or numbers.

        NaN, or None for u, is a sample without a measurement.
        """
        if u is None:
            u = np.full(len(self._stepper.u), np.nan)
        measured = np.array(y, dtype=np.float64, ndmin=1)  # copies: the caller may go on with its
        applied = np.array(u, dtype=np.float64, ndmin=1)  # own
        fault = self._take(t)
        if fault:
            return self._unknown(t, measured, fault)
        fault = self._fault(t, measured, applied)
        if fault:
            return self._unknown(t, measured, self._without(applied, fault) or fault)
        self._beyond = self._beyond or self._beyond_training(t, applied)
        self._u_before = applied
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
        nothing = np.full(len(self._names), np.nan)
        fault = self._take(t) or self._without(np.array(u, dtype=np.float64, ndmin=1), reason)
        return self._unknown(t, nothing, fault or reason)

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

    def _fault(self, t: float, y: FloatArray, u: FloatArray) -> str:
        if y.shape != (len(self._names),) or u.shape != (len(self._stepper.u),):
            return f"{y.shape} outputs and {u.shape} inputs at t = {t:g} s"
        values = (*y.tolist(), *u.tolist())
        for value, signal in zip(values, self._signals, strict=True):
            if not math.isfinite(value):
                return f"no {signal.name} at t = {t:g} s ({unsaid(value)}): nothing is claimed"
        return ""

    def _beyond_training(self, t: float, u: FloatArray) -> str:
        """Which input leaves the range or the pace that it had in training; empty if none does."""
        if self._trained is None:
            return ""
        change = np.abs(u - (u if self._u_before is None else self._u_before))
        least, most, fastest = self._trained.T
        room = CLEARLY * (most - least)
        out = (u < least - room) | (u > most + room) | (change > fastest + room)
        if not out.any():
            return ""
        i = int(np.argmax(out))
        signal, now = self._stepper.u[i], f"{u[i]:.4g}"
        if least[i] - room[i] <= u[i] <= most[i] + room[i]:
            now = f"changed by {change[i]:.4g} in a sample"
        trained = f"{least[i]:.4g} to {most[i]:.4g}, changes to {fastest[i]:.4g}"
        return f"; {BEYOND} from t = {t:g} s on: {signal.name} {now}, in training {trained}"

    def _without(self, u: FloatArray, fault: str) -> str:
        """A step with e = 0 under the input u, or a new run if that is not known.

        fault: why nothing was measured. Why the model ends the run, empty if it does not.
        """
        known = u.shape == (len(self._stepper.u),) and np.isfinite(u).all()
        if self._x is None or not known:
            self._begin(fault)
            return ""
        _, after, refused = self._advance(self._stepper, self._x, u)
        if refused:
            self._begin(refused)
            return refused
        self._x, self._spent, self._k = after, self._rho * self._spent, self._k + 1
        self._follow_command(u)
        return ""

    def _collect(self, t: float, y: FloatArray, u: FloatArray) -> Reading:
        if self._box is not None and not _within(u, self._box[1]):
            away = f"outside the box in which the tube is proved, at t = {t:g} s"
            self._begin(away)
            return self._unknown(t, y, away)
        self._follow_command(u)
        self._start.append((y, u))
        if len(self._start) >= self.lags:
            ys, us = (np.array(part) for part in zip(*self._start, strict=True))
            self._x = np.tile(self._stepper.begin(ys, us), (len(self._tubes) + 1, 1))
            self._start = []
        why = f" of a new run: {self._ended}" if self._ended else ""
        return self._unknown(t, y, f"{STARTING} {self.lags} samples{why}")

    def _advance(
        self, stepper: Stepper, x: FloatArray, u: FloatArray
    ) -> tuple[FloatArray, FloatArray, str]:
        """Outputs and next states, and why there are none or nothing is known of them."""
        try:
            outputs, after = stepper.advance(x, u)
        except (DataError, SolverError) as error:
            return x, x, str(error)
        if self._box is not None and not all(map(_within, (outputs, u, x), self._box)):
            return outputs, after, "outside the box in which the tube is proved"
        return outputs, after, ""

    def _follow_command(self, u: FloatArray) -> None:
        """The levels at the sample whose inputs are u (n_u,)."""
        if self._meters:
            now = u.tolist()
            self._g = {j: meter.update(now) for j, meter in self._meters.items()}

    def _judge(self, t: float, y: FloatArray, u: FloatArray) -> Reading:
        assert self._x is not None
        outputs, after, refused = self._advance(self._stepper, self._x, u)
        if refused:
            refused = f"{refused}, at t = {t:g} s"
            self._begin(refused)
            return self._unknown(t, y, f"{refused}; a new run starts")
        self._follow_command(u)
        e = y - outputs[:-1]
        simulated = outputs[-1]
        deviation = y - simulated
        g, widths = self._followed(self._g)
        level = self._level * g
        with np.errstate(over="ignore", invalid="ignore"):  # looked at below
            if self._single_R is not None:
                used = self._single_R * (e[:, 0] * e[:, 0])
                after[:-1] += self._L[:, :, 0] * e
            else:
                used = np.einsum("ti,tij,tj->t", e, self._R, e) * self._up
                after[:-1] += np.einsum("tnp,tp->tn", self._L, e)
            self._spent = self._rho * self._spent + used
            hidden = self._hides(simulated)
            sizes = (np.abs(deviation) + hidden) / widths
            spent = (self._spent / level).tolist()
            parts = (e / self._peak) ** 2
            if g is not self._unmoved:
                parts /= np.maximum(g, 1.0)[:, None]
            peaks = parts.max(axis=1).tolist()
        self._x, self._k = after, self._k + 1
        followed = all(map(math.isfinite, self._g.values()))
        nominal = tuple(simulated.tolist())
        finite = all(map(math.isfinite, (*self._spent.tolist(), *nominal)))
        if not (followed and finite and np.isfinite(after).all()):
            what = "the model's state" if followed else "the level that follows the commands"
            reason = f"{what} is not finite at t = {t:g} s"
            self._begin(reason)
            if np.isfinite(simulated).all() and (sizes > 1.0).any():
                return Reading(
                    t,
                    Status.OUTSIDE,
                    -math.inf,
                    math.inf,
                    0.0,
                    measured=tuple(y.tolist()),
                    level=Level.NONE,
                    reason=f"outside the tube; {reason}",
                )
            return self._unknown(t, y, reason)
        if not (hidden <= MOST_ROUNDING * widths).all():
            most = f"rounding can hide {float(hidden.max()):.2g}"
            least = f"{float(widths.min()):.2g}"
            return self._unknown(
                t, y, f"{COARSE}: {most} beside a half-width of {least}, at t = {t:g} s"
            )
        alarm = self._alarm(e[0].tolist())
        lasting = self._lasting(self._k)
        if not lasting:
            over = f"the proof covers {self._tubes[0].samples} samples; they are over"
            return self._unknown(t, y, over)._replace(alarm=alarm)
        row = sizes[lasting].max(axis=0) if len(lasting) > 1 else sizes[lasting[0]]
        size = float(row.max())
        share, reason = self._used(t, lasting, spent, peaks)
        status = Status.ASSUMPTION_VIOLATED if reason else Status.INSIDE
        if not size <= 1.0:
            status = Status.OUTSIDE
            kept = "although the assumption was kept: what runs is not what was proved"
            reason = f"outside the tube; {reason}" if reason else f"outside {kept}"
        return Reading(
            t,
            status,
            1.0 - size,
            share,
            self._trend.exit_after(t, 1.0 - size),
            self._names[int(row.argmax())],
            nominal,
            tuple(y.tolist()),
            Level.TUBE if size <= 1.0 else Level.NONE,
            reason,
            self._assuming + self._beyond,
            [*deviation.tolist(), *e[0].tolist()],
            alarm,
            tuple(widths[lasting].min(axis=0).tolist()) if self._follow else (),
        )

    def _used(
        self, t: float, lasting: list[int], spent: list[float], peaks: list[float]
    ) -> tuple[float, str]:
        """The most of what the tubes that last assume that is used, and what is exceeded."""
        most = max(lasting, key=spent.__getitem__)
        sharpest = max(lasting, key=peaks.__getitem__)
        used = max(spent[most], peaks[sharpest])
        if not spent[most] <= 1.0:
            unit = self._tubes[most].energy_unit(self._stepper.y)
            return used, (
                f"innovation energy {self._spent[most]:.4g}{unit} above the level "
                f"{self._spent[most] / spent[most]:.4g}{unit} at t = {t:g} s"
            )
        if not peaks[sharpest] <= 1.0:
            peak = self._tubes[sharpest].peak
            beside = "" if peak is not None and peak.direct.any() else f" ({WATCHED})"
            return used, (
                f"one sample's innovation is {math.sqrt(peaks[sharpest]):.4g} times what is "
                f"assumed{beside}, at t = {t:g} s"
            )
        return used, ""

    def _hides(self, simulated: FloatArray) -> FloatArray:
        """(tubes, p) what rounding can hide of the outputs' distance from these simulated (p,)."""
        assert self._x is not None
        reached = np.abs(self._x[-1])
        if (reached > self._largest).any():
            self._largest = np.maximum(self._largest, 1.1 * reached)  # so that this is seldom
            none = np.zeros_like(simulated)
            self._hidden = np.array([tube.hidden(self._largest, none) for tube in self._tubes])
            if self._linear is not None and self._carried is not None:
                directly = self._carried @ self._linear.rounded(self._largest)
                self._hidden = np.minimum(self._hidden, directly)
        return self._hidden + STEPS * UNIT * np.abs(simulated)

    def _followed(self, g: dict[int, float]) -> tuple[FloatArray, FloatArray]:
        """By what levels are multiplied (tubes,), and half-widths (tubes, p), where g is this."""
        if not g:
            return self._unmoved, self._widths
        room = np.array([max(g[j], TINY) if j in g else 1.0 for j in range(len(self._tubes))])
        return room, self._widths * np.sqrt(room)[:, None]

    def _alarm(self, innovation: list[float]) -> str:
        """What CUSUM says of the first observer; empty if it does not alarm."""
        cusum, sums = self._cusum, self._sums
        if cusum is None or sums is None:
            return ""
        z = [e / size for e, size in zip(innovation, cusum.deviation.tolist(), strict=True)]
        reached = sums.update(z)
        if reached <= cusum.threshold:
            return ""
        return (
            f"cusum alarm: the innovations add up to {reached:.4g} standard deviations on one "
            f"side, above {cusum.threshold:.4g}; nothing is proved of this"
        )

    def _reached(self, steps: int) -> FloatArray:
        """(tubes, p) of `reach` after so many steps; found for twice as many where they are new."""
        if steps > len(self._reach):
            parts = [reach(tube, self._linear, 2 * steps) for tube in self._tubes]
            self._reach = np.stack(parts, axis=1)
        return np.asarray(self._reach[steps - 1])

    def _lasting(self, k: int) -> list[int]:
        """The tubes whose proof covers k samples."""
        return [j for j, tube in enumerate(self._tubes) if k <= (tube.samples or k)]

    def _unknown(self, t: float, y: FloatArray, reason: str) -> Reading:
        return Reading(t, Status.UNKNOWN, measured=tuple(y.tolist()), reason=reason)


class Ahead:
    """A second simulation from a run's present estimate, and how far the robot can be from it.

    `step` once for each next sample, with its inputs. Where it says nothing, `ended` says why, and
    it never says anything again. The run goes on as if this were not there.
    """

    def __init__(self, run: TubeRun) -> None:
        self._run = run
        self._x, self._k, self._spent, self._g = run._x, run._k, run._spent, run._g
        self._stepper, self._meters = run._stepper.ahead(), copy.deepcopy(run._meters)
        self.steps, self._total = 0, np.zeros(len(run._rho))
        self.ended = "no run has begun" if self._x is None else ""

    def step(self, u: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Between which values (p,) the outputs are at the next sample, under its inputs u (n_u,).

        Within the funnel's tubes too.
        """
        run = self._run
        if self.ended or self._x is None:
            return None
        outputs, self._x, self.ended = run._advance(self._stepper, self._x, u)
        self.steps += 1
        self._g = {j: meter.update(u.tolist()) for j, meter in self._meters.items()}
        g, widths = run._followed(self._g)
        left = run._level * g * (1.0 + OUTWARD) - run._rho**self.steps * self._spent * (
            1.0 - OUTWARD
        )
        self._total = run._rho * self._total + np.maximum(g, 1.0)
        left = np.minimum(left, run._single * self._total * (1.0 + OUTWARD))
        lasting = run._lasting(self._k + self.steps)
        if not lasting or not (left[lasting] >= 0.0).all():
            self.ended = self.ended or "what the tube assumes is broken, or over"
        if self.ended:
            return None
        beside = np.sqrt(left[lasting, None] * run._reached(self.steps)[lasting])
        centres = np.vstack([outputs[lasting], np.tile(outputs[-1], (len(lasting), 1))])
        room = np.vstack([beside, widths[lasting]]) * (1.0 + OUTWARD)
        room += np.tile(run._hides(outputs[-1])[lasting], (2, 1))
        return (centres - room).max(axis=0), (centres + room).min(axis=0)


def refuse_far(model: StableModel, funnel: TubeFunnel, trials: Dataset) -> None:
    """DataError if a run on such trials (y, u) could not be judged in float64."""
    for trial in trials:
        refuse_coarse(np.spacing(np.abs(trial.y).max(axis=0)), funnel.half_widths, trial.name)
        run = TubeRun(model, funnel)
        for k in range(min(len(trial), run.lags + 1)):
            reading = run.update(k * model.period, trial.y[k], trial.u[k])
        if reading.reason.startswith(COARSE):
            raise DataError(f"{trial.name}: {reading.reason}; measure from a place nearby")


def _within(values: FloatArray, box: FloatArray) -> bool:
    """Whether all values (..., n) are in the box (2, n)."""
    return bool(((box[0] <= values) & (values <= box[1])).all())


def assuming(tubes: Sequence[Tube]) -> str:
    """What they assume, in letters."""
    return "; ".join(tube.assumption for tube in tubes)
