"""Node `funnel_publisher`: checks a funnel's proof, then publishes the funnel, latched.

Publishes ~/funnel, ~/model and ~/policy (std_msgs/String, transient local): the JSON documents as
they were proved. Refuses what is not proved: one error on /diagnostics, and exit status 1.
"""

import json
import sys
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from std_msgs.msg import String

from bags.documents import load_proved_funnel
from nlsid_core._types import Json
from nlsid_core.errors import NlsidError
from nlsid_ros import qos
from nlsid_ros.diagnostics import status
from nlsid_ros.running import ManagedNode, declare_text, run

NAME = "funnel_publisher"


class FunnelPublisher(ManagedNode):
    """Publishes one proved funnel for as long as it runs."""

    def __init__(self) -> None:
        super().__init__(NAME)
        self._path = Path(declare_text(self, "funnel", "", "funnel.json, with its proof beside it"))

    def start(self) -> None:
        """Check, publish latched, and say what was proved."""
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", qos.EVENTS)
        try:
            proved = load_proved_funnel(self._path)
        except (NlsidError, OSError) as refusal:
            self._say(DiagnosticStatus.ERROR, f"REJECTED {refusal}")
            self.get_logger().fatal(f"not published, not proved: {refusal}")
            raise
        documents: dict[str, Json] = {
            "model": proved.model.document(),
            "policy": proved.policy.document(),
            "funnel": proved.funnel.document(),
        }
        self._latched = [self._latch(name, document) for name, document in documents.items()]
        self._say(DiagnosticStatus.OK, str(proved.verdict))
        self.get_logger().info(str(proved.verdict))
        for assumption in proved.verdict.assumptions:
            self.get_logger().info(f"assuming {assumption}")

    def _latch(self, name: str, document: Json) -> rclpy.publisher.Publisher:
        publisher = self.create_publisher(String, f"~/{name}", qos.DOCUMENT)
        publisher.publish(String(data=json.dumps(document)))
        return publisher

    def _say(self, level: bytes, message: str) -> None:
        now = self.get_clock().now().to_msg()
        self._diagnostics.publish(status(now, NAME, level, message, {}))


def main(args: list[str] | None = None) -> None:
    """Entry point of `ros2 run nlsid funnel_publisher`."""
    try:
        run(FunnelPublisher, args)
    except (NlsidError, OSError) as error:
        sys.exit(f"{NAME}: {error}")


if __name__ == "__main__":
    main()
