"""A continuous funnel made by hand: the monitor's and the controller's, not the checker's."""

from pathlib import Path

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.design import ContinuousTracking, Goal, compose_funnels, design
from nlsid_core.dynamics import Nominal, VectorField, constant_on, linear_through
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy

RADIUS = 0.2  # m at the start; it shrinks to half of it

Stage = tuple[VectorField, ContinuousPolicy, ContinuousFunnel]


def stage(t0: float = 0.0, radius: float = RADIUS, *, limit: float | None = None) -> Stage:
    """ẋ = u along x₀ = t from t0 to t0 + 1 s, u = 1 - 4 x̄; half as wide at the end."""
    field = VectorField.from_function(lambda x, u: [u[0]], 1, 1)  # noqa: ARG005
    digest = files.digest(field.document())
    t = np.linspace(t0, t0 + 1.0, 5)
    x = linear_through(t, t[:, None])
    policy = ContinuousPolicy(
        x,
        constant_on(t, np.ones((4, 1))),
        constant_on(t, np.full((4, 1, 1), 4.0)),
        digest,
        limits=np.zeros((0, 3)) if limit is None else np.array([[0, -limit, limit]]),
    )
    rho = (np.linspace(radius, radius / 2, 5)) ** 2
    funnel = ContinuousFunnel(x, np.ones((5, 1, 1)), rho, digest, files.digest(policy.document()))
    return field, policy, funnel


def composed(folder: Path) -> Path:
    """Two such stages, proved and composed in `folder`, which is returned."""
    goal: Goal | FloatArray = np.array([[25.0]])
    proofs = []
    for t0 in (1.0, 0.0):
        field, policy, _ = stage(t0)
        nominal = Nominal(policy.x, policy.u)
        found = design(ContinuousTracking(field, nominal, goal=goal, policy=policy))
        proofs.insert(0, found.save(folder / f"from {t0:g}")[-1])
        goal = Goal.start_of(found.funnel)
    return compose_funnels(proofs, folder / "whole").parent
