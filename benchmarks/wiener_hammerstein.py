"""Wiener-Hammerstein benchmark 2009: difference equations, then a certified block cascade.

python -m benchmarks.wiener_hammerstein --data DIR [--json]

By the thesis's protocol: Σ q_k y(t-k) = p(u(t) … u(t-n)), p cubic; trained on samples 10001-14000,
the iterate chosen on 80001-100000, stopped below 1 % improvement, tested on 100001-180000 from the
training mean. Published: Tobenkin (2014), Tables 4.2 and 4.3; for the cascade see
benchmarks.wiener_hammerstein_cascade.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.f1tenth import is_proved
from benchmarks.machine import describe
from benchmarks.recorded import percent, single, wiener_hammerstein
from benchmarks.wiener_hammerstein_cascade import measure as measure_cascade
from nlsid_core import files
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.identification import Degrees, Polynomial, prove_stability
from nlsid_core.identification.methods.rse import robust_simulation_error
from nlsid_core.identification.polynomial.rows import build_state_affine_rows
from nlsid_core.models import StateAffineModel

PERIOD = 1.0 / 51200.0  # s
ESTIMATION = slice(5100, 100_000)
THESIS_TRAIN = slice(10_000, 14_000)
THESIS_VALIDATION = slice(80_000, 100_000)
THESIS_TEST = slice(100_000, 180_000)
RUN_IN = 1000  # samples in which every initial condition is forgotten
IMPROVEMENT = 0.01
ITERATES = 20
ORDERS = (3, 5, 7)
PUBLISHED = {"first": (99.9, 66.0, 31.0), "final": (6.5, 4.9, 5.0), "rmse_v": ("-", 0.0119, "-")}

Keys = dict[str, float | bool]


def stored_and_proved(model: Json, proof: Json) -> bool:
    """What the exact checker says of the files."""
    with tempfile.TemporaryDirectory() as folder:
        files.write_document(Path(folder) / "model.json", model)
        files.write_document(Path(folder) / "model.proof.json", proof)
        return is_proved(Path(folder) / "model.proof.json")


def simulate(model: StateAffineModel, u: FloatArray, samples: slice) -> FloatArray:
    """The response on `samples`, from the training mean a thousand samples earlier."""
    begin = samples.start - RUN_IN
    return model.simulate(u[begin : samples.stop, None])[RUN_IN:, 0]


def difference_equation(u: FloatArray, y: FloatArray, n: int, train: slice) -> Keys:
    """First and chosen iterate at n lags: errors in % and V on the thesis's test samples."""
    problem = build_state_affine_rows(
        single("estimation", u[train], y[train], PERIOD),
        Polynomial(
            n, degrees=Degrees(inputs=3), input_range=((float(np.min(u)), float(np.max(u))),)
        ),
    )
    started = time.perf_counter()
    iterates: list[tuple[float, StateAffineModel]] = []
    for iterate in robust_simulation_error(
        problem.rows, iterations=ITERATES, tolerance=IMPROVEMENT
    ):
        model = problem.model(iterate.theta, iterate.p)
        validation = simulate(model, u, THESIS_VALIDATION)
        iterates.append((percent(y[THESIS_VALIDATION], validation), model))
    model = min(iterates, key=lambda entry: entry[0])[1]
    seconds = time.perf_counter() - started
    proof = prove_stability(model)
    measured, simulated = y[THESIS_TEST], simulate(model, u, THESIS_TEST)
    residual = measured - simulated
    return {
        "first": percent(measured, simulate(iterates[0][1], u, THESIS_TEST)),
        "final": percent(measured, simulated),
        "rmse_v": float(np.sqrt(np.mean(residual**2))),
        "proved": proof is not None
        and stored_and_proved(model.document(), proof.document(model, "model.json")),
        "seconds": seconds,
    }


def main() -> None:
    """Print the tables, and with --json one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with the CSV file")
    parser.add_argument("--json", action="store_true", help="last line is one JSON object")
    arguments = parser.parse_args()
    u, y = wiener_hammerstein(arguments.data)
    results = {f"n{n}": difference_equation(u, y, n, THESIS_TRAIN) for n in ORDERS}
    full = difference_equation(u, y, 5, ESTIMATION)
    print(f"Wiener-Hammerstein 2009, {describe()}\n\ndifference equations, ours (published)")
    print(f"{'':28s}" + "".join(f"{name:>20s}" for name in results))
    for label, key in (
        ("first iterate [%]", "first"),
        ("chosen iterate [%]", "final"),
        ("chosen iterate [V]", "rmse_v"),
    ):
        cells = zip(results.values(), PUBLISHED[key], strict=True)
        print(f"{label:28s}" + "".join(f"{r[key]:11.5g}{f'({p})':>9s}" for r, p in cells))
    for key in ("proved", "seconds"):
        print(f"{key:28s}" + "".join(f"{r[key]!s:>20.6s}" for r in results.values()))
    print(f"\nn5 on the full estimation set: {full['rmse_v']:.5f} V in {full['seconds']:.1f} s, "
          f"proved {full['proved']}")  # fmt: skip
    cascade, _ = measure_cascade(arguments.data)
    print(
        f"\nblock cascade, official test: {cascade['cascade_mv']:.4f} mV (published 0.241, no "
        f"certificate), proved {cascade['cascade_proved']}, {cascade['cascade_seconds']:.1f} s"
    )
    if arguments.json:
        full_keys = {f"full_{key}": value for key, value in full.items()}
        print(json.dumps({**results, **full_keys, **cascade}))


if __name__ == "__main__":
    main()
