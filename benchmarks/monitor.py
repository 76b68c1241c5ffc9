"""The monitor: time of an update alone, and margins at 1 kHz over DDS between processes.

python -m benchmarks.monitor [--seconds 60] [--rate 1000] [--load 8] [--json]

Latency is from the sending of a sample, whose stamp is on an exact grid, to its margin's arrival at
a third process. Beside it, of the same samples and by the same transport: a node of nothing but
rclpy that answers each with a message of the margin's size. On a busy machine both wait for a
processor; their ratio does not; `chrt -f 10 python -m benchmarks.monitor` gives all of them the
priority that a robot gives them. `--load` starts so many processes that only compute.
`first_verdict_s` is from the start of `nlsid run monitor DIR`, of a proof that this machine has
decided before, to its first verdict. The monitor runs on a funnel made for timing. `grown_mb` is
by how much its memory grew after the first minute, or the first third of a shorter run.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from bags.designs.bundle import Bundle
from bags.designs.documents import FUNNEL
from bags.samples import f1tenth
from bags.signals.grid import read_dataset
from bags.signals.sampling import Grid
from benchmarks.machine import parser, peers, tell
from benchmarks.processes import busy, cpu_seconds, isolate, node, python, resident_mb
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.design import OutputTube, OutputTubeDesign, design_output_tube
from nlsid_core.designs import Design
from nlsid_core.identification import Polynomial, identify
from nlsid_core.models import DifferenceEquation, Signal
from nlsid_core.running.reading import Reading, Status
from nlsid_ros import qos, shared_memory
from nlsid_ros.messages import stamp_ns_of, stamp_of

LAGS, ROUNDS, LATE = 6, 40, 10.0  # s for what a busy machine hears late
SOURCE, MARGIN, ECHO = "/benchmark", "/funnel_monitor/margin", "/benchmark/echo"
STATE, COMMAND = "/benchmark/state:position[0]", "/benchmark/command:position[0]"
OUTSIDE, OUT = 100.0, 100  # a response no funnel holds, and how many of them end a run
ASKED = {
    "update_us_p50": 20.0,
    "update_us_p99": 50.0,
    "missed": 0.0,
    "latency_ms_p99": 1.0,
    "error_ms": 5.0,
    "grown_mb": 1.0,
    "processor_ratio_rclpy": 1.25,
    "p99_ratio_rclpy": 1.3,
    "first_verdict_s": 3.0,
}


def updates() -> dict[str, float]:
    """Microseconds per update on F1TENTH trials, n = 6."""
    speed, command = "/odom:twist.twist.linear.x", "/cmd_vel:twist.linear.x"
    data = read_dataset(f1tenth(), responses=[speed], excitations=[command], grid=Grid(max_gap=0.1))
    model = identify(data, Polynomial(LAGS)).model
    problem = OutputTube(model, data, profile=[(0.0, 0.0), (2.8, 0.35)], safety_factor=1.5)
    monitor, times = design_output_tube(problem).monitor(), []
    for trial in data.trajectories[:ROUNDS]:
        monitor.restart()
        rows = zip(trial.t.tolist(), trial.y[:, 0].tolist(), trial.u[:, 0].tolist(), strict=True)
        for k, (t, y, u) in enumerate(rows):
            started = time.perf_counter_ns()
            monitor.update(t, y, u)
            if k >= LAGS:
                times.append(time.perf_counter_ns() - started)
    return {f"update_us_p{p}": float(np.percentile(times, p)) / 1e3 for p in (50, 99)}


def timing_funnel(rate: int) -> OutputTubeDesign:
    """A model sampled at `rate` Hz and a funnel that lasts for ever; for timing only."""
    period, samples = 1.0 / rate, 200
    rng = np.random.default_rng(1)
    a, b = np.array([1.9, -0.905]), np.array([0.0, 0.003, 0.002])
    blank = DifferenceEquation(
        a,
        b,
        0.0,
        Signal("state", "1", STATE),
        Signal("command", "1", COMMAND),
        (-1.0, 1.0),
        period=period,
    )
    trials = []
    for index in range(3):
        u = np.repeat(rng.uniform(-1.0, 1.0, samples // 10), 10)
        y = blank.simulate(u, [0.0, 0.0]) + 1e-3 * rng.standard_normal(samples)
        t = np.arange(samples) * period
        trials.append(Trajectory(t=t, y=y, u=u, name=f"run_{index}", digest=f"sha256:{index:064x}"))
    design = design_output_tube(OutputTube(blank, Dataset(tuple(trials))))
    tube = replace(design.funnel.tubes[0], level=2.0, peak=None)
    widths = np.sqrt(2.0 / tube.tau) * (1.0 + 1e-12)  # rounded up
    funnel = replace(design.funnel, tubes=(replace(tube, half_widths=widths),))
    return Design.proved(blank, None, funnel, claim=design.claim, proof=design.proof, found=None)


def bundle_of(design: OutputTubeDesign) -> Bundle:
    """Its files as they are published."""
    with tempfile.TemporaryDirectory() as folder:
        design.save(folder)
        return Bundle.load(Path(folder) / FUNNEL)


class Ear(Node):
    """Publishes the documents, and hears margins and alarms with their time of arrival."""

    def __init__(self, design: OutputTubeDesign) -> None:
        super().__init__("ear")
        self.margins: dict[int, int] = {}
        self.echoes: dict[int, int] = {}
        self.error_ns, self.error = 0, ""
        self.ready = self.verdict = False
        publisher = self.create_publisher(String, f"{SOURCE}/design", qos.DOCUMENT)
        publisher.publish(String(data=bundle_of(design).text()))
        for topic, heard in ((MARGIN, self.margins), (ECHO, self.echoes)):
            self.create_subscription(JointState, topic, partial(self._hear, heard), qos.STREAM)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._status, qos.EVENTS)

    def _hear(self, arrivals: dict[int, int], message: JointState) -> None:
        arrivals[stamp_ns_of(message)] = time.time_ns()
        self.verdict |= message.position[0] >= 0.0

    def _status(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.partition(":")[0] != "funnel_monitor":
                continue
            self.ready = True
            if status.level == DiagnosticStatus.ERROR and not self.error_ns:
                self.error_ns, self.error = time.time_ns(), status.message


def robot(node: Node) -> list[Publisher]:
    """Publishers of state and command."""
    topics = [path.partition(":")[0] for path in (STATE, COMMAND)]
    return [node.create_publisher(JointState, topic, qos.STREAM) for topic in topics]


def send(seconds: float, rate: int) -> None:
    """Publish command and response at `rate` Hz, the last OUT responses outside; print stamps."""
    rclpy.init()
    sender = Node("sender")
    state, command = robot(sender)
    while state.get_subscription_count() < 2 or command.get_subscription_count() < 1:
        time.sleep(0.01)  # for the monitor and the echo
    time.sleep(0.5)
    count, message = round(seconds * rate), JointState(position=[0.0])
    sent, start, start_ns = [], time.perf_counter(), time.time_ns()
    for k in range(count):
        while (ahead := start + k / rate - time.perf_counter()) > 0:
            time.sleep(max(ahead - 1e-4, 0.0))
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = divmod(start_ns + k * 10**9 // rate, 10**9)
        sent.append(time.time_ns())
        message.position[0] = 0.0
        command.publish(message)
        message.position[0] = OUTSIDE if k >= count - OUT else 0.0
        state.publish(message)
    time.sleep(1.0)
    print(json.dumps({"start_ns": start_ns, "sent_ns": sent}))
    sender.destroy_node()
    rclpy.shutdown()


def echo() -> None:
    """Answer every sample with a message as long as a margin: what rclpy alone costs."""
    rclpy.init()
    relay = Node("echo")
    answers = relay.create_publisher(JointState, ECHO, qos.STREAM)
    numbers = [*Reading(0.0, Status.INSIDE).numbers, "time_to_exit", "latency"]
    answer = JointState(name=numbers, position=[0.0] * len(numbers))

    def on_state(message: JointState) -> None:
        answer.header.stamp = message.header.stamp
        answers.publish(answer)

    relay.create_subscription(JointState, STATE.partition(":")[0], on_state, qos.STREAM)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(relay)


def live(seconds: float, rate: int) -> dict[str, float]:
    """Missed samples, latency from stamp to margin, and time to ERROR, between processes."""
    ear = Ear(timing_funnel(rate))
    executor = EventsExecutor()
    executor.add_node(ear)
    nodes = python(*node("funnel_monitor", source=SOURCE)), python("benchmarks.monitor", "--echo")
    with nodes[0] as monitor, nodes[1] as relay:
        while not (ear.ready and ear.count_publishers(ECHO)):
            executor.spin_once(timeout_sec=0.1)
        before = cpu_seconds(monitor.pid), cpu_seconds(relay.pid)
        resident: list[float] = []
        sent, start_ns = _run(
            executor, seconds, rate, lambda: resident.append(resident_mb(monitor.pid))
        )
        cpu, cpu_alone = (
            cpu_seconds(each.pid) - then
            for each, then in zip((monitor, relay), before, strict=True)
        )
        late = time.monotonic() + LATE
        while not ear.error_ns and time.monotonic() < late:
            executor.spin_once(timeout_sec=0.1)
    latencies = _latencies(ear.margins, sent, start_ns, rate)
    alone = _latencies(ear.echoes, sent, start_ns, rate)
    ear.destroy_node()
    result = {"sent": float(len(sent)), "missed": float(len(sent) - len(latencies))}
    for percent in (50, 99):
        result[f"latency_ms_p{percent}"] = float(np.percentile(latencies, percent))
    result["latency_ms_max"] = float(np.max(latencies))
    for percent in (50, 99):
        result[f"rclpy_alone_ms_p{percent}"] = float(np.percentile(alone, percent))
        ratio = result[f"latency_ms_p{percent}"] / result[f"rclpy_alone_ms_p{percent}"]
        result[f"ratio_p{percent}"] = ratio
    result["error_ms"] = (ear.error_ns - sent[-OUT]) / 1e6
    result["grown_mb"] = resident[-1] - resident[min(60, len(resident) // 3)]
    result["cpu_us_per_sample"] = 1e6 * cpu / len(sent)
    result["rclpy_alone_cpu_us_per_sample"] = 1e6 * cpu_alone / len(sent)
    result["processor_ratio_rclpy"] = cpu / cpu_alone
    result["p99_ratio_rclpy"] = result["ratio_p99"]
    return result


def first_verdict(rate: int) -> float:
    """s from the start of `nlsid run monitor DIR` to its first verdict, the second time it runs.

    Python keeps its bytecode then, as where nlsid is installed.
    """
    design, executor = timing_funnel(rate), EventsExecutor()
    ear = Ear(design)
    executor.add_node(ear)
    state, command = robot(ear)
    message, seconds = JointState(position=[0.0]), 0.0
    with tempfile.TemporaryDirectory() as folder:
        design.save(folder)
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        os.environ["PYTHONPYCACHEPREFIX"] = f"{folder}/bytecode"
        for _ in range(2):
            quiet = time.monotonic() + 1.0  # what the last one said has come
            while time.monotonic() < quiet:
                executor.spin_once(timeout_sec=0.1)
            started, ear.verdict, sent = time.monotonic(), False, 0
            with python("bags.commands.main", "run", "monitor", folder):
                while not ear.verdict:
                    executor.spin_once(timeout_sec=0.5 / rate)
                    now = int(time.time() * rate)
                    for k in range(max(sent, now - rate) + 1, now + 1):  # what is late is sent too
                        sent, message.header.stamp = k, stamp_of(k * 10**9 // rate)
                        command.publish(message)
                        state.publish(message)
                seconds = time.monotonic() - started
    ear.destroy_node()
    return seconds


def _run(
    executor: Executor,
    seconds: float,
    rate: int,
    every_second: Callable[[], None] = lambda: None,
) -> tuple[list[int], int]:
    """When each sample was sent, and the stamp of the first (ns), from a process that sends."""
    asked = ["--send", str(seconds), "--rate", str(rate)]
    command = [sys.executable, "-m", "benchmarks.monitor", *asked]
    sender = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    heard: list[str] = []
    reader = threading.Thread(target=lambda: heard.extend(sender.stdout or ()))
    reader.start()
    due = time.monotonic()
    while reader.is_alive():
        if time.monotonic() >= due:
            every_second()
            due += 1.0
        executor.spin_once(timeout_sec=0.1)
    sender.wait()
    said = json.loads(heard[-1])
    return said["sent_ns"], said["start_ns"]


def _latencies(arrivals: dict[int, int], sent: list[int], start_ns: int, rate: int) -> FloatArray:
    """ms from sending to arrival of every sample that arrived."""
    stamps = (start_ns + k * 10**9 // rate for k in range(len(sent)))
    ways = [
        arrivals[stamp] - at for stamp, at in zip(stamps, sent, strict=True) if stamp in arrivals
    ]
    return np.array(ways) / 1e6


def main() -> None:
    """Print the table; with --json the last line is one JSON object."""
    taken = parser(__doc__)
    taken.add_argument("--seconds", type=float, default=60.0)
    taken.add_argument("--rate", type=int, default=1000, help="Hz")
    taken.add_argument("--load", type=int, default=0, help="processes beside it that only compute")
    taken.add_argument("--send", type=float, help=argparse.SUPPRESS)
    taken.add_argument("--echo", action="store_true", help=argparse.SUPPRESS)
    options = taken.parse_args()
    if options.send:
        send(options.send, options.rate)
        return
    if options.echo:
        echo()
        return
    isolate()
    shared_memory.avoid_what_is_stale()  # every process by the transport that the monitor takes
    result = updates()
    rclpy.init()
    with busy(options.load, os.sched_getaffinity(0)):
        result |= live(options.seconds, options.rate)
        result["first_verdict_s"] = first_verdict(options.rate)
    rclpy.shutdown()
    tell(result | peers("ros-jazzy-rclpy"), ASKED, as_json=options.json, what="asked")


if __name__ == "__main__":
    main()
