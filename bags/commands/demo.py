"""`nlsid demo`: the chain on the shipped bags, step by step, then live where rclpy is there."""

import importlib.util
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rich.console import Console

from bags import samples
from bags.chain.config import Config, load_config
from bags.chain.faults import FAULTS, write_faulty_copy
from bags.chain.shipped import config_file
from bags.chain.simulation import simulate_excitations, simulate_runs
from bags.chain.steps import design_funnel_files, identify_bags, what_a_funnel_catches
from bags.chain.tracking_config import is_tracking, load_tracking_config
from bags.commands import show, states
from bags.commands.options import CONFIG
from bags.commands.progress import progress_bar
from bags.designs import documents
from bags.monitoring.replay import Replay
from bags.pictures.report import report_available, write_catching, write_margins
from nlsid_core.errors import DataError
from nlsid_core.proofs import check
from nlsid_core.running.reading import Status

LIVE_MODULE = "nlsid_ros.demo.live"  # started as a process: bags knows nothing of ROS
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
    started = time.perf_counter()
    demo = _Demo(out, console, DEMOS[robot]())
    demo.identify()
    demo.funnel()
    demo.check()
    monitored = demo.monitor()
    live = demo.live()
    demo.where_to_look()
    console.print(f"{time.perf_counter() - started:.0f} s in all")
    return monitored and live


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


class _Demo:
    """The steps, each under its own heading with the command that does the same."""

    def __init__(self, out: Path, console: Console, shown: Shown) -> None:
        self.out, self.console, self.shown = out, console, shown
        self.config_path = config_file(shown.config)
        self.config: Config = load_config(self.config_path)
        self.bags = shown.bags

    def identify(self) -> None:
        self._heading("1  identify a model from the recordings")
        self._command(f"identify {self.out} {self.bags[0].parent}")
        self.out.mkdir(parents=True, exist_ok=True)
        shutil.copy(self.config_path, self.out / CONFIG)
        with progress_bar("identifying") as progress:
            result = identify_bags(self.bags, self.config, self.out, progress=progress)
        self.console.print(show.methods_table(result.fit, result.test))
        if not report_available():
            self._say("no report and no pictures: install matplotlib (pip install 'nlsid[report]')")

    def funnel(self) -> None:
        self._heading("2  design a tube, and see what it would catch")
        model = self.out / documents.MODEL
        self._command(f"funnel {self.out}")
        with progress_bar("designing policy, observer and tube"):
            design = design_funnel_files(model, self.config, self.out)
            catching = what_a_funnel_catches(model, self.config, design)
        self.console.print(show.funnel_table(design))
        if catching is not None:
            show.say_catching(self.console, catching)
            write_catching(self.out, catching)

    def check(self) -> None:
        self._heading("3  check both proofs, exactly and without a solver")
        self._command(f"check {self.out}")
        for name in (documents.MODEL_PROOF, documents.FUNNEL_PROOF):
            self._say(str(check(self.out / name)))

    def monitor(self) -> bool:
        self._heading("4  hold unseen recordings against the tube")
        test = [bag for bag in self.bags if bag.name in self.config.split.test]
        self._command(f"monitor {self.out} BAG... ({len(test)} trials)")
        replays = self._replay(test)
        if report_available():
            write_margins(self.out / documents.MARGIN_PLOT, replays)
        self.console.print(show.replay_table(replays))
        inside = sum(r.verdict == Status.INSIDE.value for r in replays)
        self._say(f"{inside} of {len(replays)} test trials inside")
        others = self._floors() if self.shown.floors else self._sabotaged(test)
        return others and inside == len(replays)

    def _sabotaged(self, test: Sequence[Path]) -> bool:
        """Copies of the test trials with a broken sensor; whether each is caught."""
        signal = self.config.signals.response[0].path
        with tempfile.TemporaryDirectory() as folder:
            copies = {Path(folder) / f"{b.name}, {f}": (b, f) for b in test for f in FAULTS}
            for copy, (bag, fault) in copies.items():
                write_faulty_copy(bag, copy, signal, FAULTS[fault])
            sabotaged = self._replay(list(copies))
        if report_available():
            write_margins(self.out / OTHERS_PLOT, sabotaged)
        self.console.print(show.caught_table(sabotaged))
        caught = sum(r.first_bad is not None for r in sabotaged)
        self._say(f"{caught} of {len(sabotaged)} sabotaged trials caught")
        return caught == len(sabotaged)

    def _floors(self) -> bool:
        """Drives on other floors; whether every one that is to be flagged is."""
        folder, right, every = self.bags[0].parent, True, []
        for floor, is_inside in self.shown.floors.items():
            replays = self._replay(sorted(folder.glob(f"{floor}_*")))
            self.console.print(show.replay_table(replays))
            flagged = [replay for replay in replays if replay.first_bad is not None]
            self._say(f"{floor}: {len(flagged)} of {len(replays)} flagged")
            for replay in flagged:
                self._say(f"  {replay.name}: {replay.reason}")
            right = right and (is_inside or len(flagged) == len(replays))
            every += replays
        if report_available():
            write_margins(self.out / OTHERS_PLOT, every)
        self._say(self.shown.said)
        return right

    def live(self) -> bool:
        """The live part in processes of its own; True where ROS is not there to run it."""
        self._heading("5  the same live, over ROS 2")
        if importlib.util.find_spec("rclpy") is None:
            self._say("skipped: rclpy is not installed (pip install 'nlsid[ros]', or a ROS shell)")
            return True
        self._say("recorder, publisher, monitor and player as processes; two trials in real time")
        recording = self.out / "live"
        shutil.rmtree(recording, ignore_errors=True)
        trial = next(bag for bag in self.bags if bag.name == self.shown.live)
        command = [
            *(sys.executable, "-m", LIVE_MODULE, "--funnel", str(self.out / documents.FUNNEL)),
            *("--bag", str(trial), "--out", str(recording)),
        ]
        with progress_bar("playing"):
            done = subprocess.run(command, check=False, capture_output=True, text=True)
        self._say((done.stdout + done.stderr).strip())
        if done.returncode:
            self._say("to repeat this step alone:")
            self._say(shlex.join(["python", *command[1:]]))
        return done.returncode == 0

    def where_to_look(self) -> None:
        self._heading("where to look")
        if report_available():
            self._say(f"report    {self.out / documents.REPORT}")
            self._say(f"pictures  {self.out / documents.MARGIN_PLOT}, {self.out / OTHERS_PLOT}")
        self._say(f"proofs    {self.out / documents.MODEL_PROOF}")
        self._say(f"          {self.out / documents.FUNNEL_PROOF}")

    def _replay(self, bags: Sequence[Path]) -> list[Replay]:
        return show.replayed(documents.load(self.out), bags, self.config)

    def _heading(self, text: str) -> None:
        self.console.print()
        self.console.rule(text, align="left")

    def _command(self, text: str) -> None:
        self.console.print(f"$ nlsid {text}", soft_wrap=True, highlight=False, markup=False)

    def _say(self, text: str) -> None:
        self.console.print(text, soft_wrap=True, highlight=False, markup=False)
