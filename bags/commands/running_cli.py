"""A robot held against its funnel: `nlsid monitor`, `run`, `view` and `demo`.

A command imports what it runs when it is called.
"""

from __future__ import annotations

import importlib.util
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from bags.commands.options import (
    BagsArgument,
    ConfigOption,
    DefinitionsOption,
    DesignArgument,
    JsonOption,
    VerboseOption,
    Wired,
    err,
    out,
    settings_if_any,
)


@dataclass(frozen=True)
class Judging:
    """Which bags are judged, and where it is written."""

    every: Annotated[
        bool, typer.Option("--all", help="Judge the bags too that the design was made with.")
    ] = False
    definitions: DefinitionsOption = None
    picture: Annotated[
        Path | None, typer.Option("--out", help="The picture; default DIR/monitor.png.")
    ] = None
    as_json: JsonOption = False


def monitor(
    folder: DesignArgument,
    bags: BagsArgument,
    judging: Judging,
    wired: Wired,
    config: ConfigOption = None,
) -> None:
    """Hold recorded bags against a proved funnel of any kind: margin, worst axis, assumption used.

    Status 0: every bag is inside, and its errors are as small as assumed. Status 1: one is not, or
    raises the CUSUM alarm. Status 2: something was not judged. A tube of one output is drawn too.
    Of a bag with other topic names make a copy: `nlsid bag convert BAG --out NEW --rename OLD=NEW`.
    Bags that the design was made with are left out where there are others. -y, -u and --period
    say where state and input of a continuous funnel are.
    """
    from bags.commands import show
    from bags.designs import documents
    from bags.fleet.monitor import judged_of
    from bags.monitoring.replay import to_judge
    from bags.pictures.report import drawable, write_margins
    from bags.recordings.folders import expand_bags
    from nlsid_core.dynamics import VectorField
    from nlsid_core.errors import DataError

    settings = settings_if_any(folder, config)
    design = documents.load(folder, wiring=wired.wiring())
    if design.wiring is not None and not isinstance(design.model, VectorField):
        raise DataError(
            "-y, -u and --period are for designs of equations; this one reads the topics that it "
            "was identified with: `nlsid bag convert BAG... --out NEW --rename OLD=NEW`"
        )
    folders = expand_bags(bags)
    if settings is not None and not judging.every:
        chosen = to_judge(design, folders)
        folders = list(chosen.judged)
        for line in chosen.said:
            err.print(f"{line}; with --all these are judged too", soft_wrap=True, markup=False)
    replays = show.replayed(design, folders, settings, judging.definitions or ())
    target = judging.picture or folder / documents.MARGIN_PLOT
    if drawable(replays):
        write_margins(target, replays)
    if judging.as_json:
        pairs = zip(replays, folders, strict=True)
        typer.echo(json.dumps([judged_of(entry, bag, entry.name).cells for entry, bag in pairs]))
    else:
        show.say_replays(out, replays)
        if drawable(replays):
            out.print(f"wrote {target}", soft_wrap=True)
    if any(entry.first_bad is not None or entry.first_alarm is not None for entry in replays):
        raise typer.Exit(1)
    if any(entry.unjudged or not entry.judged for entry in replays):
        raise typer.Exit(2)


def run(
    workflow: Annotated[
        str,
        typer.Argument(
            metavar="WORKFLOW",
            help="monitor, record, control, excite or identify; none: lists their arguments.",
        ),
    ] = "",
    arguments: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[DIR] [NAME:=VALUE]...",
            help="A design's folder for monitor and control; the rest as for `ros2 launch`.",
        ),
    ] = None,
) -> None:
    """Start the nodes of a workflow and end them together. It needs rclpy, but no ROS launch."""
    from bags.commands.launching import WORKFLOWS, launch_file, run_together

    _refuse_without_rclpy()
    if not workflow:
        for name in WORKFLOWS:
            typer.echo(str(launch_file(name)))
        raise typer.Exit(2)
    if workflow not in WORKFLOWS:
        raise typer.BadParameter(f"no workflow '{workflow}'; there are: {', '.join(WORKFLOWS)}")
    given = arguments or []
    if given and ":=" not in given[0]:  # a design's folder
        design = Path(given[0]).absolute()
        proofs = (design if design.is_dir() else design.parent).glob("*.proof.json")
        if workflow in ("monitor", "control") and not any(proofs):
            raise typer.BadParameter(f"{given[0]}: no design is there; `nlsid learn` makes one")
        given[0] = f"funnel:={design}"
    commands = launch_file(workflow).commands(given)
    raise typer.Exit(run_together(commands, respawn="respawn:=true" in given))


run_app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
run_app.command()(run)


def _refuse_without_rclpy() -> None:
    if importlib.util.find_spec("rclpy") is None:
        raise typer.BadParameter("rclpy is not installed (pip install 'nlsid[ros]')")


@dataclass(frozen=True)
class Serving:
    """Where the page is served, and what is on it."""

    host: Annotated[
        str, typer.Option(help="Address to serve on; 0.0.0.0: everyone on the network may look.")
    ] = "127.0.0.1"
    port: Annotated[int, typer.Option(help="Port; 0: one that is free.", min=0, max=65535)] = 8080
    monitor: Annotated[str, typer.Option(help="The node that is shown.")] = "funnel_monitor"
    rate: Annotated[
        float, typer.Option(help="For a recording: speed, 1 as recorded.", min=0.01, max=100.0)
    ] = 1.0


def view(
    serving: Serving,
    wired: Wired,
    folder: Annotated[
        Path | None,
        typer.Argument(metavar="[DIR]", help="A recording's design; none: the live robot."),
    ] = None,
    bag: Annotated[Path | None, typer.Argument(metavar="[BAG]", help="What is replayed.")] = None,
    config: ConfigOption = None,
) -> None:
    """Serve a page of tube, signals, margin and events, live or of a recording, until Ctrl-C."""
    from bags.commands.viewing import view_live, view_recording

    if folder is None:
        _refuse_without_rclpy()
        raise typer.Exit(view_live(serving.monitor, host=serving.host, port=serving.port))
    if bag is None:
        raise typer.BadParameter("give a recording that is held against the design, or neither")
    from bags.commands import show
    from bags.designs import documents
    from bags.viewing.replay import Recording

    centre = show.centre_of(settings_if_any(folder, config))
    design = documents.load(folder, wiring=wired.wiring())
    recording = Recording(design, bag, centre=centre)
    view_recording(recording, serving.rate, host=serving.host, port=serving.port)


def demo(
    out_dir: Annotated[
        Path, typer.Option("--out", help="Folder for everything the demo makes.")
    ] = Path("nlsid-demo"),
    robot: Annotated[
        str,
        typer.Option(
            help="f1tenth, a car's speed; dart, a car's yaw rate on three floors; pendulum or arm, "
            "simulated in MuJoCo (extra `sim`), or the YAML of another that is."
        ),
    ] = "f1tenth",
    _verbose: VerboseOption = False,
) -> None:
    """Run the whole chain on recordings that ship, then live over ROS 2 where rclpy is there.

    A simulated robot is recorded first, and again with its policy, to measure the disturbance.
    """
    from bags.commands.demo import run_demo

    if not run_demo(out_dir, out, robot):
        raise typer.Exit(1)
