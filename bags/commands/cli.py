"""The command line `nlsid`: the chain's verbs, and `bag` and `track` with verbs of their own.

A command imports what it runs when it is called: `nlsid check` needs no NumPy, `--help` nothing.
"""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape

from bags.commands.bag_cli import JsonOption, bag_app
from bags.commands.config_cli import config_app
from bags.commands.fleet_cli import (
    PatienceOption,
    SchedulerOption,
    StrictOption,
    WorkersOption,
    fleet_app,
)
from bags.commands.progress import progress_bar
from bags.commands.tracking_cli import app as track_app
from nlsid_core import kernel
from nlsid_core import second as second_kernel
from nlsid_core.errors import CertificateRejected, DataError, NlsidError

if TYPE_CHECKING:
    from bags.fleet.workers import Workers

# The matrices of a search are small: threads for them wait for each other, ten times as long.
os.environ.setdefault("OMP_NUM_THREADS", "1")

app = typer.Typer(
    name="nlsid",
    help="From a recorded bag to a proved model, a proved tracking tube and a monitor.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.add_typer(track_app, name="track")
app.add_typer(bag_app)
app.add_typer(config_app)
app.add_typer(fleet_app)
out = Console()
err = Console(stderr=True)

BagsArgument = Annotated[
    list[Path],
    typer.Argument(help="Bags: rosbag2 folders, .mcap files, folders of bags, URLs (s3://...)."),
]
ConfigOption = Annotated[Path, typer.Option(help="The robot's YAML configuration.")]
ResponseOption = Annotated[
    list[str] | None, typer.Option(help="topic:field of a continuous funnel's state; repeat.")
]
CommandOption = Annotated[
    list[str] | None, typer.Option(help="topic:field of a continuous funnel's input; repeat.")
]
PeriodOption = Annotated[float, typer.Option(help="Seconds between a continuous funnel's samples.")]
OutOption = Annotated[
    Path, typer.Option("--out", help="Folder for the results; made if it is not there.")
]


def _say_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"nlsid {version('nlsid')}")
        raise typer.Exit


@app.callback()
def nlsid(
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_say_version, is_eager=True, help="Say which it is."),
    ] = False,
) -> None:
    """From a recorded bag to a proved model, a proved tracking tube and a monitor."""


@app.command()
def init(
    out_file: Annotated[
        Path, typer.Option("--out", help="The YAML to write; must not be there yet.")
    ],
    bags: Annotated[
        list[Path] | None, typer.Argument(help="Bags, or folders of bags; none with --live.")
    ] = None,
    response: Annotated[
        list[str] | None, typer.Option("--response", "-y", help="What answers; repeat.")
    ] = None,
    excitation: Annotated[
        list[str] | None, typer.Option("--excitation", "-u", help="What drives it; repeat.")
    ] = None,
    definitions: Annotated[
        list[Path] | None, typer.Option(help=".msg files that the bags do not define.")
    ] = None,
    robot: Annotated[str, typer.Option(help="What people call it.")] = "robot",
    yes: Annotated[bool, typer.Option("--yes", help="Take the likeliest signals.")] = False,
    live: Annotated[
        bool, typer.Option("--live", help="Look at the running robot's topics instead of bags.")
    ] = False,
    seconds: Annotated[
        float, typer.Option(min=1.0, max=600.0, help="To listen with --live; let the robot move.")
    ] = 10.0,
) -> None:
    """Write a first configuration from bags: signals, clock, period, gaps, split, lags, tube.

    It is tried on the bags, every key says why, and what later steps will meet is said first.
    """
    import tempfile

    from bags.commands.init import run_init
    from bags.commands.listening import listen

    if live is bool(bags):
        raise typer.BadParameter("give bags, or --live for the robot that is running")
    if out_file.exists():
        raise DataError(f"{out_file} exists already; give another name, or remove it")
    with tempfile.TemporaryDirectory() as folder:
        if live:
            out.print(f"listening for {seconds:g} s; let the robot move", soft_wrap=True)
        run_init(
            out,
            [listen(Path(folder) / "heard", seconds)] if live else bags or [],
            out_file,
            responses=response or (),
            excitations=excitation or (),
            definitions=definitions or (),
            robot=robot,
            yes=yes,
            live=live,
        )


