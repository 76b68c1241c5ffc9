"""Node `model_identifier`: identification as a service, in a worker process.

`~/identify` answers at once whether work began; progress is on /diagnostics; the model comes out on
~/model (latched) once it is proved stable, beside the files in `out`. `~/cancel` calls it off.
Recordings that are not closed yet are left out, and so are those without the configured topics.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.chain.background import BackgroundIdentification, Progress
from bags.chain.config import load_config
from bags.designs import documents
from nlsid_core.errors import DataError, NlsidError
from nlsid_core.proofs import check
from nlsid_ros import qos
from nlsid_ros.diagnostics import name_of, status
from nlsid_ros.running import Arguments, ManagedNode, declare, declare_text, run

NAME = "model_identifier"
LOOK = 0.1  # s between looks at the worker
REPORT = 1.0  # s between diagnostics while nothing changes


class ModelIdentifier(ManagedNode):
    """One identification at a time; callbacks only start, look at and end the worker."""

    def __init__(self, arguments: Arguments = None) -> None:
        super().__init__(NAME, arguments)

    def read_parameters(self) -> None:
        """Declare them; take the values that they have now."""
        bags: Any = declare(
            self, "bags", [""], "bags or folders of bags, read when ~/identify is called"
        )
        self._bags = [Path(bag) for bag in bags if bag]
        last: Any = declare(
            self, "last", 0, "only the last so many of the bags; 0: all", between=(0, 10_000)
        )
        self._last = last
        self._config = Path(declare_text(self, "config", "", "the robot's YAML configuration"))
        self._out = Path(declare_text(self, "out", "", "folder for model.json and its proof"))

    def prepare(self) -> None:
        """Refuse to wait for a request that could not be served."""
        if not self._bags or self._out == Path():
            raise DataError("nothing to identify from or to; set the parameters bags and out")
        load_config(self._config)

    def start(self) -> None:
        """Wait for requests."""
        self._work: BackgroundIdentification | None = None
        self._said = Progress("idle", 0.0)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", qos.EVENTS)
        self._model = self.create_publisher(String, "~/model", qos.DOCUMENT)
        self.create_service(Trigger, "~/identify", self._on_identify)
        self.create_service(Trigger, "~/cancel", self._on_cancel)
        self.create_timer(LOOK, self._look)
        self.create_timer(REPORT, self._report)

    def stop(self) -> None:
        """Call off what runs."""
        if self._work is not None:
            self._work.cancel()

    def _on_identify(self, _request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        answer.success = self._work is None
        answer.message = "started" if answer.success else f"busy: {self._said.what}"
        if answer.success:
            self._work = BackgroundIdentification(
                self._bags, self._config, self._out, last=self._last
            )
        return answer

    def _on_cancel(self, _request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        answer.success = self._work is not None
        answer.message = "cancelled" if answer.success else "nothing runs"
        if self._work is not None:
            self._work.cancel()
            self._look()
        return answer

    def _look(self) -> None:
        """Pass on the worker's progress; on success check the proof and publish the model."""
        if self._work is None:
            return
        progress = self._work.poll()
        if progress.done:
            self._work.cancel()
            self._work = None
            for left in progress.left_out:
                self.get_logger().warning(f"left out: {left}")
            if progress.what == "done":
                progress = self._publish(progress)
        if progress != self._said:
            self._said = progress
            self._report()

    def _publish(self, progress: Progress) -> Progress:
        try:
            verdict = check(self._out / documents.MODEL_PROOF)
            model = documents.load_stable_model(self._out / documents.MODEL)
        except (NlsidError, OSError) as error:
            return replace(progress, what="failed", error=str(error))
        self._model.publish(String(data=json.dumps(model.document())))
        return replace(progress, what=str(verdict))

    def _report(self) -> None:
        said = self._said
        level = DiagnosticStatus.ERROR if said.error else DiagnosticStatus.OK
        text = said.what + (f": {said.error}" if said.error else "")
        now = self.get_clock().now().to_msg()
        values = {"progress": f"{said.fraction:.2f}", "out": str(self._out)}
        if said.left_out:
            values["left out"] = "; ".join(said.left_out)
        self._diagnostics.publish(status(now, name_of(self), level, text, values))


def main(args: list[str] | None = None) -> None:
    """Entry point of `ros2 run nlsid model_identifier`."""
    try:
        run(ModelIdentifier, args)
    except (NlsidError, OSError) as error:
        sys.exit(f"{NAME}: {error}")


if __name__ == "__main__":
    main()
