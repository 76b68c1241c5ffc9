"""What `nlsid identify` and `funnel` do and print of a robot whose state is measured."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.markup import escape
from rich.table import Table

from bags.chain import tracking_steps
from bags.chain.steps import read_signals_of
from bags.chain.tracking_config import TrackingConfig
from bags.commands import show
from bags.commands.options import out, progress_bar
from bags.designs import documents
from bags.pictures import tables
from bags.pictures.report import report_available
from nlsid_core.design.sampled.design import TrackingDesign
from nlsid_core.identification.states import StateFit


def identify(bags: Sequence[Path], config: TrackingConfig, folder: Path) -> None:
    """Identify a model of these bags, and plan the configured motion with its policy."""
    fit = tracking_steps.identify_state_bags(bags, config, folder)
    out.print(_classes_table(fit))
    policy = tracking_steps.plan_tracking(fit, config, folder)
    seconds = len(policy) * policy.period
    out.print(f"motion of {seconds:g} s in {len(policy)} steps, inside the box of the data")
    _wrote(folder, documents.MODEL, documents.POLICY, picture=documents.FREE_RUN_PLOT)


def funnel(bags: Sequence[Path], config: TrackingConfig, folder: Path) -> TrackingDesign:
    """Design the proved funnel, from the disturbance on these bags."""
    with progress_bar("designing") as progress:
        made = tracking_steps.design_tracking_funnel(folder, bags, config, progress=progress)
    out.print(_widths_table(made))
    a = made.funnel.assumption
    out.print(
        f"assumed: the disturbance's response is at most {a.bound:.4g}, {a.safety_factor:g} times "
        f"the largest of {len(a.measured_on)} runs; the monitor watches it",
        soft_wrap=True,
    )
    widest = tracking_steps.widest_start(made, read_signals_of(bags, config))
    if widest < 1.0:
        tables.warn(
            out,
            f"the runs started within {widest:.2g} of the inlet that is claimed: what disturbs "
            "farther out was not measured; record runs that start there",
        )
    show.draw_tube(folder, made)
    _wrote(folder, documents.FUNNEL, documents.FUNNEL_PROOF, picture=documents.FUNNEL_PLOT)
    return made


def _wrote(folder: Path, *names: str, picture: str) -> None:
    """Say which files there are now; a picture only where it could be drawn."""
    for name in (*names, *([picture] if report_available() else [])):
        out.print(f"wrote {folder / name}", soft_wrap=True)


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


def _widths_table(made: TrackingDesign) -> Table:
    table = Table(title="half-widths of the tube", title_justify="left")
    for column in ("state", "at the start", "narrowest", "at the end"):
        table.add_column(column)
    widths = made.funnel.half_widths
    for signal, width in zip(made.model.x, widths.T, strict=True):
        row = (width[0], np.min(width), width[-1])
        table.add_row(escape(f"{signal.name} [{signal.unit}]"), *(f"{value:.4g}" for value in row))
    return table
