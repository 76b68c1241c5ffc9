"""What V-steps need at the knots: how c depends on ρ or P there, with the L-steps' multipliers."""

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.closed_loop import batches, error_at_end
from nlsid_core.design.continuous.graded import monomials_of
from nlsid_core.design.continuous.lstep import LSteps, coordinates
from nlsid_core.design.continuous.pieces import Part, draft, end_proof
from nlsid_core.design.continuous.sweep import Ends
from nlsid_core.design.continuous.vstep import Affine, Sample, affine_form
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy

CONSTANT = 0.95  # share of an L-step's margin that a V-step may ask for again
KEEP = 0.9  # of an L-step's margin that a V-step asks for: it stays feasible where it is


class KnotForms:
    """c at both ends of every interval and every vertex, in the coordinates of the present funnel.

    samples, pairs: c as a function of D at (own, other) knot, see `vstep`. margins: what c keeps.
    frames: (n, n) per knot, x̄ = Tz.
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
        n, v = funnel.n, len(steps.vertices)
        self.n, self.vertices = n, v
        nonlinear = steps.nonlinear
        self.frames = [
            np.sqrt(rho) * coordinates(P, nonlinear)
            for P, rho in zip(funnel.P, funnel.rho, strict=True)
        ]
        self.h = np.diff(funnel.t)
        self.rho = funnel.rho
        self.samples: list[Affine] = []
        self.pairs: list[tuple[int, int]] = []
        self.margins: list[float] = []
        intervals = len(self.h)
        for end in (0, 1):
            T = np.array([self.frames[k + end] for k in range(intervals)])
            parts = [Part(k, 0, 0) for k in range(intervals)]
            blank = draft(steps, parts, np.repeat(T, v, axis=0))
            errors = np.empty((len(blank), n, _count(n, steps.field.degree)))
            for chosen in batches(steps.field, funnel, blank):
                alike = blank.select(chosen)
                errors[chosen] = error_at_end(steps.field, policy, funnel, alike, end)
            for row in range(intervals * v):
                k, vertex = divmod(row, v)
                solution = (ends[k].start, ends[k].end)[end][vertex]
                growth = (funnel.rho[k + 1] - funnel.rho[k]) / self.h[k] / funnel.rho[k + end]
                own, other = (k, k + 1) if end == 0 else (k + 1, k)
                y = np.linalg.solve(self.frames[own], errors[row])
                y = np.pad(y, ((0, 0), (0, _count(n, 3) - y.shape[1])))
                # ρ is that of this end on both sides: Ẇ is the rate of W, not of W/ρ.
                scale = np.sqrt(funnel.rho[other] / funnel.rho[own])
                across = scale * np.linalg.solve(self.frames[other], self.frames[own])
                sign = 1 if end == 0 else -1
                bare = affine_form(Sample(own, other, 1 / self.h[k], sign, y, across))
                target = bare.constant.copy()
                target[0] += growth
                m = solution.m + growth
                _, mu = end_proof(steps.program, solution, _by_degree(target, n), 1.0, m,
                                  constant=CONSTANT)  # fmt: skip
                self.samples.append(bare.with_multiplier(mu, n))
                self.pairs.append((own, other))
                self.margins.append(min(margin, KEEP * m))


def _count(n: int, degree: int) -> int:
    return sum(len(monomials_of(n, q)) for q in range(degree + 1))


def _by_degree(coefficients: FloatArray, n: int) -> dict[int, FloatArray]:
    """A vector over degrees 0..4, split by degree."""
    sizes = np.cumsum([len(monomials_of(n, q)) for q in range(5)])
    return dict(enumerate(np.split(coefficients, sizes[:-1])))
