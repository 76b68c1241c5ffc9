"""One step of the funnel of an implicit model, for the sweeps of `state_funnel`."""

from dataclasses import dataclass, replace
from fractions import Fraction

from nlsid_core._types import FloatArray
from nlsid_core.certificate.implicit_funnel import ImplicitLink
from nlsid_core.certificate.implicit_reach import ImplicitStepProof, names_of, step_polynomials
from nlsid_core.discrete_funnel import DisturbanceAssumption
from nlsid_core.errors import CertificateRejected, Infeasible
from nlsid_core.funnels.implicit import ImplicitStep
from nlsid_core.models.trapezoidal import TrapezoidalModel
from nlsid_core.tracking_policy import TrackingPolicy

UP = 1.0 + 1e-12  # a radius written down is above its value by more than rounding


@dataclass(frozen=True, eq=False)
class ImplicitFunnelStep:
    """The semidefinite program of one step, and what the disturbance adds to its reach."""

    link: ImplicitLink
    assumption: DisturbanceAssumption

    @classmethod
    def at(
        cls,
        model: TrapezoidalModel,
        policy: TrackingPolicy,
        k: int,
        *,
        S: FloatArray,
        T: FloatArray,
        A: FloatArray,
        assumption: DisturbanceAssumption,
    ) -> "ImplicitFunnelStep":
        """The step from sample k."""
        try:
            link = ImplicitLink(model, policy, k, S=S, T=T, A=A, assumption=assumption)
        except CertificateRejected as refusal:
            raise Infeasible(str(refusal)) from refusal
        return cls(link, assumption)

    def from_radius(self, radius: float, roots: float) -> tuple[ImplicitStepProof, float]:
        """The proof of one step from `radius` to rates within `roots`, and the radius it needs."""
        loop = self.link.loop
        try:
            size, bound, D = self.link.extents(radius, roots)
        except CertificateRejected as refusal:
            raise Infeasible(str(refusal)) from refusal
        rows, equations, unit = step_polynomials(loop, size, bound)
        names = names_of(loop.states, loop.joints)
        step = ImplicitStep(
            tuple(rows), tuple(equations), names[: loop.states], names[loop.states :], bound=1.0
        )
        found = step.proof()
        proof = replace(found, reach=found.reach * float(unit))
        added = self.link.added(radius, proof.reach, D)
        return proof, float(Fraction(proof.reach) + added) * UP

    def largest(self, cap: float) -> float:
        """The largest radius up to `cap` to begin with; all of it."""
        return cap
