"""One step of the funnel of an implicit model, for the sweeps of `design_state_funnel`."""

from dataclasses import dataclass
from fractions import Fraction
from math import hypot, log2

import numpy as np

from nlsid_core.arrays import FloatArray, Json
from nlsid_core.design.sampled import closed_loop
from nlsid_core.design.sampled.closed_loop import Frame
from nlsid_core.design.sampled.implicit_step import ImplicitStep
from nlsid_core.errors import Infeasible
from nlsid_core.funnels.sampled import DisturbanceAssumption
from nlsid_core.kernel.exact import combined, identity, product
from nlsid_core.kernel.polynomials import Polynomial, Ring
from nlsid_core.kernel.sampled_step import implicit_step, linear_part
from nlsid_core.models.trapezoidal import TrapezoidalModel
from nlsid_core.policies.sampled import SampledPolicy

UP = 1.0 + 1e-9  # a radius written down is above its value by more than rounding
RATES_SHRUNK = (4, 16, 64)  # how much smaller than z the next rates are made, bounded together
REFINEMENTS = 3  # of how far apart two roots are


@dataclass(frozen=True, eq=False)
class Bounds:
    """What the kernel verifies of one step, by its names there."""

    kappa: float
    kappa_next: float
    curvature: list[float]
    state: float
    rates: float
    direct: float
    through: float

    def stretch(self, size: float, step: float) -> float:
        """μ of the kernel, of degree 2 and more."""
        far = size + step
        return sum(
            gamma * sum(far**i * size ** (m - 1 - i) for i in range(m))
            for m, gamma in enumerate(self.curvature, start=2)
        )


@dataclass(frozen=True, eq=False)
class Loop:
    """The step in one choice of coordinates of the next rates, and its bounds; see the kernel."""

    ring: Ring
    rows: list[Polynomial]
    h: list[Polynomial]
    size: Polynomial
    T_next: FloatArray
    inverse: FloatArray
    bounds: Bounds


@dataclass(frozen=True, eq=False)
class Spread:
    """How far apart roots are, in |r|; the extents of the kernel; and what r adds to the reach."""

    spread: float
    wide: float
    far: float


