"""Node `funnel_publisher`: checks a funnel's proof, then publishes the design, latched.

Publishes ~/design (std_msgs/String, transient local): the files of model, policy, funnel and proof
as one bundle, which whoever uses it has decided again; another one when the parameter `funnel` is
set. Refuses what is not proved: one error on /diagnostics, and exit status 1 if it is the first.
"""

from pathlib import Path
from types import SimpleNamespace

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.publisher import Publisher
from std_msgs.msg import String

from bags.designs.bundle import Bundle
from nlsid_core.errors import DataError, NlsidError
from nlsid_ros import qos
from nlsid_ros.documents import CHECK, limits_of
from nlsid_ros.running import ManagedNode, Parameter
from nlsid_ros.starting import entry_point


class FunnelPublisher(ManagedNode):
    """Publishes one proved funnel for as long as it runs."""

    name = "funnel_publisher"
    task = "design"
    parameters = (
        *CHECK,
        Parameter(
            "funnel",
            "",
            "funnel.json, with its proof beside it, or composition.proof.json with its stages",
            tunable=True,
        ),
    )

    def read_parameters(self) -> None:
        """Begin with nothing published."""
        self._latched: Publisher | None = None

    def tune(self, values: SimpleNamespace) -> None:
        """Publish another funnel, if it is proved."""
        path = Path(values.funnel)
        if self._latched is not None:
            self._publish(*self._load(path))
        self._path = path

    def prepare(self) -> None:
        """DataError if there is nothing to publish."""
        if not self.values.funnel:
            raise DataError("no funnel to publish; set the parameter funnel")

    def start(self) -> None:
        """Check, publish latched, and say what was proved."""
        self.keep_reporting(self._report)
        self._latched = self.create_publisher(String, "~/design", qos.DOCUMENT)
        self._publish(*self._load(self._path))

    def stop(self) -> None:
        """Publish no more."""
        self._latched = None

    def _load(self, path: Path) -> tuple[Bundle, str]:
        """What to publish, and what is proved of it."""
        try:
            bundle = Bundle.load(path)
            return bundle, str(bundle.decided(limits_of(self.values)))
        except (NlsidError, OSError) as refusal:
            self._reject(refusal)
            raise

    def _reject(self, refusal: object) -> None:
        self._say(DiagnosticStatus.ERROR, f"REJECTED {refusal}")
        self.get_logger().fatal(f"not published, not proved: {refusal}")

    def _publish(self, bundle: Bundle, verdict: str) -> None:
        assert self._latched is not None
        bundle.design()  # it can be used
        self._latched.publish(String(data=bundle.text()))
        self._say(DiagnosticStatus.OK, verdict)
        self.get_logger().info(verdict)

    def _say(self, level: bytes, message: str) -> None:
        self._said = level, message
        self._report()

    def _report(self) -> None:
        level, said = self._said
        message, _, assuming = said.partition("\n")
        self.report(level, message, {"assuming": assuming.strip()})


main = entry_point(FunnelPublisher)

if __name__ == "__main__":
    main()
