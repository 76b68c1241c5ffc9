"""Node `model_identifier`: identification as a service, by `nlsid identify` as a process.

`~/identify` answers whether work began; how long it has lasted is on /diagnostics; the model comes
out on ~/model (latched) once it is proved stable, beside the files in `out`. `~/cancel` calls it
off. Recordings that are not closed yet are left out, and so are those without the configured
topics.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticStatus
from std_msgs.msg import String

from bags.chain.config import load_config
from bags.chain.finished import finished_bags
from bags.designs import documents
from nlsid_core.errors import DataError, NlsidError
from nlsid_core.proofs import check
from nlsid_ros import qos
from nlsid_ros.running import ManagedNode, Parameter
from nlsid_ros.starting import entry_point

LOOK = 0.1  # s between looks at the process


class ModelIdentifier(ManagedNode):
    """One identification at a time; callbacks only start, look at and end it."""

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
        self._topics = load_config(self._config).signals.topics

    def start(self) -> None:
        """Wait for requests."""
        self._work: subprocess.Popen[bytes] | None = None
        self._began = 0.0
        self._level, self._text = DiagnosticStatus.OK, "idle"
        self.keep_reporting(self._report)
        self._model = self.create_publisher(String, "~/model", qos.DOCUMENT)
        self.serve("identify", self._on_identify)
        self.serve("cancel", self._on_cancel)
        self.every(LOOK, self._look)

    def stop(self) -> None:
        """Call off what runs."""
        if self._work is not None:
            self._work.kill()
            self._work.wait()
            self._work = None

    def _on_identify(self) -> tuple[bool, str]:
        if self._work is not None:
            return False, "busy: identifying"
        bags, others = finished_bags(self._bags, self._topics, last=self.values.last)
        left_out = [f"; left out {path.name}: {reason}" for path, reason in others.items()]
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 - a pipe could be full
        command = [sys.executable, "-m", "bags.commands.main", "identify", str(self._out)]
        self._work = subprocess.Popen(
            [*command, *map(str, bags), "--config", str(self._config)],
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
        )
        self._began = time.monotonic()
        self._say("identifying")
        return True, "".join(["started", *left_out])

    def _on_cancel(self) -> tuple[bool, str]:
        if self._work is None:
            return False, "nothing runs"
        self.stop()
        self._say("cancelled")
        return True, "cancelled"

    def _look(self) -> None:
        """When it has ended, check the proof and publish the model, or say why there is none."""
        if self._work is None or self._work.poll() is None:
            return
        status, self._work = self._work.returncode, None
        try:
            if status:
                self._errors.seek(0)
                said = self._errors.read().strip() or f"the process ended with status {status}"
                raise DataError(said.removeprefix("error: "))
            verdict = check(self._out / documents.MODEL_PROOF)
            model = documents.load_stable_model(self._out / documents.MODEL)
        except (NlsidError, OSError) as error:
            self._say(f"failed: {error}", DiagnosticStatus.ERROR)
            return
        self._model.publish(String(data=json.dumps(model.document())))
        self._say(str(verdict))

    def _say(self, text: str, level: bytes = DiagnosticStatus.OK) -> None:
        self._level, self._text = level, text
        self._report()

    def _report(self) -> None:
        lasted = 0.0 if self._work is None else time.monotonic() - self._began
        values = {"seconds": f"{lasted:.0f}", "out": str(self._out)}
        self.report(self._level, self._text, values)


main = entry_point(ModelIdentifier)

if __name__ == "__main__":
    main()
