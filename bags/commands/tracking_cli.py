"""`nlsid track`: from a robot's recordings to a proved funnel around a motion of it, and back."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bags.chain import tracking_steps
from bags.chain.tracking_config import TrackingConfig, load_tracking_config
from bags.commands.progress import progress_bar
from bags.monitoring import documents
from bags.pictures.report import report_available
from bags.recordings.folders import expand_bags
from nlsid_core.certificate import check
from nlsid_core.funnels.state_funnel import FunnelDesign
from nlsid_core.identification.states import StateFit
from nlsid_core.monitor import Status
from nlsid_core.reading import TrackingReading

app = typer.Typer(
    help="A measured state: model from repeats, motion, proved discrete funnel, monitor.",
    no_args_is_help=True,
)
out = Console()

EXCITATIONS, RUNS = "excitations", "runs"  # folders of bags that `run` and `simulate` make

ConfigOption = Annotated[Path, typer.Option(help="The robot's YAML configuration.")]
OutOption = Annotated[Path, typer.Option("--out", help="Folder for the results.")]
BagsArgument = Annotated[list[Path], typer.Argument(help="Bags, or folders of bags.")]
DesignOption = Annotated[Path, typer.Option(help="Folder with model.json and policy.json.")]


@app.command()
def simulate(config: ConfigOption, out_dir: OutOption) -> None:
    """Record the configured robot in MuJoCo (extra `sim`): repeats of excitations, as bags."""
    _simulate(load_tracking_config(config), out_dir)


@app.command()
def identify(bags: BagsArgument, config: ConfigOption, out_dir: OutOption) -> None:
    """Identify x⁺ = f(x, u) from repeats: model.json, and free_run.png of validation bags."""
    _identify(expand_bags(bags), load_tracking_config(config), out_dir)


@app.command()
def plan(
    model: Annotated[Path, typer.Option(help="The model.json of `nlsid track identify`.")],
    config: ConfigOption,
    out_dir: OutOption,
) -> None:
    """Plan the configured motion on the model, and its feedback: policy.json, and motion.png."""
    _plan(model, load_tracking_config(config), out_dir)


@app.command()
def drive(design: DesignOption, config: ConfigOption, out_dir: OutOption) -> None:
    """Commission the policy on the simulated robot: bags that measure the disturbance."""
    _drive(design, load_tracking_config(config), out_dir)


@app.command()
def funnel(bags: BagsArgument, design: DesignOption, config: ConfigOption) -> None:
    """Measure the disturbance on commissioning bags and prove the funnel: funnel.json, its proof.

    Draws funnel.png beside them.
    """
    _funnel(expand_bags(bags), design, load_tracking_config(config))


@app.command()
def monitor(
    bags: BagsArgument,
    funnel: Annotated[Path, typer.Option(help="The funnel.json of `nlsid track funnel`.")],
    config: ConfigOption,
) -> None:
    """Hold recorded runs of the policy against its funnel; status 1 if one is not inside.

    Draws monitor.png beside the funnel.
    """
    if not _monitor(expand_bags(bags), funnel, load_tracking_config(config)):
        raise typer.Exit(1)


@app.command()
def run(config: ConfigOption, out_dir: OutOption) -> None:
    """All steps on the configured simulated robot; its bags, model, policy, funnel and proof."""
    settings = load_tracking_config(config)
    _simulate(settings, out_dir / EXCITATIONS)
    _identify(expand_bags([out_dir / EXCITATIONS]), settings, out_dir)
    _plan(out_dir / documents.MODEL, settings, out_dir)
    _drive(out_dir, settings, out_dir / RUNS)
    runs = expand_bags([out_dir / RUNS])
    _funnel(runs, out_dir, settings)
    verdict = check(out_dir / documents.FUNNEL_PROOF)
    out.print(str(verdict), soft_wrap=True)
    for assumption in verdict.assumptions:
        out.print(f"  assuming {assumption}", soft_wrap=True)
    if not _monitor(runs, out_dir / documents.FUNNEL, settings):
        raise typer.Exit(1)


def _simulate(config: TrackingConfig, out_dir: Path) -> None:
    bags = tracking_steps.simulate_excitations(config, out_dir)
    out.print(f"wrote {len(bags)} bags of excitations in {out_dir}", soft_wrap=True)


def _identify(bags: list[Path], config: TrackingConfig, out_dir: Path) -> None:
    fit = tracking_steps.identify_state_bags(bags, config, out_dir)
    out.print(_classes_table(fit))
    _wrote(out_dir, documents.MODEL, picture=documents.FREE_RUN_PLOT)


def _plan(model: Path, config: TrackingConfig, out_dir: Path) -> None:
    policy = tracking_steps.plan_tracking(model, config, out_dir)
    seconds = len(policy) * policy.period
    out.print(f"motion of {seconds:g} s in {len(policy)} steps, inside the box of the data")
    _wrote(out_dir, documents.POLICY, picture=documents.MOTION_PLOT)


def _drive(design: Path, config: TrackingConfig, out_dir: Path) -> None:
    bags = tracking_steps.simulate_runs(design, config, out_dir)
    out.print(f"wrote {len(bags)} bags of runs in {out_dir}", soft_wrap=True)


def _funnel(bags: list[Path], design: Path, config: TrackingConfig) -> None:
    with progress_bar("designing") as progress:
        made = tracking_steps.design_tracking_funnel(design, bags, config, progress=progress)
    out.print(_funnel_table(made))
    a = made.funnel.assumption
    out.print(
        f"assumed: the disturbance's {a.form} is at most {a.bound:.4g}, {a.safety_factor:g} times "
        f"the largest of {len(a.measured_on)} runs; the monitor watches it",
        soft_wrap=True,
    )
    _wrote(design, documents.FUNNEL, documents.FUNNEL_PROOF, picture=documents.FUNNEL_PLOT)


def _wrote(folder: Path, *names: str, picture: str) -> None:
    """Say which files there are now; a picture only where it could be drawn."""
    for name in (*names, *([picture] if report_available() else [])):
        out.print(f"wrote {folder / name}", soft_wrap=True)


def _monitor(bags: list[Path], funnel: Path, config: TrackingConfig) -> bool:
    proved = documents.load_proved_tracking(funnel)
    table = Table(title="runs against the funnel", title_justify="left")
    for column in ("run", "verdict", "least margin", "most disturbance / bound", "end", "why"):
        table.add_column(column)
    inside, every = 0, []
    for bag in bags:
        readings = tracking_steps.replay_run(proved, config, bag)
        every.append(readings)
        judged = [r for r in readings if r.status is not Status.UNKNOWN]
        bad = next((r for r in readings if r.status is not Status.INSIDE), None)
        inside += bad is None
        table.add_row(
            bag.name,
            (bad or readings[-1]).status.value,
            *_extremes(judged),
            readings[-1].level.value,
            "" if bad is None else bad.reason,
        )
    out.print(table)
    out.print(f"{inside} of {len(bags)} bags are inside from first to last sample")
    if report_available():
        from bags.pictures import plots, tracking_plots

        drawn = tracking_plots.draw_watched(proved.design.model, proved.design.funnel, every)
        plots.write_png(funnel.with_name(documents.MARGIN_PLOT), drawn)
    _wrote(funnel.parent, picture=documents.MARGIN_PLOT)
    return inside == len(bags)


def _extremes(judged: list[TrackingReading]) -> tuple[str, str]:
    if not judged:
        return "-", "-"
    return (
        f"{min(r.margin for r in judged):.3f}",
        f"{max(r.disturbance for r in judged):.2f}",
    )


def _classes_table(fit: StateFit) -> Table:
    model = fit.model
    table = Table(title="classes of models: free-run error on validation", title_justify="left")
    table.add_column("highest power of " + ", ".join(s.name for s in (*model.x, *model.u)))
    table.add_column("error", justify="right")
    table.add_column("")
    for degrees, error in fit.errors:
        chosen = "chosen" if error == fit.error else ""
        shown = f"{error:.3g} %" if np.isfinite(error) else "diverges"
        table.add_row(", ".join(map(str, degrees)), shown, chosen)
    return table


def _funnel_table(made: FunnelDesign) -> Table:
    funnel, model = made.funnel, made.model
    table = Table(title="half-widths of the tube", title_justify="left")
    for column in ("state", "at the start", "narrowest", "at the end"):
        table.add_column(column)
    widths = funnel.half_widths
    for i, signal in enumerate(model.x):
        row = (widths[0, i], np.min(widths[:, i]), widths[-1, i])
        table.add_row(escape(f"{signal.name} [{signal.unit}]"), *(f"{value:.4g}" for value in row))
    return table
