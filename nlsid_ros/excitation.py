"""Node `excitation`: safe signals to identify a robot with, repeated as often as asked.

Publishes commands at a fixed rate after `~/start`, stamped on an exact grid; `~/stop`, shutdown and
the end go to rest as fast as the limits allow. What each repeat is, is said on ~/experiment
(latched, JSON), for the recorder to write into its bag; with `recorder` every repeat gets a bag of
its own, and those of one signal have one `repeat_group`. Refuses to run without limits.
"""

import hashlib
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.duration import Duration
from std_msgs.msg import String
from std_srvs.srv import Trigger

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
ANSWER = 10.0  # s for the recorder to answer
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
        Parameter(
            "pause", 2.0, "s of rest before each repeat, and after it in its own bag", (0.0, 3600.0)
        ),
        Parameter("recorder", "", "node asked for a bag per repeat (at_once: false); empty: none"),
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
        self._recorder: str = values.recorder.rstrip("/")
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
        self._once = np.concatenate([rest, self._shape(self._inputs(kind), self._period)])
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
        self._still = 0  # ticks until the bag of a repeat that is over is closed
        self._repeat = 0
        self._input = self._shape.rest
        self._sent = -math.inf  # when the last command went out, s of the wall's time
        self._asked: tuple[Any, Callable[[Any], None], float] | None = None  # the recorder
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
        self._bags = {
            name: self.create_client(Trigger, f"{self._recorder}/{name}")
            for name in ("start", "stop")
            if self._recorder
        }
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
        self._hear_recorder()
        if self._next is None:
            if self._input != self._shape.rest:
                self._to_rest()
            if self._still:
                self._still -= 1
                if not self._still:
                    self._say(f"repeat {self._repeat + 1}: closing the bag")
                    self._ask("stop", self._on_bag_closed)
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
                self._next = None
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

    def _begin_repeat(self) -> None:
        """Play at once, or when the recorder has a new bag."""
        if self._recorder:
            self._say(f"repeat {self._repeat + 1}: asking for a bag")
            self._ask("start", self._on_bag_begun)
        else:
            self._play(self.get_clock().now().nanoseconds)

    def _ask(self, what: str, then: Callable[[Any], None]) -> None:
        asked = self._bags[what].call_async(Trigger.Request())
        self._asked = asked, then, time.monotonic() + ANSWER

    def _hear_recorder(self) -> None:
        """Go on with what the recorder answers, if it does."""
        if self._asked is None:
            return
        asked, then, until = self._asked
        if asked.done():
            self._asked = None
            then(asked.result())
        elif time.monotonic() > until:
            self._fail(f"the recorder {self._recorder} has not answered for {ANSWER:g} s")

    def _on_bag_begun(self, answer: Trigger.Response) -> None:
        if answer.success:
            self._play(self.get_clock().now().nanoseconds)
        else:
            self._fail(f"no bag from the recorder: {answer.message}")

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
        if self._recorder:  # the response is heard for as long as a command may be held
            self._still = max(1, round(self.values.pause / self._period))
        else:  # the next one goes on where this one ends
            self._next_repeat(self._start_ns + len(self._once) * round(self._period * 1e9))

    def _on_bag_closed(self, answer: Trigger.Response) -> None:
        if answer.success:
            self._next_repeat(None)
        else:
            self._fail(f"the bag is not whole: {answer.message}")

    def _next_repeat(self, start_ns: int | None) -> None:
        self._repeat += 1
        if self._repeat == self.values.repeats:
            self._finish("done")
        elif start_ns is None:
            self._begin_repeat()
        else:
            self._play(start_ns)

    def _finish(self, state: str, *, whole: bool = True) -> None:
        """Say how it ended; a repeat that is not whole is no repeat."""
        self._next, self._still, self._busy, self._asked = None, 0, False, None
        ended = {"ended": state} | ({} if whole else {"repeat_group": ""})
        self._experiment.publish(String(data=json.dumps(self._did | ended)))
        self._say(state)

    def _fail(self, why: str) -> None:
        self._failed = True
        self._finish(why, whole=False)

    def _call_off(self, state: str) -> None:
        if not self._busy:
            return
        self._finish(state, whole=False)
        if self._recorder:
            self._bags["stop"].call_async(Trigger.Request())

    def _on_start(self) -> tuple[bool, str]:
        if self._busy or self._input != self._shape.rest:
            return False, "it runs already, or is on its way to rest"
        if lacking := self._command.lacking():
            return False, lacking
        if not self._has_recorder():
            return False, f"there is no recorder {self._recorder}; start it with at_once:=false"
        self._busy, self._failed, self._repeat = True, False, 0
        self._did = {}
        self._begin_repeat()
        return True, "running"

    def _has_recorder(self) -> bool:
        return all(client.service_is_ready() for client in self._bags.values())

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
        if self._recorder:
            values["recorder"] = "ready" if self._has_recorder() else "not found"
        level = DiagnosticStatus.ERROR if self._failed else DiagnosticStatus.OK
        text = self._state
        if named := graph.rivals(self, self._publisher):
            level, text = max(level, DiagnosticStatus.WARN), f"{text}; {named}"
        self.report(level, text, values)


main = entry_point(Excitation)

if __name__ == "__main__":
    main()
