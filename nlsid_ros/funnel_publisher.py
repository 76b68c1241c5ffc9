"""Node `funnel_publisher`: checks a funnel's proof, then publishes the design, latched.

Publishes ~/design (std_msgs/String, transient local): the files of model, policy, funnel and proof
as one bundle, which whoever uses it has decided again; ~/tube (visualization_msgs/MarkerArray) and
~/nominal (trajectory_msgs/JointTrajectory) show it. Publishes again when the files change. Refuses
what is not proved: one error on /diagnostics, and exit status 1 if it is the first.
"""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.publisher import Publisher
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from bags.designs import documents
from bags.designs.bundle import Bundle, Check
from bags.designs.design import AnyDesign
from nlsid_core.errors import NlsidError
from nlsid_ros import qos
from nlsid_ros.diagnostics import name_of, status
from nlsid_ros.documents import declare_limits
from nlsid_ros.pictures import nominal_trajectory, tube_markers
from nlsid_ros.running import Arguments, ManagedNode, declare, declare_text, run

NAME = "funnel_publisher"
LOOK = 0.5  # s between looks at the files
REDRAW = 1.0  # s between pictures, which last three
POLL = 0.1  # s between looks at a check that is on
REPORT = 1.0  # s between diagnostics while nothing changes


class FunnelPublisher(ManagedNode):
    """Publishes one proved funnel for as long as it runs."""

    def __init__(self, arguments: Arguments = None) -> None:
        super().__init__(NAME, arguments)

    def read_parameters(self) -> None:
        """Declare them; take the values that they have now."""
        what = "funnel.json, with its proof beside it, or composition.proof.json with its stages"
        self._path = Path(declare_text(self, "funnel", "", what, tunable=True))
        self._frame = declare_text(
            self, "frame", "map", "frame the tube is drawn in and moves with"
        )
        self._limits = declare_limits(self)
        self._watch = bool(declare(self, "watch", True, "publish again when the files change"))
        self._latched: dict[str, Publisher] = {}
        self._check: Check | None = None

    def tune(self, values: Mapping[str, Any]) -> None:
        """Publish another funnel, if it is proved."""
        path = Path(values["funnel"])
        if self._latched:
            self._publish(self._load(path))
            self._call_off()
        self._path, self._seen = path, self._files(path)

    def start(self) -> None:
        """Check, publish latched, and say what was proved."""
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", qos.EVENTS)
        self._latched = {
            name: self.create_publisher(kind, f"~/{name}", qos.DOCUMENT)
            for name, kind in (
                ("design", String),
                ("tube", MarkerArray),
                ("nominal", JointTrajectory),
            )
        }
        self._seen = self._files(self._path)
        self._publish(self._load(self._path))
        wall = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(REPORT, self._report, clock=wall)
        self.create_timer(REDRAW, self._draw, clock=wall)
        if self._watch:
            self.create_timer(LOOK, self._look, clock=wall)
            self.create_timer(POLL, self._poll, clock=wall)

    def stop(self) -> None:
        """Publish no more."""
        self._call_off()
        self._latched = {}

    def _files(self, path: Path) -> list[tuple[int, int]]:
        """When each file last changed, and its size."""
        names = (
            documents.MODEL,
            documents.VECTOR_FIELD,
            documents.POLICY,
            documents.FUNNEL_PROOF,
            path.name,
        )
        found = [*map(path.with_name, names), *sorted(path.parent.glob("stage*.json"))]
        states = (each.stat() for each in found if each.exists())
        return [(state.st_mtime_ns, state.st_size) for state in states]

    def _look(self) -> None:
        """Have the files decided if they changed; what was published stays until they are."""
        files = self._files(self._path)
        if files == self._seen:
            return
        self._seen = files
        self._call_off()
        try:
            bundle = Bundle.load(self._path)
            self._check, self._changed = Check(bundle.text(), self._limits), bundle
        except (NlsidError, OSError) as refusal:
            self._reject(refusal)

    def _poll(self) -> None:
        """Publish what changed once it is decided, in a process of its own."""
        answer = self._check.poll() if self._check is not None else None
        if answer is None:
            return
        bundle = self._changed
        self._call_off()
        if "refused" in answer:
            self._reject(answer["refused"])
            return
        try:
            self._publish((bundle, bundle.design(), str(answer["proved"])))
        except NlsidError as refusal:
            self._reject(refusal)

    def _call_off(self) -> None:
        if self._check is not None:
            self._check.close()
            self._check = None

    def _load(self, path: Path) -> tuple[Bundle, AnyDesign, str]:
        """What to publish, what it is, and what is proved of it."""
        try:
            bundle = Bundle.load(path)
            return bundle, bundle.design(), str(bundle.decided(self._limits))
        except (NlsidError, OSError) as refusal:
            self._reject(refusal)
            raise

    def _reject(self, refusal: object) -> None:
        self._say(DiagnosticStatus.ERROR, f"REJECTED {refusal}")
        self.get_logger().fatal(f"not published, not proved: {refusal}")

    def _publish(self, proved: tuple[Bundle, AnyDesign, str]) -> None:
        bundle, design, verdict = proved
        self._latched["design"].publish(String(data=bundle.text()))
        self._drawn = design
        self._draw()
        if design.policy is not None:
            self._latched["nominal"].publish(nominal_trajectory(design))
        self._say(DiagnosticStatus.OK, verdict)
        self.get_logger().info(verdict)

    def _draw(self) -> None:
        """Again and again: the picture goes when the publisher does."""
        if self._drawn.policy is not None:  # without a plan there is nothing to draw
            now = self.get_clock().now().to_msg()
            self._latched["tube"].publish(tube_markers(self._drawn, self._frame, now))

    def _say(self, level: bytes, message: str) -> None:
        self._said = level, message
        self._report()

    def _report(self) -> None:
        now = self.get_clock().now().to_msg()
        self._diagnostics.publish(status(now, name_of(self), *self._said, {}))


def main(args: list[str] | None = None) -> None:
    """Entry point of `ros2 run nlsid funnel_publisher`."""
    try:
        run(FunnelPublisher, args)
    except (NlsidError, OSError) as error:
        sys.exit(f"{NAME}: {error}")


if __name__ == "__main__":
    main()
