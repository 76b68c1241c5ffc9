"""Robust simulation error: convex upper bounds on the simulation error, made exact by iterating.

With G(θ) the banded matrix of the left side over all rows of all trials and ε(θ) the equation
errors, the simulation error is |G⁻¹ε|². Around θ_m, J_m(θ) = ε' K⁻¹ ε bounds it from above and
equals it at θ_m, so minimising and re-linearising never goes up. `bound` has the equations.
Source: thesis (4.1)-(4.3), Proposition 4.3 and Section 4.4.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from nlsid_core._types import FloatArray
from nlsid_core.identification.bound import Bound
from nlsid_core.identification.newton import minimise
from nlsid_core.identification.rows import Rows


@dataclass(frozen=True, eq=False)
class Iterate:
    """One minimiser: left parameters θ, right parameters p, J, the bound at them (scaled), and
    whether it lies on the boundary of K ≻ 0.
    """

    theta: FloatArray
    p: FloatArray
    J: float
    newton_steps: int
    on_boundary: bool


def robust_simulation_error(
    rows: Rows, *, iterations: int = 40, tolerance: float = 1e-6
) -> Iterator[Iterate]:
    """Yield the minimiser of each bound, first to last.

    Stops after `iterations` bounds or when J falls by less than `tolerance` of itself. Raises
    SolverError if Newton's method cannot go on.
    """
    linearised_at: FloatArray | None = None
    previous = float("inf")
    for _ in range(iterations):
        start = rows.identity if linearised_at is None else linearised_at
        found = minimise(Bound(rows, linearised_at), start)
        point = found.point
        yield Iterate(point.theta, point.p, point.J, found.steps, found.on_boundary)
        if previous - point.J <= tolerance * previous and linearised_at is not None:
            return
        linearised_at, previous = point.theta, point.J
