"""Health as `diagnostic_msgs/DiagnosticArray`, the way ROS tools expect it."""

import socket
from collections.abc import Mapping

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node


def name_of(node: Node) -> str:
    """A node's name in diagnostics: with its namespace, so that two robots' are told apart."""
    return node.get_fully_qualified_name().removeprefix("/")


def status(
    stamp: Time, name: str, level: bytes, message: str, values: Mapping[str, str]
) -> DiagnosticArray:
    """One status with its key-value pairs; `level` is a DiagnosticStatus constant."""
    array = DiagnosticArray()
    array.header.stamp = stamp
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    array.status = [
        DiagnosticStatus(
            level=level, name=name, message=message, hardware_id=socket.gethostname(), values=pairs
        )
    ]
    return array
