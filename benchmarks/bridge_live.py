"""The bridge through ROS: MuJoCo pendulum, controller, recorder and monitor as nodes, one push.

python -m benchmarks.bridge_live [--seconds 60] [--json]

The chain of `nlsid demo` on a swing out and back, then its funnel is tracked again and again,
pushed once in the middle. Beside what was heard live: the replay of the recorded bag, which has to
say the same bit for bit.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import math
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.designs.design import SampledDesign
from bags.designs.documents import FUNNEL, load_proved_tracking
from bags.monitoring.replay import announced_runs, replay_messages
from benchmarks.machine import describe, peers
from benchmarks.processes import isolate, node, python
from benchmarks.swing import SECONDS, swing_config
from nlsid_core.errors import NlsidError
from nlsid_core.running.reading import Status
from nlsid_ros import qos

PUSH, PUSH_SECONDS = 60.0, 0.02  # N m on the joint, s
PUSH_AT = 30  # verdicts into a run
PATIENCE = 60.0  # s for nodes to come up; the proof is checked on the way
TOPICS = ["/joint_states", "/joint_commands", "/tracking_controller/run", "/funnel_monitor/events"]


@dataclass(frozen=True)
class LiveLoop:
    """What was heard, and whether the replay of the recording says the same.

    runs: of the policy; replayed: those the recording announces. judged: samples with a live
    verdict; expected: with one in the replay. live_equals_replay: every margin and disturbance
    heard is the replay's, bit for bit, none is missing, and every alarm's reason is one it gives.
    flagged_runs: with a verdict that is not inside; left_with_assumption_kept: those that left the
    funnel first, which the proof excludes. push_detect_ms: from the first stamp under the push to
    the first that is not inside.
    """

    seconds: float
    runs: int
    replayed: int
    judged: int
    expected: int
    live_equals_replay: bool
    flagged_runs: int
    left_with_assumption_kept: int
    push_detect_ms: float
    alarm: str


@dataclass
class Heard:
    """Verdicts by stamp (ns), last texts by node, alarms, announced starts, verdicts of a run."""

    verdicts: dict[int, tuple[float, float]] = field(default_factory=dict)
    said: dict[str, str] = field(default_factory=dict)
    alarms: list[str] = field(default_factory=list)
    starts: list[str] = field(default_factory=list)
    into_run: int = 0

    def margin(self, message: JointState) -> None:
        """A verdict, unless it is unknown."""
        numbers = dict(zip(message.name, message.position, strict=True))
        if "assumption" in numbers and not math.isnan(numbers["margin"]):
            stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            self.into_run += 1
            self.verdicts[stamp_ns] = numbers["margin"], numbers["assumption"]

    def status(self, message: DiagnosticArray) -> None:
        """What each node said last, and every alarm of the monitor."""
        for entry in message.status:
            self.said[entry.name] = entry.message
            if entry.name == "funnel_monitor" and entry.level == DiagnosticStatus.ERROR:
                reason = entry.message.partition(": ")[2]
                self.alarms.append(reason.partition("; /")[0])  # then what was asked to stop it

    def run(self, message: String) -> None:
        """A run was announced."""
        self.starts.append(message.data)

    def ready(self, name: str, text: str) -> bool:
        """Whether what `name` said last contains `text`."""
        return text in self.said.get(name, "")


def live(design: Path, bag: Path, *, seconds: float) -> LiveLoop:
    """Track the funnel in the folder `design` for `seconds`, recording to `bag`, pushed once."""
    heard = Heard()
    nodes: dict[str, dict[str, object]] = {
        "plant": {"kind": "mujoco_pendulum", "push": PUSH, "push_duration": PUSH_SECONDS},
        "trajectory_recorder": {"topics": json.dumps(TOPICS), "bag": bag},
        "funnel_publisher": {"funnel": design / FUNNEL},
        "funnel_monitor": {
            "controller": "tracking_controller",
            "stop_service": "/tracking_controller/stop",
            "command_wait": 1.0,  # the machine may be busy
            "stale_after": 2.0,
        },
        "tracking_controller": {
            "response_type": "sensor_msgs/msg/JointState",
            "command_type": "sensor_msgs/msg/JointState",
            "lowest": -20.0,
            "highest": 20.0,
            "stop_rate": 100.0,
            "settling": 60.0,
            "stale_after": 2.0,
        },
    }
    pushed_ns = runs = alarms = 0
    with ExitStack() as stack:
        operator, spin_until = _operator(stack)
        stream, events = qos.STREAM, qos.EVENTS
        operator.create_subscription(JointState, "/funnel_monitor/margin", heard.margin, stream)
        operator.create_subscription(DiagnosticArray, "/diagnostics", heard.status, events)
        operator.create_subscription(String, "/tracking_controller/run", heard.run, qos.DOCUMENT)
        start = operator.create_client(Trigger, "/tracking_controller/start")
        push = operator.create_client(Trigger, "/plant/push")
        restart = operator.create_client(Trigger, "/funnel_monitor/restart")
        for name, parameters in nodes.items():
            stack.enter_context(python(*node(name, **parameters)))
        spin_until(lambda: start.service_is_ready() and push.service_is_ready())
        spin_until(lambda: heard.ready("tracking_controller", "idle"))
        spin_until(lambda: heard.ready("funnel_monitor", "waiting for the controller"))
        counted = operator.count_subscribers  # recorder, monitor, and the one it is for
        spin_until(lambda: min(counted(topic) for topic in TOPICS[:2]) >= 3)
        began = time.monotonic()
        while (passed := time.monotonic() - began) < seconds:
            heard.starts.clear()
            heard.said.pop("tracking_controller", None)
            answer = start.call_async(Trigger.Request())
            spin_until(answer.done)
            if answer.result().success:
                spin_until(lambda: heard.starts or heard.ready("tracking_controller", "idle"))
                runs += len(heard.starts)
            if not pushed_ns and passed > seconds / 2:
                heard.into_run = 0
                spin_until(
                    lambda: heard.into_run > PUSH_AT or heard.ready("tracking_controller", "idle")
                )
                if heard.into_run > PUSH_AT:
                    pushed_ns = time.time_ns()
                    push.call_async(Trigger.Request())
            spin_until(lambda: heard.ready("tracking_controller", "idle"))
            if len(heard.alarms) > alarms:  # an alarm is kept until somebody has seen to it
                spin_until(_after(1.5 * SECONDS))  # the stopped run is judged to its end
                spin_until(restart.call_async(Trigger.Request()).done)
                alarms = len(heard.alarms)
        spin_until(_after(1.0))  # the last verdicts are on their way
    return compared(
        load_proved_tracking(design / FUNNEL).design, bag, heard, pushed_ns, seconds, runs
    )


def compared(
    design: SampledDesign, bag: Path, heard: Heard, pushed_ns: int, seconds: float, runs: int
) -> LiveLoop:
    """The recording's own verdicts beside those heard."""
    replayed = [
        entry
        for entry in replay_messages(design, bag)
        if entry.reading.status is not Status.UNKNOWN
    ]
    expected = {
        entry.stamp_ns: (entry.reading.numbers["margin"], entry.reading.numbers["assumption"])
        for entry in replayed
    }
    reasons = {entry.reading.reason for entry in replayed}
    same = {stamp: struct.pack("dd", *pair) for stamp, pair in expected.items()} == {
        stamp: struct.pack("dd", *pair) for stamp, pair in heard.verdicts.items()
    }
    bad = [e for e in replayed if e.reading.status is not Status.INSIDE]
    flagged = [
        entry
        for before, entry in pairwise(replayed)
        if before.reading.status is Status.INSIDE and entry in bad
    ]
    after = [entry for entry in bad if entry.stamp_ns >= pushed_ns]
    return LiveLoop(
        seconds=seconds,
        runs=runs,
        replayed=len(announced_runs(design, bag)),
        judged=len(heard.verdicts),
        expected=len(expected),
        live_equals_replay=same and set(heard.alarms) <= reasons,
        flagged_runs=len(flagged),
        left_with_assumption_kept=sum(e.reading.status is Status.OUTSIDE for e in flagged),
        push_detect_ms=(after[0].stamp_ns - pushed_ns) / 1e6 if after else math.nan,
        alarm=heard.alarms[0] if heard.alarms else "",
    )


