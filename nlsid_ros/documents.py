"""The three latched documents of a proved funnel, put together as they arrive."""

from collections.abc import Callable
from functools import partial

from rclpy.node import Node
from std_msgs.msg import String

from bags.monitoring.designs import Design, read_design
from nlsid_core import _json
from nlsid_core._types import Json
from nlsid_core.errors import NlsidError
from nlsid_ros import qos

ROLES = ("model", "policy", "funnel")
Taken = Callable[[Design], None]


class FunnelSubscription:
    """Calls `taken` with the design of `source` once its documents are all there and belong
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
            design = read_design(self._documents)
            self.digest = _json.digest(self._documents["funnel"])
            self._taken(design)
        except NlsidError as error:
            self._refused(f"funnel not used: {error}")