@app.command()
def identify(
    bags: BagsArgument,
    config: ConfigOption,
    out_dir: OutOption,
    workers: WorkersOption = 0,
    scheduler: SchedulerOption = "",
    strict: StrictOption = False,
    patience: PatienceOption = 60.0,
) -> None:
    """Identify a model from bags and prove it stable: model.json, model.proof.json, report.html.

    Bags in object storage, or with --workers or --scheduler: each is read by a worker, one that
    cannot be used is listed and left out, and the next run reads only what is new.
    """
    from bags.chain.config import load_config
    from bags.chain.steps import identify_bags
    from bags.commands import fleet_cli, show
    from bags.fleet.workers import Workers
    from bags.recordings.folders import expand_bags
    from bags.recordings.remote import is_url

    settings = load_config(config)
    if workers or scheduler or strict or any(map(is_url, bags)):
        reading = fleet_cli.Reading(Workers(workers, scheduler), strict, patience)
        fleet_cli.identify(out, bags, settings, out_dir, reading)
        return
    folders = expand_bags(bags)
    with progress_bar("identifying") as progress:
        result = identify_bags(folders, settings, out_dir, progress=progress)
    show.say_identified(out, result)


LagsOption = Annotated[list[int] | None, typer.Option(help="Numbers of lags to try, repeatable.")]


@app.command()
def select(
    bags: BagsArgument,
    config: ConfigOption,
    out_dir: OutOption,
    lags: LagsOption = None,
    workers: WorkersOption = 0,
    scheduler: SchedulerOption = "",
    strict: StrictOption = False,
    patience: PatienceOption = 60.0,
) -> None:
    """Choose orders and bases by the error on validation bags, and write the best model.

    What is tried: the configuration's `select`, or --lags. Workers read the bags as for `identify`,
    and then try what is to be tried beside each other.
    """
    from bags.chain.choosing import select_bags
    from bags.chain.config import load_config
    from bags.commands import fleet_cli, show
    from bags.fleet.workers import Workers
    from bags.recordings.folders import expand_bags
    from bags.recordings.remote import is_url

    settings = load_config(config)
    options = {"lags": lags} if lags else None
    if workers or scheduler or strict or any(map(is_url, bags)):
        reading = fleet_cli.Reading(Workers(workers, scheduler), strict, patience)
        fleet_cli.select(out, bags, settings, out_dir, reading, options)
        return
    folders = expand_bags(bags)
    with progress_bar("selecting") as progress:
        result = select_bags(folders, settings, out_dir, options=options, progress=progress)
    show.say_selected(out, result)


@app.command()
def compare(
    bags: BagsArgument,
    config: ConfigOption,
    lags: LagsOption = None,
    out_dir: Annotated[
        Path | None, typer.Option("--out", help="Folder for a picture of the test errors.")
    ] = None,
) -> None:
    """Score every method on the same test bags: simulation, prediction, residual tests, proof.

    What is compared: the configuration's `compare`, a list of model classes, or else the one it
    identifies, with --lags at each number of lags.
    """
    from bags.chain.choosing import compare_bags
    from bags.chain.config import load_config
    from bags.commands import show
    from bags.designs import documents
    from bags.pictures.report import report_available
    from bags.recordings.folders import expand_bags

    settings = load_config(config)
    folders = expand_bags(bags)
    with progress_bar("comparing") as progress:
        compared = compare_bags(folders, settings, lags=lags or (), progress=progress)
    out.print(show.comparison_table(compared))
    for refusal in compared.refusals:
        out.print(f"no model: {escape(refusal)}", soft_wrap=True)
    if out_dir is not None and report_available():
        out_dir.mkdir(parents=True, exist_ok=True)
        compared.draw(out_dir / documents.COMPARISON_PLOT)
        out.print(f"wrote {out_dir / documents.COMPARISON_PLOT}", soft_wrap=True)


