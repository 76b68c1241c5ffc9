"""`nlsid demo`: the chain on the shipped bags, step by step, then live where rclpy is there."""

import importlib.util
import math
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Final

from rich.console import Console

from bags import samples
from bags.chain.config import Config, load_config
from bags.chain.faults import FAULTS, ONSETS, write_faulty_copy
from bags.chain.shipped import config_file
from bags.chain.simulation import simulate_excitations, simulate_runs
from bags.chain.tracking_config import is_tracking, load_tracking_config
from bags.commands import designs_cli, models_cli, show, states
from bags.commands.options import CONFIG, details, progress_bar
from bags.designs import documents
from bags.monitoring.replay import Replay
from bags.pictures.report import drawable, write_margins
from nlsid_core.errors import DataError
from nlsid_core.proofs import check
from nlsid_core.running.reading import Status

OTHERS_PLOT = "others.png"
EXCITATIONS, RUNS = "excitations", "runs"  # folders of bags of simulated robots


@dataclass(frozen=True)
class Shown:
    """What a demo is of: the configuration, the bags it names, the trial that is played live.

    floors: other bags to be held against the tube, by what they are: True if they ought to be
    inside. Without them sabotaged copies of the test trials are. said: what to know of the robot.
    """

    config: str
    bags: Sequence[Path]
    live: str
    floors: Mapping[str, bool]
    said: str = ""


DEMOS: Final = {
    "f1tenth": lambda: Shown("f1tenth_driven.yaml", samples.f1tenth(), "trial_05", {}),
    "dart": lambda: Shown(
        "dart.yaml",
        samples.dart("rubbery"),
        "rubbery_20240927_162027",
        {"control": True, "tape": False, "slippery": False},
        "The tube is of the yaw rate. Below 3 m/s^2 of lateral acceleration no one can tell these "
        "floors apart, so that slow drives stay inside on any of them. Throttle to speed gave no "
        "usable tube: how fast the car is at a given throttle depends on the day, probably on the "
        "battery, more than on the floor. The controls were driven half a year later, in laps "
        "faster than any drive that the model was made of.",
    ),
}


def run_demo(out: Path, console: Console, robot: str) -> bool:
    """Run every step into `out`, saying what happens; True if all came out as it should.

    robot: one of DEMOS, or a simulated one, by the name of a shipped configuration or by its file.
    """
    if robot not in DEMOS:
        config = Path(robot) if robot.endswith(".yaml") else config_file(f"{robot}.yaml")
        return _simulated(config, out, console)

    console.quiet = details.quiet  # what the verbs print are details here
    try:
        return _driven(out, Console(), DEMOS[robot]())
    finally:
        console.quiet = False


def _driven(out: Path, console: Console, shown: Shown) -> bool:
    """Run every step on recordings that ship: what was found, and what it means."""
    out.mkdir(parents=True, exist_ok=True)
    config = config_file(shown.config).read_bytes()
    if any(out.iterdir()) and not (
        (out / CONFIG).is_file() and (out / CONFIG).read_bytes() == config
    ):
        raise DataError(f"{out} is there already and is not this demo's: give another --out")
    (out / CONFIG).write_bytes(config)
    settings = load_config(out / CONFIG)

    bags = shown.bags[0].parent
    _step(console, "1  identify a model from recordings", f"identify {out} {bags}")
    result = models_cli.identify_here(shown.bags, settings, out)
    show.say(console, f"{len(result.train)} recordings made it. {show.worth(result)}")
    show.say(console, "It simulates what will be measured from the commands alone.")

    _step(console, "2  prove a tube around it", f"funnel {out}")
    show.say(console, show.promise(designs_cli.tube(out, settings)))
    show.say(console, "A robot outside the tube does what it did in none of these trials.")

    _step(console, "3  check both proofs", f"check {out}")
    for name in (documents.MODEL_PROOF, documents.FUNNEL_PROOF):
        show.say(details, str(check(out / name)))
    show.say(
        console, "Both hold in exact arithmetic, with no solver: nobody needs to trust the search."
    )

    _step(console, "4  hold other recordings against the tube", f"monitor {out} BAG...")
    right, sentences = _monitor(console, shown, settings, out)

    _step(console, "5  the same live, over ROS 2", f"run monitor {out}")
    live = _live(console, shown, out)

    console.rule()
    show.say(console, f"{'; '.join(sentences)}.")
    show.say(console, f"Look at {out / OTHERS_PLOT} and {out / documents.REPORT}.")
    show.say(console, "Your own recordings: nlsid learn BAG... --out DIR")
    return right and live


