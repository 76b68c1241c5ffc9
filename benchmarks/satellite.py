"""The tumbling satellite: funnel, proof for every t, and attempts to break it.

    python -m benchmarks.satellite [--json] [--lqr-order] [--out DIR] [--starts N] [--no-p]

Published: thesis Chapter 7, 12 cores: ρ(t) exact 13 429 s, sampled P(t) 8 397 s (never verified).
`tightness` is the smallest scaling of the start set from which a trajectory was seen to miss the
goal. `lstep` is one program of the thesis's alternation, ours and Drake's side by side in processor
seconds: the largest m with g - m ≥ 0 on |z| = 1, n = 6, degree 4; `*_over_drake_lstep` say how many
of Drake's the whole design of a funnel takes. Drake is left out where it is not installed.
"""

import argparse
import importlib
import math
import statistics
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import parser, peers, spending, tell
from benchmarks.thesis.alternation import alternate_rho, exponential_start
from benchmarks.thesis.soundness import Simulation
from examples import satellite
from examples.satellite_funnel import goal_matrix, problem
from nlsid_core.design import ContinuousTracking, FunnelDesign, design_funnel
from nlsid_core.design.continuous.lstep import LSteps
from nlsid_core.polynomial import Polynomial
from nlsid_core.proofs import check
from nlsid_core.sos import SphereProgram

TIMES = (0.0, 1.25, 2.5, 3.75, 5.0)
PUBLISHED = {"rho_seconds": 13429.0, "p_seconds": 8397.0}
LATER_KNOTS = (12, 24, 36, 44)
LSTEPS = 12  # of the 192 along the motion; a time is the median over them


