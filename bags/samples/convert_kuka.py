"""Convert recordings of a KUKA KR300 (MAT) into the bags that ship in `kuka/`.

    python -m bags.samples.convert_kuka --data DATA/kuka_kr300 --out bags/samples/kuka

The same input gives the same bytes. Source of the data and what was done to it: kuka/README.md.
"""

import argparse
from pathlib import Path
from typing import Final

import numpy as np
from scipy.io import loadmat

from bags.recordings.message_types import standard_types
from bags.recordings.writer import BagWriter
from nlsid_core.arrays import FloatArray
from nlsid_core.errors import NlsidError

JOINTS: Final = 3
EVERY: Final = 2  # of the rows at 250 Hz
PERIOD_NS: Final = 8_000_000
STEP: Final = 2.0**-20  # rad, to which numbers are rounded, so that they compress
START_NS: Final = 1_603_238_400 * 10**9  # the day of the recordings; the hour is made up
JOINT_STATE: Final = "sensor_msgs/msg/JointState"
CUSTOM: Final = {
    "source": "J. Weigand, J. Ulmen, A. Janot, M. Ruskowski; Robot_Identification, commit 9e403c0",
    "licence": "MIT, Copyright (c) 2021 Jonas Weigand",
}


def main() -> None:
    """Convert the three recordings; exit with a message if something is missing or exists."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder that holds the .mat files")
    parser.add_argument("--out", type=Path, required=True, help="folder for the bags")
    arguments = parser.parse_args()
    try:
        for minute, letter in enumerate("ABC"):
            file = arguments.data / f"2020-10-21_10s_FF_{letter}_08ms.mat"
            recording = loadmat(file, squeeze_me=True, struct_as_record=False)["rec"]
            convert(
                arguments.out / f"motion_{letter.lower()}",
                {"/reference": recording.ref_pos_deg, "/joint_states": recording.act_pos_mot_deg},
                START_NS + minute * 60 * 10**9,
                file.name,
            )
    except (NlsidError, OSError) as error:
        raise SystemExit(f"error: {error}") from error


def convert(bag: Path, degrees: dict[str, FloatArray], start_ns: int, file: str) -> None:
    """Write angles (6, N) in degrees by topic, at 250 Hz; raises BagError if `bag` exists."""
    kinds = standard_types().types
    names = [f"joint_{k + 1}" for k in range(JOINTS)]
    nothing = np.zeros(0)
    with BagWriter(bag, custom=CUSTOM | {"source_file": file}) as writer:
        angles = {topic: np.deg2rad(found[:JOINTS, ::EVERY]).T for topic, found in degrees.items()}
        for k in range(len(next(iter(angles.values())))):
            stamp_ns = start_ns + k * PERIOD_NS
            stamp = kinds["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
            header = kinds["std_msgs/msg/Header"](stamp, "")
            for topic, rows in angles.items():
                position = np.round(rows[k] / STEP) * STEP
                message = kinds[JOINT_STATE](header, names, position, nothing, nothing)
                data = bytes(standard_types().serialize_cdr(message, JOINT_STATE))
                writer.write(
                    topic, JOINT_STATE, data, log_time_ns=stamp_ns, publish_time_ns=stamp_ns
                )


if __name__ == "__main__":
    main()
