"""rclpy's message class for a type name such as `nav_msgs/msg/Odometry`."""

import importlib
import re
from typing import Any

from nlsid_core.errors import BagError

_NAME = re.compile(r"([a-z][a-z0-9_]*)/msg/([A-Za-z][A-Za-z0-9]*)", re.ASCII)


def message_class(msgtype: str) -> Any:
    """The class; BagError if the name is malformed or its package is not installed."""
    match = _NAME.fullmatch(msgtype)
    if match is None:
        raise BagError(f"'{msgtype}' is not a message type; one is written package/msg/Type")
    try:
        return getattr(importlib.import_module(f"{match[1]}.msg"), match[2])
    except (ImportError, AttributeError) as error:
        raise BagError(f"message type {msgtype} is not installed: {error}") from error
