"""Units: which one a field of a standard message is in, and conversion between units."""

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from bags.recordings.names import listed
from nlsid_core.errors import BagError


class Unit(NamedTuple):
    """A unit of `kind`: a value in it is scale·value + zero in the SI unit of that kind."""

    kind: str
    scale: float
    zero: float = 0.0


def _units(kind: str, scales: dict[str, float]) -> dict[str, Unit]:
    return {name: Unit(kind, scale) for name, scale in scales.items()}


UNITS: Final[Mapping[str, Unit]] = {
    **_units("angle", {"rad": 1.0, "deg": math.pi / 180, "rev": 2 * math.pi}),
    **_units("length", {"m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3}),
    **_units("time", {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}),
    **_units("speed", {"m/s": 1.0, "km/h": 1 / 3.6, "mm/s": 1e-3, "kn": 1852 / 3600}),
    **_units("angular speed", {"rad/s": 1.0, "deg/s": math.pi / 180, "rpm": 2 * math.pi / 60}),
    **_units("acceleration", {"m/s^2": 1.0, "g": 9.80665}),
    **_units("angular acceleration", {"rad/s^2": 1.0, "deg/s^2": math.pi / 180}),
    **_units("force", {"N": 1.0, "kN": 1e3}),
    **_units("torque", {"Nm": 1.0, "mNm": 1e-3}),
    **_units("pressure", {"Pa": 1.0, "hPa": 1e2, "kPa": 1e3, "bar": 1e5}),
    **_units("voltage", {"V": 1.0, "mV": 1e-3}),
    **_units("current", {"A": 1.0, "mA": 1e-3}),
    **_units("field", {"T": 1.0, "uT": 1e-6, "gauss": 1e-4}),
    "K": Unit("temperature", 1.0),
    "degC": Unit("temperature", 1.0, 273.15),
}

# (message type, field) -> unit of every number in that field; an entry further in goes before one
# further out, and "" says that none is implied. "or": the type leaves the choice to its user.
# Source: the comments of the ROS 2 Jazzy message definitions, and REP 103.
_IMPLIED: Final[Mapping[tuple[str, str], str]] = {
    ("sensor_msgs/msg/JointState", "position"): "rad or m",
    ("sensor_msgs/msg/JointState", "velocity"): "rad/s or m/s",
    ("sensor_msgs/msg/JointState", "effort"): "Nm or N",
    ("trajectory_msgs/msg/JointTrajectoryPoint", "positions"): "rad or m",
    ("trajectory_msgs/msg/JointTrajectoryPoint", "velocities"): "rad/s or m/s",
    ("trajectory_msgs/msg/JointTrajectoryPoint", "accelerations"): "rad/s^2 or m/s^2",
    ("trajectory_msgs/msg/JointTrajectoryPoint", "effort"): "Nm or N",
    ("sensor_msgs/msg/Imu", "linear_acceleration"): "m/s^2",
    ("sensor_msgs/msg/Imu", "angular_velocity"): "rad/s",
    ("geometry_msgs/msg/Twist", "linear"): "m/s",
    ("geometry_msgs/msg/Twist", "angular"): "rad/s",
    ("geometry_msgs/msg/Accel", "linear"): "m/s^2",
    ("geometry_msgs/msg/Accel", "angular"): "rad/s^2",
    ("geometry_msgs/msg/Wrench", "force"): "N",
    ("geometry_msgs/msg/Wrench", "torque"): "Nm",
    ("geometry_msgs/msg/Pose", "position"): "m",
    ("geometry_msgs/msg/PointStamped", "point"): "m",
    ("geometry_msgs/msg/Transform", "translation"): "m",
    ("geometry_msgs/msg/Quaternion", "roll"): "rad",
    ("geometry_msgs/msg/Quaternion", "pitch"): "rad",
    ("geometry_msgs/msg/Quaternion", "yaw"): "rad",
    ("geometry_msgs/msg/Inertia", "m"): "kg",
    ("sensor_msgs/msg/MagneticField", "magnetic_field"): "T",
    ("sensor_msgs/msg/FluidPressure", "fluid_pressure"): "Pa",
    ("sensor_msgs/msg/Temperature", "temperature"): "degC",
    ("sensor_msgs/msg/Illuminance", "illuminance"): "lx",
    ("sensor_msgs/msg/Range", "field_of_view"): "rad",
    ("sensor_msgs/msg/Range", "min_range"): "m",
    ("sensor_msgs/msg/Range", "max_range"): "m",
    ("sensor_msgs/msg/Range", "range"): "m",
    ("sensor_msgs/msg/LaserScan", "angle_min"): "rad",
    ("sensor_msgs/msg/LaserScan", "angle_max"): "rad",
    ("sensor_msgs/msg/LaserScan", "angle_increment"): "rad",
    ("sensor_msgs/msg/LaserScan", "time_increment"): "s",
    ("sensor_msgs/msg/LaserScan", "scan_time"): "s",
    ("sensor_msgs/msg/LaserScan", "range_min"): "m",
    ("sensor_msgs/msg/LaserScan", "range_max"): "m",
    ("sensor_msgs/msg/LaserScan", "ranges"): "m",
    ("sensor_msgs/msg/NavSatFix", "latitude"): "deg",
    ("sensor_msgs/msg/NavSatFix", "longitude"): "deg",
    ("sensor_msgs/msg/NavSatFix", "altitude"): "m",
    ("sensor_msgs/msg/BatteryState", "voltage"): "V",
    ("sensor_msgs/msg/BatteryState", "temperature"): "degC",
    ("sensor_msgs/msg/BatteryState", "current"): "A",
    ("sensor_msgs/msg/BatteryState", "charge"): "Ah",
    ("sensor_msgs/msg/BatteryState", "capacity"): "Ah",
    ("sensor_msgs/msg/BatteryState", "design_capacity"): "Ah",
    ("sensor_msgs/msg/BatteryState", "cell_voltage"): "V",
    ("sensor_msgs/msg/BatteryState", "cell_temperature"): "degC",
    ("builtin_interfaces/msg/Time", "sec"): "s",
    ("builtin_interfaces/msg/Time", "nanosec"): "ns",
    ("builtin_interfaces/msg/Duration", "sec"): "s",
    ("builtin_interfaces/msg/Duration", "nanosec"): "ns",
    ("ackermann_msgs/msg/AckermannDrive", "steering_angle"): "rad",
    ("ackermann_msgs/msg/AckermannDrive", "steering_angle_velocity"): "rad/s",
    ("ackermann_msgs/msg/AckermannDrive", "speed"): "m/s",
    ("ackermann_msgs/msg/AckermannDrive", "acceleration"): "m/s^2",
}


def implied_unit(owners: Sequence[tuple[str, str]]) -> str:
    """The unit of a number from the (message type, field) on the way to it; "" if none is implied.

    Where a type leaves the choice to its user, both: `rad or m`.
    """
    found = [_IMPLIED[owner] for owner in owners if owner in _IMPLIED]
    return found[-1] if found else ""


def conversion(of: str, to: str) -> tuple[float, float]:
    """(factor, shift) such that factor·value + shift is in `to` what value is in `of`.

    `of` may leave a choice (`rad or m`): the one of the same kind is meant. Raises BagError for an
    unknown unit, and for units of different kinds.
    """
    if to not in UNITS:
        raise BagError(f"'{to}' is not a unit; known are {', '.join(UNITS)}")
    choices = [name for name in of.split(" or ") if name in UNITS]
    fitting = [name for name in choices if UNITS[name].kind == UNITS[to].kind]
    if not fitting:
        kinds = listed(name for name, unit in UNITS.items() if unit.kind == UNITS[to].kind)
        raise BagError(
            f"'{of or 'no unit'}' cannot be converted to '{to}', which is of a kind with {kinds}; "
            "state the unit of the recorded number first: |unit(...)"
        )
    source, target = UNITS[fitting[0]], UNITS[to]
    return source.scale / target.scale, (source.zero - target.zero) / target.scale


def per_second(unit: str) -> str:
    """The unit of the time derivative of a number in `unit`; "" stays ""."""
    if not unit:
        return ""
    known = {"m": "m/s", "m/s": "m/s^2", "rad": "rad/s", "rad/s": "rad/s^2"}
    known |= {"deg": "deg/s", "deg/s": "deg/s^2"}
    return " or ".join(known.get(name, f"{name}/s") for name in unit.split(" or "))
