"""The command line `nlsid`: identify, funnel, check, monitor, live, demo."""

import importlib.util
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from bags import documents, show, stack
from bags.config import load_config
from bags.demo import run_demo
from bags.folders import expand_bags
from bags.replay import replay_bag
from bags.report import report_available, write_margins
from bags.steps import design_funnel_files, identify_bags
from nlsid_core.certificate import check as check_proof
from nlsid_core.errors import CertificateRejected, NlsidError
from nlsid_core.monitor import Status

app = typer.Typer(
    name="nlsid",
    help="From a recorded bag to a proved model, a proved tracking tube and a monitor.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
out = Console()
err = Console(stderr=True)

BagsArgument = Annotated[
    list[Path], typer.Argument(help="Bags: rosbag2 folders, .mcap files, or folders of bags.")
]
ConfigOption = Annotated[Path, typer.Option(help="The robot's YAML configuration.")]
OutOption = Annotated[Path, typer.Option(help="Folder for the results; made if it is not there.")]


@app.command()
def identify(bags: BagsArgument, config: ConfigOption, out_dir: Annotated[
    Path, typer.Option("--out", help="Folder for the results; made if it is not there.")
]) -> None:  # fmt: skip
    """Identify a model from bags and prove it stable: model.json, model.proof.json, report.html."""
    settings = load_config(config)
    folders = expand_bags(bags)
    with _progress("identifying") as progress:
        result = identify_bags(folders, settings, out_dir, progress=progress)
    out.print(show.methods_table(result.fit, result.test))
    for file in result.files:
        out.print(f"wrote {file}", soft_wrap=True)
    if not report_available():
        out.print(f"no {documents.REPORT}: install matplotlib (pip install 'nlsid[report]')")


@app.command()
def funnel(
    model: Annotated[Path, typer.Option(help="The model.json that `nlsid identify` wrote.")],
    config: ConfigOption,
    out_dir: Annotated[
        Path, typer.Option("--out", help="Folder for the results; made if it is not there.")
    ],
) -> None:
    """Design a tracking policy and a proved tube: policy.json, funnel.json, funnel.proof.json."""
    settings = load_config(config)
    with _progress("designing") as progress:
        progress("policy, observer and tube", 0.1)
        design = design_funnel_files(model, settings, out_dir)
        progress("done", 1.0)
    out.print(show.funnel_table(design))
    for name in (documents.POLICY, documents.FUNNEL, documents.FUNNEL_PROOF):
        out.print(f"wrote {out_dir / name}", soft_wrap=True)


@app.command()
def check(
    proofs: Annotated[list[Path], typer.Argument(help="Proof files (FILE.proof.json).")],
) -> None:
    """Decide proofs exactly, without a solver: PROVED (status 0) or REJECTED (status 1)."""
    rejected = False
    for path in proofs:
        try:
            verdict = check_proof(path)
        except (CertificateRejected, OSError) as refusal:
            rejected = True
            typer.echo(f"REJECTED {path.name}: {refusal}")
        else:
            typer.echo(str(verdict))
            for assumption in verdict.assumptions:
                typer.echo(f"  assuming {assumption}")
    if rejected:
        raise typer.Exit(1)


@app.command()
def monitor(
    bags: BagsArgument,
    funnel: Annotated[Path, typer.Option(help="The funnel.json that `nlsid funnel` wrote.")],
    replay: Annotated[
        bool, typer.Option("--replay", help="Replay the bags (live monitoring is funnel_monitor).")
    ] = False,
    config: Annotated[
        Path | None, typer.Option(help="Takes `split.test` (which bags) and `monitor.nominal`.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Where to draw; default monitor.png beside the funnel.")
    ] = None,
) -> None:
    """Hold recorded bags against a proved funnel: margin, worst axis, disturbance budget.

    Status 0 if every bag is inside with the assumption kept, 1 if one is not.
    """
    if not replay:
        raise typer.BadParameter(
            "give --replay; a live robot is watched by the node funnel_monitor"
        )
    settings = load_config(config) if config is not None else None
    proved = documents.load_proved_funnel(funnel)
    folders = expand_bags(bags)
    if settings is not None:
        folders = [f for f in folders if f.name in settings.split.test] or folders
    nominal = show.nominal_of(settings)
    with _progress("replaying") as progress:
        replays = []
        for done, bag in enumerate(folders):
            progress(bag.name, done / len(folders))
            replays.append(replay_bag(proved, bag, nominal=nominal))
        progress("drawing", 1.0)
        picture = plot or funnel.with_name(documents.MARGIN_PLOT)
        if report_available():
            write_margins(picture, replays)
    out.print(show.replay_table(replays))
    for entry in replays:
        if entry.reason:
            out.print(f"{entry.name}: {entry.reason}", soft_wrap=True)
    if report_available():
        out.print(f"wrote {picture}", soft_wrap=True)
    if any(entry.verdict != Status.INSIDE.value for entry in replays):
        raise typer.Exit(1)


@app.command()
def live(
    funnel: Annotated[Path, typer.Option(help="The funnel.json that `nlsid funnel` wrote.")],
    track: Annotated[
        bool, typer.Option("--track", help="Run the policy too; give --highest. Default: watch.")
    ] = False,
    plant: Annotated[
        bool, typer.Option("--plant", help="With --track: simulate the robot by the model.")
    ] = False,
    lowest: Annotated[float, typer.Option(help="Least input the robot may get.")] = 0.0,
    highest: Annotated[float, typer.Option(help="Greatest input the robot may get.")] = 0.0,
) -> None:
    """Start the live nodes on a funnel and end them together: no ROS launch needed, rclpy is."""
    if importlib.util.find_spec("rclpy") is None:
        raise typer.BadParameter("rclpy is not installed (pip install 'nlsid[ros]')")
    nodes = stack.monitoring(funnel)
    if track:
        nodes = stack.tracking(funnel, lowest=lowest, highest=highest, plant=plant)
    raise typer.Exit(stack.run_stack(nodes))


@app.command()
def demo(
    out_dir: Annotated[
        Path, typer.Option("--out", help="Folder for everything the demo makes.")
    ] = Path("nlsid-demo"),
) -> None:
    """Run the whole chain on the shipped bags, then live over ROS 2 where rclpy is there."""
    if not run_demo(out_dir, out):
        raise typer.Exit(1)


@contextmanager
def _progress(task: str) -> Iterator[Callable[[str, float], None]]:
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=err, transient=True) as bar:
        identifier = bar.add_task(task, total=1.0)
        yield lambda what, fraction: bar.update(identifier, description=what, completed=fraction)


def main() -> None:
    """Entry point: errors made for people are shown as one message and end with status 1."""
    try:
        app()
    except NlsidError as error:
        err.print(f"[red]error:[/red] {error}", soft_wrap=True, markup=True, highlight=False)
        sys.exit(1)
    except OSError as error:
        err.print(f"error: {error}", soft_wrap=True, markup=False, highlight=False)
        sys.exit(1)


if __name__ == "__main__":
    main()
