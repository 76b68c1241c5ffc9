"""Simulation error minimised inside a convex set of stable models, for every class that has one.

The simulated outputs are y(θ) and the set is convex in θ and its storage P together. A step solves
    minimise |r + J u|² + damping |u|²   over (θ + D⁻¹u, P) in the set,   D the column norms of J,
a cone program in which the data are one triangular factor, however many samples there are: steps of
Gauss and Newton, damped as Levenberg and Marquardt do, that never leave the set. A start outside it
is allowed: the first step enters the set as near to the start's outputs as it can.
Source: thesis Definition 2.2 and Chapter 2; Marquardt 1963.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import SolverError

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e-8, 1e4
DAMPING_DOWN, DAMPING_UP = 0.1, 10.0
STOP = 1e-4  # relative gain of a step that ends the descent, twice in a row
FLAT = 1e-9  # norm of a column of J, relative to the largest, below which it is taken as that


@dataclass(frozen=True, eq=False)
class Outputs:
    """r (N,): simulated minus measured outputs, in one unit; J (N, p): its derivatives in θ."""

    r: FloatArray
    J: FloatArray


@dataclass(frozen=True, eq=False)
class Step:
    """minimise |R u + r|² + damping |u|², θ = θ_0 + u/D."""

    theta: FloatArray
    D: FloatArray
    R: FloatArray
    r: FloatArray
    damping: float


class StableSet(Protocol):
    """A class of models with its data and its convex set."""

    def outputs(self, theta: FloatArray) -> Outputs | None:
        """None where the simulation diverges."""
        ...

    def cost(self, theta: FloatArray) -> float:
        """|r|²; infinite where the simulation diverges."""
        ...

    def inside(self, step: Step) -> FloatArray:
        """θ in the set that solves the step. Raises SolverError if the solver gives up."""
        ...


def descend(
    problem: StableSet, theta: FloatArray, *, steps: int, inside: bool = False
) -> FloatArray | None:
    """θ in the set with a local minimum of |r|²; None if no step from `theta` enters the set.

    inside: `theta` is in the set, and is what is returned if no step goes down.
    """
    best, cost = (theta, problem.cost(theta)) if inside else (None, np.inf)
    damping, small, found = FIRST_DAMPING, 0, problem.outputs(theta)
    for _ in range(steps):
        if found is None:
            break
        D = np.linalg.norm(found.J, axis=0)
        D = np.maximum(D, FLAT * np.max(D))
        stacked = np.column_stack([found.J / D, found.r])
        factor: FloatArray = np.asarray(np.linalg.qr(stacked, mode="r"))
        gain = 0.0
        while damping <= MOST_DAMPING:
            step = Step(theta, D, factor[:, :-1], factor[:, -1], damping)
            try:
                candidate = problem.inside(step)
            except SolverError:
                damping *= DAMPING_UP
                continue
            reached = problem.cost(candidate)
            if reached < cost:
                gain = 1.0 - reached / cost if np.isfinite(cost) else 1.0
                theta = best = candidate
                cost, damping = reached, max(damping * DAMPING_DOWN, LEAST_DAMPING)
                break
            damping *= DAMPING_UP
        small = small + 1 if gain < STOP else 0
        if small == 2 or gain == 0.0:
            break
        found = problem.outputs(theta)
    return best
