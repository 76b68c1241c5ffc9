"""Heat exchanger: simulation errors over the iterates, and models stable for every input.

python -m benchmarks.heat_exchanger --data DIR [--json]

q(w) quadratic, p cubic in w = [u(t) … u(t-n)]; trained on the first 1500 of 4000 samples, scored on
all of them from the training mean. Published: Tobenkin (2014), Table 4.1.
"""

import time
from pathlib import Path

from benchmarks.machine import parser, spending, tell
from benchmarks.recorded import heat_exchanger, percent, proved, single
from benchmarks.thesis.rie import robust_identification_error
from nlsid_core.identification import Degrees, Polynomial, prove_stability
from nlsid_core.identification.methods.rse import robust_simulation_error
from nlsid_core.identification.polynomial.certified import (
    certified_simulation_error,
    descend_certified,
)
from nlsid_core.identification.polynomial.rows import build_state_affine_rows
from nlsid_core.models import StateAffineModel

TRAINING = 1500
FLOW_RANGE = (0.1, 0.7)  # of the plant's valve, stated with the data
ITERATES = 40
ORDERS = (2, 3, 4)
PUBLISHED = {
    "rie": (27.9, 24.4, 20.5),
    "first": (20.7, 17.7, 13.7),
    "fifth": (13.7, 11.4, 9.7),
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
    keys["certified_proved"] = proved(model, proof)
    keys["certified_rate"] = proof.rate
    started = time.perf_counter()
    lowest = descend_certified(problem, model, proof)
    keys["last_step_seconds"] = time.perf_counter() - started
    keys["last_step"] = score(lowest)
    keys["last_step_proved"] = prove_stability(lowest) is not None
    return keys


def main() -> None:
    """Print the figures, and with --json one JSON object as the last line."""
    arguments = parser(__doc__, data=True).parse_args()
    with spending() as spent:
        keys = {f"n{n}": measure(arguments.data, n) for n in ORDERS}
    published = {
        f"n{n}.{key}": value
        for key, values in PUBLISHED.items()
        for n, value in zip(ORDERS, values, strict=True)
    }
    result = {**keys, "seconds": spent.seconds, "processor_seconds": spent.processor}
    tell(result, published, as_json=arguments.json)


if __name__ == "__main__":
    main()
