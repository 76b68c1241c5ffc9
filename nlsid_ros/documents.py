"""The three latched documents of a proved funnel, put together as they arrive."""

from collections.abc import Callable
from functools import partial

from rclpy.node import Node
from std_msgs.msg import String

from nlsid_core import _json
from nlsid_core._types import Json
from nlsid_core.errors import CertificateMismatch, NlsidError
from nlsid_core.funnel import Funnel
from nlsid_core.models import DifferenceEquation
from nlsid_core.policy import Policy
from nlsid_ros import qos

ROLES = ("model", "policy", "funnel")
Taken = Callable[[DifferenceEquation, Policy, Funnel], None]


class FunnelSubscription:
    """Calls `taken` with model, policy and funnel of `source` once all are there and belong
    together, again whenever they are replaced; `refused` with the reason when they do not.
    """

    def __init__(
        self, node: Node, source: str, taken: Taken, refused: Callable[[str], None]
    ) -> None:
        self._taken, self._refused = taken, refused
        self._documents: dict[str, Json] = {}
        self.digest = ""
        for role in ROLES:
            node.create_subscription(
                String, f"{source}/{role}", partial(self._take, role), qos.DOCUMENT
            )

    def _take(self, role: str, message: String) -> None:
        try:
            self._documents[role] = _json.parse_document(message.data, source=role)
            if len(self._documents) < len(ROLES):
                return
            model = DifferenceEquation.from_document(self._documents["model"])
            policy = Policy.from_document(self._documents["policy"])
            funnel = Funnel.from_document(self._documents["funnel"])
            if _json.digest(self._documents["policy"]) != funnel.policy:
                raise CertificateMismatch("the funnel was made for another policy")
            if _json.digest(self._documents["model"]) != funnel.model:
                raise CertificateMismatch("the funnel was made for another model")
            self.digest = _json.digest(self._documents["funnel"])
            self._taken(model, policy, funnel)
        except NlsidError as error:
            self._refused(f"funnel not used: {error}")
