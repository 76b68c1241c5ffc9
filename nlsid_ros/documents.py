"""The three latched documents of a proved funnel, put together as they arrive.

Of a continuous funnel `model` is the vector field, and parameters say where its signals are.
"""

from collections.abc import Callable
from functools import partial

from rclpy.node import Node
from std_msgs.msg import String

from bags.designs.design import AnyDesign, Wiring, read_design
from nlsid_core import files
from nlsid_core.arrays import Json
from nlsid_core.errors import NlsidError
from nlsid_ros import qos
from nlsid_ros.running import declare_number, declare_text

ROLES = ("model", "policy", "funnel")
Taken = Callable[[AnyDesign], None]


def declare_wiring(node: Node) -> Wiring | None:
    """The parameters that say where a continuous funnel's state and inputs are; None if unset."""
    what = "of a continuous funnel: topic:field paths separated by commas, all on one topic; empty"
    response = declare_text(node, "response", "", f"the state {what}: the model says it")
    command = declare_text(node, "command", "", f"the inputs {what}: the model says it")
    period = declare_number(
        node, "period", 0.0, "s between samples of a continuous funnel", between=(0.0, 60.0)
    )
    if not (response or command):
        return None
    return Wiring.parse(
        (path.strip() for path in response.split(",")),
        (path.strip() for path in command.split(",")),
        period,
    )


class FunnelSubscription:
    """Calls `taken` with the design of `source` once its documents are all there and belong
    together, again whenever they are replaced; `refused` with the reason when they do not.
    """

    def __init__(
        self,
        node: Node,
        source: str,
        taken: Taken,
        refused: Callable[[str], None],
        *,
        wiring: Wiring | None = None,
    ) -> None:
        self._taken, self._refused = taken, refused
        self._documents: dict[str, Json] = {}
        self._wiring = wiring
        self.digest = ""
        for role in ROLES:
            node.create_subscription(
                String, f"{source}/{role}", partial(self._take, role), qos.DOCUMENT
            )

    def _take(self, role: str, message: String) -> None:
        try:
            self._documents[role] = files.parse_document(message.data, source=role)
            if len(self._documents) < len(ROLES):
                return
            design = read_design(self._documents, wiring=self._wiring)
            self.digest = files.digest(self._documents["funnel"])
            self._taken(design)
        except NlsidError as error:
            self._refused(f"funnel not used: {error}")
