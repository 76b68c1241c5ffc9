"""How funnels scale with the number of states: a chain of coupled pendulums, 2 to 12 states or 16.

    python -m benchmarks.funnel_scaling [--json] [--most N]

The thesis stopped at 6 states. Every state enters nonlinearly.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.machine import parser, tell
from nlsid_core.design import ContinuousTracking, design_funnel, integrate_nominal
from nlsid_core.design.continuous.lstep import LSteps, section_at
from nlsid_core.design.continuous.tvlqr import tvlqr
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import NlsidError

KNOTS, FINAL_TIME = 9, 1.0  # s
GOAL = 8.0  # P = 8 I: 0.35 rad and rad/s around rest


def chain(pendulums: int) -> Callable[[Any, Any], Any]:
    """ẋ of pendulums to third order with cubic drag, torques on all, springs between neighbours."""

    def dynamics(x: Any, u: Any) -> Any:
        q, v = x[:pendulums], x[pendulums:]
        rates = []
        for i in range(pendulums):
            torque = u[i] - q[i] + q[i] ** 3 / 6 - v[i] / 5 - v[i] ** 3 / 10
            if i:
                torque = torque + (q[i - 1] - q[i]) / 4
            if i + 1 < pendulums:
                torque = torque + (q[i + 1] - q[i]) / 4
            rates.append(torque)
        return np.concatenate([v, np.array(rates)])

    return dynamics


def row(n: int) -> dict[str, Any]:
    """Times and outcome for n states."""
    half = n // 2
    field = VectorField.from_function(chain(half), n, half)
    t = np.linspace(0, FINAL_TIME, KNOTS)
    nominal = integrate_nominal(field, lambda _: np.zeros(half), t=t, start=np.zeros(n))
    goal = GOAL * np.eye(n)
    tracking = tvlqr(field, nominal, Q=np.eye(n), R=np.eye(half), S_final=1.01 * goal)
    steps = LSteps(field, tracking.policy)
    section = section_at(steps, tracking.S, KNOTS - 2, 1.0)
    first = steps.solve(section, 1.0)
    started = time.perf_counter()
    steps.solve(section, 0.99, first)
    l_step = time.perf_counter() - started
    started = time.perf_counter()
    try:
        design = design_funnel(
            ContinuousTracking(field, nominal, goal=goal, Q=np.eye(n), R=np.eye(half))
        )
        proved, pieces = True, len(design.found.proved.pieces)
    except NlsidError:
        proved, pieces = False, 0
    return {
        "states": n,
        "l_step_ms": 1e3 * l_step,
        "total_seconds": time.perf_counter() - started,
        "pieces": pieces,
        "proved": proved,
    }


def main() -> None:
    """Print the figures, and with --json one JSON object as the last line."""
    options = parser(__doc__)
    options.add_argument("--most", type=int, default=12)
    arguments = options.parse_args()
    rows = []
    for n in range(2, arguments.most + 1, 2):
        rows.append(row(n))
        print(rows[-1], flush=True)
    tell({"rows": rows}, as_json=arguments.json)


if __name__ == "__main__":
    main()
