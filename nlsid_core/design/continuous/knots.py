"""What V-steps need at the knots: how c depends on ρ or P there, with the L-steps' multipliers."""

from dataclasses import replace

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.closed_loop import (
    batches,
    closed_loop_polynomial,
    error_at_end,
)
from nlsid_core.design.continuous.graded import monomials_of
from nlsid_core.design.continuous.lstep import LSteps, coordinates
from nlsid_core.design.continuous.pieces import Part, draft, end_proof
from nlsid_core.design.continuous.sweep import Ends
from nlsid_core.design.continuous.vstep import Affine, Sample, affine_form, squares_along
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.sos.sphere import SphereSolution

CONSTANT = 0.95  # share of an L-step's margin that a V-step may ask for again
KEEP = 0.9  # of an L-step's margin that a V-step asks for: it stays feasible where it is


class KnotForms:
    """c at both ends of every interval in every case, in the coordinates of the present funnel.

    samples: c less what it keeps as a function of D, see `vstep`. frames: (n, n) per knot, x̄ = Tz.
    What bounds the pushes of w is taken to first order in D.
    """

    def __init__(
        self,
        steps: LSteps,
        policy: ContinuousPolicy,
        funnel: ContinuousFunnel,
        ends: list[Ends],
        *,
        margin: float,
    ) -> None:
        n, cases = funnel.n, steps.cases
        self.cases = cases
        self.frames = [
            np.sqrt(rho) * coordinates(P, steps.nonlinear)
            for P, rho in zip(funnel.P, funnel.rho, strict=True)
        ]
        self.h = np.diff(funnel.t)
        self.rho = funnel.rho
        self.samples: list[Affine] = []
        for end in (0, 1):
            solutions = [(pair.start, pair.end)[end] for pair in ends]
            errors, targets = self._at(steps, policy, funnel, solutions, end)
            for row, (error, target) in enumerate(zip(errors, targets, strict=True)):
                k, case = divmod(row, cases)
                own, other = (k, k + 1) if end == 0 else (k + 1, k)
                # ρ is that of this end on both sides: Ẇ is the rate of W, not of W/ρ.
                scale = np.sqrt(funnel.rho[other] / funnel.rho[own])
                sample = Sample(
                    own,
                    other,
                    1 / self.h[k],
                    1 if end == 0 else -1,
                    np.linalg.solve(self.frames[own], error),
                    scale * np.linalg.solve(self.frames[other], self.frames[own]),
                )
                growth = (funnel.rho[k + 1] - funnel.rho[k]) / self.h[k] / funnel.rho[own]
                m = solutions[k][case].m + growth
                _, mu = end_proof(
                    steps.program,
                    solutions[k][case],
                    _by_degree(target, n),
                    1.0,
                    m,
                    constant=CONSTANT,
                )
                target[0] -= growth + min(margin, KEEP * m)
                form = affine_form(sample)
                pushed = self._pushed(steps, policy, k, own)
                form = replace(form, constant=target, own=form.own - pushed)
                self.samples.append(form.with_multiplier(mu, n))

    def _at(
        self,
        steps: LSteps,
        policy: ContinuousPolicy,
        funnel: ContinuousFunnel,
        solutions: list[list[SphereSolution]],
        end: int,
    ) -> tuple[FloatArray, FloatArray]:
        """Errors (B, n, M₃), and c of D = 0 with ρ̇ (B, M₄), by interval and case, in 1/s."""
        n, intervals = funnel.n, len(self.h)
        T = np.array([self.frames[k + end] for k in range(intervals)])
        blank = draft(steps, [Part(k, 0, 0) for k in range(intervals)], T.repeat(steps.cases, 0))
        scale = (self.h * funnel.rho[np.arange(intervals) + end]).repeat(steps.cases)
        tau = np.array([found.tau for row in solutions for found in row])
        tau = scale[:, None, None, None] * tau.reshape(len(blank), -1, n + 1, n + 1)
        blank = replace(blank, tau=np.stack([tau, tau], axis=1))
        errors = np.zeros((len(blank), n, _count(n, 3)))
        targets = np.zeros((len(blank), _count(n, 4)))
        for chosen in batches(blank):
            alike = blank.select(chosen)
            found = error_at_end(steps.field, policy, funnel, alike, end)
            errors[chosen, :, : found.shape[2]] = found
            c = closed_loop_polynomial(steps.field, policy, funnel, alike)
            for q, part in c.items():
                columns = slice(_count(n, q - 1), _count(n, q))
                targets[chosen, columns] = part[:, -end] / scale[chosen, None]
        return errors, targets

    def _pushed(
        self, steps: LSteps, policy: ContinuousPolicy, k: int, knot: int
    ) -> FloatArray | float:
        """What D adds at first order to Σ rκ(x̄'Pg)², the bound of what w does."""
        if steps.kappa is None:
            return 0.0
        field = steps.field
        G = field.pushes(field.span(float(policy.t[k])))
        assert G is not None  # `steps.kappa` says so
        along = np.linalg.solve(self.frames[knot], G)
        scale = self.rho[knot] * steps.kappa[k] * np.ptp(field.uncertain, axis=1) / 2
        return squares_along(along, scale)


def _count(n: int, degree: int) -> int:
    return sum(len(monomials_of(n, q)) for q in range(degree + 1))


def _by_degree(coefficients: FloatArray, n: int) -> dict[int, FloatArray]:
    """A vector over degrees 0..4, split by degree."""
    sizes = np.cumsum([len(monomials_of(n, q)) for q in range(5)])
    return dict(enumerate(np.split(coefficients, sizes[:-1])))
