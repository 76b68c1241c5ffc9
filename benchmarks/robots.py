"""Many recorded robots: from their bags through `nlsid init` to a monitor, with nothing edited.

python -m benchmarks.robots --data DIR [--json]

DIR holds dart, emps, kuka_kr300, schunk_arm, ur10_panda and cougars_auv; the F1TENTH bags ship with
the project. Tables are imported as bags once, to the cache. `options` are those of `nlsid init`;
`lines_of_yaml_edited` counts what was changed in the file that it wrote. Test bags are unseen; a
false alarm is one of them that is not inside, `caught` are copies of them with a broken sensor.
DART has a tube for each of six random splits besides, and counts what is flagged on each floor.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import logging
import math
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bags.chain.config import Config, load_config
from bags.chain.faults import FAULTS, write_faulty_copy
from bags.chain.steps import design_funnel_files, identify_bags, what_a_funnel_catches
from bags.designs import documents
from bags.monitoring.replay import replay_bag
from bags.samples import convert_dart, f1tenth
from bags.setup.candidates import look
from bags.setup.proposal import Proposal
from bags.setup.proposing import choose, propose
from bags.setup.written import yaml_text
from bags.signals.expressions import Expression
from bags.tools.edit import split
from bags.tools.importing import import_tables
from benchmarks.cache import cache_folder
from benchmarks.machine import describe
from nlsid_core.errors import NlsidError
from nlsid_core.progress import silent
from nlsid_core.running.reading import Status

JOINTS = "sensor_msgs/msg/JointState"
TWIST = "geometry_msgs/msg/TwistStamped"
SCHUNK_TRIALS = range(5, 101, 5)  # of 100 repeats of a few motions
PARTS = 5  # of a robot's only recording
DART_INPUTS = (
    "/command:twist.angular.z|lag(0.1 s) * /motion:twist.linear.x",
    "/motion:twist.linear.x",
)
DART_MODEL = {"model": "state_affine", "lags": 2, "delays": [1], "right_degree": 4}
DART_FUNNEL = {"level": "commands"}
DART_KINDS = {"20240909": "ramps", "20240904": "circles", "20240927": "circles", "20240916": "free"}
DART_SPLITS = 6


@dataclass(frozen=True)
class Robot:
    """One robot: the folder below DIR, what makes its bags, and what is said to `nlsid init`."""

    name: str
    folder: str
    bags: Callable[[Path, Path], list[Path]]
    responses: tuple[str, ...] = ()
    excitations: tuple[str, ...] = ()


def f1tenth_bags(_folder: Path, _cache: Path) -> list[Path]:
    """The shipped ones."""
    return f1tenth()


def schunk_bags(folder: Path, cache: Path) -> list[Path]:
    """Motor torques and joint states of a few of the hundred trials."""
    made = []
    for trial in SCHUNK_TRIALS:
        source = folder / "Robot" / f"measurement_{trial}"
        signals = [
            f"/joint_states:{field}[name=joint_{k + 1}]={table}[{k + shift}]"
            for k in range(6)
            for field, table, shift in (
                ("position", "trajectory", 0),
                ("velocity", "trajectory", 6),
                ("effort", "input", 0),
            )
        ]  # fmt: skip
        made.append(
            imported(
                cache / f"trial_{trial:03d}", [source / "input.csv", source / "trajectory.csv"],
                signals, period=0.004,
            )
        )  # fmt: skip
    return made


def emps_bags(folder: Path, cache: Path) -> list[Path]:
    """Reference, measured position and motor voltage of both recordings, each in parts."""
    made = []
    for name in ("DATA_EMPS", "DATA_EMPS_PULSES"):
        signals = [
            f"/reference:position[name=slide]={name}.qg",
            f"/joint_states:position[name=slide]={name}.qm",
            f"/motor_command:effort[name=slide]={name}.vir",
        ]
        whole = imported(cache / name, [folder / f"{name}.mat"], signals, period=0.001)
        made += parts(whole, 24.8 / PARTS)
    return made


def kuka_bags(folder: Path, cache: Path) -> list[Path]:
    """Reference and measured position, velocity and torque of six motors; three recordings."""
    made = []
    for letter in "ABC":
        signals = [
            f"{topic}[name=motor_{k + 1}]=rec.{table}[{k}, :]"
            for k in range(6)
            for topic, table in (
                ("/reference:position", "ref_pos_deg"),
                ("/joint_states:position", "act_pos_mot_deg"),
                ("/joint_states:velocity", "act_vel_mot_deg_per_s"),
                ("/joint_states:effort", "act_torque_abs_nm"),
            )
        ]
        file = folder / f"2020-10-21_10s_FF_{letter}_08ms.mat"
        made.append(imported(cache / f"drive_{letter}", [file], signals, period=0.004))
    return made


def ur10_bags(folder: Path, cache: Path) -> list[Path]:
    """One recording in parts."""
    return one_in_parts(folder / "ur10_exciting_trajectory.db3", cache, 27.5)


def panda_bags(folder: Path, cache: Path) -> list[Path]:
    """One recording in parts."""
    return one_in_parts(folder / "panda_exciting_trajectory.db3", cache, 24.2)


def cougars_bags(folder: Path, cache: Path) -> list[Path]:
    """One recording of an underwater robot in parts."""
    return one_in_parts(folder / "SO_lastbag_mcap", cache, 119.5)


def dart_bags(folder: Path, cache: Path) -> list[Path]:
    """Every drive of the car on the rubbery floor."""
    return dart_drives(folder, cache, "rubbery")


def dart_drives(folder: Path, cache: Path, floor: str) -> list[Path]:
    """Every drive on one floor, converted once as those that ship are."""
    drives = cache / "drives"
    if not drives.is_dir():
        with tempfile.TemporaryDirectory(dir=cache) as name:
            for drive in convert_dart.drives(folder):
                convert_dart.convert(drive, Path(name) / "drives" / drive.name)
            (Path(name) / "drives").rename(drives)
    return sorted(drives.glob(f"{floor}_*"))


def dart_split(bags: list[Path], seed: int) -> dict[str, list[str]]:
    """Each kind of drive is shuffled and dealt in turn to training, calibration and test."""
    rng = np.random.default_rng(seed)
    dealt: tuple[list[str], ...] = ([], [], [])
    for kind in dict.fromkeys(DART_KINDS.values()):
        mine = [bag.name for bag in bags if DART_KINDS[bag.name.split("_")[1]] == kind]
        for turn, k in enumerate(rng.permutation(len(mine))):
            dealt[turn % 3].append(mine[k])
    return {"calibration": dealt[1], "test": dealt[2]}


def imported(bag: Path, files: Sequence[Path], signals: Sequence[str], *, period: float) -> Path:
    """Tables as a bag of joint states, once."""
    if not bag.is_dir():
        topics = dict.fromkeys(signal.partition(":")[0] for signal in signals)
        import_tables(files, bag, signals, types=dict.fromkeys(topics, JOINTS), period=period)
    return bag


def one_in_parts(bag: Path, cache: Path, seconds: float) -> list[Path]:
    """A robot's only recording in PARTS parts."""
    copy = cache / bag.stem
    if not copy.exists():
        shutil.copytree(bag, copy) if bag.is_dir() else shutil.copy(bag, copy.with_suffix(".db3"))
    return parts(copy if bag.is_dir() else copy.with_suffix(".db3"), seconds / PARTS)


