"""Serialised standard messages and small bags for the tests of bags."""

from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from bags.recordings.bag import Bag
from bags.recordings.message_types import standard_types
from bags.recordings.writer import BagWriter
from bags.tools.convert import Copied, convert
from bags.tools.copies import Into, What
from nlsid_core.arrays import FloatArray

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 25_000_000
ODOM, CMD = "/odom", "/cmd_vel"
ODOM_TYPE, CMD_TYPE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistStamped"
SPEED = f"{ODOM}:twist.twist.linear.x"
COMMAND = f"{CMD}:twist.linear.x"
JOINT_TYPE = "sensor_msgs/msg/JointState"
TRANSFORMS = "tf2_msgs/msg/TFMessage"


def serialised(msgtype: str, message: object) -> bytes:
    return bytes(standard_types().serialize_cdr(message, msgtype))


def header(stamp_ns: int) -> Any:
    types = standard_types().types
    stamp = types["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
    return types["std_msgs/msg/Header"](stamp, "odom")


def twist(speed: float) -> Any:
    types = standard_types().types
    vector = types["geometry_msgs/msg/Vector3"]
    return types["geometry_msgs/msg/Twist"](vector(speed, 0.0, 0.0), vector(0.0, 0.0, 0.0))


def command(stamp_ns: int, speed: float) -> bytes:
    stamped = standard_types().types[CMD_TYPE](header(stamp_ns), twist(speed))
    return serialised(CMD_TYPE, stamped)


def odometry(stamp_ns: int, speed: float) -> bytes:
    types = standard_types().types
    pose = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](0.0, 0.0, 0.0),
        types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
    )
    message = types[ODOM_TYPE](
        header(stamp_ns),
        "base_link",
        types["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
        types["geometry_msgs/msg/TwistWithCovariance"](twist(speed), np.zeros(36)),
    )
    return serialised(ODOM_TYPE, message)


def joints(stamp_ns: int, position: Iterable[float]) -> bytes:
    values = np.array(list(position), dtype=np.float64)
    names = [f"joint_{i}" for i in range(len(values))]
    message = standard_types().types[JOINT_TYPE](
        header(stamp_ns),
        names,
        values,
        np.zeros(0),
        np.zeros(0),
    )
    return serialised(JOINT_TYPE, message)


def transforms(stamp_ns: int, moved: Mapping[str, tuple[FloatArray, float]]) -> bytes:
    """A message of TRANSFORMS: of each child frame where it is, (3,), and its yaw."""
    types = standard_types().types
    parts = [
        types["geometry_msgs/msg/TransformStamped"](
            header(stamp_ns),
            child,
            types["geometry_msgs/msg/Transform"](
                types["geometry_msgs/msg/Vector3"](*place),
                types["geometry_msgs/msg/Quaternion"](0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)),
            ),
        )
        for child, (place, yaw) in moved.items()
    ]
    return serialised(TRANSFORMS, types[TRANSFORMS](parts))


def put(bag: BagWriter, at_ns: int, topic: str, msgtype: str, data: bytes) -> None:
    """A message that was logged and published at this time."""
    bag.write(topic, msgtype, data, log_time_ns=at_ns, publish_time_ns=at_ns)


def speed_bag(
    path: Path,
    speeds: Iterable[float | None],
    commands: Iterable[float],
    *,
    start_ns: int = START_NS,
    stamps_ns: Iterable[int] | None = None,
    custom: dict[str, str] | None = None,
) -> Path:
    """A bag of speeds on /odom and commands on /cmd_vel, one of each every 25 ms by default.

    A speed that is None was lost.
    """
    pairs = list(zip(speeds, commands, strict=True))
    stamps = list(stamps_ns or (start_ns + k * PERIOD_NS for k in range(len(pairs))))
    with BagWriter(path, custom=custom) as bag:
        for k, (stamp, (speed, value)) in enumerate(zip(stamps, pairs, strict=True)):
            log = start_ns + k * PERIOD_NS
            put(bag, log, CMD, CMD_TYPE, command(stamp, value))
            if speed is not None:
                put(bag, log, ODOM, ODOM_TYPE, odometry(stamp, speed))
    return path


def number_bag(path: Path, values: Mapping[str, FloatArray], *, period: float) -> Path:
    """Numbers without stamps, each on a topic of its own, `period` s apart; NaN is not written."""
    kind = "std_msgs/msg/Float64"
    number = standard_types().types[kind]
    with BagWriter(path) as writer:
        for k, row in enumerate(zip(*values.values(), strict=True)):
            stamp_ns = START_NS + round(1e9 * period * k)
            for topic, value in zip(values, row, strict=True):
                if not np.isnan(value):
                    put(writer, stamp_ns, topic, kind, serialised(kind, number(float(value))))
    return path


def converted(out: Path, *bags: Path, what: What | None = None, into: Into | None = None) -> Copied:
    """New bags of what is chosen of these."""
    with ExitStack() as stack:
        opened = [stack.enter_context(Bag(bag)) for bag in bags]
        return convert(opened, out, what, into)
