"""A robot held against its funnel: `nlsid monitor`, `live`, `call`, `view` and `demo`.

A command imports what it runs when it is called.
"""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from bags.commands.bag_cli import JsonOption
from bags.commands.options import (
    BagsArgument,
    CommandOption,
    PeriodOption,
    ResponseOption,
    err,
    out,
)
from bags.commands.progress import progress_bar


def monitor(
    bags: BagsArgument,
    funnel: Annotated[Path, typer.Option(help="The funnel.json that `nlsid funnel` wrote.")],
    replay: Annotated[
        bool, typer.Option("--replay", help="Replay the bags (live monitoring is funnel_monitor).")
    ] = False,
    config: Annotated[
        Path | None,
        typer.Option(help="Takes `monitor.nominal`, `definitions`; without it all are judged."),
    ] = None,
    definitions: Annotated[
        list[Path] | None, typer.Option(help=".msg files that the bags do not define.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Where to draw; default monitor.png beside the funnel.")
    ] = None,
    forecast: Annotated[
        float, typer.Option(min=0.0, help="Seconds ahead: also what the outputs could have been.")
    ] = 0.0,
    response: ResponseOption = None,
    command: CommandOption = None,
    period: PeriodOption = 0.0,
    as_json: JsonOption = False,
) -> None:
    """Hold recorded bags against a proved funnel of any kind: margin, worst axis, assumption used.

    Status 0 if all of every bag is inside with the assumption kept, 1 if one is outside, breaks the
    assumption or raises the CUSUM alarm, 2 if something was not judged. A tube of one output is
    drawn too.
    """
    from bags.chain.config import load_config
    from bags.commands import show
    from bags.designs import documents
    from bags.designs.design import Wiring
    from bags.fleet.monitor import judged_of
    from bags.monitoring.replay import replay_bag, to_judge
    from bags.pictures.report import report_available, write_margins
    from bags.recordings.definitions import read_definitions
    from bags.recordings.folders import expand_bags

    if not replay:
        raise typer.BadParameter(
            "give --replay; a live robot is watched by the node funnel_monitor"
        )
    settings = load_config(config) if config is not None else None
    wiring = Wiring.parse_if_any(response or [], command or [], period)
    proved = documents.load_proved(funnel, wiring=wiring)
    folders = expand_bags(bags)
    if settings is not None:
        chosen = to_judge(proved.design, folders, validation=settings.split.validation)
        folders = list(chosen.judged)
        for line in chosen.said:
            err.print(f"{line}; without --config all are judged", soft_wrap=True, markup=False)
    types = read_definitions([*(definitions or []), *(settings.definitions if settings else ())])
    centre = show.centre_of(settings)
    with progress_bar("replaying") as progress:
        replays = []
        for done, bag in enumerate(folders):
            progress(bag.name, done / len(folders))
            replays.append(
                replay_bag(proved, bag, centre=centre, definitions=types, forecast=forecast)
            )
        progress("drawing", 1.0)
        picture = plot or funnel.with_name(documents.MARGIN_PLOT)
        is_judged = any(entry.judged for entry in replays)
        drawn = report_available() and is_judged and all(entry.half_width for entry in replays)
        if drawn:
            write_margins(picture, replays)
    if as_json:
        pairs = zip(replays, folders, strict=True)
        typer.echo(json.dumps([asdict(judged_of(entry, bag, entry.name)) for entry, bag in pairs]))
    else:
        out.print(show.replay_table(replays))
    for entry in [] if as_json else replays:
        seen = show.forecasts(entry, proved.design) if forecast else ()
        for line in (*seen, *show.replay_lines(entry)):
            out.print(line, soft_wrap=True, markup=False, highlight=False)
    for line in () if as_json else show.paced_lines(replays):
        out.print(line, soft_wrap=True, markup=False, highlight=False)
    if drawn and not as_json:
        out.print(f"wrote {picture}", soft_wrap=True)
    if any(entry.first_bad is not None or entry.first_alarm is not None for entry in replays):
        raise typer.Exit(1)
    if any(entry.unjudged or not entry.judged for entry in replays):
        raise typer.Exit(2)


