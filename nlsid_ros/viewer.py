"""Node `viewer`: serves a page of what the monitor says to any browser.

Hears ~/margin and ~/forecast of `monitor` and /diagnostics, and publishes nothing. It listens to
the margins as best effort, so that a slow viewer never holds up the monitor; what it shows is the
monitor's word, while that is fresh (`bags.viewing.scene`).
"""

import sys
from contextlib import ExitStack
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState

from bags.viewing.page import LOCAL, PORT, serve_page
from bags.viewing.scene import Scene
from nlsid_core.errors import NlsidError
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of
from nlsid_ros.running import Arguments, ManagedNode, declare, declare_text, run

NAME = "viewer"
NAMES = "signals"  # where the monitor's diagnostics name the measured signals, one a line


class Viewer(ManagedNode):
    """Feeds a scene from what it hears; a server in threads of its own shows it."""

    def __init__(self, arguments: Arguments = None) -> None:
        super().__init__(NAME, arguments)
        self._served = ExitStack()

    def read_parameters(self) -> None:
        """Declare them; take the values that they have now."""
        self._monitor = declare_text(self, "monitor", "funnel_monitor", "node that is shown")
        self._host = declare_text(
            self, "host", LOCAL, "address to serve on; 0.0.0.0: the whole network"
        )
        port: Any = declare(self, "port", PORT, "port; 0: one that is free", between=(0, 65535))
        self._port = port

    def start(self) -> None:
        """Listen, and serve."""
        topic = self.resolve_topic_name(f"{self._monitor}/margin")
        self._shown = topic.removesuffix("/margin").removeprefix("/")
        self._scene = Scene(f"live: {self._shown}", self._shown)
        self.create_subscription(JointState, topic, self._on_margin, qos.SENSOR)
        ahead = f"/{self._shown}/forecast"
        self.create_subscription(JointState, ahead, self._on_forecast, qos.SENSOR)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_status, qos.EVENTS)
        server = serve_page(self._scene, host=self._host, port=self._port)
        address = self._served.enter_context(server)
        self.get_logger().info(f"{self._shown} is shown at {address}")

    def stop(self) -> None:
        """Serve no more."""
        self._served.close()

    def _on_forecast(self, message: JointState) -> None:
        numbers = dict(zip(message.name, message.position, strict=False))
        self._scene.forecast(stamp_ns_of(message), numbers)

    def _on_margin(self, message: JointState) -> None:
        numbers = dict(zip(message.name, message.position, strict=False))
        self._scene.sample(stamp_ns_of(message), numbers)

    def _on_status(self, message: DiagnosticArray) -> None:
        for status in message.status:
            names = [pair.value for pair in status.values if pair.key == NAMES]
            self._scene.say(
                stamp_ns_of(message),
                status.name,
                status.level[0],
                status.message,
                names=names[0].splitlines() if names else (),
            )


def main(args: list[str] | None = None) -> None:
    """Entry point of `ros2 run nlsid viewer`."""
    try:
        run(Viewer, args)
    except (NlsidError, OSError) as error:
        sys.exit(f"{NAME}: {error}")


if __name__ == "__main__":
    main()
