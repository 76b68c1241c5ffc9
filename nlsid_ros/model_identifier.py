"""Node `model_identifier`: identification as a service, in a worker process.

`~/identify` answers at once whether work began; progress is on /diagnostics; the model comes out on
~/model (latched) once it is proved stable, beside the files in `out`. `~/cancel` calls it off.
Recordings that are not closed yet are left out, and so are those without the configured topics.
"""

import json
from dataclasses import replace
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticStatus
from std_msgs.msg import String

from bags.chain.background import BackgroundIdentification, Progress
from bags.chain.config import load_config
from bags.designs import documents
from nlsid_core.errors import DataError, NlsidError
from nlsid_core.proofs import check
from nlsid_ros import qos
from nlsid_ros.running import ManagedNode, Parameter
from nlsid_ros.starting import entry_point

LOOK = 0.1  # s between looks at the worker


class ModelIdentifier(ManagedNode):
    """One identification at a time; callbacks only start, look at and end the worker."""

    name = "model_identifier"
    task = "identification"
    parameters = (
        Parameter("bags", [""], "bags or folders of bags, read when ~/identify is called"),
        Parameter("last", 0, "only the last so many of the bags; 0: all", (0, 10_000)),
        Parameter("config", "", "the robot's YAML configuration"),
        Parameter("out", "", "folder for model.json and its proof"),
    )

    def read_parameters(self) -> None:
        """Take the paths."""
        self._bags = [Path(bag) for bag in self.values.bags if bag]
        self._config, self._out = Path(self.values.config), Path(self.values.out)

    def prepare(self) -> None:
        """Refuse to wait for a request that could not be served."""
        if not self._bags or self._out == Path():
            raise DataError("nothing to identify from or to; set the parameters bags and out")
        load_config(self._config)

    def start(self) -> None:
        """Wait for requests."""
        self._work: BackgroundIdentification | None = None
        self._said = Progress("idle", 0.0)
        self.keep_reporting(self._report)
        self._model = self.create_publisher(String, "~/model", qos.DOCUMENT)
        self.serve("identify", self._on_identify)
        self.serve("cancel", self._on_cancel)
        self.every(LOOK, self._look)

    def stop(self) -> None:
        """Call off what runs."""
        if self._work is not None:
            self._work.cancel()

    def _on_identify(self) -> tuple[bool, str]:
        if self._work is not None:
            return False, f"busy: {self._said.what}"
        last = self.values.last
        self._work = BackgroundIdentification(self._bags, self._config, self._out, last=last)
        return True, "started"

    def _on_cancel(self) -> tuple[bool, str]:
        if self._work is None:
            return False, "nothing runs"
        self._work.cancel()
        self._look()
        return True, "cancelled"

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
        values = {"progress": f"{said.fraction:.2f}", "out": str(self._out)}
        if said.left_out:
            values["left out"] = "; ".join(said.left_out)
        self.report(level, text, values)


main = entry_point(ModelIdentifier)

if __name__ == "__main__":
    main()
