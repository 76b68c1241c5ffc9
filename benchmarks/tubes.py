"""Tubes around the simulation of identified models: how wide, how fast, and what they catch.

python -m benchmarks.tubes [--json]

Models of the shipped F1TENTH recordings: half of the training trials identify a model and design
its tube, the other half scale it, and the test trials are judged, untouched and sabotaged. Widths
are per amplitude (half the range), at safety factor 1; published are earlier figures of the same
tubes, scaled on all trials.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import statistics
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import read_trials
from bags.monitoring.catching import what_it_catches
from bags.samples import f1tenth
from benchmarks.machine import describe
from nlsid_core.data.trajectory import Dataset
from nlsid_core.design.tube import design_output_tube, energy, innovations
from nlsid_core.identification import (
    ImplicitClass,
    LinearClass,
    identify,
)
from nlsid_core.identification.prediction import simulate_trial
from nlsid_core.running.monitor import Monitor
from nlsid_core.running.reading import Status

FACTOR = 1.5
PUBLISHED = {
    "f1tenth_linear": {"response": 0.470, "fading": 0.606, "energy": 0.727},
    "f1tenth_implicit": {"response": 0.968, "fading": 1.19, "energy": 1.28},
}
CHECKS = 5  # repetitions; the median is reported


@dataclass(frozen=True, eq=False)
class Case:
    """Trials to identify on, to scale on, and to judge; horizon: s of the energy beside it."""

    model_class: Any
    train: Dataset
    calibration: Dataset
    judged: Dataset
    horizon: float


def f1tenth_case(model_class: Any) -> Case:
    """Commanded to measured speed: the test trials of the shipped configuration are judged."""
    config = load_config(config_file("f1tenth.yaml"))
    plain = config.split.model_copy(update={"calibration": ()})
    trials = read_trials(
        f1tenth(), config.model_copy(update={"split": plain}), progress=lambda _w, _f: None
    )
    recorded = trials.train.trajectories
    train, calibration = Dataset(recorded[::2]), Dataset(recorded[1::2])
    return Case(model_class, train, calibration, trials.test, 114 * config.grid.period)


def measure(case: Case) -> dict[str, float | int]:
    """The promised keys of one case."""
    model = identify(case.train, case.model_class).model
    started = time.perf_counter()
    made = design_output_tube(
        model, case.train, case.calibration, safety_factor=FACTOR, horizon=case.horizon
    )
    design_seconds = time.perf_counter() - started
    seconds = []
    for _ in range(CHECKS):
        started = time.perf_counter()
        made.decided()
        seconds.append(time.perf_counter() - started)
    y = np.concatenate([t.y for t in (*case.train, *case.calibration)])
    amplitude = float(np.ptp(y[:, 0])) / 2.0
    settling = made.funnel.settling
    errors = [
        float(np.abs(simulate_trial(model, t)[settling:] - t.y[settling:])[:, 0].max())
        for t in case.calibration
    ]
    fading, ending = made.funnel.tubes
    keys: dict[str, float | int] = {
        "half_width_response": max(errors) / amplitude,
        "half_width_fading": float(np.sqrt(fading.measured / fading.tau[0])) / amplitude,
        "half_width_energy": float(np.sqrt(ending.measured / ending.tau[0])) / amplitude,
        "design_s": design_seconds,
        "check_ms": 1e3 * statistics.median(seconds),
    }
    lasting = replace(made.funnel, tubes=(fading,))
    monitor = Monitor(model, None, lasting)
    outside, busy, samples = 0, 0.0, 0
    for trial in case.judged:
        monitor.restart()
        E = energy(innovations(model, fading.L[None], trial, settling)[:, 0], fading)
        kept = np.concatenate([np.zeros(settling, bool), fading.level >= E])
        started = time.perf_counter()
        said = [
            monitor.update(t, *given)
            for t, *given in zip(trial.t.tolist(), trial.y, trial.u, strict=True)
        ]
        busy, samples = busy + time.perf_counter() - started, samples + len(trial)
        outside += sum(
            bool(k) and r.status is Status.OUTSIDE for k, r in zip(kept, said, strict=True)
        )
    keys |= {"update_us": 1e6 * busy / samples, "outside_with_assumption_kept": outside}
    caught = what_it_catches(
        monitor, model, fading.half_widths.tolist(), held_back=case.judged,
        calibration=case.calibration, ranges=np.ptp(y, axis=0), factor=FACTOR, remedy="",
    )  # fmt: skip
    untouched, *faults = caught.rows
    after = [row.funnel.after for row in faults if np.isfinite(row.funnel.after)]
    keys |= {
        "false_alarms": untouched.funnel.count,
        "trials": len(case.judged),
        "sabotages": len(faults),
        "caught": sum(row.funnel.count for row in faults),
        "delay_median": statistics.median(after) if after else float("nan"),
    }
    for name, key in (("CUSUM", "cusum"), ("3σ", "sigma"), ("box", "box")):
        keys[f"caught_{key}"] = sum(row.others[name].count for row in faults if row.others)
    return keys


def main() -> None:
    """Print the table, and with --json one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="last line is one JSON object")
    arguments = parser.parse_args()
    cases = {
        "f1tenth_linear": f1tenth_case(LinearClass(4)),
        "f1tenth_implicit": f1tenth_case(ImplicitClass(4)),
    }
    print(f"tubes around the simulation of identified models, {describe()}\n")
    keys: dict[str, float | int] = {}
    for name, case in cases.items():
        found = measure(case)
        keys |= {f"{name}_{key}": value for key, value in found.items()}
        print(name)
        for key, value in found.items():
            published = PUBLISHED[name].get(key.removeprefix("half_width_"), "")
            print(f"  {key:32s}{value:12.4g}{published!s:>12s}")
    if arguments.json:
        print(json.dumps(keys))


if __name__ == "__main__":
    main()