@app.command()
def funnel(
    out_dir: OutOption,
    model: Annotated[
        Path | None, typer.Option(help="The model.json that `nlsid identify` wrote.")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="The robot's YAML configuration.")] = None,
    problem: Annotated[
        Path | None,
        typer.Option(help="Dynamics, nominal and goal in a file; instead of model and config."),
    ] = None,
    require: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="Status 1 if a half-width is more than this part of its output's range."
        ),
    ] = None,
    workers: WorkersOption = 0,
    scheduler: SchedulerOption = "",
) -> None:
    """Design a proved funnel: funnel.json, funnel.proof.json, and policy.json if it has a policy.

    Around the simulation of an identified model of any class, and a plan of a linear one (--model,
    --config with a profile), or a trajectory of given dynamics (--problem). Of an identified model
    it says what it catches: faults put into the test trials, through the monitor. --workers and
    --scheduler share the L-steps of a --problem of shape P.
    """
    from bags.chain.config import load_config
    from bags.chain.steps import design_funnel_files, what_a_funnel_catches
    from bags.commands import show
    from bags.designs import documents
    from bags.fleet.workers import Workers
    from bags.pictures.report import write_catching

    if problem is not None:
        if not (model is None and config is None and require is None):
            raise typer.BadParameter(
                "--problem stands alone; it takes no --model, no --config and no --require"
            )
        _funnel_around_trajectory(problem, out_dir, Workers(workers, scheduler))
        return
    if workers or scheduler:
        raise typer.BadParameter("--workers and --scheduler share the search of a --problem")
    if model is None or config is None:
        raise typer.BadParameter("give --model and --config, or --problem")
    settings = load_config(config)
    with progress_bar("designing") as progress:
        progress("policy, observer and tube", 0.1)
        design = design_funnel_files(model, settings, out_dir)
        progress("sabotaging the test trials", 0.7)
        catching = what_a_funnel_catches(model, settings, design)
        progress("done", 1.0)
    out.print(show.funnel_table(design))
    if catching is None:
        out.print(f"what it catches is not known: no test trials in {documents.HELD_BACK}")
        if require is not None:
            raise typer.Exit(2)
    else:
        show.say_catching(out, catching, require)
    for path in (
        *(out_dir / name for name in design.documents()),
        *([] if catching is None else write_catching(out_dir, catching)),
    ):
        out.print(f"wrote {path}", soft_wrap=True)
    if catching is not None and require is not None and not catching.widest.share <= require:
        raise typer.Exit(1)


@app.command()
def push(
    bags: BagsArgument,
    problem: Annotated[Path, typer.Option(help="The problem whose equations are compared.")],
    out_file: Annotated[Path, typer.Option("--out", help="The problem to write, with its push.")],
    response: Annotated[list[str], typer.Option("--response", "-y", help="A state; repeat.")],
    command: Annotated[list[str], typer.Option("--command", "-u", help="An input; repeat.")],
    period: Annotated[
        float, typer.Option(help="Seconds between samples; default: as they come.")
    ] = 0.0,
    seconds: Annotated[
        float, typer.Option(min=0.0, help="Over which a push is averaged; default one sample.")
    ] = 0.0,
    safety_factor: Annotated[
        float, typer.Option(min=1.0, help="Of the box over the largest push that was measured.")
    ] = 1.5,
    resample: Annotated[
        str, typer.Option(help="none, last or linear: see grid.resample.")
    ] = "none",
) -> None:
    """Measure on bags how far a problem's equations are off; `nlsid funnel` proves with that.

    States and inputs in the equations' order and units. The problem that is written has a member
    `push`: the largest of each trial with its digest.
    """
    from bags.chain.problems import measured
    from bags.commands import show
    from bags.recordings.folders import expand_bags
    from nlsid_core import files

    given, broken = measured(
        problem, expand_bags(bags), responses=response, excitations=command, period=period or None,
        seconds=seconds or None, safety_factor=safety_factor, resample=resample,
    )  # fmt: skip
    files.write_document(out_file, given.document())
    assert given.push is not None  # `measured` has just measured it
    out.print(str(given.push), soft_wrap=True, markup=False)
    out.print(show.breaking_table(broken))
    out.print(f"wrote {out_file}", soft_wrap=True)


@app.command()
def compose(
    proofs: Annotated[
        list[Path], typer.Argument(help="funnel.proof.json files, in the order of time.")
    ],
    out_dir: OutOption,
) -> None:
    """Bind funnels that follow each other into one claim: composition.proof.json, for `check`."""
    from nlsid_core.design import compose_funnels

    path = compose_funnels(proofs, out_dir)
    out.print(f"wrote {path} and {4 * len(proofs)} files of its stages", soft_wrap=True)


