"""Node `excitation`: safe signals to identify a robot with, repeated as often as asked.

Publishes commands at a fixed rate after `~/start`, stamped on an exact grid; `~/stop`, shutdown and
the end go to rest as fast as the limits allow. What each repeat is, is said on ~/experiment
(latched, JSON): a recorder with `at_once: false` gives each its own bag, and those of one signal
have one `repeat_group`. Refuses to run without limits.
"""

import hashlib
import json
import math
import time
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.duration import Duration
from std_msgs.msg import String

from bags.chain.config import load_config
from bags.signals.expressions import Expression, factors
from bags.signals.message_reader import SignalVector
from bags.signals.signal import SignalPath
from nlsid_core.arrays import FloatArray
from nlsid_core.data.excitation import Shape, chirp, multisine, prbs, steps
from nlsid_core.errors import DataError
from nlsid_ros import graph, qos
from nlsid_ros.messages import (
    OTHERS,
    PATIENT_PERIODS,
    ZERO,
    SignalMessage,
    base_stopped,
    patience,
)
from nlsid_ros.running import ManagedNode, Parameter
from nlsid_ros.starting import entry_point

COMMAND = "/cmd_vel:twist.linear.x"
KINDS = ("multisine", "chirp", "prbs", "steps")
BIG = 1e9
STILL = 1.0  # s of the wall's time without a command while a signal is played
LAST_WORD = 1.0  # s for the last command to be received before the node goes


