"""Simulation error of monotone equations, minimised among those that (3.8) proves stable.

In c = [e₁, e₂, e₃, -c, -a, -b] and P the set is one matrix inequality, with ρ = `slowest`,
    [ρ²P - S'P₂₂S - δI, -a - S'P₂₁, 0; ·, 2e₁ - P₁₁, e₂; ·, ·, 3e₃/2] ⪰ 0,   e₁ = 1,
jointly affine in both; a straight e has no third row. Source: thesis (3.8), (3.14).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from nlsid_core import conic
from nlsid_core.arrays import FloatArray
from nlsid_core.conic import Cone, ConeProgram
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.errors import DataError
from nlsid_core.identification.methods.descent import Outputs, Step, descend
from nlsid_core.identification.polynomial.moment_rie import Problem, equation
from nlsid_core.identification.polynomial.moments import Moments, Offsets
from nlsid_core.identification.polynomial.monotone import sensitivities, simulate_banded
from nlsid_core.identification.polynomial.options import Polynomial
from nlsid_core.models import MonotoneEquation


@dataclass(frozen=True, eq=False)
class MonotoneSet:
    """The set, and the trials whose simulation error is minimised in it.

    problem: the matrix inequality and the scales of its unknowns.
    """

    problem: Problem
    model_class: Polynomial
    offsets: Offsets
    trials: Sequence[Trajectory]

    def model(self, theta: FloatArray) -> MonotoneEquation | None:
        """The equation of c = [1, θ]; None if e is not increasing."""
        try:
            c = np.concatenate([[1.0], theta])
            return equation(c, self.model_class, self.trials[0], self.offsets)
        except DataError:
            return None

    def outputs(self, theta: FloatArray) -> Outputs | None:
        """Of all trials, all but their first `history` samples."""
        model, r, J = self.model(theta), [], []
        for trial in self.trials:
            simulated = None if model is None else simulate_banded(model, trial)
            if model is None or simulated is None:
                return None
            r.append((simulated - trial.y[:, 0])[model.history :])
            moved = sensitivities(model, trial)  # in e₂, e₃, c, a, b
            J.append(np.hstack([moved[:, : self.model_class.degrees.left - 1], -moved[:, 2:]]))
        return Outputs(np.concatenate(r), np.concatenate(J))

    def cost(self, theta: FloatArray) -> float:
        """Σ (ŷ - y)²."""
        model, total = self.model(theta), 0.0
        for trial in self.trials:
            simulated = None if model is None else simulate_banded(model, trial)
            if model is None or simulated is None:
                return np.inf
            total += float(np.sum((simulated - trial.y[:, 0])[model.history :] ** 2))
        return total

    def inside(self, step: Step) -> FloatArray:
        """θ of the step's cone program, in u and P."""
        layout, G = self.problem.layout, self.problem.stability
        units = self.problem.columns[layout.c]
        of_c, of_P = G.slope[:, layout.c], G.slope[:, : layout.c[0]]
        at = of_c @ (np.concatenate([[1.0], step.theta]) / units) + G.constant
        of_u = of_c[:, 1:] @ sp.diags(1.0 / (step.D * units[1:]))
        p, n_P = len(step.D), of_P.shape[1]
        quadratic = 2.0 * (step.R.T @ step.R + step.damping * np.eye(p))
        program = ConeProgram(
            P=sp.block_diag([sp.csc_matrix(quadratic), sp.csc_matrix((n_P, n_P))], format="csc"),
            q=np.concatenate([2.0 * step.R.T @ step.r, np.zeros(n_P)]),
            A=sp.csc_matrix(-sp.hstack([of_u, of_P])),
            b=at,
            cones=(Cone("psd", G.order),),
        )
        return np.asarray(step.theta + conic.solve(program).x[:p] / step.D)


def minimise_certified(
    start: MonotoneEquation,
    moments: Moments,
    model_class: Polynomial,
    trials: Sequence[Trajectory],
    *,
    slowest: float = 1.0,
    steps: int,
) -> MonotoneEquation | None:
    """A local minimum of Σ (y - ŷ)² in the set from `start`, in it or not; None if there is none.

    moments: of the trials, biased or not, about the start's offsets: they scale the unknowns.
    """
    offsets = Offsets(start.y_offset, start.u_offset)
    problem = Problem.of(moments, len(start), slowest)
    inside = MonotoneSet(problem, model_class, offsets, trials)
    e = start.e[: model_class.degrees.left]
    c = np.concatenate([e, [-start.c], -start.a, -start.b]) / e[0]
    found = descend(inside, c[1:], steps=steps)
    return None if found is None else inside.model(found)