class ImplicitFunnelStep:
    """The semidefinite program of one step, and what the disturbance adds to its reach."""

    def __init__(self, loops: list[Loop], T: FloatArray, assumption: DisturbanceAssumption) -> None:
        self._loops, self._T, self.assumption = loops, T, assumption

    @classmethod
    def at(
        cls,
        model: TrapezoidalModel,
        policy: SampledPolicy,
        norms: Frame,
        k: int,
        assumption: DisturbanceAssumption,
    ) -> "ImplicitFunnelStep":
        """The step from sample k."""
        ratio = 2.0 ** round(log2(norms.cap[k + 1] / norms.cap[k]))
        loops = [_loop(model, policy, norms, k, ratio * weight) for weight in RATES_SHRUNK]
        return cls(loops, norms.T[k], assumption)

    def from_radius(self, radius: float, roots: float) -> tuple[Json, float]:
        """The proof of one step from `radius` to rates within `roots`, and the radius it needs."""
        if len(self._loops) > 1:  # the best coordinates for a radius are kept for others
            self._loops = [min(self._loops, key=lambda loop: self._added(loop, radius, roots))]
        (loop,) = self._loops
        found = self._spread(loop, radius, roots)
        if found is None:
            raise Infeasible(
                "roots may differ by more than a disturbance explains; cut the bound or the radius"
            )
        proof = ImplicitStep(loop.ring, loop.rows, loop.h, loop.size, radius, found.far).proof()
        near, added = self._after(loop, found, radius, proof["reach"])
        stated = {"spread": found.spread, "extents": [found.wide, near]}
        return proof | stated, float((Fraction(proof["reach"]) + Fraction(added)) * Fraction(UP))

    def proof(self, found: Json) -> Json:
        """The proof of what was found."""
        return found

    def stated(self) -> Json:
        """Coordinates and bounds."""
        loop = self._loops[0]
        return {
            "T": self._T.tolist(),
            "T_next": loop.T_next.tolist(),
            "inverse": loop.inverse.tolist(),
            **vars(loop.bounds),
        }

    def bases(self) -> Json:
        """The monomials of every step's witnesses."""
        loop = self._loops[0]
        step = ImplicitStep(loop.ring, loop.rows, loop.h, loop.size, 1.0, 1.0)
        return {name: basis.tolist() for name, basis in step.bases().items()}

    def _spread(self, of: Loop, radius: float, roots: float) -> Spread | None:
        """What the kernel verifies of two roots; None if they may be far apart."""
        loop = of.bounds
        z, r = loop.kappa * radius, loop.kappa * self.assumption.bound
        spread = 2.0 * (1.0 + loop.state)  # where it is looked for first; then a smaller one
        for attempt in range(1 + REFINEMENTS):
            far = (loop.kappa_next * roots + spread * r) * UP
            wide = hypot(z, far) * UP
            mu = loop.stretch(wide, (1.0 + spread) * r)
            shrink = 1.0 - loop.rates - mu
            smaller = (loop.state + mu) / shrink * UP if shrink > 0 else np.inf
            if smaller > spread:
                if attempt == 0:
                    return None
                break
            found, spread = Spread(spread, wide, far), smaller
        return found

    def _after(self, of: Loop, found: Spread, radius: float, reach: float) -> tuple[float, float]:
        """The second extent, and what the disturbance adds."""
        loop = of.bounds
        z, r = loop.kappa * radius, loop.kappa * self.assumption.bound
        near = hypot(z, loop.kappa_next * reach) * UP
        mu = loop.stretch(near, (1.0 + found.spread) * r)
        shrink = 1.0 - loop.rates - mu
        spread = min(found.spread, (loop.state + mu) / shrink) if shrink > 0 else found.spread
        error = loop.rates * spread + mu * (1.0 + spread)
        return near, (loop.direct + loop.through * error) * r

    def _added(self, loop: Loop, radius: float, roots: float) -> float:
        """What the disturbance would add, the reach being about the radius."""
        found = self._spread(loop, radius, roots)
        return np.inf if found is None else self._after(loop, found, radius, radius)[1]


def _loop(
    model: TrapezoidalModel, policy: SampledPolicy, norms: Frame, k: int, weight: float
) -> Loop:
    n, d = len(model), model.joints
    sample, T = norms.sample(policy, k), closed_loop.exact(norms.T[k])
    T_next = norms.T[k + 1][d:, d:] * weight
    after = closed_loop.exact(T_next)
    ring = closed_loop.ring_of(n + d)
    rows, h = implicit_step(
        closed_loop.map_of(model), sample, T, after, Fraction(model.period), ring
    )
    ST = product(sample.S, T)
    scaled = ring.product(ST, ring.variables[:n])
    unit = product(sample.S_next, product(sample.A, T))
    slope = closed_loop.floats(linear_part(h, ring, n)[1])
    inverse = np.linalg.inv(slope)
    normal = ring.product(closed_loop.exact(inverse), h)
    (B, C), (direct, through) = linear_part(normal, ring, n), linear_part(rows, ring, n)
    left = combined(combined(direct, product(through, B), -1), unit, -1)
    S_rates = [row[d:] for row in sample.S_next[d:]]
    bounds = Bounds(
        kappa=closed_loop.inverse_bound(ST),
        kappa_next=closed_loop.inverse_bound(product(S_rates, after)),
        curvature=closed_loop.curvature_bounds(normal, ring, 2),
        state=closed_loop.norm_bound(B),
        rates=closed_loop.norm_bound(combined(C, identity(d), -1)),
        direct=closed_loop.norm_bound(left),
        through=closed_loop.norm_bound(through),
    )
    return Loop(ring, rows, h, ring.dot(scaled, scaled), T_next, inverse, bounds)
