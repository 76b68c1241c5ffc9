"""Node `excitation`: safe signals to identify a robot with, repeated as often as asked.

Publishes commands at a fixed rate after `~/start`, stamped on an exact grid; `~/stop`, shutdown and
the end fade to rest. What was done is said on ~/experiment (latched, JSON), for the recorder.
Refuses to run without limits.
"""

import json
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.signals.grid import seconds
from bags.signals.reader import read_signals
from bags.signals.signal import SignalPath
from nlsid_core._types import FloatArray
from nlsid_core.errors import DataError, NlsidError
from nlsid_core.excitation import Shape, chirp, multisine, prbs, steps
from nlsid_ros import qos
from nlsid_ros.diagnostics import status
from nlsid_ros.messages import SignalMessage
from nlsid_ros.running import ManagedNode, declare, declare_number, declare_text, run

NAME = "excitation"
KINDS = ("multisine", "chirp", "prbs", "steps", "replay")
BIG = 1e9
LAST_WORD = 1.0  # s for the last command to be received before the node goes


class Excitation(ManagedNode):
    """Plays one signal `repeats` times, resting in between."""

    def __init__(self) -> None:
        super().__init__(NAME)
        number = partial(declare_number, self)
        self._kind = declare_text(self, "kind", "multisine", "one of " + ", ".join(KINDS))
        self._command = SignalMessage(
            SignalPath.parse(
                declare_text(self, "command", "/cmd_vel:twist.linear.x", "signal published")
            ),
            declare_text(self, "command_type", "geometry_msgs/msg/TwistStamped", "its type"),
        )
        self._bag = declare_text(self, "bag", "", "for kind replay: the bag whose command is sent")
        self._period = number("period", 0.025, "s between commands", between=(1e-3, 10.0))
        self._duration = number("duration", 20.0, "s of one signal", between=(0.1, 36000.0))
        self._lowest_hz = number("lowest_hz", 0.1, "lowest frequency", between=(1e-6, 1e4))
        self._highest_hz = number("highest_hz", 2.0, "highest frequency", between=(1e-6, 1e4))
        self._hold = number("hold", 0.5, "s a step or a bit lasts", between=(1e-3, 1e4))
        self._pause = number("pause", 2.0, "s of rest before each repeat", between=(0.0, 3600.0))
        repeats: Any = declare(self, "repeats", 1, "how often it is played", between=(1, 1000))
        seed: Any = declare(self, "seed", 1, "of phases and levels", between=(0, 2**31))
        self._repeats, self._seed = repeats, seed
        self._shape = Shape(
            lowest=number("lowest", 0.0, "least input", between=(-BIG, BIG)),
            highest=number("highest", 0.0, "greatest input; must be set", between=(-BIG, BIG)),
            slew=number("slew", 0.0, "fastest change, 1/s; must be set", between=(0.0, BIG)),
            fade=number("fade", 1.0, "s of soft start and stop", between=(0.0, 60.0)),
            rest=number("rest", 0.0, "input of a robot at rest", between=(-BIG, BIG)),
        )

    def prepare(self) -> None:
        """Make the whole signal before anything moves."""
        once = np.concatenate(
            [np.full(round(self._pause / self._period), self._shape.rest), self._inputs()]
        )
        self._inputs_in_all = np.tile(once, self._repeats)

    def _inputs(self) -> FloatArray:
        samples, period = round(self._duration / self._period), self._period
        rng = np.random.default_rng(self._seed)
        band = {"lowest": self._lowest_hz, "highest": self._highest_hz}
        match self._kind:
            case "multisine":
                signal = multisine(samples, period, rng=rng, **band)
            case "chirp":
                signal = chirp(samples, period, **band)
            case "prbs":
                signal = prbs(samples, period, hold=self._hold)
            case "steps":
                signal = steps(samples, period, hold=self._hold, rng=rng)
            case "replay":
                signal = self._recorded()
            case _:
                raise DataError(f"kind is '{self._kind}'; it should be one of {', '.join(KINDS)}")
        return self._shape(signal, period)

    def _recorded(self) -> FloatArray:
        """The bag's command on our grid, held between its samples; beyond the limits it is cut."""
        path = str(self._command.path)
        samples = read_signals(Path(self._bag), [path])[path]
        t = seconds(samples.stamp_ns, int(samples.stamp_ns[0]))
        grid = np.arange(0.0, float(t[-1]), self._period)
        held = samples.values[np.searchsorted(t, grid, side="right") - 1]
        lo, hi = self._shape.lowest, self._shape.highest
        return np.asarray(2.0 * (held - lo) / (hi - lo) - 1.0)

    def start(self) -> None:
        """Be ready; nothing moves before ~/start."""
        self._next: int | None = None
        self._input = self._shape.rest
        self._state = "idle"
        self._publisher = self.create_publisher(
            self._command.kind, self._command.path.topic, qos.STREAM
        )
        self._experiment = self.create_publisher(String, "~/experiment", qos.DOCUMENT)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", qos.EVENTS)
        self.create_service(Trigger, "~/start", self._on_start)
        self.create_service(Trigger, "~/stop", self._on_stop)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(self._period, self._on_tick, clock=steady)
        self.create_timer(1.0, self._report, clock=steady)

    def stop(self) -> None:
        """Fade to rest before going."""
        while self._next is not None or self._input != self._shape.rest:
            self._next = None
            self._to_rest()
            time.sleep(self._period)
        self._publisher.wait_for_all_acked(Duration(seconds=LAST_WORD))

    def _on_tick(self) -> None:
        if self._next is None:
            if self._input != self._shape.rest:
                self._to_rest()
            return
        self._input = float(self._inputs_in_all[self._next])
        self._send(self._start_ns + self._next * round(self._period * 1e9))
        self._next += 1
        if self._next == len(self._inputs_in_all):
            self._next, self._state = None, "done"
            self._report()

    def _to_rest(self) -> None:
        step = self._shape.slew * self._period
        self._input += min(max(self._shape.rest - self._input, -step), step)
        self._send(self.get_clock().now().nanoseconds)

    def _send(self, stamp_ns: int) -> None:
        self._publisher.publish(self._command.make(stamp_ns, self._input))

    def _on_start(self, _request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        answer.success = self._next is None
        answer.message = "running" if answer.success else "it runs already"
        if answer.success:
            self._next, self._state = 0, "running"
            self._start_ns = self.get_clock().now().nanoseconds
            did = {
                "kind": self._kind, "signal": str(self._command.path), "period": self._period,
                "duration": self._duration, "repeats": self._repeats, "pause": self._pause,
                "seed": self._seed, "lowest_hz": self._lowest_hz, "highest_hz": self._highest_hz,
                "hold": self._hold, "limits": vars(self._shape), "start_ns": self._start_ns,
            }  # fmt: skip
            self._experiment.publish(String(data=json.dumps(did)))
            self._report()
        return answer

    def _on_stop(self, _request: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        answer.success, answer.message = True, "stopping"
        if self._next is not None:
            self._next, self._state = None, "stopped when asked to"
            self._report()
        return answer

    def _report(self) -> None:
        total = len(self._inputs_in_all)
        values = {"input": f"{self._input:.6g}", "of": str(total), "sample": str(self._next)}
        now = self.get_clock().now().to_msg()
        self._diagnostics.publish(
            status(now, self.get_name(), DiagnosticStatus.OK, self._state, values)
        )


def main(args: list[str] | None = None) -> None:
    """Entry point of `ros2 run nlsid excitation`."""
    try:
        run(Excitation, args)
    except (NlsidError, OSError) as error:
        sys.exit(f"{NAME}: {error}")


if __name__ == "__main__":
    main()
