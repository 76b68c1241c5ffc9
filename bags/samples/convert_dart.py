"""Convert the drives of the DART car (CSV) into what ships in `dart/`: bags, and thinned tables.

    python -m bags.samples.convert_dart --data DATA/dart --out bags/samples/dart

The same input gives the same bytes. Source of the data and what was done to it: dart/README.md.
"""

import argparse
import io
import tarfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from bags.recordings.message_types import standard_types
from bags.recordings.writer import BagWriter
from bags.signals.expressions import derivative
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.errors import DataError, NlsidError

PERIOD_NS: Final = 50_000_000  # between samples of the motion
WINDOW: Final = 0.2  # s, of the slopes that make speed and yaw rate of poses
COMMAND_EVERY: Final = 0.5  # s, of commands that do not change
STEP: Final = 2.0**-10  # to which numbers are rounded, so that they compress: about 1 mm/s
FLIP: Final = 8.0  # rad/s between two poses: the motion capture took another marker
AFTER_FLIP: Final = 0.3  # s
SLOW: Final = 0.1  # m/s: before and after the car moves, LEAD s are kept
LEAD: Final = 1.0  # s
SHORTEST: Final = 5.0  # s of a drive that is kept
SHIPPED: Final = 90.0  # s: longer drives are left out of what ships, to keep it small
TABLES: Final = "tables.tar.xz"
THINNED: Final = 5  # of the rows at 100 Hz every fifth is in the tables, of those at 20 Hz all
FIRST_COLUMNS: Final = 7  # of the files at 20 Hz: what follows is computed from these
IN_TABLES: Final = (
    "81_throttle_ramps/*_15_46_50*.csv",
    "81_throttle_ramps/*_16_05_28*.csv",
    "81_throttle_ramps/*_16_09_11*.csv",
    "81_throttle_ramps/*_16_15_13*.csv",
    "80_circles_rubbery_floor/*_12_34_30.csv",
    "80_circles_rubbery_floor/*_12_37_59.csv",
    "91_free_driving_16_sept_2024/*_10_01_01.csv",
    "91_free_driving_16_sept_2024/*_10_12_05.csv",
    "free_driving_steer_rate_testing_16_sept_2024/*.csv",
    "circles_27_sept_2024_fast_ramp/*.csv",
    "81_circles_tape_and_tiles/*.csv",
    "83_16_april_2025_slippery_floor/*-15-56-43.csv",
    "83_16_april_2025_slippery_floor/*-16-21-24.csv",
    "83_16_april_2025_slippery_floor/*-17-02-48.csv",
    "83_9_april_2025_MPCCPP_rosbag/*.csv",
)
TWIST: Final = "geometry_msgs/msg/TwistStamped"
FLOORS: Final = {
    "81_throttle_ramps": "rubbery",
    "80_circles_rubbery_floor": "rubbery",
    "91_free_driving_16_sept_2024": "rubbery",
    "free_driving_steer_rate_testing_16_sept_2024": "rubbery",
    "circles_27_sept_2024_fast_ramp": "rubbery",
    "83_4_april_2025_MPCC_rosbag": "control",
    "83_9_april_2025_MPCCPP_rosbag": "control",
    "81_circles_tape_and_tiles": "tape",
    "83_16_april_2025_slippery_floor": "slippery",
}
SOURCE: Final = (
    "L. Lyons, T. Niesten, L. Ferranti, DART: A Compact Platform for Autonomous Driving Research; "
    "System_identification/Data"
)
LICENCE: Final = "MIT, Copyright (c) 2024 Lorenzo Lyons"


@dataclass(frozen=True, eq=False)
class Drive:
    """A stretch of a file: its name, and columns (N,) by their titles, "t" in s since the epoch."""

    name: str
    file: str
    columns: Mapping[str, FloatArray]


def main() -> None:
    """Convert every drive; exit with a message if something is missing or exists already."""
    parser = argparse.ArgumentParser(description="Convert the DART car's drives (CSV) into bags.")
    parser.add_argument("--data", type=Path, required=True, help="folder that holds 81_*/ etc.")
    parser.add_argument("--out", type=Path, required=True, help="folder for the bags")
    parser.add_argument("--longest", type=float, default=SHIPPED, help="s; longer drives are not")
    arguments = parser.parse_args()
    try:
        write_tables(arguments.data, arguments.out / TABLES)
        for drive in drives(arguments.data):
            convert(drive, arguments.out / drive.name, longest=arguments.longest)
    except (NlsidError, OSError) as error:
        raise SystemExit(f"error: {error}") from error


def write_tables(data: Path, out: Path) -> None:
    """Write the thinned files, LICENSE and all, as one archive; DataError if one is absent."""
    out.parent.mkdir(parents=True, exist_ok=True)
    with tarfile.open(out, "w:xz", preset=9) as archive:
        for pattern in ("LICENSE", *IN_TABLES):
            files = sorted(data.glob(pattern))
            if not files:
                raise DataError(f"{data}: no {pattern}")
            for file in files:
                content = _thinned(file).encode()
                entry = tarfile.TarInfo(f"dart/{file.relative_to(data)}")
                entry.size = len(content)
                archive.addfile(entry, io.BytesIO(content))


def _thinned(file: Path) -> str:
    text = file.read_text(encoding="utf-8-sig")
    if file.suffix != ".csv":
        return text
    titles, *rows = text.splitlines()
    if titles.startswith("vicon time"):
        lines = [",".join(row.split(",")[:FIRST_COLUMNS]) for row in (titles, *rows)]
    else:
        lines = [titles, *rows[::THINNED]]
    return "\n".join(lines) + "\n"


