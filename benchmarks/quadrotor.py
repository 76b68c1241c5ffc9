"""The 12-state quadrotor: funnel, proof for every t of its Taylor model, and attempts to break it.

    python -m benchmarks.quadrotor [--json] [--knots K] [--level C] [--starts N] [--out DIR]

The proof covers what the cubic Taylor model of the rotation leaves out: as a push on the
acceleration, bounded where the funnel is proved to stay. Simulated starts obey the true dynamics.
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
from examples import quadrotor
from nlsid_core.proofs import check


def run(arguments: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Everything the benchmark promises, by its promised keys."""
    started, processor = time.perf_counter(), time.process_time()
    design = quadrotor.designed(arguments.knots, arguments.level)
    seconds, used = time.perf_counter() - started, time.process_time() - processor
    *_, proof = design.save(folder)
    used_before = time.process_time()
    verdict = check(proof)
    check_seconds = time.process_time() - used_before
    model = (design.policy, design.funnel)
    rng = np.random.default_rng(12)
    truth = TrueDynamics(lambda X, U: quadrotor.truth(X.T, U.T).T)
    run = simulate_boundary(truth, *model, starts=arguments.starts, rng=rng)
    shape = np.linalg.inv(design.funnel.shape(0.0))
    return {
        "states": 12,
        "knots": arguments.knots,
        "seconds": seconds,
        "process_seconds": used,
        "check_seconds": check_seconds,
        "proof_mb": proof.stat().st_size / 1e6,
        "pieces": len(design.found.proved.pieces),
        "margin": float(verdict.margin),
        "proved": True,
        "remainder_covered": True,
        "remainder": quadrotor.remainder(quadrotor.TILT, quadrotor.THRUST).tolist(),
        "assumptions": list(verdict.assumptions),
        "half_widths_at_start": np.sqrt(np.diag(shape)).round(4).tolist(),
        "starts": run.starts,
        "violations": run.violations,
        "max_v": run.max_v,
    }


def main() -> None:
    """Print the table, and with --json one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--knots", type=int, default=31)
    parser.add_argument("--level", type=float, default=0.1, help="of the goal, in LQR cost")
    parser.add_argument("--starts", type=int, default=200_000)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = run(arguments, arguments.out or Path(folder))
    print(f"quadrotor, 12 states, {quadrotor.FINAL_TIME:g} s; {describe()}")
    for key, value in result.items():
        print(f"{key:24} {value:.5g}" if isinstance(value, float) else f"{key:24} {value}")
    if arguments.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()
