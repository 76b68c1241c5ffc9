"""One step of the funnel of an explicit model, for the sweeps of `design_state_funnel`."""

from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import FloatArray, Json
from nlsid_core.design.sampled import closed_loop
from nlsid_core.design.sampled.closed_loop import Frame
from nlsid_core.design.sampled.reach import Reach, bases, reach
from nlsid_core.funnels.sampled import DisturbanceAssumption
from nlsid_core.kernel.exact import Matrix, product
from nlsid_core.kernel.polynomials import Polynomial, Ring
from nlsid_core.kernel.sampled_step import explicit_step
from nlsid_core.models.state_map import StateModel
from nlsid_core.policies.sampled import SampledPolicy

UP = 1.0 + 1e-9  # a radius written down is above its value by more than rounding


@dataclass(frozen=True, eq=False)
class ExplicitStep:
    """The exact step S⁺f̄(Tz) of z, |S T z|², and the bounds that the disturbance needs."""

    T: FloatArray
    ring: Ring
    rows: list[Polynomial]
    size: Polynomial
    degree: int
    kappa: float
    curvature: list[float]
    assumption: DisturbanceAssumption

    @classmethod
    def at(
        cls,
        model: StateModel,
        policy: SampledPolicy,
        norms: Frame,
        k: int,
        assumption: DisturbanceAssumption,
    ) -> "ExplicitStep":
        """The step from sample k."""
        n, sample, T = len(model), norms.sample(policy, k), closed_loop.exact(norms.T[k])
        ring = closed_loop.ring_of(n)
        rows = explicit_step(closed_loop.map_of(model), sample, T, ring)
        ST: Matrix = product(sample.S, T)
        scaled = ring.product(ST, ring.variables)
        unit = product(sample.S_next, product(sample.A, T))
        carried = ring.product(unit, ring.variables)
        moved = [p - q for p, q in zip(rows, carried, strict=True)]
        return cls(
            T=norms.T[k],
            ring=ring,
            rows=rows,
            size=ring.dot(scaled, scaled),
            degree=max(1, int(np.max(model.exponents.sum(axis=1)))),
            kappa=closed_loop.inverse_bound(ST),
            curvature=closed_loop.curvature_bounds(moved, ring),
            assumption=assumption,
        )

    def from_radius(self, radius: float) -> tuple[Reach, float]:
        """The reach from `radius`, and the radius it needs next."""
        found = reach(self.rows, self.ring, radius, self.degree)
        return found, (found.bound + self.assumption.bound * self.stretch(radius)) * UP

    def stretch(self, radius: float) -> float:
        """μ of the kernel: what a deviation up to the bound is stretched by, from `radius`."""
        z, far = self.kappa * radius, self.kappa * (radius + self.assumption.bound)
        powers = enumerate(self.curvature, start=1)
        return self.kappa * sum(
            gamma * sum(far**i * z ** (m - 1 - i) for i in range(m)) for m, gamma in powers
        )

    def proof(self, found: Reach) -> Json:
        """The proof of a reach."""
        return found.stated(self.rows, self.size, self.ring)

    def stated(self) -> Json:
        """Coordinates and bounds."""
        return {"T": self.T.tolist(), "kappa": self.kappa, "curvature": self.curvature}

    def bases(self) -> Json:
        """The monomials of every step's witnesses."""
        basis, inner = bases(len(self.T), self.degree)
        return {"basis": basis.tolist(), "ball_basis": inner.tolist()}