def live(
    workflow: Annotated[
        str, typer.Argument(help="monitor, closed_loop or identify; none: lists their arguments.")
    ] = "",
    arguments: Annotated[
        list[str] | None,
        typer.Argument(help="NAME:=VALUE, as for `ros2 launch`; none: lists them."),
    ] = None,
    one_process: Annotated[
        bool, typer.Option("--one-process", help="All nodes in one process, on one executor.")
    ] = False,
) -> None:
    """Start a workflow's nodes and end them together: no ROS launch needed, rclpy is."""
    from bags.chain.shipped import shipped_file
    from bags.commands.launching import WORKFLOWS, LaunchFile, in_one_process, run_together

    if importlib.util.find_spec("rclpy") is None:
        raise typer.BadParameter("rclpy is not installed (pip install 'nlsid[ros]')")
    if not workflow:
        for name in WORKFLOWS:
            typer.echo(str(LaunchFile(shipped_file("launch", f"{name}.launch.xml"))))
        raise typer.Exit(2)
    if workflow not in WORKFLOWS:
        raise typer.BadParameter(f"no workflow '{workflow}'; there are: {', '.join(WORKFLOWS)}")
    launch = LaunchFile(shipped_file("launch", f"{workflow}.launch.xml"))
    commands = launch.commands(arguments or [])
    raise typer.Exit(run_together([in_one_process(commands)] if one_process else commands))


def call(
    service: Annotated[
        str, typer.Argument(help="As /excitation/start; none: lists what there is.")
    ] = "",
) -> None:
    """Call a service of a running node (std_srvs/Trigger), as `ros2 service call` does.

    Status 0: done, 1: refused, 2: nobody answered.
    """
    from bags.commands.launching import run_together

    if importlib.util.find_spec("rclpy") is None:
        raise typer.BadParameter("rclpy is not installed (pip install 'nlsid[ros]')")
    given = [service] if service else []
    raise typer.Exit(run_together([[sys.executable, "-m", "nlsid_ros.calling", *given]]))


def view(
    bag: Annotated[
        Path | None, typer.Argument(help="A recording to replay; none: the live robot.")
    ] = None,
    host: Annotated[
        str, typer.Option(help="Address to serve on; 0.0.0.0: everyone on the network may look.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port; 0: one that is free.", min=0, max=65535)] = 8080,
    monitor: Annotated[str, typer.Option(help="The node that is shown.")] = "funnel_monitor",
    funnel: Annotated[
        Path | None, typer.Option(help="For a recording: the funnel it is held against.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="For a recording: takes `monitor.nominal`.")
    ] = None,
    rate: Annotated[
        float, typer.Option(help="For a recording: speed, 1 as recorded.", min=0.01, max=100.0)
    ] = 1.0,
    response: ResponseOption = None,
    command: CommandOption = None,
    period: PeriodOption = 0.0,
) -> None:
    """Serve a page of tube, signals, margin and events, live or of a recording, until Ctrl-C."""
    from bags.commands.viewing import view_live, view_recording

    if bag is None:
        if importlib.util.find_spec("rclpy") is None:
            raise typer.BadParameter("rclpy is not installed (pip install 'nlsid[ros]')")
        raise typer.Exit(view_live(monitor, host=host, port=port))
    if funnel is None:
        raise typer.BadParameter("a recording is held against a funnel: give --funnel")
    from bags.chain.config import load_config
    from bags.commands import show
    from bags.designs import documents
    from bags.designs.design import Wiring
    from bags.viewing.replay import Recording

    centre = show.centre_of(load_config(config) if config is not None else None)
    wiring = Wiring.parse_if_any(response or [], command or [], period)
    recording = Recording(documents.load_proved(funnel, wiring=wiring), bag, centre=centre)
    view_recording(recording, rate, host=host, port=port)


def demo(
    out_dir: Annotated[
        Path, typer.Option("--out", help="Folder for everything the demo makes.")
    ] = Path("nlsid-demo"),
    robot: Annotated[
        str, typer.Option(help="f1tenth, a car's speed; dart, a car's yaw rate on three floors.")
    ] = "f1tenth",
) -> None:
    """Run the whole chain on the shipped bags, then live over ROS 2 where rclpy is there."""
    from bags.commands.demo import run_demo

    if not run_demo(out_dir, out, robot):
        raise typer.Exit(1)