def parts(bag: Path, seconds: float) -> list[Path]:
    """The bag cut every so many seconds, once."""
    name = f"{bag.stem}_of_{PARTS}"
    made = sorted(bag.parent.glob(f"{name}_[0-9][0-9]"))
    return made or list(split(bag, bag.parent / name, every=seconds).parts)


ROBOTS = (
    Robot("F1TENTH speed", ".", f1tenth_bags, ("/odom:twist.twist.linear.x",)),
    Robot("F1TENTH yaw rate", ".", f1tenth_bags),
    Robot(
        "F1TENTH 2x2", ".", f1tenth_bags,
        ("/odom:twist.twist.linear.x", "/odom:pose.pose.orientation.yaw|unwrap|derivative(0.12 s)"),
        ("/cmd_vel:twist.linear.x", "/steering_command:position[name=steering]"),
    ),
    Robot("DART yaw rate", "dart", dart_bags, ("/motion:twist.angular.z",), DART_INPUTS),
    Robot("Schunk arm", "schunk_arm", schunk_bags),
    Robot("EMPS slide", "emps", emps_bags),
    Robot("KUKA KR300", "kuka_kr300", kuka_bags),
    Robot("UR10", "ur10_panda", ur10_bags),
    Robot("Panda", "ur10_panda", panda_bags),
    Robot("CoUGARs underwater robot", "cougars_auv", cougars_bags),
)  # fmt: skip


