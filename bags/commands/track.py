"""What the commands do and print of a robot whose state is measured and that tracks a motion."""

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bags.chain import tracking_steps
from bags.chain.shipped import config_file
from bags.chain.tracking_config import is_tracking, load_tracking_config
from bags.commands.progress import progress_bar
from bags.commands.show import breaking_table
from bags.designs import documents
from bags.pictures.report import report_available
from bags.recordings.folders import expand_bags
from nlsid_core.design.sampled.design import TrackingDesign
from nlsid_core.errors import DataError
from nlsid_core.identification.states import StateFit
from nlsid_core.proofs import check
from nlsid_core.running.reading import Reading, Status

EXCITATIONS, RUNS = "excitations", "runs"  # folders of bags that `run` makes
out = Console()


def simulate(config: Path, out_dir: Path) -> None:
    """Excitations of the configured robot as bags."""
    bags = tracking_steps.simulate_excitations(load_tracking_config(config), out_dir)
    out.print(f"wrote {len(bags)} bags of excitations in {out_dir}", soft_wrap=True)


def identify(bags: list[Path], config: Path, out_dir: Path) -> None:
    """A model of these bags."""
    fit = tracking_steps.identify_state_bags(
        expand_bags(bags), load_tracking_config(config), out_dir
    )
    out.print(_classes_table(fit))
    _wrote(out_dir, documents.MODEL, picture=documents.FREE_RUN_PLOT)


def plan(config: Path, out_dir: Path) -> None:
    """The configured motion, and a policy around it."""
    model = out_dir / documents.MODEL
    policy = tracking_steps.plan_tracking(model, load_tracking_config(config), out_dir)
    seconds = len(policy) * policy.period
    out.print(f"motion of {seconds:g} s in {len(policy)} steps, inside the box of the data")
    _wrote(out_dir, documents.POLICY, picture=documents.MOTION_PLOT)


def drive(design: Path, config: Path, out_dir: Path) -> None:
    """Runs of the policy on the configured robot as bags."""
    bags = tracking_steps.simulate_runs(design, load_tracking_config(config), out_dir)
    out.print(f"wrote {len(bags)} bags of runs in {out_dir}", soft_wrap=True)


def funnel(bags: list[Path], design: Path, config: Path) -> None:
    """The proved funnel, from the disturbance on these bags."""
    settings = load_tracking_config(config)
    runs = expand_bags(bags)
    with progress_bar("designing") as progress:
        made = tracking_steps.design_tracking_funnel(design, runs, settings, progress=progress)
    out.print(_funnel_table(made))
    a = made.funnel.assumption
    out.print(
        f"assumed: the disturbance's {a.form} is at most {a.bound:.4g}, {a.safety_factor:g} times "
        f"the largest of {len(a.measured_on)} runs; the monitor watches it",
        soft_wrap=True,
    )
    recorded = tracking_steps.read_states(runs, settings)
    out.print(breaking_table(tracking_steps.what_breaks(made, recorded)))
    widest = tracking_steps.widest_start(made, recorded)
    if widest < 1.0:
        out.print(
            f"warning: the runs started within {widest:.2g} of the inlet that is claimed: what "
            "disturbs farther out was not measured; record runs that start there",
            soft_wrap=True,
        )
    _wrote(design, documents.FUNNEL, documents.FUNNEL_PROOF, picture=documents.FUNNEL_PLOT)


def monitor(bags: list[Path], funnel: Path) -> bool:
    """Whether every run on these bags is inside its funnel from first to last sample."""
    runs = expand_bags(bags)
    proved = documents.load_proved_tracking(funnel)
    table = Table(title="runs against the funnel", title_justify="left")
    for column in ("run", "verdict", "least margin", "most disturbance / bound", "end", "why"):
        table.add_column(column)
    inside, every = 0, []
    for bag in runs:
        readings = tracking_steps.replay_run(proved, bag)
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
    out.print(f"{inside} of {len(runs)} bags are inside from first to last sample")
    if report_available():
        from bags.pictures import plots, tracking_plots

        drawn = tracking_plots.draw_watched(proved.design.model, proved.design.funnel, every)
        plots.write_png(funnel.with_name(documents.MARGIN_PLOT), drawn)
    _wrote(funnel.parent, picture=documents.MARGIN_PLOT)
    return inside == len(runs)


def demo(robot: str, out_dir: Path) -> bool:
    """All steps on a simulated robot, shipped or of a YAML; whether its runs are inside."""
    config = Path(robot) if robot.endswith(".yaml") else config_file(f"{robot}.yaml")
    if not is_tracking(config):
        raise DataError(f"{config}: no motion and no simulation; demos are of simulated robots")
    simulate(config, out_dir / EXCITATIONS)
    identify([out_dir / EXCITATIONS], config, out_dir)
    plan(config, out_dir)
    drive(out_dir, config, out_dir / RUNS)
    funnel([out_dir / RUNS], out_dir, config)
    out.print(str(check(out_dir / documents.FUNNEL_PROOF)), soft_wrap=True)
    return monitor([out_dir / RUNS], out_dir / documents.FUNNEL)


def _wrote(folder: Path, *names: str, picture: str) -> None:
    """Say which files there are now; a picture only where it could be drawn."""
    for name in (*names, *([picture] if report_available() else [])):
        out.print(f"wrote {folder / name}", soft_wrap=True)


def _extremes(judged: list[Reading]) -> tuple[str, str]:
    if not judged:
        return "-", "-"
    return (
        f"{min(r.margin for r in judged):.3f}",
        f"{max(r.assumption for r in judged):.2f}",
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


def _funnel_table(made: TrackingDesign) -> Table:
    funnel, model = made.funnel, made.model
    table = Table(title="half-widths of the tube", title_justify="left")
    for column in ("state", "at the start", "narrowest", "at the end"):
        table.add_column(column)
    widths = funnel.half_widths
    for i, signal in enumerate(model.x):
        row = (widths[0, i], np.min(widths[:, i]), widths[-1, i])
        table.add_row(escape(f"{signal.name} [{signal.unit}]"), *(f"{value:.4g}" for value in row))
    return table
