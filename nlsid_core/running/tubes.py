"""`TubeRun`: a robot held against tubes around its model's own simulation, for as long as it runs.

Each tube has an observer, x̂⁺ = f(x̂, w) + L e, and a number, E⁺ = ρE + e'Re; the simulation x⁺ =
f(x, w) is common to them. A sample without a measurement is a step with e = 0, and nothing is said
of it. The simulation needs every input: where one is not known, as of a sample that never came, is
refused by the model or leaves the box, a new run starts. Source: docs/certificate_tube.md.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import DataError, SolverError
from nlsid_core.funnels.factor import UNIT
from nlsid_core.funnels.tube import Tube, TubeFunnel
from nlsid_core.models import StableModel
from nlsid_core.running.grid import TOLERANCE
from nlsid_core.running.reading import Level, Reading, Status
from nlsid_core.running.stepping import Stepper

TREND = 10  # samples over which the margin's fall is taken
FOLLOW = 0.1  # part of a stamp's error by which the next one is expected later: clocks drift
ROUNDING = 1e-9  # relative, of |o| and of E beside a half-width and a level
STARTING = "waiting for the first"


def assuming(tubes: Sequence[Tube]) -> str:
    """What they assume, in letters."""
    return "; ".join(tube.assumption for tube in tubes)


class Judged(NamedTuple):
    """One funnel at one sample, over its tubes that still last; NaN where none does.

    size: the largest |o_j| in half-widths, worst: that j. used: the largest part of a level, most:
    whose.
    """

    size: float
    used: float
    most: int
    worst: int


class Stacked:
    """The T tubes of m funnels of one model: their numbers, rounded so that no bound is missed.

    owner: of each tube, its funnel's number; first: of each funnel, its first tube's.
    """

    def __init__(self, funnels: Sequence[TubeFunnel]) -> None:
        tubes = [tube for funnel in funnels for tube in funnel.tubes]
        self.owner = [i for i, funnel in enumerate(funnels) for _ in funnel.tubes]
        self.first = [self.owner.index(i) for i in range(len(funnels))]
        p = len(tubes[0].R)
        # Products and sums are rounded up, so that E is never below its exact value.
        self.rho: FloatArray = np.array([tube.rho for tube in tubes]) * (1.0 + 8.0 * UNIT)
        self._R = np.array([tube.R for tube in tubes])
        spread = max(
            np.linalg.norm(np.abs(R), 2) * np.linalg.norm(np.linalg.inv(R), 2) for R in self._R
        )
        self._up = 1.0 + 8.0 * (p * p + 4) * UNIT * float(spread)
        self._single_R = self._R[:, 0, 0] * self._up if p == 1 else None
        self.L: FloatArray = np.array([tube.L for tube in tubes])
        self._level = np.array([tube.level for tube in tubes]) * (1.0 - ROUNDING)
        self._widths = np.array([tube.half_widths for tube in tubes]) * (1.0 - ROUNDING)
        self.samples = [tube.samples for tube in tubes]
        self._rows = [
            np.flatnonzero(np.array(self.owner) == i).tolist() for i in range(len(funnels))
        ]

    def spent(self, before: FloatArray, e: FloatArray) -> FloatArray:
        """E⁺ = ρE + e'Re of innovations e (T, p): (T,), never below its exact value."""
        if self._single_R is not None:
            return np.asarray(self.rho * before + self._single_R * (e[:, 0] * e[:, 0]))
        used = np.einsum("ti,tij,tj->t", e, self._R, e) * self._up
        return np.asarray(self.rho * before + used)

    def injected(self, e: FloatArray) -> FloatArray:
        """L e, (T, n)."""
        if self._single_R is not None:
            return np.asarray(self.L[:, :, 0] * e)
        return np.asarray(np.einsum("tnp,tp->tn", self.L, e))

    def left(self, deviation: FloatArray) -> bool:
        """Whether an output is shown to have left a half-width."""
        return bool((np.abs(deviation) / self._widths > 1.0).any())

    def judged(self, count: int, deviation: FloatArray, spent: FloatArray) -> list[Judged]:
        """Of each funnel after `count` samples. deviation: o (T, p), or (p,) if all have one."""
        sizes, parts = np.abs(deviation) / self._widths, (spent / self._level).tolist()
        found = []
        for rows in self._rows:
            lasting = [j for j in rows if (self.samples[j] or math.inf) >= count]
            if not lasting:
                found.append(Judged(math.nan, math.nan, rows[0], 0))
                continue
            place = int(sizes[lasting].argmax())
            most = max(lasting, key=parts.__getitem__)
            size = float(sizes[lasting].flat[place])
            found.append(Judged(size, parts[most], most, place % sizes.shape[1]))
        return found

    def excess(self, j: int, spent: FloatArray, t: float) -> str:
        """How tube j's assumption is broken at t (s)."""
        level = self._level[j] / (1.0 - ROUNDING)
        return f"innovation energy {spent[j]:.4g} above the level {level:.4g} at t = {t:g} s"


