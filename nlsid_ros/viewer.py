"""Node `viewer`: serves the monitor's verdicts as a page to any browser.

Hears ~/margin and ~/forecast of `monitor` and /diagnostics, and publishes nothing. It listens to
the margins as best effort, so that a slow viewer never holds up the monitor; what it shows is the
monitor's word, while that is fresh (`bags.viewing.scene`).
"""

from contextlib import ExitStack

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState

from bags.viewing.page import LOCAL, PORT, serve_page
from bags.viewing.scene import Scene
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of
from nlsid_ros.running import ManagedNode, Parameter
from nlsid_ros.starting import entry_point

NAMES = "signals"  # where the monitor's diagnostics name the measured signals, one a line


class Viewer(ManagedNode):
    """Feeds a scene from what it hears; a server in threads of its own shows it."""

    name = "viewer"
    parameters = (
        Parameter("monitor", "funnel_monitor", "node that is shown"),
        Parameter("host", LOCAL, "address to serve on; 0.0.0.0: the whole network"),
        Parameter("port", PORT, "port; 0: one that is free", (0, 65535)),
    )

    def start(self) -> None:
        """Listen, and serve."""
        topic = self.resolve_topic_name(f"{self.values.monitor}/margin")
        self._shown = topic.removesuffix("/margin").removeprefix("/")
        self._scene = Scene(f"live: {self._shown}", self._shown)
        self.create_subscription(JointState, topic, self._on_margin, qos.SENSOR)
        self.create_subscription(
            JointState, f"/{self._shown}/forecast", self._on_forecast, qos.SENSOR
        )
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_status, qos.EVENTS)
        server = serve_page(self._scene, host=self.values.host, port=self.values.port)
        self._served = ExitStack()
        address = self._served.enter_context(server)
        self.get_logger().info(f"{self._shown} is shown at {address}")

    def stop(self) -> None:
        """Serve no more."""
        self._served.close()

    def _on_forecast(self, message: JointState) -> None:
        self._scene.forecast(stamp_ns_of(message), _numbers(message))

    def _on_margin(self, message: JointState) -> None:
        self._scene.sample(stamp_ns_of(message), _numbers(message))

    def _on_status(self, message: DiagnosticArray) -> None:
        for status in message.status:
            names = [pair.value for pair in status.values if pair.key == NAMES]
            self._scene.say(
                stamp_ns_of(message),
                status.name.partition(":")[0],
                status.level[0],
                status.message,
                names=names[0].splitlines() if names else (),
            )


def _numbers(message: JointState) -> dict[str, float]:
    return dict(zip(message.name, message.position, strict=False))


main = entry_point(Viewer)

if __name__ == "__main__":
    main()
