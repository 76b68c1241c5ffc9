"""The satellite's time-sampled funnel, thesis (6.7), made in Drake by hand, and ours in one run.

    python -m benchmarks.drake_funnel [--json] [--limit SECONDS]

Both have the same 49 knots, 4 samples an interval, P(t) and multipliers of degree 2. Drake gets the
thesis's alternation, since it has no sweep: 192 L-steps, then one program for all of ρ(t), until
the volume grows by less than 2.5 % or the time is up. Neither result is a proof; what `nlsid`
proves for every t, and how long that takes, is printed beside them.
"""

import argparse
import dataclasses
import importlib.util
import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import numpy as np  # noqa: E402 - the thread counts have to be set first

from benchmarks.machine import describe, peers  # noqa: E402
from benchmarks.thesis.relaxation import sample_funnel  # noqa: E402
from examples import satellite  # noqa: E402
from examples.satellite_funnel import goal_matrix, problem  # noqa: E402
from nlsid_core.arrays import FloatArray  # noqa: E402
from nlsid_core.design import ContinuousTracking, design_funnel  # noqa: E402
from nlsid_core.design.continuous.shape import STOP  # noqa: E402

BALL = np.pi**3 / 6  # volume of the unit ball in 6 dimensions
SAMPLES = satellite.SAMPLES_PER_INTERVAL
LIMIT = 600.0
BACK_OFF = 1e-5  # relative; of ρ after a V-step, so that the next L-steps are feasible


class TimeIsUp(Exception):  # noqa: N818 - not an error
    """The limit was reached."""


class DrakeAlternation:
    """The thesis's alternation for ρ(t) with Drake's symbolic programs and its Clarabel."""

    def __init__(self, motion: satellite.Nominal, limit: float) -> None:
        self.solvers: Any = importlib.import_module("pydrake.solvers")
        self.symbolic: Any = importlib.import_module("pydrake.symbolic")
        self.motion, self.steps = motion, satellite.l_steps(motion)
        self.rho: FloatArray = np.exp(-satellite.DECAY * (1 - motion.t / motion.t[-1]))
        self.started, self.limit = time.perf_counter(), limit
        self.l_steps_done = self.v_steps_done = 0

    def volume(self) -> float:
        """∫ volume dt by the trapezoidal rule."""
        volumes = BALL * np.sqrt(self.rho**6 / np.linalg.det(self.motion.S))
        return float((volumes[1:] + volumes[:-1]) @ np.diff(self.motion.t) / 2)

    def run(self) -> dict[str, Any]:
        """Alternate until it converges or the time is up."""
        volumes, finished = [self.volume()], False
        try:
            while not finished:
                multipliers = [self.l_step(i) for i in range(len(self.steps))]
                self.v_step(multipliers)
                volumes.append(self.volume())
                finished = volumes[-1] < (1 + STOP) * volumes[-2]
        except TimeIsUp:
            pass
        return {
            "drake_seconds": time.perf_counter() - self.started,
            "drake_volume": volumes[-1],
            "drake_volumes": volumes,
            "drake_l_steps": self.l_steps_done,
            "drake_v_steps": self.v_steps_done,
            "drake_finished": finished,
        }

    def l_step(self, i: int) -> Any:
        """μ of the largest γ with g - γ + μ(1 - |z|²) a sum of squares at sample i."""
        self._left()
        program = self.solvers.MathematicalProgram()
        z = program.NewIndeterminates(6, "z")
        every = self.symbolic.Variables(z)
        gamma = program.NewContinuousVariables(1, "gamma")[0]
        mu = program.NewFreePolynomial(every, 2)
        g = self._polynomial(self._terms(i), z)
        sphere = self.symbolic.Polynomial(1 - sum(v * v for v in z), every)
        bound = self.symbolic.Polynomial(self.symbolic.Expression(gamma), every)
        program.AddSosConstraint(g - bound + mu * sphere, self.symbolic.MonomialBasis(every, 2))
        program.AddLinearCost(-gamma)
        result = self._solve(program)
        if result.GetSolution(gamma) <= 0:
            raise SystemExit(f"Drake finds no multiplier at t = {self.steps[i].time:.3g} s")
        self.l_steps_done += 1
        found = result.GetSolution(mu).monomial_to_coefficient_map().items()
        exponents = {}
        for monomial, value in found:
            powers = {v.get_id(): power for v, power in monomial.get_powers().items()}
            exponents[tuple(powers.get(v.get_id(), 0) for v in z)] = value.Evaluate()
        return exponents

    def v_step(self, multipliers: list[Any]) -> None:
        """The largest Σρ_k with every sample's c = ρ̇ - Ẇ + μ(ρ - W) a sum of squares."""
        program = self.solvers.MathematicalProgram()
        z = program.NewIndeterminates(6, "z")
        every = self.symbolic.Variables(z)
        rho = program.NewContinuousVariables(len(self.rho), "rho")
        basis = self.symbolic.MonomialBasis(every, 2)
        for i, mu in enumerate(multipliers):
            self._left()
            k, s = self._place(i)
            h = self.motion.t[k + 1] - self.motion.t[k]
            now = (1 - s) * self.rho[k] + s * self.rho[k + 1]
            rate = (self.rho[k + 1] - self.rho[k]) / h
            # c/ρ° in the coordinates of the present ρ°: W = ρ°|z|².
            level = ((1 - s) * rho[k] + s * rho[k + 1]) / now
            terms: dict[tuple[int, ...], Any] = dict(self._terms(i))
            zero = (0,) * 6
            terms[zero] = terms.get(zero, 0.0) - rate / now + (rho[k + 1] - rho[k]) / (h * now)
            for exponent, value in mu.items():
                terms[exponent] = terms.get(exponent, 0.0) + value * level
                for j in range(6):
                    raised = tuple(e + 2 * (j == a) for a, e in enumerate(exponent))
                    terms[raised] = terms.get(raised, 0.0) - value
            program.AddSosConstraint(self._polynomial(terms, z), basis)
        program.AddLinearConstraint(rho[-1] == 1.0)
        program.AddLinearCost(-sum(rho))
        result = self._solve(program)
        found = np.asarray(result.GetSolution(rho))
        if not result.is_success() and not np.isfinite(found).all():
            raise SystemExit("Drake's V-step failed")
        self.rho = np.r_[found[:-1] * (1 - BACK_OFF), 1.0]
        self.v_steps_done += 1

    def _place(self, i: int) -> tuple[int, float]:
        return i // SAMPLES, (i % SAMPLES) / (SAMPLES - 1)

    def _terms(self, i: int) -> dict[tuple[int, ...], float]:
        """g = (ρ̇ - Ẇ)/ρ at sample i with the present ρ."""
        k, s = self._place(i)
        step = self.steps[i]
        now = float((1 - s) * self.rho[k] + s * self.rho[k + 1])
        rate = float((self.rho[k + 1] - self.rho[k]) / (self.motion.t[k + 1] - self.motion.t[k]))
        moved = dataclasses.replace(
            step, rho=now, rho_rate=rate, T=step.T * np.sqrt(now / step.rho)
        )
        return {tuple(e): float(c) for e, c in moved.polynomial().terms()}

    def _polynomial(self, terms: dict[tuple[int, ...], Any], z: Any) -> Any:
        made = {}
        for exponent, value in terms.items():
            powers = {z[j]: power for j, power in enumerate(exponent) if power}
            known = isinstance(value, float)
            made[self.symbolic.Monomial(powers)] = (
                self.symbolic.Expression(value) if known else value
            )
        return self.symbolic.Polynomial(made)

    def _solve(self, program: Any) -> Any:
        options = self.solvers.SolverOptions()
        solver = self.solvers.ClarabelSolver()
        options.SetOption(solver.solver_id(), "time_limit", self._left())
        result = solver.Solve(program, None, options)
        self._left()
        return result

    def _left(self) -> float:
        left = self.limit - (time.perf_counter() - self.started)
        if left <= 0:
            raise TimeIsUp
        return left


