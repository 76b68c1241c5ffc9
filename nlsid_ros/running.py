"""What every node's `main` and constructor share: start, spin, stop cleanly; declare parameters."""

from collections.abc import Callable
from typing import TypeVar

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.utilities import try_shutdown

from nlsid_core.errors import DataError

AnyNode = TypeVar("AnyNode", bound=Node)
Value = str | float | bool | list[str]


def run(
    make: Callable[[], AnyNode],
    args: list[str] | None,
    *,
    work: Callable[[AnyNode], None] = rclpy.spin,
) -> None:
    """Make the node and let it work until it is done, SIGINT, SIGTERM or shutdown; always destroy
    it. Most nodes' work is to spin.
    """
    rclpy.init(args=args)
    node: AnyNode | None = None
    try:
        node = make()
        work(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if node is not None:
            node.destroy_node()
        try_shutdown()


def declare(
    node: Node,
    name: str,
    default: Value,
    description: str,
    *,
    between: tuple[float, float] | None = None,
) -> Value:
    """Declare a read-only parameter with its description and range, and return its value.

    The default's type is the parameter's: ROS keeps 2 and 2.0 apart. Raises DataError if the value
    given has another type or is out of range.
    """
    descriptor = ParameterDescriptor(name=name, description=description, read_only=True)
    if between is not None:
        lo, hi = between
        if isinstance(default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(lo), to_value=int(hi))]
        else:
            descriptor.floating_point_range = [FloatingPointRange(from_value=lo, to_value=hi)]
    try:
        value: Value = node.declare_parameter(name, default, descriptor).value
    except ParameterException as error:
        raise DataError(f"parameter {name} ({description}): {error}") from error
    return value