def measure(robot: Robot, data: Path, *, cache: Path) -> dict[str, Any]:
    """One robot's way; `refused` says where it ended, with the reason, if it did."""
    options = [*(f"-y {text}" for text in robot.responses),
               *(f"-u {text}" for text in robot.excitations)]  # fmt: skip
    row: dict[str, Any] = {"robot": robot.name, "options": options, "lines_of_yaml_edited": 0}
    folder = data / robot.folder
    if not folder.is_dir():
        return row | {"refused": f"data: no folder {robot.folder}"}
    mine = cache / "robots" / (robot.folder if robot.folder != "." else "f1tenth")
    mine.mkdir(parents=True, exist_ok=True)
    bags = robot.bags(folder, mine)
    step, started = "init", time.perf_counter()
    try:
        with tempfile.TemporaryDirectory() as name:
            out = Path(name)
            config = initialised(robot, bags, out / "robot.yaml")
            row["signals"] = [
                s.path for s in (*config.signals.response, *config.signals.excitation)
            ]
            step = "identify"
            fit = identify_bags(bags, config, out, progress=silent)
            row["test_error"] = fit.fit.errors["test"][fit.fit.chosen.method.name]
            step = "funnel"
            design = design_funnel_files(out / documents.MODEL, config, out)
            test = [bag for bag in bags if bag.name in config.split.test]
            catching = what_a_funnel_catches(out / documents.MODEL, config, design)
            widths = [width.share for width in catching.widths] if catching is not None else []
            row |= {"half_width_of_range": max(widths, default=math.nan), "each": widths}
            step = "monitor"
            row |= held_against(config, test, out)
            if robot.folder == "dart":
                step = "floors"
                row |= floors(robot, bags, folder, mine)
    except NlsidError as error:
        row["refused"] = f"{step}: {error}"
    finally:
        row["minutes"] = (time.perf_counter() - started) / 60.0
    return row


def initialised(robot: Robot, bags: list[Path], path: Path) -> Config:
    """What `nlsid init --yes` writes for this robot, read again."""
    path.write_text(yaml_text(proposed(robot, bags)))
    return load_config(path)


def proposed(robot: Robot, bags: list[Path]) -> Proposal:
    """What `nlsid init --yes` proposes for this robot."""
    found = look(bags)
    responses, excitations = choose(found, robot.responses, robot.excitations)
    return propose(bags, found, responses=responses, excitations=excitations, robot=robot.name)


def held_against(config: Config, test: list[Path], out: Path) -> dict[str, Any]:
    """Unseen bags that are not inside, and copies of them with a broken sensor that are caught."""
    alarms = [flagged(config, bag, out) for bag in test]
    signal = str(Expression.parse(config.signals.response[0].path).path)
    caught = []
    for bag in test:
        for number, (_, fault) in enumerate(FAULTS.items()):
            copy = out / f"{bag.name}_{number}"
            try:
                write_faulty_copy(bag, copy, signal, fault)
            except NlsidError:  # an angle is made of four numbers and cannot be scaled
                continue
            caught.append(flagged(config, copy, out))
    return {
        "test_bags": len(test),
        "false_alarms": sum(alarms),
        "broken": len(caught),
        "caught": sum(caught),
    }


