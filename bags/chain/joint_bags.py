"""Trajectories of joints as bags: states on /joint_states, efforts on /joint_commands."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from bags.recordings.message_types import standard_types
from bags.recordings.writer import whole_bag
from bags.signals.grid import REPEAT_GROUP
from nlsid_core.data.trajectory import Trajectory

JOINTS: Final = "sensor_msgs/msg/JointState"
STATES, COMMANDS = "/joint_states", "/joint_commands"
FIRST_NS: Final = 1_700_000_000 * 10**9  # a date, so that stamps look like a recording's


def write_joint_bag(
    folder: Path, trajectory: Trajectory, *, custom: Mapping[str, str] | None = None
) -> Path:
    """Write `trajectory` as the bag folder/NAME: y = [angles; rates], u efforts, from row to row.

    Raises BagError if the bag exists.
    """
    path = folder / trajectory.name
    n = trajectory.y.shape[1] // 2
    names = [f"joint_{i}" for i in range(n)]
    information = dict(custom or {})
    if trajectory.group:
        information[REPEAT_GROUP] = trajectory.group
    with whole_bag(path, custom=information) as writer:
        for t, y, u in zip(trajectory.t.tolist(), trajectory.y, trajectory.u, strict=True):
            stamp_ns = FIRST_NS + round(t * 1e9)
            none = np.zeros(0)
            for topic, values in ((COMMANDS, (none, none, u)), (STATES, (y[:n], y[n:], none))):
                stamp = _make("builtin_interfaces/msg/Time", stamp_ns // 10**9, stamp_ns % 10**9)
                header = _make("std_msgs/msg/Header", stamp, "")
                message = _make(JOINTS, header, names, *(part.copy() for part in values))
                data = bytes(standard_types().serialize_cdr(message, JOINTS, little_endian=True))
                writer.write(topic, JOINTS, data, log_time_ns=stamp_ns, publish_time_ns=stamp_ns)
    return path


def _make(msgtype: str, /, *fields: Any) -> object:
    return standard_types().types[msgtype](*fields)