def run(arguments: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Everything the benchmark promises, by its promised keys."""
    field, nominal, weights = problem()
    goal = goal_matrix(lqr_order=arguments.lqr_order)
    with spending() as spent:
        design = design_funnel(ContinuousTracking(field, nominal, goal=goal, **weights))
    *_, proof = design.save(folder)
    result: dict[str, Any] = {
        "rho_seconds": spent.seconds,
        "rho_processor_seconds": spent.processor,
        "rho_volume": design.funnel.volume_integral(),
        "pieces": len(design.found.proved.pieces),
        "pieces_proved": int(np.isfinite(design.found.proved.margins).sum()),
        "volumes": {f"{t:g}": design.funnel.volume(t) for t in TIMES},
        "policy_seconds": design.found.seconds["policy"],
        "margin": float(design.verdict.margin),
    }
    with spending() as spent:
        check(proof)
    result |= {"check_seconds": spent.processor, "exact_seconds": spent.seconds}
    result["proof_mb"] = proof.stat().st_size / 1e6
    result |= _attacks(design, goal, arguments.starts)
    start = exponential_start(LSteps(field, design.policy), design.funnel.P)
    result["start_volume"] = start.volume_integral()
    with spending() as spent:
        alternated = alternate_rho(LSteps(field, design.policy), start)
    result["alternation_seconds"] = spent.seconds
    result["alternation_iterations"] = len(alternated.volumes) - 1
    result["alternation_volume"] = alternated.volumes[-1]
    result["alternation_ratio"] = alternated.volumes[-1] / result["rho_volume"]
    if not arguments.no_p:
        result |= _shape(field, nominal, goal, weights, arguments.starts // 5)
    result["lstep"] = lstep()
    if drake := result["lstep"].get("drake_ms"):
        for name in ("rho", "p"):
            if seconds := result.get(f"{name}_processor_seconds"):
                result[f"{name}_over_drake_lstep"] = 1e3 * seconds / drake
    return result


def _attacks(design: FunnelDesign, goal: Any, starts: int) -> dict[str, Any]:
    rng = np.random.default_rng(7)
    parts = (design.model, design.policy, design.funnel)
    runs = [Simulation(*parts).boundary(starts=starts, rng=rng)]
    each = math.ceil(2 * starts / len(LATER_KNOTS))
    runs += [Simulation(*parts).boundary(starts=each, rng=rng, knot=k) for k in LATER_KNOTS]
    return {
        "starts": sum(run.starts for run in runs),
        "violations": sum(run.violations for run in runs),
        "max_v": max(run.max_v for run in runs),
        "tightness": Simulation(*parts).escape(goal, starts=4000, rng=rng),
    }


def _shape(field: Any, nominal: Any, goal: Any, weights: Any, starts: int) -> dict[str, Any]:
    with spending() as spent:
        design = design_funnel(ContinuousTracking(field, nominal, goal=goal, shape="P", **weights))
    rng = np.random.default_rng(8)
    run = Simulation(design.model, design.policy, design.funnel).boundary(starts=starts, rng=rng)
    return {
        "p_seconds": spent.seconds,
        "p_processor_seconds": spent.processor,
        "p_volume": design.funnel.volume_integral(),
        "p_pieces": len(design.found.proved.pieces),
        "p_volumes": {f"{t:g}": design.funnel.volume(t) for t in TIMES},
        "p_violations": run.violations,
    }


def lstep() -> dict[str, float]:
    """Processor ms of one L-step, ours and Drake's, and by how much they differ at most."""
    sphere, drake = SphereProgram(6), drake_solver()
    steps = satellite.l_steps(satellite.nominal())
    chosen = [steps[round(k)] for k in np.linspace(0, len(steps) - 1, LSTEPS)]
    ours, theirs, differ = [], [], 0.0
    for step in chosen:
        values = step.values(sphere.points)
        with spending() as spent:
            m = sphere.solve(values).m
        ours.append(spent.processor)
        if drake is not None:
            g = step.polynomial()
            with spending() as spent:
                found = drake(g)
            theirs.append(spent.processor)
            differ = max(differ, abs(found - m) / float(np.ptp(values)))
    result = {"ours_ms": 1e3 * statistics.median(ours)}
    if theirs:
        result |= {"drake_ms": 1e3 * statistics.median(theirs), "disagreement": differ}
    return result


def drake_solver() -> Callable[[Polynomial], float] | None:
    """The largest m with g - m + μ(1 - |z|²) a sum of squares, in Drake; None if it is not here."""
    try:
        solvers: Any = importlib.import_module("pydrake.solvers")
        symbolic: Any = importlib.import_module("pydrake.symbolic")
    except ImportError:
        print("Drake is not installed: pip install 'nlsid[bench]'", file=sys.stderr)
        return None

    def solve(g: Polynomial) -> float:
        program = solvers.MathematicalProgram()
        z = program.NewIndeterminates(len(g.names), "z")
        m = program.NewContinuousVariables(1, "m")[0]
        every = symbolic.Variables(z)
        mu = program.NewFreePolynomial(every, 2)
        terms = {
            symbolic.Monomial(
                {z[j]: power for j, power in enumerate(exponent) if power}
            ): symbolic.Expression(coefficient)
            for exponent, coefficient in g.terms()
        }
        sphere = symbolic.Polynomial(1 - z.dot(z), every)
        bound = symbolic.Polynomial(symbolic.Expression(m), every)
        program.AddSosConstraint(
            symbolic.Polynomial(terms) - bound - mu * sphere, symbolic.MonomialBasis(every, 2)
        )
        program.AddLinearCost(-m)
        result = solvers.ClarabelSolver().Solve(program, None, solvers.SolverOptions())
        return float(result.GetSolution(m))

    return solve


def main() -> None:
    """Print the figures, and with --json one JSON object as the last line."""
    options = parser(__doc__)
    options.add_argument("--lqr-order", action="store_true", help="the variant of P_G for [w; s]")
    options.add_argument("--out", type=Path, help="where funnel.json, policy.json and the proof go")
    options.add_argument("--starts", type=int, default=100_000)
    options.add_argument("--no-p", action="store_true", help="leave the search for P(t) out")
    arguments = options.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = run(arguments, arguments.out or Path(folder))
    tell(result | peers("drake"), PUBLISHED, as_json=arguments.json)


if __name__ == "__main__":
    main()