@app.command()
def check(
    proofs: Annotated[list[Path], typer.Argument(help="Proof files (FILE.proof.json).")],
    second: Annotated[
        bool, typer.Option("--second", help="Also ask the checker that Coq proves right.")
    ] = False,
    recording: Annotated[
        Path | None,
        typer.Option(help="Of a falsification: the bag, whose digest and samples are compared."),
    ] = None,
) -> None:
    """Decide proofs without a solver: PROVED or FALSIFIED (status 0), or REJECTED (status 1).

    FALSIFIED: of what a tube assumes, by `nlsid monitor --falsify`. Status 2 if a proof cannot be
    read, so that nothing was decided about it, or if the second kernel was asked and has no opinion
    of it.
    """
    status = 0
    for path in proofs:
        name = str(path) if str(path).isprintable() else ascii(str(path))
        try:
            said = str(kernel.check(path))
            word, _, rest = said.partition(" ")
            typer.echo(said if len(proofs) == 1 else f"{word} {name}: {rest}")
            if recording is not None:
                from bags.monitoring.falsify import recorded

                typer.echo(f"  compared: {recorded(path, recording)}")
            if second:
                opinion = second_kernel.opinion(path)
                typer.echo(f"  {opinion}")
                status = max(status, {"accepted": 0, "refused": 1}.get(opinion.verdict, 2))
        except (kernel.Rejected, CertificateRejected) as refusal:
            status = max(status, 1)
            typer.echo(f"REJECTED {name}: {refusal}")
        except OSError as error:
            status = 2
            typer.echo(f"NOT READ {name}: {error.strerror}")
    raise typer.Exit(status)


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(help="A design folder, of any kind.")],
    bags: Annotated[
        list[Path] | None,
        typer.Argument(help="Their losses are listed; those that made no part of it are judged."),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(help="Takes `split.validation` (bags that are not judged) and `monitor`."),
    ] = None,
    page: Annotated[
        Path | None, typer.Option("--out", help="The page; default DIR/design.html.")
    ] = None,
    pdf: Annotated[
        bool, typer.Option("--pdf", help="Also as PDF beside the page; needs Chromium or Chrome.")
    ] = False,
) -> None:
    """Make one page of a design folder: proofs, model, what it catches, pictures, recordings.

    The proofs are decided again. Of the bags, those are held against the funnel that it was not
    made with. The page needs nothing else, and prints.
    """
    from bags.chain.config import load_config
    from bags.commands import show
    from bags.designs import documents
    from bags.monitoring.replay import replay_bag, to_judge
    from bags.monitoring.watch import Watch
    from bags.pictures.folder_report import print_page, write_folder_report
    from bags.pictures.report import report_available
    from bags.recordings.folders import expand_bags
    from bags.tools.info import bag_info

    settings = load_config(config) if config is not None else None
    target = page or folder / documents.DESIGN_REPORT
    recordings, replays, drawn = [], [], ""
    used: list[str] = []
    if bags:
        proved = documents.load_proved(documents.funnel_of(folder))
        folders = expand_bags(bags)
        topics = Watch(proved.design, centre=show.centre_of(settings)).pairing.topics
        with progress_bar("reading") as progress:
            for done, bag in enumerate(folders):
                progress(bag.name, done / len(folders))
                recordings.append(bag_info(bag, topics=topics))
        validation = settings.split.validation if settings is not None else ()
        chosen = to_judge(proved.design, folders, validation=validation)
        with progress_bar("replaying") as progress:
            for done, bag in enumerate(chosen.judged):
                progress(bag.name, done / len(chosen.judged))
                replays.append(replay_bag(proved, bag, centre=show.centre_of(settings)))
        used = chosen.said
        out.print(show.replay_table(replays))
        for line in used:
            out.print(line, soft_wrap=True, markup=False, highlight=False)
        if report_available() and all(entry.half_width for entry in replays):
            from bags.pictures import plots

            drawn = plots.svg(plots.margins(replays))
    write_folder_report(
        folder, target, recordings=recordings, replays=replays, used=used, drawn=drawn
    )
    out.print(f"wrote {target}", soft_wrap=True)
    if pdf:
        print_page(target, target.with_suffix(".pdf"))
        out.print(f"wrote {target.with_suffix('.pdf')}", soft_wrap=True)


