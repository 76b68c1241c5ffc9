"""Nodes as real processes, over real DDS, on a domain of their own."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import rclpy
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from tests.ros.domains import fresh_domain

ROOT = Path(__file__).parents[2]
STARTED = 60.0  # s: patience with a process or with discovery on a busy machine

ros_test = [
    pytest.mark.ros,
    # an old lark, which the ROS wheels load with their first message
    pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning"),
]


def use_domain_of_this_run(patch: pytest.MonkeyPatch) -> None:
    """Let nodes here and in processes started here see only each other."""
    patch.setenv("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    patch.setenv("ROS_DOMAIN_ID", fresh_domain())


@contextmanager
def process(module: str, **parameters: object) -> Iterator[subprocess.Popen[str]]:
    """Run a node's module with ROS parameters, and remappings where a name starts with __ or with a
    slash; killed at the end if it still runs.
    """
    settings = []
    for name, value in parameters.items():
        settings += ["-r" if name.startswith(("__", "/")) else "-p", f"{name}:={value}"]
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


@contextmanager
def node_here(name: str) -> Iterator[tuple[Node, Callable[[Callable[[], bool]], None]]]:
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


def set_parameter(
    node: Node,
    spin_until: Callable[[Callable[[], bool]], None],
    name: str,
    key: str,
    value: float | str,
) -> str:
    """Change a parameter of a running node; why it was refused, empty if it was not."""
    client = node.create_client(SetParameters, f"/{name}/set_parameters")
    spin_until(client.service_is_ready)
    if isinstance(value, int):
        wanted = ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=value)
    elif isinstance(value, str):
        wanted = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=value)
    else:
        wanted = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
    answer = client.call_async(
        SetParameters.Request(parameters=[Parameter(name=key, value=wanted)])
    )
    spin_until(answer.done)
    [result] = answer.result().results
    node.destroy_client(client)
    return "" if result.successful else str(result.reason)
