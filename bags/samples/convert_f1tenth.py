"""Convert the F1TENTH trials of Kochdumper and Bak (CSV) into the bags that ship in `f1tenth/`.

    python -m bags.samples.convert_f1tenth --data DATA/f1tenth --out bags/samples/f1tenth

The same input gives the same bytes. Source of the data: see f1tenth/README.md.
"""

import argparse
import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from bags.recordings.message_types import standard_types
from bags.recordings.writer import BagWriter
from nlsid_core.arrays import FloatArray
from nlsid_core.errors import DataError, NlsidError

TRIALS: Final = 41
STEPS: Final = 120  # commands of a trial; there is one measurement more
PERIOD_NS: Final = 25_000_000
FIRST_NS: Final = 1_640_995_200 * 10**9  # the source has no dates: 2022-01-01, a minute a trial
MINUTE_NS: Final = 60 * 10**9

COMMAND: Final = "geometry_msgs/msg/TwistStamped"
STEERING: Final = "sensor_msgs/msg/JointState"
ODOMETRY: Final = "nav_msgs/msg/Odometry"

SOURCE: Final = (
    "N. Kochdumper and S. Bak, Conformant synthesis for Koopman operator linearized systems, "
    "Control Systems Letters 2022; measured from a F1TENTH racecar"
)
LICENCE: Final = "CC0-1.0"


def main() -> None:
    """Convert every trial; exit with a message if something is missing or exists already."""
    parser = argparse.ArgumentParser(description="Convert the F1TENTH trials (CSV) into bags.")
    parser.add_argument("--data", type=Path, required=True, help="folder that holds F1tenthCar/")
    parser.add_argument("--out", type=Path, required=True, help="folder for trial_01 to trial_41")
    arguments = parser.parse_args()
    try:
        for trial in range(1, TRIALS + 1):
            source = arguments.data / "F1tenthCar" / f"measurement_{trial}"
            convert(source, arguments.out / f"trial_{trial:02d}", start_ns=_start_ns(trial))
    except (NlsidError, OSError) as error:
        raise SystemExit(f"error: {error}") from error


def convert(source: Path, bag: Path, *, start_ns: int) -> None:
    """Write the trial in the folder `source` to `bag`, with stamps from `start_ns` every 25 ms.

    Raises DataError if the files do not hold such a trial, BagError if `bag` exists.
    """
    inputs = _table(source / "input.csv", (STEPS, 2))
    states = _table(source / "trajectory.csv", (STEPS + 1, 4))
    times = _table(source / "time.csv", (STEPS + 1, 1))[:, 0]
    if np.abs(times - np.arange(STEPS + 1) * PERIOD_NS / 1e9).max() > 1e-9:
        raise DataError(f"{source / 'time.csv'}: not every 25 ms")
    with BagWriter(bag, custom=_custom(source.name, inputs)) as writer:
        for k, (x, y, heading, speed) in enumerate(states):
            stamp_ns = start_ns + k * PERIOD_NS
            if k < STEPS:
                steering, wanted = inputs[k]
                _write(writer, "/cmd_vel", COMMAND, _command(stamp_ns, wanted), stamp_ns)
                _write(writer, "/steering_command", STEERING, _joint(stamp_ns, steering), stamp_ns)
            odometry = _odometry(stamp_ns, x, y, heading, speed)
            _write(writer, "/odom", ODOMETRY, odometry, stamp_ns)


def _start_ns(trial: int) -> int:
    return FIRST_NS + trial * MINUTE_NS


def _table(path: Path, shape: tuple[int, int]) -> FloatArray:
    try:
        table = np.loadtxt(path, delimiter=",", dtype=np.float64, ndmin=2)
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error
    if table.shape != shape:
        raise DataError(f"{path} should have shape {shape}, has {table.shape}")
    return table


def _custom(name: str, inputs: FloatArray) -> dict[str, str]:
    steering, speed = inputs.T
    custom = {
        "excitation": f"{_changes('speed', speed, 'm/s')}; {_changes('steering', steering, 'rad')}",
        "source": SOURCE,
        "source_trial": name,
        "licence": LICENCE,
    }
    steps = np.flatnonzero(np.diff(speed))
    if len(steps) == 1 and speed[0] == 0.0:  # from rest: five trials a step, steering apart
        custom["repeat_group"] = f"speed step 0 to {speed[-1]:g} m/s"
    return custom


def _changes(name: str, values: FloatArray, unit: str) -> str:
    """The first value and each new one with its time: `speed [m/s] 0, 0.4 at 0.025 s`."""
    changes = np.flatnonzero(np.diff(values)) + 1
    later = [f", {values[k]:g} at {k * PERIOD_NS / 1e9:g} s" for k in changes]
    return f"{name} [{unit}] {values[0]:g}{''.join(later)}"


def _write(writer: BagWriter, topic: str, msgtype: str, message: object, stamp_ns: int) -> None:
    data = bytes(standard_types().serialize_cdr(message, msgtype, little_endian=True))
    writer.write(topic, msgtype, data, log_time_ns=stamp_ns, publish_time_ns=stamp_ns)


def _command(stamp_ns: int, speed: float) -> object:
    return _make(COMMAND, _header(stamp_ns, "base_link"), _twist(speed))


def _joint(stamp_ns: int, angle: float) -> object:
    empty = np.zeros(0)
    return _make(STEERING, _header(stamp_ns, ""), ["steering"], np.array([angle]), empty, empty)


def _odometry(stamp_ns: int, x: float, y: float, heading: float, speed: float) -> object:
    position = _make("geometry_msgs/msg/Point", float(x), float(y), 0.0)
    yaw = _make(
        "geometry_msgs/msg/Quaternion", 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)
    )
    pose = _make("geometry_msgs/msg/Pose", position, yaw)
    return _make(
        ODOMETRY,
        _header(stamp_ns, "odom"),
        "base_link",
        _make("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36)),
        _make("geometry_msgs/msg/TwistWithCovariance", _twist(speed), np.zeros(36)),
    )


def _header(stamp_ns: int, frame: str) -> object:
    stamp = _make("builtin_interfaces/msg/Time", stamp_ns // 10**9, stamp_ns % 10**9)
    return _make("std_msgs/msg/Header", stamp, frame)


def _twist(forward: float) -> object:
    linear = _make("geometry_msgs/msg/Vector3", float(forward), 0.0, 0.0)
    return _make(
        "geometry_msgs/msg/Twist", linear, _make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
    )


def _make(msgtype: str, /, *fields: Any) -> object:
    return standard_types().types[msgtype](*fields)


if __name__ == "__main__":
    main()
