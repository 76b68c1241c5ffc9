"""Tubes around the simulation of identified models: how wide, how fast, and what they catch.

python -m benchmarks.tubes [--data DIR] [--case NAME]... [--lasting SAMPLES] [--json]

DIR holds f1tenth, exchanger, wh2009, schunk_arm, emps and kuka_kr300; without it the shipped
F1TENTH recordings are measured. Some trials identify a model and design its tube, others scale it,
others yet are judged, untouched and sabotaged. Widths are per amplitude (half the range), the mean
over outputs, at safety factor 1: `fading` is the tube of the fast observer (where it follows the
commands, its mean), `headline` the last of those for ever. `response` is the simulation's largest
error, of each output for itself; at one scale it promises what a tube does, of any output's alarm.
Times are of the processor, a sample's update that of the quickest trial. `unjudged` are sabotaged
trials of which a part was unknown and nothing else was said. Published are figures of a trial of
the method, each scaled by itself.
"""

import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import read_trials
from bags.monitoring.catching import Caught, what_it_catches
from bags.samples import f1tenth
from benchmarks import recorded
from benchmarks.machine import parser, tell
from benchmarks.processes import resident_mb
from benchmarks.recorded import block_means
from nlsid_core.arrays import FloatArray
from nlsid_core.data.calibration import recording
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.design import OutputTube
from nlsid_core.design.tube import design_output_tube, energy, innovations
from nlsid_core.errors import NlsidError
from nlsid_core.funnels.tube import Tube
from nlsid_core.identification import (
    Degrees,
    FilterMapFilter,
    Method,
    Network,
    Polynomial,
    Rse,
    identify,
)
from nlsid_core.progress import silent
from nlsid_core.running.monitor import Monitor
from nlsid_core.running.stage import Stage

FACTOR = 1.2  # the default
CHECKS = 5  # repetitions; the median is reported
FORMS = ("response", "headline", "fading")
PUBLISHED = {
    "f1tenth_linear": (0.529, 0.551, 0.723),
    "f1tenth_implicit": (0.649, 0.677, 0.880),
    "f1tenth_two": (0.361, 0.376, 0.476),
    "exchanger": (0.268, 0.284, 0.529),
    "wh2009": (0.0189, 0.0202, 0.0257),
    "schunk": (0.284, 0.300, 2.27),
    "emps": (0.0003, 0.0003, 0.0015),
    "kuka_1": (0.0040, 0.0041, 0.0047),
    "kuka_2": (0.0058, 0.0066, 0.0143),
    "kuka_3": (0.0329, 0.0351, 0.0430),
}


@dataclass(frozen=True, eq=False)
class Case:
    """Trials to identify on, to scale on, and to judge."""

    model_class: Any
    train: Dataset
    calibration: Dataset
    judged: Dataset
    method: Method | None = None


def f1tenth_case(model_class: Any) -> Case:
    """Commanded to measured speed: the test trials of the shipped configuration are judged."""
    config = load_config(config_file("f1tenth.yaml"))
    plain = config.split.model_copy(update={"calibration": ()})
    trials = read_trials(f1tenth(), config.model_copy(update={"split": plain}), progress=silent)
    recorded = trials.train.trajectories
    train, calibration = Dataset(recorded[::2]), Dataset(recorded[1::2])
    return Case(model_class, train, calibration, trials.test)


def named(trials: Sequence[Trajectory]) -> Dataset:
    """Each with a digest of its samples, as a recording of its own."""
    return Dataset(tuple(replace(trial, digest=recording(trial)) for trial in trials))


def thirds(trials: Sequence[Trajectory], model_class: Any) -> Case:
    """Of every three trials one identifies and designs, one scales, one is judged."""
    train, calibration, judged = (named(trials[k::3]) for k in range(3))
    return Case(model_class, train, calibration, judged)


def f1tenth_two_case(data: Path) -> Case:
    """Steering and speed commands to yaw rate (over four samples) and speed."""
    trials = []
    for k, (u, motion) in recorded.f1tenth_car(data / "f1tenth").items():
        yaw, speed = np.unwrap(motion[:, 2]), motion[:, 3]
        y = np.column_stack([(yaw[4:] - yaw[:-4]) / 0.1, speed[4:]])[: len(u) - 4]
        trials.append(
            Trajectory(
                t=0.025 * np.arange(len(y)), y=y, u=u[4:], name=f"{k}", y_names=("yaw", "speed")
            )
        )
    return thirds(trials, Polynomial(6, (1, 2, 3, 4, 5, 6)))


def in_parts(
    u: FloatArray, y: FloatArray, period: float, samples: int, name: str
) -> list[Trajectory]:
    """One recording cut into trials of so many samples."""
    return [
        Trajectory(
            t=period * np.arange(samples),
            y=y[k : k + samples],
            u=u[k : k + samples],
            name=f"{name} {k // samples}",
        )
        for k in range(0, len(y) - samples + 1, samples)
    ]


