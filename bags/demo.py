"""`nlsid demo`: the chain on the shipped bags, step by step, then live where rclpy is there."""

import importlib.util
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.progress import track

from bags import documents, samples, show
from bags.config import load_config
from bags.faults import FAULTS, write_faulty_copy
from bags.replay import Replay, replay_bag
from bags.report import report_available, write_margins
from bags.shipped import config_file
from bags.steps import design_funnel_files, identify_bags
from nlsid_core.certificate import check
from nlsid_core.monitor import Status

LIVE_MODULE = "nlsid_ros.live"  # started as a process: bags knows nothing of ROS
LIVE_TRIAL = "trial_05"
SABOTAGED_PLOT = "sabotaged.png"


def run_demo(out: Path, console: Console) -> bool:
    """Run every step into `out`, saying what happens; True if all came out as it should."""
    started = time.perf_counter()
    config_path = config_file("f1tenth.yaml")
    config = load_config(config_path)
    bags = samples.f1tenth()
    test = [bag for bag in bags if bag.name in config.split.test]

    console.rule("1  identify", align="left")
    console.print(
        f"$ nlsid identify {bags[0].parent} --config {config_path} --out {out}",
        soft_wrap=True,
        highlight=False,
    )
    with console.status("identifying") as status:
        result = identify_bags(bags, config, out, progress=lambda what, _: status.update(what))
    console.print(show.methods_table(result.fit, result.test))
    if not report_available():
        console.print("no report and no pictures: install matplotlib (pip install 'nlsid[report]')")

    console.rule("2  funnel", align="left")
    console.print(
        f"$ nlsid funnel --model {out / documents.MODEL} --config {config_path} --out {out}",
        soft_wrap=True,
        highlight=False,
    )
    console.print(show.funnel_table(design_funnel_files(out / documents.MODEL, config, out)))

    console.rule("3  check", align="left")
    for name in (documents.MODEL_PROOF, documents.FUNNEL_PROOF):
        console.print(f"$ nlsid check {out / name}", soft_wrap=True, highlight=False)
        console.print(str(check(out / name)), soft_wrap=True)

    console.rule("4  monitor", align="left")
    console.print(
        f"$ nlsid monitor --funnel {out / documents.FUNNEL} --replay <the 8 test trials>",
        soft_wrap=True,
        highlight=False,
    )
    proved = documents.load_proved_funnel(out / documents.FUNNEL)
    nominal = config.monitor.nominal_source
    replays = [replay_bag(proved, bag, nominal=nominal) for bag in test]
    console.print(show.replay_table(replays))
    signal = config.signals.response.path
    sabotaged: list[Replay] = []
    with tempfile.TemporaryDirectory() as folder:
        pairs = [(bag, fault) for bag in test for fault in FAULTS]
        for bag, fault in track(pairs, description="sabotaging", console=console, transient=True):
            copy = Path(folder) / f"{bag.name}, {fault}"
            write_faulty_copy(bag, copy, signal, FAULTS[fault])
            sabotaged.append(replay_bag(proved, copy, nominal=nominal))
    console.print(show.caught_table(sabotaged))
    if report_available():
        write_margins(out / documents.MARGIN_PLOT, replays)
        write_margins(out / SABOTAGED_PLOT, sabotaged)

    inside = sum(r.verdict == Status.INSIDE.value for r in replays)
    caught = sum(r.first_bad is not None for r in sabotaged)
    console.print(f"{inside} of {len(replays)} test trials inside, "
                  f"{caught} of {len(sabotaged)} sabotaged trials caught")  # fmt: skip
    live = _live(out, console)

    console.rule("done", align="left")
    if report_available():
        console.print(f"report    {out / documents.REPORT}", soft_wrap=True)
        console.print(f"pictures  {out / documents.MARGIN_PLOT}, {out / SABOTAGED_PLOT}",
                      soft_wrap=True)  # fmt: skip
    console.print(f"proofs    {out / documents.MODEL_PROOF}, {out / documents.FUNNEL_PROOF}",
                  soft_wrap=True)  # fmt: skip
    console.print(f"{time.perf_counter() - started:.0f} s in all")
    return inside == len(replays) and caught == len(sabotaged) and live


def _live(out: Path, console: Console) -> bool:
    """The live part in processes of its own; True where ROS is not there to run it."""
    console.rule("5  live, over ROS 2", align="left")
    if importlib.util.find_spec("rclpy") is None:
        console.print("skipped: rclpy is not installed (pip install 'nlsid[ros]', or a ROS shell)")
        return True
    recording = out / "live"
    shutil.rmtree(recording, ignore_errors=True)
    trial = next(bag for bag in samples.f1tenth() if bag.name == LIVE_TRIAL)
    command = [
        sys.executable, "-m", LIVE_MODULE,
        "--funnel", str(out / documents.FUNNEL), "--bag", str(trial), "--out", str(recording),
    ]  # fmt: skip
    return subprocess.run(command, check=False).returncode == 0
