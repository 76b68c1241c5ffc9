"""Heat exchanger: simulation errors over the iterates, and models stable for every input.

python -m benchmarks.heat_exchanger --data DIR [--json]

q(w) quadratic, p cubic in w = [u(t) … u(t-n)]; trained on the first 1500 of 4000 samples, scored on
all of them from the training mean. Published: Tobenkin (2014), Table 4.1.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import tempfile
import time
from pathlib import Path

from benchmarks.f1tenth import is_proved
from benchmarks.machine import describe
from benchmarks.recorded import heat_exchanger, percent, single
from nlsid_core import files
from nlsid_core.identification import Degrees, Polynomial, prove_stability
from nlsid_core.identification.methods.rse import robust_simulation_error
from nlsid_core.identification.polynomial.certified import (
    certified_simulation_error,
    descend_certified,
)
from nlsid_core.identification.polynomial.rie import robust_identification_error
from nlsid_core.identification.polynomial.rows import build_state_affine_rows
from nlsid_core.models import StateAffineModel

TRAINING = 1500
FLOW_RANGE = (0.1, 0.7)  # of the plant's valve, stated with the data
ITERATES = 40
PUBLISHED = {
    "rie": (27.9, 24.4, 20.5),
    "first": (20.7, 17.7, 13.7),
    "fifth": (13.7, 11.4, 9.7),
    "nlarx, simulation error": (26.7, 26.4, 26.4),
}


def measure(data: Path, n: int) -> dict[str, float | bool]:
    """Errors in % at n lags, and whether the exact checker proves the certified model."""
    flow, temperature = heat_exchanger(data)
    train = single("exchanger", flow[:TRAINING], temperature[:TRAINING], 1.0)
    model_class = Polynomial(n, degrees=Degrees(inputs=3, leading=2), input_range=(FLOW_RANGE,))
    problem = build_state_affine_rows(train, model_class)

    def score(model: StateAffineModel) -> float:
        return percent(temperature, model.simulate(flow[:, None])[:, 0])

    started = time.perf_counter()
    keys: dict[str, float | bool] = {"rie": score(robust_identification_error(problem)[0])}
    keys["rie_seconds"] = time.perf_counter() - started
    started = time.perf_counter()
    iterates = list(robust_simulation_error(problem.rows, iterations=ITERATES))
    keys["seconds"] = time.perf_counter() - started
    for name, iterate in (
        ("first", iterates[0]),
        ("fifth", iterates[4]),
        ("converged", iterates[-1]),
    ):
        keys[name] = score(problem.model(iterate.theta, iterate.p))
    started = time.perf_counter()
    *_, last = certified_simulation_error(problem, iterations=ITERATES)
    model = problem.model(last.point.theta, last.point.p)
    proof = prove_stability(model)
    assert proof is not None, "the certified set was left"
    keys["certified_seconds"] = time.perf_counter() - started
    keys["certified"] = score(model)
    with tempfile.TemporaryDirectory() as folder:
        files.write_document(Path(folder) / "model.json", model.document())
        path = Path(folder) / "model.proof.json"
        files.write_document(path, proof.document(model, "model.json"))
        keys["certified_proved"] = is_proved(path)
    keys["certified_rate"] = proof.rate
    started = time.perf_counter()
    lowest = descend_certified(problem, model, proof)
    keys["last_step_seconds"] = time.perf_counter() - started
    keys["last_step"] = score(lowest)
    keys["last_step_proved"] = prove_stability(lowest) is not None
    return keys


def main() -> None:
    """Print the table, and with --json one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with exchanger.dat")
    parser.add_argument("--json", action="store_true", help="last line is one JSON object")
    arguments = parser.parse_args()
    started, processor = time.perf_counter(), time.process_time()
    keys = {f"n{n}": measure(arguments.data, n) for n in (2, 3, 4)}
    seconds, processor = time.perf_counter() - started, time.process_time() - processor
    print(f"heat exchanger, test error [%], ours (published), {describe()}\n")
    print(f"{'':40s}" + "".join(f"{name:>18s}" for name in keys))
    for label, key in (
        ("robust identification error", "rie"),
        ("robust simulation error, 1st iterate", "first"),
        ("  5th iterate", "fifth"),
        (f"  converged (at most {ITERATES})", "converged"),
        ("  stable for every input", "certified"),
        ("  and the simulation error minimised", "last_step"),
    ):
        published = PUBLISHED.get(key, ("-",) * 3)
        cells = zip(keys.values(), published, strict=True)
        print(f"{label:40s}" + "".join(f"{entry[key]:10.2f}{f'({p})':>8s}" for entry, p in cells))
    for label, key in (("  proved exactly", "certified_proved"), ("  its rate", "certified_rate"),
                       ("  seconds, converged", "seconds"),
                       ("  seconds, stable for every input", "certified_seconds")):  # fmt: skip
        print(f"{label:40s}" + "".join(f"{entry[key]!s:>18.8s}" for entry in keys.values()))
    print(f"\nwhole benchmark {seconds:.1f} s, {processor:.1f} s of one processor")
    if arguments.json:
        print(json.dumps({**keys, "seconds": seconds, "processor_seconds": processor}))


if __name__ == "__main__":
    main()
