"""What a monitor catches: sabotaged copies of trials, and what other detectors make of them.

The trials are those that were held back from the model and from the tube. Every copy goes through
the same `Monitor` as a bag or a live robot.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from statistics import median
from typing import Any

import numpy as np

from bags.signals.grid import said_restarts
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.designs import AnyDesign
from nlsid_core.errors import DataError, SolverError
from nlsid_core.kernel import text
from nlsid_core.models import StableModel
from nlsid_core.running.comparison import Centre
from nlsid_core.running.detectors import DETECTORS, Detector, Residuals
from nlsid_core.running.monitor import OVER, Monitor
from nlsid_core.running.reading import Reading, Status
from nlsid_core.running.stepping import Stepper

UNTOUCHED = "untouched"
BIAS = 0.1  # of the range of each output
DELAY = 5  # samples
LOST = 5  # samples
NOT_THERE = "lost"
WIDE = 0.5  # of the range: a tube of a larger half-width says little
OUTLIER = 4.0  # times the median trial's share of the level: twice its amplitude


TINY = float(np.finfo(float).tiny)


# What is recorded, (N, p), of a trial's outputs, whose ranges are (p,); NaN where nothing is.
Fault = Callable[[Trajectory, FloatArray, StableModel], FloatArray]


def _scaled(factor: float) -> Fault:
    return lambda trial, _ranges, _model: factor * trial.y


def _stuck(trial: Trajectory, _ranges: FloatArray, _model: StableModel) -> FloatArray:
    return np.tile(trial.y[0], (len(trial), 1))


def _biased(trial: Trajectory, ranges: FloatArray, _model: StableModel) -> FloatArray:
    return trial.y + BIAS * ranges


def _delayed(trial: Trajectory, _ranges: FloatArray, _model: StableModel) -> FloatArray:
    first = np.tile(trial.y[0], (min(DELAY, len(trial)), 1))
    return np.vstack([first, trial.y])[: len(trial)]


def _weak(trial: Trajectory, _ranges: FloatArray, model: StableModel) -> FloatArray:
    """What the model says the output would have been, had 0.8 of the command arrived."""
    full, less = (_simulated(model, trial, gain) for gain in (1.0, 0.8))
    y = trial.y.copy()
    y[len(y) - len(full) :] += less - full
    return y


def _simulated(model: StableModel, trial: Trajectory, gain: float) -> FloatArray:
    stepper = Stepper(model)
    n = stepper.lags
    x = stepper.begin(trial.y[:n], trial.u[:n])[None, :]
    outputs = []
    for u in trial.u[n:]:
        y, x = stepper.advance(x, gain * u)
        outputs.append(y[0])
    return np.array(outputs)


def _dropped(trial: Trajectory, _ranges: FloatArray, _model: StableModel) -> FloatArray:
    y, onset = trial.y.copy(), len(trial) // 2
    y[onset : onset + LOST] = np.nan
    return y


SABOTAGES: tuple[tuple[str, Fault], ...] = (
    ("stuck at first value", _stuck),
    ("sensor x 0.6", _scaled(0.6)),
    ("sensor x 0.8", _scaled(0.8)),
    (f"bias, {100 * BIAS:.0f} % of range", _biased),
    (f"late by {DELAY} samples", _delayed),
    ("actuator x 0.8", _weak),
    (f"{LOST} samples lost", _dropped),
)

OF_SENSORS = frozenset(name for name, _ in SABOTAGES[:5])  # put into one output at a time


@dataclass(frozen=True)
class Caught:
    """In how many of the trials, by which status, and s from the fault to the alarm (median).

    unjudged: trials of which a part is unknown and nothing bad was seen. after: NaN if none was
    caught. alarmed: by the monitor's second alarm alone, which no proof rests on.
    """

    outside: int = 0
    violated: int = 0
    unjudged: int = 0
    after: float = float("nan")
    alarmed: int = 0

    @property
    def count(self) -> int:
        """How many were caught, in any way."""
        return self.outside + self.violated + self.alarmed


@dataclass(frozen=True)
class Row:
    """One kind of sabotage; others: by the name of a detector. refused: why it was not tried.

    output: of several, the one whose sensor alone had it: that in which it was caught least.
    """

    fault: str
    funnel: Caught
    others: dict[str, Caught]
    refused: str = ""
    output: str = ""


@dataclass(frozen=True, eq=False)
class Width:
    """One output's half-width beside its range, and its largest error on the calibration trials.

    range: of the trials given, in the output's unit as are the others. error: of the simulation.
    half_width: on average over the calibration trials, where it follows the commands between
    `least` and `most`. moves: its range within a calibration trial, the median of them.
    """

    name: str
    unit: str
    half_width: float
    range: float
    error: float
    least: float | None = None
    most: float | None = None
    moves: float = float("inf")

    @property
    def said(self) -> str:
        """The half-width with its unit, rounded up, and how it changes with the commands."""
        mean = f"{_up(self.half_width)} {self.unit}".strip()
        if self.least is None or self.most is None or _up(self.least) == _up(self.most):
            return mean
        span = f"{_up(self.least)} to {_up(self.most)}"
        return f"{mean} on average over the calibration trials, {span} as their commands go"

    @property
    def part(self) -> str:
        """The half-width as a part of the range, rounded up, and the range."""
        return f"{_up(self.share)} of its range, {self.range:.3g} {self.unit}".strip()

    @property
    def share(self) -> float:
        """The half-width as a part of the range; inf if the output was constant."""
        return self.half_width / self.range if self.range > 0.0 else float("inf")


@dataclass(frozen=True, eq=False)
class Catching:
    """What is known before anyone trusts a funnel.

    trials: how many were held back. shares: of each calibration trial, the part of what the funnel
    assumes that it uses, largest first. errors: of each held-back trial, t (N,) s and y - nominal
    (N, p). half_widths: of each, (N, p) where they follow the commands, else (0, p).
    restarts: which of them a monitor would not judge as one run, and why.
    """

    widths: tuple[Width, ...]
    rows: tuple[Row, ...]
    trials: int
    factor: float
    shares: tuple[tuple[str, float], ...]
    errors: tuple[tuple[FloatArray, FloatArray], ...]
    half_widths: tuple[FloatArray, ...]
    restarts: tuple[str, ...] = ()

    @property
    def beyond(self) -> list[str]:
        """What to know of a tube that follows the commands beyond the output's range."""
        return [
            f"the half-width of {width.name} is up to {_up(width.most)} {width.unit} where the "
            f"commands change most, beyond its range, {width.range:.3g} {width.unit}: the tube "
            "says nothing there"
            for width in self.widths
            if width.most is not None and width.most > width.range
        ]

    @property
    def still(self) -> list[str]:
        """What to know of a tube that is narrow in the range and wide in most trials."""
        return [
            f"the half-width of {width.name} is {_up(width.half_width)} {width.unit}, and within a "
            f"calibration trial {width.name} moves by {width.moves:.3g} {width.unit} (the median): "
            "even if it stood still in the middle of such a trial, it would not leave the tube, "
            "which can hardly tell anything there. What is caught is then caught by what is "
            "assumed, which the monitor watches too (violated, above)"
            for width in self.widths
            if width.share <= WIDE and width.half_width > WIDE * width.moves
        ]

    def warnings(self) -> list[str]:
        """What to know of a tube whose half-width is more than WIDE of the range."""
        said = []
        for width in self.widths:
            if not width.share <= WIDE:
                causes = "; ".join(self._causes(width))
                said.append(
                    f"the half-width of {width.name}, {width.said}, is {width.part}; more than "
                    f"{WIDE:g} says little of where the robot is: {causes}"
                )
        return said

    def _causes(self, width: Width) -> list[str]:
        """Which trial sets the level, and whether model or assumption is what is wide."""
        said = []
        names, parts = zip(*self.shares, strict=True)
        typical = median(parts)
        if len(parts) > 1 and parts[0] > OUTLIER * typical:
            said.append(
                f"{names[0]} sets the level: it uses {parts[0] / typical:.3g} times as much of it "
                f"as the median of {len(parts)} calibration trials, {names[1]} as the next "
                f"{parts[1] / typical:.3g} times. Look at it: fit the model to trials like it too, "
                "or leave it out of split.calibration if it is not what the robot does"
            )
        needed = self.factor * width.error
        off = (
            f"the simulation is off by up to {_up(width.error)} {width.unit} on the calibration "
            f"trials, {_up(needed)} {width.unit} with the safety factor"
        )
        if needed > WIDE * width.range:
            said.append(f"{off}: try more lags, another class of models, or more training trials")
        else:
            said.append(
                f"{off}, and the half-width is {width.half_width / max(needed, TINY):.3g} times "
                "that: what is assumed of the innovations is wider than the model's error. Try "
                "another funnel.reaction_time, or a model that leaves less in its residual"
            )
        return said


