"""What every node's `main` and constructor share: start, spin, stop cleanly; declare parameters."""

from collections.abc import Callable

import rclpy
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

Value = str | float | bool | list[str]


def run(make: Callable[[], Node], args: list[str] | None) -> None:
    """Make the node and spin it until SIGINT, SIGTERM or shutdown; always destroy it."""
    rclpy.init(args=args)
    node: Node | None = None
    try:
        node = make()
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def declare(
    node: Node,
    name: str,
    default: Value,
    description: str,
    *,
    between: tuple[float, float] | None = None,
) -> Value:
    """Declare a read-only parameter with its description and range, and return its value."""
    descriptor = ParameterDescriptor(name=name, description=description, read_only=True)
    if between is not None:
        lo, hi = between
        descriptor.floating_point_range = [FloatingPointRange(from_value=lo, to_value=hi)]
    value: Value = node.declare_parameter(name, default, descriptor).value
    return value
