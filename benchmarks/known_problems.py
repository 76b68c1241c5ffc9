"""Funnels for problems people know: cart-pole swing-up, planar quadrotor, torque-limited pendulum.

    python -m benchmarks.known_problems [--json] [--starts N] [--plot DIR] [--only NAME]

Each is proved for every t; the proof covers what its polynomials leave out of the true dynamics,
on the boxes stated, and starts on the boundary follow the true dynamics. The pendulum's torque
saturates, and its funnel is compared with the set of all starts that truly reach the goal.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import describe
from benchmarks.thesis.soundness import TrueDynamics, simulate_boundary
from examples import cart_pole, planar_quadrotor, torque_limited_pendulum
from nlsid_core.design import FunnelDesign
from nlsid_core.dynamics import VectorField
from nlsid_core.proofs import check

PROBLEMS: dict[str, Any] = {
    "cart_pole": cart_pole,
    "planar_quadrotor": planar_quadrotor,
    "pendulum": torque_limited_pendulum,
}
LATER_KNOTS = 3  # where starts are taken besides t₀
SAMPLES = 2000  # per time span
UNBOUNDED = (-20.0, 20.0)  # where entries are sampled that the field is exact in
ROUNDING = 1e-9


def run(name: str, starts: int) -> tuple[FunnelDesign, dict[str, Any]]:
    """The design, and everything the benchmark promises about one problem."""
    example = PROBLEMS[name]
    started, processor = time.perf_counter(), time.process_time()
    design = example.designed()
    seconds, used = time.perf_counter() - started, time.process_time() - processor
    with tempfile.TemporaryDirectory() as folder:
        path = design.save(folder)[-1]
        used_before = time.process_time()
        verdict = check(path)
        check_seconds = time.process_time() - used_before
        megabytes = path.stat().st_size / 1e6
    truth, rng = TrueDynamics(example.truth), np.random.default_rng(21)
    knots = len(design.funnel.t)
    runs = [
        simulate_boundary(
            truth, design.policy, design.funnel, starts=count, rng=rng, knot=knot, substeps=10
        )
        for knot, count in [
            (0, starts),
            *((k, starts // 10) for k in np.linspace(1, knots - 2, LATER_KNOTS, dtype=int)),
        ]
    ]
    result = {
        "states": design.funnel.n,
        "knots": knots,
        "seconds": seconds,
        "process_seconds": used,
        "check_seconds": check_seconds,
        "proof_mb": megabytes,
        "pieces": len(design.found.proved.pieces),
        "modes": len(design.policy.modes()),
        "margin": float(verdict.margin),
        "proved": True,  # `check` raises otherwise
        "remainder_covered": encloses(design.model, example.truth, rng),
        "assumptions": list(verdict.assumptions),
        "half_widths_at_start": np.sqrt(np.diag(np.linalg.inv(design.funnel.shape(0.0)))).tolist(),
        "starts": sum(found.starts for found in runs),
        "violations": sum(found.violations for found in runs),
        "max_v": max(found.max_v for found in runs),
    }
    if name == "pendulum":
        fractions = example.area_fractions(design.policy, design.funnel)
        result |= {"area_fraction": fractions[0], "ellipse_fraction": fractions[1]}
    return design, result


def encloses(field: VectorField, truth: Any, rng: np.random.Generator) -> bool:
    """True if, at random points of the boxes where it is `valid`, the field for some w in its box
    is the truth: what the example or `taylor_field` derived, tried."""
    times = np.r_[-np.inf, field.breaks]
    for span in range(len(field.pieces)):
        bounds = {j: (low, high) for j, low, high in field.validity(span)}
        box = np.array([bounds.get(j, UNBOUNDED) for j in range(field.n + field.m)])
        points = rng.uniform(box[:, 0], box[:, 1], size=(SAMPLES, len(box)))
        X, U = np.split(points, [field.n], axis=1)
        t = float(times[span]) if span else 0.0
        rates = np.array([field(t, X, U, w, span=span) for w in field.vertices()])
        true = truth(X, U)
        room = ROUNDING * (1 + np.abs(true))
        if (true < rates.min(axis=0) - room).any() or (true > rates.max(axis=0) + room).any():
            return False
    return True


def draw(name: str, design: FunnelDesign, folder: Path) -> None:
    """The tube around the motion, or the pendulum's slice over what truly reaches the goal."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    if name == "pendulum":
        angles, rates, reached = torque_limited_pendulum.reaching(design.policy, 401)
        axes.contourf(angles, rates, reached, levels=[0.5, 1.5], colors=["tab:green"], alpha=0.25)
        edge = design.funnel.outline(0.0, (0, 1))
        axes.plot(edge[:, 0], edge[:, 1], label="proved funnel at t = 0")
        for sign in (-1, 1):
            u = design.policy.u(0.0)[0] - sign * torque_limited_pendulum.TORQUE
            K = design.policy.K(0.0)[0]
            axes.plot(angles, (u - K[0] * angles) / K[1], "k:", linewidth=0.8)
        axes.plot([], [], "k:", label="torque saturates outside")
        axes.fill_between([], [], color="tab:green", alpha=0.25, label="truly reaches the goal")
        axes.set(xlim=(-3, 3), ylim=(-10, 10), xlabel="angle from upright [rad]")
        axes.set_ylabel("rate [rad/s]")
    elif name == "cart_pole":
        outlines = [(t, design.funnel.outline(float(t), (0, 1))) for t in design.funnel.t]
        for axis, label in ((0, "cart position [m]"), (1, "angle from hanging [rad]")):
            low, high = (np.array([f(o[:, axis]) for _, o in outlines]) for f in (np.min, np.max))
            axes.fill_between(design.funnel.t, low, high, alpha=0.4)
            axes.plot(design.funnel.t, design.funnel.x(design.funnel.t)[:, axis], label=label)
        axes.set_xlabel("time [s]")
    else:
        for t in design.funnel.t[::2]:
            edge = design.funnel.outline(float(t), (0, 1))
            axes.plot(edge[:, 0], edge[:, 1], color="tab:blue", alpha=0.5, linewidth=0.8)
        path = design.funnel.x(np.linspace(design.funnel.t0, design.funnel.tf, 200))
        axes.plot(path[:, 0], path[:, 1], color="k", label="motion")
        axes.set(xlabel="sideways [m]", ylabel="up [m]", aspect="equal")
    axes.legend(frameon=False, fontsize=8)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / f"funnel-{name.replace('_', '-')}.png", dpi=110, bbox_inches="tight")


def main() -> None:
    """Print the tables, and with --json one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--starts", type=int, default=100_000)
    parser.add_argument("--plot", type=Path, help="folder for the pictures")
    parser.add_argument("--only", choices=list(PROBLEMS))
    arguments = parser.parse_args()
    print(describe())
    results = {}
    for name in [arguments.only] if arguments.only else PROBLEMS:
        design, results[name] = run(name, arguments.starts)
        print(f"\n{name.replace('_', ' ')}")
        for key, value in results[name].items():
            print(f"{key:24} {value:.5g}" if isinstance(value, float) else f"{key:24} {value}")
        if arguments.plot is not None:
            draw(name, design, arguments.plot)
    if arguments.json:
        whole = {
            "proved": all(found["proved"] for found in results.values()),
            "remainder_covered": all(found["remainder_covered"] for found in results.values()),
            "violations": sum(found["violations"] for found in results.values()),
            "seconds": sum(found["seconds"] for found in results.values()),
        }
        print(json.dumps(whole | results))


if __name__ == "__main__":
    main()