@dataclass(frozen=True, eq=False)
class _Run:
    """The judged part of a run: when each sample was, what is bad first, and the residuals.

    alarm: the first reading with the monitor's second alarm. widths: (N, p) where half-widths
    follow the commands, else (0, p).
    """

    t: FloatArray
    bad: Reading | None
    alarm: Reading | None
    widths: FloatArray
    lost: bool
    residuals: Residuals
    share: float


def what_it_catches(
    design: AnyDesign,
    *,
    held_back: Dataset,
    calibration: Dataset,
    ranges: FloatArray,
) -> Catching:
    """Every sabotage of every held-back trial, through the monitor and through DETECTORS.

    Of several outputs a sensor's fault is put into one at a time.

    ranges: (p,) of each output, in its unit. The thresholds of detectors have the tube's safety
    factor too. A detector that alarms in more of the untouched trials than the monitor gets its
    threshold raised until it does not.
    """
    monitor, p = design.monitor(Centre.COMMAND), len(ranges)
    factor = design.funnel.tubes[0].measured.safety_factor
    half_widths = design.funnel.half_widths.tolist()
    first = held_back.trajectories[0]
    scaling = [_run(monitor, trial, trial.y) for trial in calibration]
    clean = [_run(monitor, trial, trial.y) for trial in held_back]
    judged = [run.residuals for run in scaling if len(run.t)]
    if not judged or not any(len(run.t) for run in clean):
        raise DataError("the monitor judges no sample of the trials; are they shorter than lags?")
    false_alarms = sum(run.bad is not None or run.alarm is not None for run in clean)
    untouched = [run.residuals for run in clean if len(run.t)]
    detectors = [
        Detector.calibrated(name, judged, factor).quieter(untouched, false_alarms)
        for name in DETECTORS
    ]
    rows = [_row(UNTOUCHED, clean, [0] * len(clean), detectors)]
    for name, fault in SABOTAGES:
        try:
            copies = [fault(trial, ranges, design.model) for trial in held_back]
        except (DataError, SolverError) as reason:
            rows.append(Row(name, Caught(), {}, str(reason)))
            continue
        onsets = [
            float(trial.t[np.isnan(y).any(axis=1).argmax()])
            for trial, y in zip(held_back, copies, strict=True)
        ]
        tried = {"": copies}
        if p > 1 and name in OF_SENSORS:
            tried = {
                output: [_in_one(j, *pair) for pair in zip(held_back, copies, strict=True)]
                for j, output in enumerate(first.y_names)
            }
        found = [
            replace(_row(name, runs, onsets, detectors), output=output)
            for output, sabotaged in tried.items()
            for runs in [list(map(partial(_run, monitor), held_back, sabotaged))]
        ]
        rows.append(min(found, key=lambda row: (row.funnel.count, -row.funnel.after)))
    errors = np.max([np.abs(run.error).max(axis=0) for run in judged], axis=0)
    following = np.concatenate([run.widths for run in scaling])
    limits: list[tuple[float | None, float | None]] = [(None, None)] * p
    if len(following):
        half_widths = following.mean(axis=0).tolist()
        limits = list(zip(following.min(axis=0), following.max(axis=0), strict=True))
    moves = np.median([np.ptp(trial.y, axis=0) for trial in calibration], axis=0)
    named = zip(
        first.y_names, first.y_units, half_widths, ranges, errors, limits, moves, strict=True
    )
    shares = {trial.name: run.share for trial, run in zip(calibration, scaling, strict=True)}
    return Catching(
        tuple(
            Width(n, u, float(w), float(r), float(e), least, most, float(m))
            for n, u, w, r, e, (least, most), m in named
        ),
        tuple(rows),
        len(held_back),
        factor,
        tuple(sorted(shares.items(), key=lambda entry: -entry[1])),
        tuple((run.t, run.residuals.error) for run in clean),
        tuple(run.widths for run in clean),
        tuple(said_restarts(held_back)),
    )


