"""Simulation error of implicit models, minimised inside the sets of thesis Lemmas 2.10 to 2.13.

In signals of unit spread θ holds the coefficients of e and f; the set keeps |x - x̂|²_Q and makes e
monotone by `MONOTONE`. A model and a multiple of it are the same, so a step is free along θ.
Sensitivities are those of the equations of all samples together: J_y dy = -∂h/∂θ dθ (`rollout`).
Source: thesis Lemmas 2.10-2.13, (2.19), Definition 2.2.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.identification.methods.descent import Outputs, Step, descend
from nlsid_core.identification.polynomial.implicit_rie import (
    indeterminates_of,
    left_coefficients,
    right_coefficients,
    set_constraints,
    unknowns,
)
from nlsid_core.identification.polynomial.implicit_rows import ImplicitRows, delayed_states
from nlsid_core.identification.polynomial.rollout import DIVERGED, Linearised, Rollout
from nlsid_core.models import ImplicitModel, MonotoneEquation, Polynomials, Signal
from nlsid_core.models.monotone_equation import is_increasing
from nlsid_core.polynomial import constant, variables
from nlsid_core.polynomial.maps import combinations
from nlsid_core.sos import NormBound, Program, solve
from nlsid_core.sos.program import Constraint

MONOTONE = 0.1  # kept of ∂e/∂v + (∂e/∂v)', where Q is 1
FREE = 1e-3  # of the damping, along θ
SCALE = 4.0  # of the coefficients that a descent begins with: what Q may then grow by


@dataclass(frozen=True, eq=False)
class ImplicitSet:
    """The set of the rows' class, and the trials of the rows.

    slowest: rate that it keeps; None: no set, but e of one output increases.
    """

    rows: ImplicitRows
    slowest: float | None

    @cached_property
    def rollout(self) -> Rollout:
        """All scaled trials as one system."""
        rows = self.rows
        (y_mean, y_std), (u_mean, u_std) = rows.y_scale, rows.u_scale
        scaled = [
            Trajectory(t=trial.t, y=(trial.y - y_mean) / y_std, u=(trial.u - u_mean) / u_std)
            for trial in rows.dataset
        ]
        n_v, n, names = len(y_mean), rows.states, rows.names
        known = n + len(names.w)
        exponents = np.vstack(
            [
                np.hstack([rows.left, np.zeros((len(rows.left), known), dtype=np.int64)]),
                np.hstack([np.zeros((len(rows.right), n_v), dtype=np.int64), rows.right]),
            ]
        )
        model = ImplicitModel(
            h=Polynomials(exponents, np.zeros((len(exponents), n_v))),
            shift=delayed_states(n - n_v, known),
            monotonicity=MONOTONE,
            period=rows.dataset.period,
            states=names.x,
            inputs=names.w,
            y=tuple(Signal(name, "") for name in names.v),
            u=tuple(Signal(f"u{i}", "") for i in range(len(u_mean))),
            window=rows.model_class.window(len(u_mean)),
        )
        return Rollout(model, scaled)

    @cached_property
    def constraints(self) -> list[Constraint]:
        """The inequalities of the set, the same at every step; none without one."""
        if self.slowest is None:
            return []
        e, f = unknowns(self.rows)
        S = np.array(
            [[constant(MONOTONE * (i == j)) for j in range(len(e))] for i in range(len(e))]
        )
        return set_constraints(self.rows, e, f, S, self.slowest)

    def split(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """e (m_e, n_v) and f (m_f, n_v)."""
        both = theta.reshape(-1, len(self.rows.y_scale[0]))
        return both[: len(self.rows.left)], both[len(self.rows.left) :]

    def solved(self, theta: FloatArray) -> tuple[FloatArray, Linearised] | None:
        """`Rollout.solved`; None where e does not increase, if that is not kept by a set."""
        e, f = self.split(theta)
        if self.slowest is None and not is_increasing(np.pad(e[:, 0], (0, 3 - len(e)))):
            return None
        return self.rollout.solved(np.concatenate([e, -f]))

    def outputs(self, theta: FloatArray) -> Outputs | None:
        """In spreads of the outputs, of all samples that are not given."""
        e, _ = self.split(theta)
        rollout, n_v, solved = self.rollout, e.shape[1], self.solved(theta)
        if solved is None:
            return None
        y, jacobian = solved
        values = rollout.monomials(y)
        values[:, : len(e)] *= -1.0  # dy = J_y⁻¹(-∂h/∂θ), h = e - f
        moved = np.zeros((len(y), n_v, values.shape[1], n_v))
        for i in range(n_v):
            moved[:, i, :, i] = values
        J = jacobian.solve(moved.reshape(len(y), n_v, -1))[rollout.free]
        return Outputs((y - rollout.measured)[rollout.free].ravel(), J.reshape(-1, theta.size))

    def cost(self, theta: FloatArray) -> float:
        """Σ |ŷ - y|², in spreads."""
        solved = self.solved(theta)
        if solved is None or not np.abs(solved[0]).max() < DIVERGED:
            return np.inf
        return float(np.sum((solved[0] - self.rollout.measured) ** 2))

    def inside(self, step: Step) -> FloatArray:
        """θ of the step's program, a sum of squares for every inequality of the set.

        Terms of f in the inputs alone are eliminated from the program.
        """
        along = step.D * step.theta / np.linalg.norm(step.D * step.theta)
        across = np.sqrt(step.damping) * (
            np.eye(len(step.D)) - (1.0 - FREE) * np.outer(along, along)
        )
        everything = np.concatenate([step.R, across])
        right_side = np.concatenate([step.r, np.zeros(len(across))])
        if self.slowest is None:
            return np.asarray(
                step.theta - np.linalg.lstsq(everything, right_side, rcond=None)[0] / step.D
            )
        rows, (bound,) = self.rows, variables("bound")
        n_v, n_e = len(rows.y_scale[0]), len(rows.left)
        columns = [
            [*left_coefficients(rows, i, n_v), *right_coefficients(rows, i)] for i in range(n_v)
        ]
        names = list(np.array(columns, dtype=object).T.ravel())
        kept = np.repeat(np.concatenate([np.ones(n_e, dtype=bool), ~rows.driven]), n_v)
        first = int((~kept).sum())
        factor: FloatArray = np.asarray(
            np.linalg.qr(
                np.column_stack([everything[:, ~kept], everything[:, kept], right_side]), mode="r"
            )
        )
        R = factor[first:, first:-1] * step.D[kept]
        moving = np.column_stack([R, factor[first:, -1] - R @ step.theta[kept]])
        entries = combinations(moving, [*names, constant(1.0)])
        program = Program(
            indeterminates_of(rows.names),
            (*self.constraints, NormBound(tuple(entries), bound)),
            minimise=bound,
        )
        found, theta = solve(program), step.theta.copy()
        theta[kept] = [float(found.value(name)) for name in names]
        moved = step.D[kept] * (theta[kept] - step.theta[kept])
        left = factor[:first, -1] + factor[:first, first:-1] @ moved
        theta[~kept] -= solve_triangular(factor[:first, :first], left) / step.D[~kept]
        return theta


def minimise_certified_implicit(
    rows: ImplicitRows,
    start: tuple[FloatArray, FloatArray],
    *,
    slowest: float = 1.0,
    steps: int,
) -> tuple[FloatArray, FloatArray] | None:
    """Scaled e and f of a local minimum of Σ |y - ŷ|² in the set; None if there is none.

    start: scaled e and f, in the set or not.
    """
    inside = ImplicitSet(rows, slowest)
    found = descend(inside, SCALE * np.concatenate(start).ravel(), steps=steps)
    return None if found is None else inside.split(found)


def minimise_equation(
    rows: ImplicitRows, start: tuple[FloatArray, FloatArray], *, steps: int
) -> MonotoneEquation | None:
    """The same of set 3.8 without the set: nothing makes the equation stable."""
    everywhere, theta = ImplicitSet(rows, None), np.concatenate(start).ravel()
    found = descend(everywhere, theta, steps=steps, inside=True)
    if found is None or not np.isfinite(everywhere.cost(found)):
        return None
    return rows.equation(*everywhere.split(found))
