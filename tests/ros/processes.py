"""Nodes as real processes, over real DDS."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import GetState
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future
from std_srvs.srv import Trigger

from nlsid_ros import qos

SpinUntil = Callable[[Callable[[], bool]], None]
ROOT = Path(__file__).parents[2]
LOAD = os.getloadavg()[0] / (os.cpu_count() or 1)  # processes that want each processor
STARTED = 60.0 * min(max(1.0, LOAD), 4.0)  # s: patience with a process or with discovery

ros_test = [
    pytest.mark.ros,
    # an old lark, which the ROS wheels load with their first message
    pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning"),
]


@contextmanager
def process(module: str, **parameters: object) -> Iterator[subprocess.Popen[str]]:
    """Run a node's module with ROS parameters, and remappings where a name starts with __ or with a
    slash; killed at the end if it still runs.
    """
    settings = [
        word
        for name, value in parameters.items()
        for word in ("-r" if name.startswith(("__", "/")) else "-p", f"{name}:={value}")
    ]
    running = subprocess.Popen(
        [sys.executable, "-m", module, "--ros-args", *settings],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=ROOT,
    )
    try:
        yield running
    finally:
        if running.poll() is None:
            running.kill()
        running.wait()
        assert running.stdout is not None
        running.stdout.close()


def stop(running: subprocess.Popen[str], how: signal.Signals = signal.SIGINT) -> str:
    """Signal a node, expect it to end cleanly, and return what it printed."""
    running.send_signal(how)
    output = running.communicate(timeout=STARTED)[0]
    assert running.returncode == 0, output
    return output


def refusal(module: str, **parameters: object) -> str:
    """What a node prints that refuses its parameters: it ends by itself, with exit status 1."""
    with process(module, **parameters) as running:
        output = running.communicate(timeout=STARTED)[0]
    assert running.returncode == 1, output
    assert "Traceback" not in output
    return output


@contextmanager
def node_here(name: str) -> Iterator[tuple[Node, SpinUntil]]:
    """A node in this process, and a function that spins it until a condition holds."""
    context = Context()
    rclpy.init(context=context)
    node = Node(name, context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def spin_until(condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + STARTED
        while not condition():
            assert time.monotonic() < deadline, "nothing happened"
            executor.spin_once(timeout_sec=0.02)

    try:
        yield node, spin_until
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()


def service(node: Node, spin_until: SpinUntil, name: str, kind: type = Trigger) -> Client:
    """A client of a service of one of nlsid's nodes, whose questions are answered.

    One client as long as `node` lives. A node drops an answer to a client that it does not know
    0.1 s later (rmw_fastrtps issue 842), and on a busy machine it may know it later than the client
    knows the service. So a new client waits until a question that may be lost, asked by a client
    newer than itself, is answered: a node learns of both in order.
    """
    for each in node.clients:
        if each.service_name == name:
            return each
    new = node.create_client(kind, name)
    spin_until(new.service_is_ready)
    probe = node.create_client(GetState, f"{name.rpartition('/')[0]}/get_state")
    spin_until(probe.service_is_ready)
    answers: list[Future] = []
    asked_at = time.monotonic()

    def answered() -> bool:
        if time.monotonic() >= asked_at + len(answers):
            answers.append(probe.call_async(GetState.Request()))
        return any(each.done() for each in answers)

    spin_until(answered)
    node.destroy_client(probe)
    return new


def call(
    node: Node, spin_until: SpinUntil, name: str, kind: type = Trigger, **request: object
) -> Any:
    """The answer of a service of one of nlsid's nodes."""
    answer = service(node, spin_until, name, kind).call_async(kind.Request(**request))  # type: ignore[attr-defined]
    spin_until(answer.done)
    return answer.result()


def set_parameter(
    node: Node, spin_until: SpinUntil, name: str, key: str, value: float | str
) -> str:
    """Change a parameter of a running node; why it was refused, empty if it was not."""
    if isinstance(value, int):
        wanted = ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=value)
    elif isinstance(value, str):
        wanted = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=value)
    else:
        wanted = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
    change = [Parameter(name=key, value=wanted)]
    answer = call(node, spin_until, f"/{name}/set_parameters", SetParameters, parameters=change)
    [result] = answer.results
    return "" if result.successful else str(result.reason)


class Bench:
    """A node of this process, the nodes that are started beside it, and what they say.

    said: of each node the texts and values of its diagnostics. levels: of the newest.
    """

    def __init__(self, stack: ExitStack, name: str = "test_robot") -> None:
        self.stack = stack
        self.node, self._spin_until = stack.enter_context(node_here(name))
        self._started: list[subprocess.Popen[str]] = []
        self.said: dict[str, list[tuple[str, dict[str, str]]]] = {}
        self.levels: dict[str, bytes] = {}
        self.listen(DiagnosticArray, "/diagnostics", self._hear, qos.EVENTS)

    def _hear(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            assert len(values) <= 20
            name = status.name.partition(":")[0]
            self.said.setdefault(name, []).append((status.message, values))
            self.levels[name] = status.level

    def start(self, name: str, **parameters: object) -> subprocess.Popen[str]:
        """Start a node of nlsid."""
        self._started.append(self.stack.enter_context(process(f"nlsid_ros.{name}", **parameters)))
        return self._started[-1]

    def spin_until(self, condition: Callable[[], bool]) -> None:
        """Wait until it holds; fails with what a node printed that ended with status 1."""

        def holds() -> bool:
            for each in self._started:
                if each.poll() == 1 and each.stdout is not None:
                    raise AssertionError(each.stdout.read())
            return condition()

        self._spin_until(holds)

    def listen(
        self,
        kind: type,
        topic: str,
        callback: Callable[[Any], None],
        profile: QoSProfile = qos.STREAM,
    ) -> None:
        """Subscribe."""
        self.node.create_subscription(kind, topic, callback, profile)

    def has_said(self, text: str, node: str = "funnel_monitor") -> bool:
        """Whether `node` has said `text`."""
        return any(text in said for said, _ in self.said.get(node, []))

    def hears(self, text: str, node: str = "funnel_monitor") -> None:
        """Wait until `node` has said `text`."""
        self.spin_until(lambda: self.has_said(text, node))

    def waits(self, seconds: float) -> None:
        """Let time pass."""
        until = time.monotonic() + seconds
        self.spin_until(lambda: time.monotonic() > until)

    def call(self, name: str, kind: type = Trigger, **request: object) -> Any:
        """The answer of a service."""
        return call(self.node, self.spin_until, name, kind, **request)

    def set(self, name: str, key: str, value: float | str) -> str:
        """Change a node's parameter; why it was refused, empty if it was not."""
        return set_parameter(self.node, self.spin_until, name, key, value)