def _up(value: float) -> str:
    """Rounded up."""
    return text.above(Fraction(value), 3) if value < float("inf") else "inf"


def _in_one(output: int, trial: Trajectory, faulty: FloatArray) -> FloatArray:
    """What is recorded with the fault in the sensor of one output only."""
    y = trial.y.copy()
    y[:, output] = faulty[:, output]
    return y


def _run(monitor: Monitor, trial: Trajectory, recorded: FloatArray) -> _Run:
    """The samples (N, p) recorded of a trial's outputs through the monitor, as a bag's are."""
    monitor.restart()
    p = recorded.shape[1]
    single = p == trial.u.shape[1] == 1
    times: list[float] = []
    innovation: list[Sequence[float]] = []
    error: list[FloatArray] = []
    widths: list[Sequence[float]] = []
    bad, alarm, lost, share = None, None, False, 0.0
    for t, y, u in zip(trial.t.tolist(), recorded, trial.u, strict=True):
        sample: tuple[Any, Any] = (float(y[0]), float(u[0])) if single else (y, u)
        if np.isnan(y).any():
            monitor.unmeasured(t, sample[1], NOT_THERE)
            lost = True
            continue
        reading = monitor.update(t, *sample)
        if reading.status is Status.UNKNOWN:
            lost = lost or (bool(times) and not reading.reason.startswith(OVER))
            continue
        times.append(t)
        innovation.append(reading.deviation[-p:])
        error.append(np.subtract(reading.measured, reading.nominal))
        share = max(share, reading.assumption)
        if reading.half_widths:
            widths.append(reading.half_widths)
        if alarm is None and reading.alarm:
            alarm = reading
        if bad is None and reading.status is not Status.INSIDE:
            bad = reading
    residuals = Residuals(np.reshape(innovation, (-1, p)), np.reshape(error, (-1, p)))
    return _Run(np.array(times), bad, alarm, np.reshape(widths, (-1, p)), lost, residuals, share)


