"""Repeated experiments: the moment RIE without bias beside least squares, SEM and the naive RIE.

python -m benchmarks.repeated_experiments [--trials 10] [--minutes M] [--json]

System (3.13): 3y + y² + y³ = w(t) - Σ_k g(k) y(t-k), 15 lags, w uniform on [-1, 1], noise 0.05 on
two repeats; one excitation to train and one to test, new noise in every trial, as in thesis
Section 3.6. Errors are 100·‖y - ŷ‖/‖y - mean(y)‖ over 50 000 test samples, seconds are the
processor time of the proposed method and its exact proof; both are means over the trials, and
*_spread is the standard deviation. With --minutes no trial is begun after that many of them.
Published: Tables 3.1 and 3.2; from the printed system they do not come out.
"""

import math
import statistics
import time
from typing import Any

import numpy as np

from benchmarks.machine import parser, tell
from benchmarks.recorded import proved as is_proved
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.identification import Degrees, Polynomial
from nlsid_core.identification.polynomial.implicit_descent import minimise_equation
from nlsid_core.identification.polynomial.implicit_rie import (
    ImplicitFit,
    least_squares_coefficients,
    minimise_implicit_rie,
)
from nlsid_core.identification.polynomial.implicit_rows import build_implicit_rows
from nlsid_core.identification.polynomial.moments import rows_without_bias
from nlsid_core.identification.validation import simulation_percent
from nlsid_core.models import MonotoneEquation, Signal

ORDERS, LENGTHS, TEST = (1, 8, 15, 22), (500, 5_000, 50_000), 50_000
NOISE = 0.05
STEPS = 100  # of simulation error minimisation
METHODS = (
    "proposed",
    "least_squares",
    "sem",
    "naive",
    "noiseless",
    "sem_zero",
    "sem_least_squares",
)
PUBLISHED = {
    "n1_T50000.proposed": 6.9,
    "n8_T50000.proposed": 5.0,
    "n15_T50000.proposed": 1.3,
    "n22_T50000.proposed": 1.4,
    "n1_T5000.proposed": 7.3,
    "n8_T5000.proposed": 5.9,
    "n15_T5000.proposed": 3.0,
    "n15_T50000.seconds": 4.0,
    "n22_T50000.seconds": 15.0,
}


def system() -> MonotoneEquation:
    """(3.13) as printed."""
    g = np.zeros(16)
    g[0], g[1], g[8], g[15] = 5 / 4, 4 / 5, -1 / 10, -1 / 10
    return MonotoneEquation(
        e=np.array([3.0 + g[0], 1.0, 1.0]),
        a=-g[1:],
        b=np.ones(1),
        c=0.0,
        window=((0, 0),),
        y_offset=0.0,
        u_offset=np.zeros(1),
        period=1.0,
        y=Signal("y"),
        u=(Signal("w"),),
    )


def from_rest(model: MonotoneEquation, w: FloatArray) -> FloatArray:
    """The response to w with zeros before."""
    h = model.history
    return model.simulate(np.concatenate([np.zeros(h), w]))[h:]


def repeats(w: FloatArray, rng: np.random.Generator, noise: float) -> list[Trajectory]:
    """Two noisy responses to w from random initial conditions."""
    truth, runs = system(), []
    h = truth.history
    for k in range(2):
        y = truth.simulate(np.concatenate([np.zeros(h), w]), NOISE * rng.standard_normal(h))[h:]
        measured = y + noise * rng.standard_normal(len(y))
        t = np.arange(len(y), dtype=np.float64)
        runs.append(Trajectory(t=t, y=measured, u=w, name=f"run {k + 1}", group="pair"))
    return runs


def identify(runs: list[Trajectory], n: int) -> tuple[ImplicitFit, float]:
    """The proposed method and the processor time [s] of moments, program and exact proof."""
    started = time.process_time()
    model_class = Polynomial(n, (0,), Degrees(left=3), set="3.8")
    data = Dataset(tuple(runs))
    fit = minimise_implicit_rie(rows_without_bias(data, model_class, accept_untested_repeats=True))
    return fit, time.process_time() - started