def drives(data: Path) -> Iterator[Drive]:
    """The stretches in which the car moves, called by floor and time; DataError if one is absent.

    A file is cut where the yaw flips; less than SHORTEST s of motion is left out.
    """
    for folder, floor in FLOORS.items():
        files = sorted((data / folder).glob("*.csv"))
        if not files:
            raise DataError(f"{data / folder}: no .csv files")
        for file in files:
            columns = read(file)
            whole = [part for part in _between_flips(columns) if _is_long(part)]
            for part, stretch in enumerate(whole, start=1):
                start = datetime.fromtimestamp(columns["t"][0], tz=UTC)
                end = f"_{part}" if len(whole) > 1 else ""
                yield Drive(f"{floor}_{start:%Y%m%d_%H%M%S}{end}", file.name, stretch)


def read(file: Path) -> dict[str, FloatArray]:
    """The columns of a file, rows of which the motion capture's time does not repeat."""
    with file.open(encoding="utf-8-sig") as stream:
        titles = stream.readline().strip().split(",")
    try:
        table = np.genfromtxt(file, delimiter=",", skip_header=1)
        columns = dict(zip(titles, table.T, strict=True))
        t = columns["vicon time"]
    except (ValueError, KeyError) as error:
        raise DataError(f"{file}: {error}") from error
    if t[0] < 1e9:  # since the start of the file, which its name says
        began = datetime.strptime(file.stem, "%Y-%m-%d-%H-%M-%S").replace(tzinfo=UTC)
        t = t + began.timestamp()
    kept = np.concatenate([[True], np.diff(t) > 0.0])
    return {title: values[kept] for title, values in (columns | {"t": t}).items()}


def _between_flips(columns: Mapping[str, FloatArray]) -> list[dict[str, FloatArray]]:
    t, yaw = columns["t"], np.unwrap(columns["vicon yaw"])
    flips = t[1:][np.abs(np.diff(yaw) / np.diff(t)) > FLIP]
    starts = [float(t[0]), *(flips + AFTER_FLIP).tolist()]
    ends = [*(flips - AFTER_FLIP).tolist(), float(t[-1])]
    kept = [(t >= a) & (t <= b) for a, b in zip(starts, ends, strict=True)]
    return [{title: c[rows] for title, c in columns.items()} for rows in kept if rows.any()]


def _is_long(columns: Mapping[str, FloatArray]) -> bool:
    return float(columns["t"][-1] - columns["t"][0]) >= SHORTEST


def convert(drive: Drive, bag: Path, *, longest: float = float("inf")) -> bool:
    """Write a drive, and say whether it was: one of more than `longest` s of motion is not.

    Raises BagError if `bag` exists.
    """
    messages = list(_messages(drive.columns))
    if messages[-1][0] - messages[0][0] > longest * 1e9:
        return False
    custom = {"source": SOURCE, "source_file": drive.file, "licence": LICENCE}
    with BagWriter(bag, custom=custom) as writer:
        for stamp, topic, x, z in messages:
            data = twist(stamp, _rounded(x), _rounded(z))
            writer.write(topic, TWIST, data, log_time_ns=stamp, publish_time_ns=stamp)
    return True


def _messages(columns: Mapping[str, FloatArray]) -> list[tuple[int, str, float, float]]:
    """Stamp (ns), topic, linear.x, angular.z in the order of stamps.

    /motion every 50 ms, /command as it changes and at least every 0.5 s.
    """
    first = -(-round(columns["t"][0] * 1e9) // PERIOD_NS) * PERIOD_NS
    stamps: IntArray = np.arange(first, round(columns["t"][-1] * 1e9), PERIOD_NS, dtype=np.int64)
    at, t = (stamps - first) / 1e9, columns["t"] - first / 1e9

    def slope(values: FloatArray) -> FloatArray:
        return derivative(np.interp(at, t, values), stamps, WINDOW)

    speed = np.hypot(slope(columns["vicon x"]), slope(columns["vicon y"]))
    yaw_rate = slope(np.unwrap(columns["vicon yaw"]))
    moving = np.flatnonzero(speed > SLOW)
    lead = round(LEAD * 1e9 / PERIOD_NS)
    begin = max(int(moving[0]) - lead, int(np.argmax(np.isfinite(speed))))
    rows = range(begin, min(int(moving[-1]) + lead, len(speed)))
    messages = [(int(stamps[k]), "/motion", float(speed[k]), float(yaw_rate[k])) for k in rows]
    start, end = int(stamps[rows[0]]), int(stamps[rows[-1]])
    before_ns, before = 0, (np.nan, np.nan)
    for stamp, *command in zip(
        np.rint(columns["t"] * 1e9).astype(np.int64).tolist(),
        columns["throttle"].tolist(),
        columns["steering"].tolist(),
        strict=True,
    ):
        due = tuple(command) != before or stamp - before_ns >= COMMAND_EVERY * 1e9
        if due and start - COMMAND_EVERY * 2e9 <= stamp <= end:
            messages.append((stamp, "/command", *command))
            before_ns, before = stamp, tuple(command)
    return sorted(messages)


def _rounded(value: float) -> float:
    return round(float(value) / STEP) * STEP


def twist(stamp_ns: int, x: float, z: float) -> bytes:
    """A TwistStamped with linear.x and angular.z."""
    kinds = standard_types().types
    vector = kinds["geometry_msgs/msg/Vector3"]
    stamp = kinds["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
    header = kinds["std_msgs/msg/Header"](stamp, "base_link")
    body = kinds["geometry_msgs/msg/Twist"](vector(x, 0.0, 0.0), vector(0.0, 0.0, z))
    return bytes(standard_types().serialize_cdr(kinds[TWIST](header, body), TWIST))


if __name__ == "__main__":
    main()