def _row(
    fault: str,
    runs: Sequence[_Run],
    onsets: Sequence[float],
    detectors: Sequence[Detector],
) -> Row:
    """Counts and delays; an alarm before the fault, a false one, has not caught it."""
    starts = [
        max(onset, float(run.t[0])) if len(run.t) else onset
        for run, onset in zip(runs, onsets, strict=True)
    ]
    said = [
        [r if r is not None and r.t >= start else None for r in (run.bad, run.alarm)]
        for run, start in zip(runs, starts, strict=True)
    ]
    statuses = [bad.status for bad, _ in said if bad is not None]
    alarms = [min((r.t for r in both if r is not None), default=None) for both in said]
    funnel = Caught(
        statuses.count(Status.OUTSIDE),
        statuses.count(Status.ASSUMPTION_VIOLATED),
        sum(run.lost and run.bad is None and run.alarm is None for run in runs),
        _delay(alarms, starts),
        sum(bad is None and alarm is not None for bad, alarm in said),
    )
    others = {}
    for detector in detectors:
        times = [_alarm(detector, run) for run in runs]
        times = [
            t if t is not None and t >= start else None
            for t, start in zip(times, starts, strict=True)
        ]
        caught = sum(t is not None for t in times)
        others[detector.name] = Caught(violated=caught, after=_delay(times, starts))
    return Row(fault, funnel, others)


def _alarm(detector: Detector, run: _Run) -> float | None:
    """When the detector alarms first."""
    found = detector.alarm(run.residuals) if len(run.t) else None
    return None if found is None else float(run.t[found])


def _delay(alarms: Sequence[float | None], starts: Sequence[float]) -> float:
    """The median of s from the first faulty sample that is judged to the alarm; NaN if none."""
    delays = [t - start for t, start in zip(alarms, starts, strict=True) if t is not None]
    return float(median(delays)) if delays else float("nan")