def _after(seconds: float) -> Callable[[], bool]:
    """Whether they have passed since now."""
    until = time.monotonic() + seconds
    return lambda: time.monotonic() > until


def _operator(stack: ExitStack) -> tuple[Node, Callable[[Callable[[], object]], None]]:
    """A node of this process, and what spins it until a condition holds."""
    context = Context()
    rclpy.init(context=context)
    operator = Node("operator", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(operator)

    def spin_until(condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + PATIENCE
        while not condition():
            if time.monotonic() > deadline:
                raise NlsidError(f"waited {PATIENCE:g} s in vain")
            executor.spin_once(timeout_sec=0.02)

    stack.callback(context.try_shutdown)
    stack.callback(operator.destroy_node)
    stack.callback(executor.shutdown)
    return operator, spin_until


def design_swing(folder: Path) -> Path:
    """`nlsid demo` on the swing; the folder of its funnel."""
    out = folder / "design"
    command = [sys.executable, "-m", "bags.commands.cli", "demo"]
    options = ["--robot", str(swing_config(folder)), "--out", str(out)]
    done = subprocess.run(command + options, capture_output=True, text=True, check=False)
    if done.returncode:
        raise NlsidError(f"the design failed: {done.stdout[-2000:]} {done.stderr[-2000:]}")
    return out


def main() -> None:
    """Print what was heard; with --json the last line is one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--json", action="store_true", help="last line is one JSON object")
    options = parser.parse_args()
    isolate()
    with tempfile.TemporaryDirectory() as name:
        result = live(design_swing(Path(name)), Path(name) / "bag", seconds=options.seconds)
    print(f"MuJoCo pendulum, tracked over ROS, {describe()}\n")
    for key, value in asdict(result).items():
        print(f"{key:22} {value}")
    if options.json:
        print(json.dumps(asdict(result) | peers("ros-jazzy-rclpy")))


if __name__ == "__main__":
    main()