class Excitation(ManagedNode):
    """Plays one signal `repeats` times, resting in between."""

    name = "excitation"
    task = "excitation"
    parameters = (
        Parameter("kind", "multisine", "one of " + ", ".join(KINDS)),
        Parameter("command", "", f"signal published; empty: that of config, else {COMMAND}"),
        Parameter("config", "", "a robot's configuration, whose excitation it is"),
        Parameter("command_type", "geometry_msgs/msg/TwistStamped", "its type"),
        Parameter("others", ZERO, f"its fields that are not the signal: {OTHERS}"),
        Parameter("period", 0.025, "s between commands", (1e-3, 10.0)),
        Parameter("duration", 20.0, "s of one signal", (0.1, 36000.0)),
        Parameter("lowest_hz", 0.1, "lowest frequency", (1e-6, 1e4)),
        Parameter("highest_hz", 2.0, "highest frequency", (1e-6, 1e4)),
        Parameter("hold", 0.5, "s a step or a bit lasts", (1e-3, 1e4)),
        Parameter("pause", 2.0, "s of rest before and after each repeat", (0.0, 3600.0)),
        Parameter("repeats", 1, "how often it is played", (1, 1000)),
        Parameter("seed", 1, "of phases and levels", (0, 2**31)),
        Parameter("lowest", 0.0, "least input", (-BIG, BIG)),
        Parameter("highest", 0.0, "greatest input; must be set", (-BIG, BIG)),
        Parameter("slew", 0.0, "fastest change, 1/s; must be set", (0.0, BIG)),
        Parameter("fade", 1.0, "s of soft start and stop", (0.0, 60.0)),
        Parameter("rest", 0.0, "input of a robot at rest", (-BIG, BIG)),
    )

    def read_parameters(self) -> None:
        """Find the signal and the limits; DataError if there are none."""
        values = self.values
        self._command = SignalMessage(
            SignalVector((self._signal(),)), values.command_type, values.others
        )
        self._period: float = values.period
        self._shape = Shape(
            lowest=values.lowest,
            highest=values.highest,
            slew=values.slew,
            fade=values.fade,
            rest=values.rest,
        )

    def _signal(self) -> SignalPath:
        """What is published: the parameter `command`, else the one excitation of `config`."""
        command, config = self.values.command, self.values.config
        if command or not config:
            return SignalPath.parse(command or COMMAND)
        texts = [signal.path for signal in load_config(Path(config)).signals.excitation]
        if len(texts) > 1 or len(factors(texts[0])) > 1:
            raise DataError(
                f"{config} has the excitations {', '.join(texts)}; name the one to move by the "
                "parameter command"
            )
        return Expression.parse(texts[0]).path

    def prepare(self) -> None:
        """Make the whole signal before anything moves."""
        kind = self.values.kind
        rest = np.full(round(self.values.pause / self._period), self._shape.rest)
        self._once = np.concatenate([rest, self._shape(self._inputs(kind), self._period), rest])
        digest = hashlib.sha256(self._once.tobytes()).hexdigest()
        self._group = f"{self._command.path}, {kind}, sha256:{digest[:16]}"

    def _inputs(self, kind: str) -> FloatArray:
        """The signal between -1 and 1."""
        values, period = self.values, self._period
        samples, rng = round(values.duration / period), np.random.default_rng(values.seed)
        band = {"lowest": values.lowest_hz, "highest": values.highest_hz}
        match kind:
            case "multisine":
                return multisine(samples, period, rng=rng, **band)
            case "chirp":
                return chirp(samples, period, **band)
            case "prbs":
                return prbs(samples, period, hold=values.hold)
            case "steps":
                return steps(samples, period, hold=values.hold, rng=rng)
        raise DataError(f"kind is '{kind}'; it should be one of {', '.join(KINDS)}")

    def start(self) -> None:
        """Be ready; nothing moves before ~/start."""
        self._next: int | None = None
        self._repeat = 0
        self._input = self._shape.rest
        self._sent = -math.inf  # when the last command went out, s of the wall's time
        self._state, self._failed, self._busy = "idle", False, False
        self._did: dict[str, object] = {}
        self._publisher = self.create_publisher(
            self._command.kind,
            self.signal_topic(self._command.path.topic),
            qos.command(self._period),
        )
        self._command.listen(self)
        self._experiment = self.create_publisher(String, "~/experiment", qos.DOCUMENT)
        self.keep_reporting(self._report)
        self.serve("start", self._on_start)
        self.serve("stop", self._on_stop)
        self.every(self._period, self._on_tick)

    def stop(self) -> None:
        """Go to rest before going."""
        self._call_off("stopped with the node")
        while self._input != self._shape.rest:
            self._to_rest()
            time.sleep(self._period)
        self._publisher.wait_for_all_acked(Duration(seconds=LAST_WORD))

    def _on_tick(self) -> None:
        """Send what is due by this node's clock, on the grid of stamps and all of it: a signal that
        ran late, or skipped a part, would not be the one that the limits were kept by.
        """
        if self._next is None:
            if self._input != self._shape.rest:
                self._to_rest()
            return
        if lacking := self._command.lacking():
            self._fail(lacking)
            return
        now_ns, most = self.get_clock().now().nanoseconds, patience(0.0, self._period)
        late = (now_ns - self._due_ns(self._next)) * 1e-9
        if abs(late) > most + self._period:
            way = "before" if late > 0 else "after"
            self._fail(
                f"stopped: a command was due {abs(late):.3g} s {way} this node's clock; {most:g} s "
                "are allowed"
            )
            return
        if time.monotonic() - self._sent > max(STILL, PATIENT_PERIODS * self._period):
            self._fail("stopped: this node's clock stands still")
            return
        while self._next is not None and (stamp_ns := self._due_ns(self._next)) <= now_ns:
            self._input = float(self._once[self._next])
            self._send(stamp_ns)
            self._next += 1
            if self._next == len(self._once):
                self._end_repeat()

    def _due_ns(self, k: int) -> int:
        return self._start_ns + k * round(self._period * 1e9)

    def _to_rest(self) -> None:
        if base_stopped(time.monotonic() - self._sent, self._period):
            self._input = self._shape.rest
        step = self._shape.slew * self._period
        self._input += min(max(self._shape.rest - self._input, -step), step)
        self._send(self.get_clock().now().nanoseconds)

    def _send(self, stamp_ns: int) -> None:
        self._sent = time.monotonic()
        self._publisher.publish(self._command.make(stamp_ns, self._input))

    def _play(self, start_ns: int) -> None:
        self._next, self._start_ns, self._sent = 0, start_ns, time.monotonic()
        values = self.values
        self._did = {
            "kind": values.kind,
            "signal": str(self._command.path),
            "period": values.period,
            "duration": values.duration,
            "repeat": self._repeat + 1,
            "repeats": values.repeats,
            "pause": values.pause,
            "seed": values.seed,
            "lowest_hz": values.lowest_hz,
            "highest_hz": values.highest_hz,
            "hold": values.hold,
            "limits": vars(self._shape),
            "start_ns": self._start_ns,
            "repeat_group": self._group,
        }
        self._experiment.publish(String(data=json.dumps(self._did)))
        self._say(f"repeat {self._repeat + 1} of {values.repeats}")

    def _end_repeat(self) -> None:
        self._repeat += 1
        if self._repeat == self.values.repeats:
            self._finish("done")
        else:  # the next one goes on where this one ends
            self._play(self._due_ns(len(self._once)))

    def _finish(self, state: str, *, whole: bool = True) -> None:
        """Say how it ended; a repeat that is not whole is no repeat."""
        self._next, self._busy = None, False
        ended = {"ended": state} | ({} if whole else {"repeat_group": ""})
        self._experiment.publish(String(data=json.dumps(self._did | ended)))
        self._say(state)

    def _fail(self, why: str) -> None:
        self._failed = True
        self._finish(why, whole=False)

    def _call_off(self, state: str) -> None:
        if self._busy:
            self._finish(state, whole=False)

    def _on_start(self) -> tuple[bool, str]:
        if self._busy:
            return False, "it runs already"
        if lacking := self._command.lacking():
            return False, lacking
        self._busy, self._failed, self._repeat = True, False, 0
        self._play(self.get_clock().now().nanoseconds)
        return True, "running"

    def _on_stop(self) -> tuple[bool, str]:
        said = "stopping" if self._busy else "nothing runs"
        self._call_off("stopped when asked to")
        return True, said

    def _say(self, state: str) -> None:
        self._state = state
        self._report()

    def _report(self) -> None:
        values = {
            "input": f"{self._input:.6g}",
            "sample": "none" if self._next is None else str(self._next),
            "of": str(len(self._once)),
            "repeat": str(min(self._repeat + 1, self.values.repeats)),
        }
        level = DiagnosticStatus.ERROR if self._failed else DiagnosticStatus.OK
        text = self._state
        if named := graph.rivals(self, self._publisher):
            level, text = max(level, DiagnosticStatus.WARN), f"{text}; {named}"
        self.report(level, text, values)


main = entry_point(Excitation)

if __name__ == "__main__":
    main()
