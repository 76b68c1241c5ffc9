"""`closed_cycle`: a funnel that ends inside its own start, so its motion is repeated for ever.

In coordinates across a periodic motion, with the phase along it as t, a limit cycle is a point; an
impact at the end of a step is a linear map of these coordinates. Source: thesis Lemma 5.2 from one
cycle to the next; docs/theory-funnels.md, "Cycles and impacts".
"""

import numpy as np

from nlsid_core.arrays import ArrayLike
from nlsid_core.design.continuous.design import FunnelDesign
from nlsid_core.design.continuous.setting import Goal
from nlsid_core.designs import Design
from nlsid_core.errors import DataError, Infeasible
from nlsid_core.funnels.continuous import ellipsoid_inside

ROUNDING = 1 - 1e-9  # of the start's size: what its matrix loses where it is rounded


def closed_cycle(found: FunnelDesign, *, reset: ArrayLike | None = None) -> FunnelDesign:
    """The same funnel F, its goal now {x : Rx ∈ F(t0)}: a solution that ends is again at the start.

    found: designed with any goal, without a hold. reset: R (n, n), invertible, of x at the end
    (None: nothing jumps). The kernel decides F(tf) ⊂ goal.

    Raises DataError for an R that has no inverse or a held funnel, Infeasible if it does not close.
    """
    if "hold" in found.claim:
        raise DataError("an input that is held into the next cycle is not covered: design without")
    funnel = found.funnel
    R = np.eye(funnel.n) if reset is None else np.asarray(reset, dtype=np.float64)
    if R.shape != (funnel.n, funnel.n) or np.linalg.matrix_rank(R) < funnel.n:
        raise DataError(f"reset should be an invertible ({funnel.n}, {funnel.n}) matrix, is {R}")
    centre = np.linalg.solve(R, funnel.nominal(funnel.t0))
    P = R.T @ funnel.shape(funnel.t0) @ R / ROUNDING
    goal = Goal(centre, (P + P.T) / 2)
    multiplier = ellipsoid_inside(
        funnel.nominal(funnel.tf), funnel.shape(funnel.tf), goal.centre, goal.P
    )
    if multiplier is None:
        raise Infeasible(
            f"the funnel does not end inside its start: half-widths {funnel.widths(funnel.t0)} at "
            f"the start, {funnel.widths(funnel.tf)} at the end, before the reset if there is one. "
            "Take a smaller goal, or a policy that brings states nearer in one cycle"
        )
    claim = found.claim | {"goal": {"centre": goal.centre.tolist(), "P": goal.P.tolist()}}
    proof = found.proof | {"goal_multiplier": multiplier}
    return Design.proved(
        found.model, found.policy, funnel, claim=claim, proof=proof, found=found.found
    )
