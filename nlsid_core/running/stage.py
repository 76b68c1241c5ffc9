"""`Stage`: what a monitor or a controller is made of; a composition has one after another."""

from typing import NamedTuple, TypeAlias

from nlsid_core import files
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import CertificateMismatch, DataError
from nlsid_core.funnels import AnyFunnel
from nlsid_core.models import StableModel, StateModel
from nlsid_core.policies import AnyPolicy
from nlsid_core.running.held import Held

Dynamics: TypeAlias = StableModel | StateModel | VectorField


class Stage(NamedTuple):
    """A model, a policy and a funnel that were made for each other.

    policy: None where the funnel is around the model itself. funnel: None of a policy of which
    nothing is proved. held: of a vector field, how its policy is applied, and how often.
    """

    model: Dynamics
    policy: AnyPolicy | None
    funnel: AnyFunnel | None
    held: Held | None = None

    @property
    def applied(self) -> Held:
        """`held`; DataError where nobody said it."""
        if self.held is None:
            raise DataError(
                "a continuous funnel names no time between samples, nor how its policy may be "
                "applied, its claim does: give `held`, Held.of_claim(design.claim, period)"
            )
        return self.held

    def refuse_mismatch(self) -> None:
        """CertificateMismatch if a part was made for another."""
        policy, funnel = self.policy, self.funnel
        digest = files.digest(self.model.document())
        if policy is not None and policy.made_for != digest:
            raise CertificateMismatch("the policy was made for another model")
        if funnel is None:
            return
        made_for, its_policy = funnel.made_for
        if made_for != digest:
            raise CertificateMismatch("the funnel was made for another model")
        if its_policy is not None and policy is None:
            raise CertificateMismatch("the funnel is about a policy")
        if policy is not None and its_policy != files.digest(policy.document()):
            raise CertificateMismatch("the funnel was made for another policy")