def _simulated(config: Path, out: Path, console: Console) -> bool:
    """All steps on a simulated robot; whether its runs are inside."""
    if not is_tracking(config):
        raise DataError(f"{config}: no motion and no simulation; demos are of simulated robots")
    settings = load_tracking_config(config)
    excited = simulate_excitations(settings, out / EXCITATIONS)
    console.print(f"wrote {len(excited)} bags of excitations in {out / EXCITATIONS}")
    states.identify(excited, settings, out)
    runs = simulate_runs(out, settings, out / RUNS)
    console.print(f"wrote {len(runs)} bags of runs in {out / RUNS}")
    design = states.funnel(runs, settings, out)
    console.print(str(check(out / documents.FUNNEL_PROOF)), soft_wrap=True)
    replays = show.replayed(design, runs, None)
    show.say_replays(console, replays)
    inside = sum(replay.verdict == Status.INSIDE.value for replay in replays)
    console.print(f"{inside} of {len(runs)} bags are inside from first to last sample")
    return inside == len(runs)


def _monitor(console: Console, shown: Shown, settings: Config, out: Path) -> tuple[bool, list[str]]:
    """Hold the test trials against the tube, and what should be flagged.

    Whether all are right, and a sentence about each kind.
    """
    design = documents.load(out)
    test = [bag for bag in shown.bags if bag.name in settings.split.test]
    replays = show.replayed(design, test, settings)
    if drawable(replays):
        write_margins(out / documents.MARGIN_PLOT, replays)
    details.print(show.replay_table(replays))
    inside = sum(replay.verdict == Status.INSIDE.value for replay in replays)
    sentences = [f"{inside} of {len(replays)} healthy recordings inside"]
    show.say(console, sentences[0])

    right, every = inside == len(replays), []
    with tempfile.TemporaryDirectory() as folder:
        for what, bags in _others(shown, test, settings, Path(folder)).items():
            others = show.replayed(design, bags, settings)
            details.print(show.replay_table(others))
            said, all_flagged = _flagged(what, others)
            sentences.append(said)
            show.say(console, said)
            right = right and (shown.floors.get(what, False) or all_flagged)
            every += others
    if drawable(every):
        write_margins(out / OTHERS_PLOT, every)
    show.say(console, shown.said)
    return right, sentences


def _flagged(what: str, replays: Sequence[Replay]) -> tuple[str, bool]:
    """How many were flagged and how soon after the fault, and whether all were."""
    onset = ONSETS.get(what, math.inf)
    delays = [
        replay.first_bad.t - max(onset, replay.judged[0].t)
        for replay in replays
        if replay.first_bad is not None
    ]
    soon = f", half of them within {median(delays):.2f} s" if delays and onset < math.inf else ""
    return f"{what}: {len(delays)} of {len(replays)} caught{soon}", len(delays) == len(replays)


def _others(
    shown: Shown, test: Sequence[Path], settings: Config, folder: Path
) -> dict[str, list[Path]]:
    """Drives on other floors, or copies of the test trials with a broken sensor, in `folder`."""
    beside = shown.bags[0].parent
    if shown.floors:
        return {floor: sorted(beside.glob(f"{floor}_*")) for floor in shown.floors}
    signal = settings.signals.response[0].path
    copies: dict[str, list[Path]] = {}
    for what, fault in FAULTS.items():
        copies[what] = [folder / f"{bag.name}, {what}" for bag in test]
        for bag, copy in zip(test, copies[what], strict=True):
            write_faulty_copy(bag, copy, signal, fault)
    return copies


def _live(console: Console, shown: Shown, out: Path) -> bool:
    """Run the live part in processes of its own; True where ROS is not there to run it."""
    if importlib.util.find_spec("rclpy") is None:
        show.say(console, "skipped: there is no rclpy (pip install 'nlsid[ros]', or a ROS shell)")
        return True
    show.say(console, "Recorder, publisher, monitor and player run; two trials are played.")
    recording = out / "live"
    shutil.rmtree(recording, ignore_errors=True)
    trial = next(bag for bag in shown.bags if bag.name == shown.live)
    command = [  # a process: bags knows nothing of ROS
        *(sys.executable, "-m", "nlsid_ros.demo.live", "--funnel", str(out / documents.FUNNEL)),
        *("--bag", str(trial), "--out", str(recording)),
    ]
    with progress_bar("playing"):
        done = subprocess.run(command, check=False, capture_output=True, text=True)
    show.say(console, (done.stdout + done.stderr).strip())
    if done.returncode:
        show.say(console, f"to repeat this step alone: {shlex.join(['python', *command[1:]])}")
    return done.returncode == 0


def _step(console: Console, title: str, command: str) -> None:
    """A heading, and the command that does the same."""
    console.print()
    console.rule(title, align="left")
    show.say(console, f"$ nlsid {command}")