def floors(robot: Robot, bags: list[Path], folder: Path, cache: Path) -> dict[str, Any]:
    """How many drives are flagged over DART_SPLITS random splits, by floor.

    Rubbery drives are those of the test split. Keys of `identification` and `funnel.level` are
    edited for these.
    """
    counts = {floor: [0, 0] for floor in ("rubbery", "control", "tape", "slippery")}
    errors, widths = [], []
    proposal = proposed(robot, bags)
    for seed in range(DART_SPLITS):
        content = proposal.content | {
            "identification": DART_MODEL,
            "funnel": proposal.content["funnel"] | DART_FUNNEL,
            "split": dart_split(bags, seed),
        }
        config = Config.model_validate(content)
        with tempfile.TemporaryDirectory() as name:
            out = Path(name)
            fit = identify_bags(bags, config, out, progress=silent)
            errors.append(fit.fit.errors["test"][fit.fit.chosen.method.name])
            made = design_funnel_files(out / documents.MODEL, config, out)
            catching = what_a_funnel_catches(out / documents.MODEL, config, made)
            widths.append(catching.widths[0].half_width if catching is not None else math.nan)
            for floor, count in counts.items():
                held = [
                    bag
                    for bag in dart_drives(folder, cache, floor)
                    if floor != "rubbery" or bag.name in config.split.test
                ]
                count[0] += sum(flagged(config, bag, out) for bag in held)
                count[1] += len(held)
    proposed_model = proposal.content["identification"]
    edited = len(DART_FUNNEL) + sum(
        DART_MODEL.get(key) != proposed_model.get(key) for key in DART_MODEL.keys() | proposed_model
    )
    return {
        "lines_of_yaml_edited": edited,
        "splits": DART_SPLITS,
        "split_errors": errors,
        "split_half_widths": widths,
        **{f"flagged_{floor}": f"{n} of {of}" for floor, (n, of) in counts.items()},
    }


def flagged(config: Config, bag: Path, out: Path) -> bool:
    """Whether a bag is outside or violates the assumption."""
    proved = documents.load_proved(out / documents.FUNNEL)
    replay = replay_bag(proved, bag, centre=config.monitor.nominal_source)
    return replay.verdict in (Status.OUTSIDE.value, Status.ASSUMPTION_VIOLATED.value)


def main() -> None:
    """Print the table, and with --json one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of recorded data")
    parser.add_argument("--json", action="store_true", help="last line is one JSON object")
    parser.add_argument("robots", nargs="*", help="parts of names; all by default")
    arguments = parser.parse_args()
    logging.getLogger("bags").setLevel(logging.ERROR)  # every bag's samples left out at its ends
    wanted = [
        r for r in ROBOTS if not arguments.robots or any(n in r.name for n in arguments.robots)
    ]
    print(f"{describe()}\n")
    print(
        f"{'':36s}{'edited':>7s}{'error %':>9s}"
        f"{'width/range':>12s}{'false':>8s}{'caught':>8s}{'min':>6s}"
    )
    rows = []
    for robot in wanted:
        row = measure(robot, arguments.data, cache=cache_folder())
        rows.append(row)
        print(line(row), flush=True)
    widths = [row["half_width_of_range"] for row in rows if "half_width_of_range" in row]
    narrow = sum(width <= 0.5 for width in widths)
    print(f"\n{narrow} of {len(widths)} tubes are at most half of the range")
    if arguments.json:
        print(json.dumps({"robots": rows, "narrow": narrow, "tubes": len(widths)}))


def line(row: dict[str, Any]) -> str:
    """One robot's row."""
    parts_of_row = [f"{row['robot']:36s}{row['lines_of_yaml_edited']:7d}"]
    parts_of_row.append(f"{row['test_error']:9.2f}" if "test_error" in row else f"{'-':>9s}")
    if "false_alarms" in row:
        false = f"{row['false_alarms']}/{row['test_bags']}"
        caught = f"{row['caught']}/{row['broken']}"
        parts_of_row.append(f"{row['half_width_of_range']:12.3f}{false:>8s}{caught:>8s}")
    else:
        width = row.get("half_width_of_range")
        parts_of_row.append(f"{'-' if width is None else f'{width:.3f}':>12s}{'-':>8s}{'-':>8s}")
    parts_of_row.append(f"{row.get('minutes', 0.0):6.2f}")
    floors_of_row = [f"{key}: {value}" for key, value in row.items() if key.startswith("flagged")]
    extras = [extra for extra in (*floors_of_row, row.get("refused", "")) if extra]
    parts_of_row.extend(f"\n    {extra}" for extra in extras)
    return "".join(parts_of_row)


if __name__ == "__main__":
    main()