class TubeRun:
    """Samples (t, y, u) of one run against funnels of one model; `readings` once per sample.

    lags: samples that start a run. Raises DataError if the funnels start in different ways.
    """

    def __init__(self, model: StableModel, funnels: Sequence[TubeFunnel]) -> None:
        self._stepper = Stepper(model)
        self.period, self.lags = model.period, funnels[0].settling
        if any(funnel.settling != self.lags for funnel in funnels):
            raise DataError("the funnels start after different numbers of samples")
        if self.lags < self._stepper.lags:
            raise DataError(f"a run of this model starts after {self._stepper.lags} samples")
        self._tubes = Stacked(funnels)
        self._count = len(funnels)
        p, n = len(self._stepper.y), self._stepper.order
        if any(tube.L.shape != (n, p) for funnel in funnels for tube in funnel.tubes):
            raise DataError("the funnel is not one of this model")
        self._names = [signal.name for signal in self._stepper.y]
        boxed = [f for f in funnels if f.y_box is not None and f.u_box is not None]
        self._boxes = [
            (np.array(f.y_box).T, np.array(f.u_box).T, np.tile(np.array(f.y_box), (n // p, 1)).T)
            for f in boxed
        ]
        self._assuming = [assuming(funnel.tubes) for funnel in funnels]
        self.restart()

    def restart(self) -> None:
        """A new run."""
        self._due = math.nan
        self._begin()

    def _begin(self) -> None:
        """Collect a start again; the grid of time goes on."""
        self._start: list[tuple[FloatArray, FloatArray]] = []
        self._x: FloatArray | None = None
        self._spent: FloatArray = np.zeros(len(self._tubes.owner))
        self._k = 0
        self._fall: list[deque[tuple[float, float]]] = [
            deque(maxlen=TREND) for _ in range(self._count)
        ]

    def readings(self, t: float, y: Any, u: Any) -> list[Reading]:
        """What is said of the sample at t (s): outputs y (p,) and inputs u (n_u,), or numbers.

        NaN, or None for u, is a sample without a measurement.
        """
        measured = np.atleast_1d(np.array(y, dtype=np.float64))  # copies: the caller may go on
        if u is None:
            u = np.full(len(self._stepper.u), np.nan)
        applied = np.atleast_1d(np.array(u, dtype=np.float64))  # with its own
        fault = self._take(t)
        if fault:
            return self._unknown(t, measured, fault)
        fault = self._fault(t, measured, applied)
        if fault:
            return self._unknown(t, measured, self._without(applied) or fault)
        if self._x is None:
            return self._collect(t, measured, applied)
        return self._judge(t, measured, applied)

    def missing(self, t: float, reason: str) -> Reading:
        """The reading at t (s) where no sample came; the run goes on with the next one."""
        return Reading(t, Status.UNKNOWN, reason=reason)

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
            return f"the sample at t = {t:g} s came a second time, or time went back"
        if abs(late - lost) > TOLERANCE:
            self._begin()
            self._due = t + self.period
            return (
                f"the sample at t = {t:g} s is {late - lost:+.2g} periods of {self.period:g} s off "
                f"the grid; {TOLERANCE:g} are allowed; a new run starts"
            )
        self._due += (lost + 1) * self.period + FOLLOW * (late - lost) * self.period
        if lost:
            self._begin()
        return ""

    def _fault(self, t: float, y: FloatArray, u: FloatArray) -> str:
        if y.shape != (len(self._names),) or u.shape != (len(self._stepper.u),):
            return f"{y.shape} outputs and {u.shape} inputs at t = {t:g} s"
        for values, signals in ((y, self._stepper.y), (u, self._stepper.u)):
            for value, signal in zip(values.tolist(), signals, strict=True):
                if not math.isfinite(value):
                    return f"no {signal.name} at t = {t:g} s (it is {value}): nothing is claimed"
        return ""

    def _without(self, u: FloatArray) -> str:
        """A step with e = 0 under the input u, or a new run if that is not known.

        Why the model ends the run, empty if it does not.
        """
        known = u.shape == (len(self._stepper.u),) and np.isfinite(u).all()
        if self._x is None or not known:
            self._begin()
            return ""
        _, after, refused = self._advance(u)
        if refused:
            self._begin()
            return refused
        self._x, self._k = after, self._k + 1
        self._spent = self._tubes.rho * self._spent
        return ""

    def _collect(self, t: float, y: FloatArray, u: FloatArray) -> list[Reading]:
        if any(((u < low) | (u > high)).any() for _, (low, high), _ in self._boxes):
            self._begin()
            return self._unknown(
                t, y, f"outside the box in which the tube is proved, at t = {t:g} s"
            )
        self._start.append((y, u))
        if len(self._start) >= self.lags:
            ys, us = (np.array(part) for part in zip(*self._start, strict=True))
            self._x = np.tile(self._stepper.begin(ys, us), (len(self._tubes.owner) + 1, 1))
            self._start = []
        return self._unknown(t, y, f"{STARTING} {self.lags} samples")

    def _advance(self, u: FloatArray) -> tuple[FloatArray, FloatArray, str]:
        """Outputs and next states, and why there are none or nothing is known of them."""
        x = self._x
        assert x is not None
        try:
            outputs, after = self._stepper.advance(x, u)
        except (DataError, SolverError) as error:
            return x, x, str(error)
        for (y_low, y_high), (u_low, u_high), (x_low, x_high) in self._boxes:
            inside = (
                ((y_low <= outputs) & (outputs <= y_high)).all()
                and ((u_low <= u) & (u <= u_high)).all()
                and ((x_low <= x) & (x <= x_high)).all()
            )
            if not inside:
                return outputs, after, "outside the box in which the tube is proved"
        return outputs, after, ""

    def _judge(self, t: float, y: FloatArray, u: FloatArray) -> list[Reading]:
        outputs, after, refused = self._advance(u)
        if refused:
            self._begin()
            return self._unknown(t, y, f"{refused}, at t = {t:g} s; a new run starts")
        e = y - outputs[:-1]
        simulated = outputs[-1]
        with np.errstate(over="ignore", invalid="ignore"):  # looked at below
            self._spent = self._tubes.spent(self._spent, e)
            after[:-1] += self._tubes.injected(e)
        self._x, self._k = after, self._k + 1
        deviation = y - simulated
        if not (np.isfinite(self._spent).all() and np.isfinite(after).all()):
            self._begin()
            reason = f"the model's state is not finite at t = {t:g} s"
            if np.isfinite(simulated).all() and self._tubes.left(deviation):
                away = Reading(
                    t, Status.OUTSIDE, -math.inf, math.inf, 0.0, measured=tuple(y.tolist()),
                    level=Level.NONE, reason=f"outside the tube; {reason}",
                )  # fmt: skip
                return [away] * self._count
            return self._unknown(t, y, reason)
        measured, nominal = tuple(y.tolist()), tuple(simulated.tolist())
        away, innovations = deviation.tolist(), e.tolist()
        said = []
        judged = self._tubes.judged(self._k, deviation, self._spent)
        for i, (size, used, most, worst) in enumerate(judged):
            if math.isnan(used):
                over = f"the proof covers {self._tubes.samples[most]} samples; they are over"
                said.append(Reading(t, Status.UNKNOWN, measured=measured, reason=over))
                continue
            margin = 1.0 - size
            status, reason = Status.INSIDE, ""
            if not used <= 1.0:
                status = Status.ASSUMPTION_VIOLATED
                reason = self._tubes.excess(most, self._spent, t)
            if not size <= 1.0:
                status = Status.OUTSIDE
                kept = "although the assumption was kept: what runs is not what was proved"
                reason = f"outside the tube; {reason}" if reason else f"outside {kept}"
            said.append(Reading(
                t, status, margin, used, self._exit(i, t, margin), self._names[worst],
                nominal, measured, Level.TUBE if size <= 1.0 else Level.NONE, reason,
                self._assuming[i], away + innovations[self._tubes.first[i]],
            ))  # fmt: skip
        return said

    def _exit(self, i: int, t: float, margin: float) -> float:
        """S until the margin is 0 if it goes on falling as over the last samples."""
        before, earlier = self._fall[i][0] if self._fall[i] else (t, margin)
        self._fall[i].append((t, margin))
        if not margin > 0.0:
            return 0.0
        return margin * (t - before) / (earlier - margin) if earlier > margin else math.inf

    def _unknown(self, t: float, y: FloatArray, reason: str) -> list[Reading]:
        measured = tuple(y.tolist())
        return [Reading(t, Status.UNKNOWN, measured=measured, reason=reason)] * self._count