def run(limit: float) -> dict[str, Any]:
    """Ours, proved and sampled, then Drake's."""
    field, nominal, weights = problem()
    goal = goal_matrix()
    searches: dict[str, Callable[[], Any]] = {
        "proved": lambda: design_funnel(ContinuousTracking(field, nominal, goal=goal, **weights)),
        "sampled": lambda: sample_funnel(field, nominal, goal=goal, samples=SAMPLES, **weights),
    }
    timed = {}
    for name, search in searches.items():
        started = time.perf_counter()
        found = search()
        timed[f"{name}_seconds"] = time.perf_counter() - started
        timed[f"{name}_volume"] = found.funnel.volume_integral()
    theirs = DrakeAlternation(satellite.nominal(), limit).run()
    return {
        **timed,
        **theirs,
        "time_ratio": theirs["drake_seconds"] / timed["sampled_seconds"],
        "volume_ratio": theirs["drake_volume"] / timed["sampled_volume"],
    }


def main() -> None:
    """Print the table, and with --json one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--limit", type=float, default=LIMIT, help="of Drake's time, in s")
    arguments = parser.parse_args()
    if importlib.util.find_spec("pydrake") is None:
        sys.exit("Drake is not installed: pip install 'nlsid[bench]'")
    result = run(arguments.limit)
    print(f"satellite, 49 knots, {SAMPLES} samples an interval; {describe()}")
    for key, value in result.items():
        print(f"{key:24} {value:.5g}" if isinstance(value, float) else f"{key:24} {value}")
    if arguments.json:
        print(json.dumps(result | peers("drake")))


if __name__ == "__main__":
    main()