def models(runs: list[Trajectory], clean: list[Trajectory], n: int) -> dict[str, MonotoneEquation]:
    """What the comparators find."""
    model_class, data = Polynomial(n, (0,), Degrees(left=3), set="3.8"), Dataset(tuple(runs))
    rows = build_implicit_rows(data, model_class)
    exact = build_implicit_rows(Dataset(tuple(clean)), model_class)
    e, f = squares = least_squares_coefficients(rows)
    starts = {"zero": (np.array([[1.0], [0.0], [1.0]]), 0.0 * f), "least_squares": squares}
    minima = {
        f"sem_{name}": found
        for name, start in starts.items()
        if (found := minimise_equation(rows, start, steps=STEPS)) is not None
    }
    return {
        "least_squares": rows.equation(e, f),
        "sem": min(minima.values(), key=lambda model: simulation_percent(model, data)),
        **minima,
        "naive": minimise_implicit_rie(rows).model,
        "noiseless": minimise_implicit_rie(exact).model,
    }


def measure(trials: int, seconds_left: float = math.inf) -> dict[str, Any]:
    """Mean errors [%], processor time [s] and proofs, per order and length, and how many `trials`.

    seconds_left: no trial is begun after that many of them, but one always is.
    """
    until = time.monotonic() + seconds_left
    rng = np.random.default_rng(0)
    w_train, w_test = (rng.uniform(-1.0, 1.0, size) for size in (max(LENGTHS), TEST))
    y_test = from_rest(system(), w_test)
    spread = float(np.linalg.norm(y_test - y_test.mean()))
    errors: dict[tuple[int, int, str], list[float]] = {}
    seconds: dict[tuple[int, int], list[float]] = {}
    proved: dict[tuple[int, int], list[bool]] = {}

    def score(n: int, T: int, method: str, model: MonotoneEquation) -> None:
        error = 100.0 * float(np.linalg.norm(y_test - from_rest(model, w_test))) / spread
        errors.setdefault((n, T, method), []).append(error)

    for trial in range(trials):
        if trial and time.monotonic() > until:
            trials = trial
            break
        noisy = repeats(w_train, np.random.default_rng([1, trial]), NOISE)
        clean = repeats(w_train, np.random.default_rng([1, trial]), 0.0)
        for T in LENGTHS:
            runs, exact = ([_shortened(run, T) for run in pair] for pair in (noisy, clean))
            for n in ORDERS:
                fit, elapsed = identify(runs, n)
                seconds.setdefault((n, T), []).append(elapsed)
                proved.setdefault((n, T), []).append(is_proved(fit.model, fit.proof))
                score(n, T, "proposed", fit.model)
                if max(LENGTHS) == T:
                    for method, model in models(runs, exact, n).items():
                        score(n, T, method, model)
        print(f"trial {trial + 1} of {trials}", flush=True)
    found: dict[str, Any] = {"trials": trials}
    for n, T in seconds:
        columns = {m: errors[n, T, m] for m in METHODS if (n, T, m) in errors}
        columns["seconds"] = seconds[n, T]
        found[f"n{n}_T{T}"] = {
            **{name: statistics.mean(values) for name, values in columns.items()},
            **{
                f"{name}_spread": statistics.stdev(values)
                for name, values in columns.items()
                if trials > 1
            },
            "proved": all(proved[n, T]),
        }
    return found


def _shortened(run: Trajectory, samples: int) -> Trajectory:
    return Trajectory(
        t=run.t[:samples], y=run.y[:samples], u=run.u[:samples], name=run.name, group=run.group
    )


def main() -> None:
    """Print the figures, and with --json one JSON object as the last line."""
    options = parser(__doc__)
    options.add_argument("--trials", type=int, default=10)
    options.add_argument("--minutes", type=float, default=math.inf, help="then begin no trial")
    arguments = options.parse_args()
    result = measure(arguments.trials, 60.0 * arguments.minutes)
    tell(result, PUBLISHED, as_json=arguments.json)


if __name__ == "__main__":
    main()
