"""The one-dimensional example of thesis Section 7.1 against its true backward reachable set.

    python -m benchmarks.one_dimensional [--json] [--plot FILE]

Known: the best symmetric funnel covers 87.2 % of the true set. `ratio` is the mean radius over the
best one, `area` the fraction of the true set that is proved; both for 40 and 160 knots.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import describe
from benchmarks.thesis.alternation import alternate_rho, exponential_start
from examples.one_dimensional import BEST_AREA, designed, problem, radius, true_sets
from nlsid_core.design.continuous.lstep import LSteps

TIMES = np.linspace(-1.0, 1.0, 2001)


def run() -> dict[str, Any]:
    """Everything the benchmark promises."""
    width, best = true_sets(TIMES)
    result: dict[str, Any] = {"best_area": float(2 * best.mean() / width.mean())}
    for knots in (40, 160):
        started = time.perf_counter()
        found = designed(knots)
        result[f"seconds_{knots}"] = time.perf_counter() - started
        result[f"ratio_{knots}"] = float((radius(found.funnel, TIMES) / best).mean())
        result[f"area_{knots}"] = float(2 * radius(found.funnel, TIMES).mean() / width.mean())
        result[f"pieces_{knots}"] = len(found.found.proved.pieces)
        steps = LSteps(problem(knots)[0])
        start = exponential_start(steps, found.policy, found.funnel.P)
        two = alternate_rho(steps, found.policy, start, stop=0.0, iterations=2)
        two_radii = radius(two.funnel, TIMES)
        result[f"two_alternations_ratio_{knots}"] = float((two_radii / best).mean())
        iterates = alternate_rho(steps, found.policy, start, stop=1e-3)
        result[f"start_ratio_{knots}"] = float((radius(start, TIMES) / best).mean())
        result[f"alternation_ratio_{knots}"] = float((radius(iterates.funnel, TIMES) / best).mean())
        result[f"alternations_{knots}"] = len(iterates.volumes) - 1
    return result


def draw(path: Path) -> None:
    """Figure 7.1: the true set, the best symmetric funnel and the proved one."""
    from matplotlib.figure import Figure

    width, best = true_sets(TIMES)
    funnel = designed().funnel
    middle = funnel.x(TIMES)[:, 0]
    low = _lower(TIMES)
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    axes.fill_between(TIMES, low, low + width, alpha=0.15, label="true backward reachable set")
    for r, label in ((best, "best symmetric"), (radius(funnel, TIMES), "proved")):
        (line,) = axes.plot(TIMES, middle + r, label=label)
        axes.plot(TIMES, middle - r, color=line.get_color())
    axes.set_xlabel("time [s]")
    axes.set_ylabel("x")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=130)


def _lower(t: np.ndarray) -> np.ndarray:
    from scipy.integrate import solve_ivp

    from examples.one_dimensional import dynamics

    found = solve_ivp(
        lambda s, x: dynamics(s, x), (1.0, -1.0), [0.0], t_eval=t[::-1], rtol=1e-10, atol=1e-12
    )
    return np.asarray(found.y[0, ::-1])


def main() -> None:
    """Print the table, and with --json one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    result = run()
    print(f"one-dimensional example; {describe()}")
    for key, value in result.items():
        known = f"   (known {BEST_AREA})" if key == "best_area" else ""
        print(f"{key:24} {value:.5g}{known}")
    if arguments.plot is not None:
        draw(arguments.plot)
    if arguments.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()