@app.command()
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
    falsify: Annotated[
        Path | None,
        typer.Option(
            help="Folder for certificates that bags break what a tube assumes, for `nlsid check`."
        ),
    ] = None,
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
    from bags.monitoring.falsify import falsified, refuse_unfalsifiable
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
    if falsify is not None:
        refuse_unfalsifiable(proved.design.model)
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
        drawn = report_available() and all(entry.half_width for entry in replays)
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
    if falsify is not None:
        bad = [f for f, r in zip(folders, replays, strict=True) if r.first_bad is not None]
        for said in (line for f in bad for line in falsified(funnel, f, falsify, types)):
            (err if as_json else out).print(said, soft_wrap=True, markup=False, highlight=False)
    if drawn and not as_json:
        out.print(f"wrote {picture}", soft_wrap=True)
    if any(entry.first_bad is not None or entry.first_alarm is not None for entry in replays):
        raise typer.Exit(1)
    if any(entry.unjudged or not entry.judged for entry in replays):
        raise typer.Exit(2)


@app.command()
def tolerances(
    folder: Annotated[Path, typer.Argument(help="Folder of a design: funnel.json, its proof, ...")],
    out_dir: Annotated[
        Path | None, typer.Option("--out", help="Folder for the files; default the design's.")
    ] = None,
) -> None:
    """Write proved tolerances: joint_trajectory_controller.yaml, validator.yaml, tolerances.txt.

    Path and goal tolerances of ros2_control's joint_trajectory_controller for positions, thresholds
    of Autoware's validators for speeds and distances, and a table of all signals.
    """
    from bags.designs import tolerances as proved

    found = proved.tolerances(folder)
    target = folder if out_dir is None else out_dir
    target.mkdir(parents=True, exist_ok=True)
    out.print(str(found), soft_wrap=True, markup=False, highlight=False)
    written = found.write(target)
    for path in written:
        out.print(f"wrote {path}", soft_wrap=True)
    for name, units in ((proved.CONTROLLER, proved.POSITIONS), (proved.VALIDATOR, ("m/s", "m"))):
        if target / name not in written:
            out.print(f"no {name}: no signal is in {' or '.join(units)}", soft_wrap=True)


@app.command()
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


@app.command()
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


@app.command()
def view(
    bag: Annotated[
        Path | None, typer.Argument(help="A recording to replay; none: the live robot.")
    ] = None,
    page: Annotated[
        bool, typer.Option("--page", help="A page for any browser; else a server for Foxglove.")
    ] = False,
    host: Annotated[
        str, typer.Option(help="Address to serve on; 0.0.0.0: everyone on the network may look.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(help="Port; 0: 8765 for Foxglove, 8080 for the page.", min=0, max=65535)
    ] = 0,
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
    """Show tube, signals, margin, assumption and events, live or of a recording, until Ctrl-C."""
    from bags.commands.viewing import view_live, view_recording

    if bag is None:
        if importlib.util.find_spec("rclpy") is None:
            raise typer.BadParameter("rclpy is not installed (pip install 'nlsid[ros]')")
        raise typer.Exit(view_live(monitor, page=page, host=host, port=port))
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
    view_recording(recording, rate, page=page, host=host, port=port)


@app.command()
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


def _funnel_around_trajectory(problem: Path, out_dir: Path, workers: Workers) -> None:
    from bags.chain.problems import FunnelProblem
    from bags.designs import documents
    from bags.pictures.report import report_available
    from nlsid_core import files

    given = FunnelProblem.load(problem)
    with progress_bar("designing") as progress, workers.sharing() as executor:
        design = given.design(progress, executor=executor)
    for path in design.save(out_dir):
        out.print(f"wrote {path}", soft_wrap=True)
    if report_available():
        from bags.pictures.funnel_plots import write_funnel_picture

        picture = out_dir / documents.FUNNEL_PLOT
        write_funnel_picture(picture, design)
        out.print(f"wrote {picture}", soft_wrap=True)
    out.print(str(design), soft_wrap=True)
    if given.push is not None:
        path = out_dir / documents.PUSH
        files.write_document(path, given.push.document())
        out.print(f"wrote {path}", soft_wrap=True)
        out.print(f"measured, not proved: {given.push}", soft_wrap=True, markup=False)


def main() -> None:
    """Entry point: errors made for people are shown as one message and end with status 2.

    Status 0 says yes, 1 no (not fit, outside, rejected), 2 that it could not be done or judged.
    """
    try:
        app()
    except NlsidError as error:
        err.print(f"[red]error:[/red] {escape(str(error))}", soft_wrap=True, highlight=False)
        sys.exit(2)
    except OSError as error:
        said = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        err.print(f"error: {said}", soft_wrap=True, markup=False, highlight=False)
        sys.exit(2)


if __name__ == "__main__":
    main()