def exchanger_case(data: Path) -> Case:
    """Flow to temperature, state-affine with a quadratic G_0."""
    u, y = recorded.heat_exchanger(data / "exchanger")
    trials = in_parts(u, y, 1.0, 250, "exchanger")
    model_class = Polynomial(4, (0, 1, 2), Degrees(inputs=3, leading=2), input_range=((0.1, 0.7),))
    train, calibration, judged = map(named, (trials[:6], trials[6:11], trials[11:]))
    return Case(model_class, train, calibration, judged, Rse(certified=True))


def wh2009_case(data: Path) -> Case:
    """The circuit's voltages, block cascade (3, 3)."""
    u, y = recorded.wiener_hammerstein(data / "wh2009")
    whole = in_parts(u[5000:25000], y[5000:25000], 1 / 51200, 20000, "train")
    later = in_parts(u[30000:60000], y[30000:60000], 1 / 51200, 2000, "later")
    train, calibration, judged = map(named, (whole, later[:10], later[10:]))
    model_class = Network(FilterMapFilter(phases=2, intervals=24, starts=6, begin="rest"))
    return Case(model_class, train, calibration, judged)


def schunk_case(data: Path) -> Case:
    """Six torques to six velocities at 50 Hz."""
    measured = recorded.schunk(data / "schunk_arm", range(1, 101, 2))
    trials = [block_means(u, y, 0.004, 5, str(k)) for k, (u, y) in measured.items()]
    return thirds(trials, Polynomial(2))


def emps_case(data: Path) -> Case:
    """Reference to measured position of a servo with dry friction, 100 Hz."""
    table = recorded.emps(data / "emps")
    whole = block_means(table["qg"], table["qm"], 1e-3, 10, "emps")
    return thirds(in_parts(whole.u, whole.y, 0.01, 270, "emps"), Polynomial(5))


def kuka_case(data: Path, joint: int) -> Case:
    """Reference to measured motor angle, in windows of 2 s."""
    trials = []
    signals = ("ref_pos_deg", "act_pos_mot_deg")
    for letter, (u, y) in recorded.kuka(data / "kuka_kr300", signals).items():
        whole = block_means(u[joint - 1], y[joint - 1], 4e-3, 2, letter)
        trials += in_parts(whole.u, whole.y, 8e-3, 200, letter)
    return thirds(trials, Polynomial(4))


SHIPPED: dict[str, Callable[[], Case]] = {
    "f1tenth_linear": partial(f1tenth_case, Polynomial(4)),
    "f1tenth_implicit": partial(f1tenth_case, Polynomial(4, degrees=Degrees(left=3), set="2.11")),
}
RECORDED: dict[str, Callable[[Path], Case]] = {
    "f1tenth_two": f1tenth_two_case,
    "exchanger": exchanger_case,
    "wh2009": wh2009_case,
    "schunk": schunk_case,
    "emps": emps_case,
    **{f"kuka_{j}": partial(kuka_case, joint=j) for j in (1, 2, 3)},
}


def widths(model: Any, made: Any, case: Case, amplitudes: FloatArray) -> dict[str, float]:
    """Of every form, at factor 1, per amplitude: the mean over outputs."""
    settling: int = made.funnel.settling
    u = [trial.u for trial in case.calibration]
    still = np.zeros((1, *made.funnel.tubes[0].L.shape))
    largest, designed = (
        np.max(
            [np.abs(innovations(model, still, t, settling)[:, 0]).max(axis=0) for t in trials], 0
        )
        for trials in (case.calibration, case.train)
    )

    def mean(tube: Tube) -> FloatArray:
        if tube.follows is None:
            return np.asarray(tube.half_widths)
        rows = [tube.follows.along(now)[settling:] for now in u]
        return np.asarray(tube.half_widths * float(np.mean(np.sqrt(np.concatenate(rows)))))

    tubes = made.funnel.tubes
    found = {
        "response": largest,
        "response_at_one_scale": designed * np.max(largest / designed),
        "headline": mean(tubes[-1]) / FACTOR,
        "fading": mean(tubes[0]) / FACTOR,
    }
    inferred = 1.0 - tubes[-1].peak.direct * tubes[-1].peak.at_most / tubes[-1].half_widths
    keys = {form: float(np.mean(width / amplitudes)) for form, width in found.items()}
    return keys | {"share_inferred": float(np.mean(inferred))}


def outside(model: Any, made: Any, trial: Trajectory) -> int:
    """Samples at which an output leaves a tube of which the assumption is kept so far."""
    settling, count = made.funnel.settling, 0
    for tube in made.funnel.tubes:
        gains = np.stack([tube.L, 0.0 * tube.L])
        e, o = innovations(model, gains, trial, settling).swapaxes(0, 1)
        g = np.ones(len(e))
        if tube.follows is not None:
            g = tube.follows.along(trial.u)[settling:]
        kept = energy(e, tube) <= tube.level * g
        if tube.peak is not None:
            kept &= (np.abs(e) <= tube.peak.at_most * np.sqrt(np.maximum(g, 1.0))[:, None]).all(1)
        left = (np.abs(o) > tube.half_widths * np.sqrt(g)[:, None]).any(axis=1)
        count += int((left & np.logical_and.accumulate(kept))[: tube.samples].sum())
    return count


def measure(case: Case) -> dict[str, float | int]:
    """The promised keys of one case."""
    started = time.process_time()
    model = identify(case.train, case.model_class, method=case.method).model
    keys: dict[str, float | int] = {"identify_s": time.process_time() - started}
    started = time.process_time()
    made = design_output_tube(OutputTube(model, case.train, case.calibration, safety_factor=FACTOR))
    keys["design_s"] = time.process_time() - started
    seconds = []
    for _ in range(CHECKS):
        started = time.process_time()
        made.decided()
        seconds.append(time.process_time() - started)
    keys["check_ms"] = 1e3 * statistics.median(seconds)
    y = np.concatenate([t.y for t in (*case.train, *case.calibration)])
    ranges = np.ptp(y, axis=0)
    keys |= widths(model, made, case, ranges / 2.0)
    keys["follows"] = int(made.funnel.tubes[0].follows is not None)
    keys["tubes"] = len(made.funnel.tubes)
    monitor = made.monitor()
    left, busy = 0, float("inf")
    for trial in case.judged:
        monitor.restart()
        started = time.process_time()
        for t, *given in zip(trial.t.tolist(), trial.y, trial.u, strict=True):
            monitor.update(t, *given)
        busy = min(busy, (time.process_time() - started) / len(trial))
        left += outside(model, made, trial)
    keys |= {"update_us": 1e6 * busy, "outside_with_assumption_kept": left}
    caught = what_it_catches(
        made,
        held_back=case.judged,
        calibration=case.calibration,
        ranges=ranges,
    )
    untouched, *faults = caught.rows
    keys |= {
        "false_alarms": untouched.funnel.count,
        "trials": len(case.judged),
        "sabotages": len(faults),
        "caught": sum(row.funnel.count for row in faults),
        "caught_without_alarm": sum(row.funnel.outside + row.funnel.violated for row in faults),
        "unjudged": sum(row.funnel.unjudged for row in faults),
        "delay_median": _median([row.funnel for row in faults]),
    }
    for name, key in (("CUSUM", "cusum"), ("3σ", "sigma"), ("box", "box")):
        others = [row.others[name] for row in faults if row.others]
        keys[f"caught_{key}"] = sum(each.count for each in others)
        keys[f"delay_{key}"] = _median(others)
    return keys


def _median(found: Sequence[Caught]) -> float:
    """The median over faults of s from a fault to the alarm; NaN if none is caught."""
    after = [each.after for each in found if np.isfinite(each.after)]
    return statistics.median(after) if after else float("nan")


def lasting(samples: int) -> dict[str, float]:
    """One monitor over so many samples: µs of a sample in the first and the last tenth (the least
    over trials), and by how much the process grew between them.
    """
    case = f1tenth_case(Polynomial(4))
    model = identify(case.train, case.model_class, method=case.method).model
    made = design_output_tube(OutputTube(model, case.train, case.calibration))
    monitor, k = Monitor([Stage(model, None, made.funnel)]), 0
    tenths: list[list[float]] = [[] for _ in range(10)]
    grown = [0.0] * 10
    while k < samples:
        for trial in case.judged:
            started, tenth = time.process_time(), min(10 * k // samples, 9)
            for y, u in zip(trial.y, trial.u, strict=True):
                monitor.update(k * model.period, y, u)
                k += 1
            tenths[tenth].append((time.process_time() - started) / len(trial))
            grown[tenth] = resident_mb(os.getpid())
    first, last = (1e6 * min(tenths[i]) for i in (0, 9))
    return {
        "lasting_samples": k,
        "lasting_first_us": first,
        "lasting_last_us": last,
        "lasting_grown_mb": grown[9] - grown[0],
    }


def main() -> None:
    """Print the figures, and with --json one JSON object as the last line."""
    options = parser(__doc__)
    options.add_argument("--data", type=Path, help="folder of the recordings that do not ship")
    options.add_argument("--case", action="append", help="one of the cases; repeat for several")
    options.add_argument(
        "--lasting", type=int, help="samples of one run, e.g. 10000000: nothing else"
    )
    arguments = options.parse_args()
    if arguments.lasting:
        tell(lasting(arguments.lasting), as_json=arguments.json)
        return
    cases: dict[str, Callable[[], Case]] = dict(SHIPPED)
    if arguments.data is not None:
        cases |= {name: partial(made, arguments.data) for name, made in RECORDED.items()}
    keys: dict[str, float | int | str] = {}
    for name in arguments.case or cases:
        print(name, flush=True)
        try:
            found = measure(cases[name]())
        except NlsidError as refused:
            keys[f"{name}_refused"] = str(refused)
            continue
        keys |= {f"{name}_{key}": value for key, value in found.items()}
    published = {
        f"{name}_{form}": value
        for name, values in PUBLISHED.items()
        for form, value in zip(FORMS, values, strict=True)
    }
    tell(keys, published, as_json=arguments.json)


if __name__ == "__main__":
    main()
