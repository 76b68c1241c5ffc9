"""`report.html`: one file that shows what was identified, how well, and what is proved."""

import importlib.util
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from pathlib import Path

from bags.designs import documents
from bags.monitoring.catching import Catching
from bags.monitoring.replay import Replay
from bags.pictures import tables
from nlsid_core import files
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError
from nlsid_core.identification import Candidate, Fit, Model

MODEL_BEGINS, MODEL_ENDS = "<!-- model begins -->", "<!-- model ends -->"
FUNNEL_BEGINS, FUNNEL_ENDS = "<!-- funnel begins -->", "<!-- funnel ends -->"
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 62rem; margin: 2rem auto;
       padding: 0 1rem }
h1 { font-size: 1.5rem } h2 { font-size: 1.1rem; margin-top: 2rem }
table { border-collapse: collapse } th, td { padding: .3rem .8rem; text-align: right }
td { white-space: nowrap } .left td { white-space: normal }
th:first-child, td:first-child, .left th, .left td { text-align: left }
thead { border-bottom: 2px solid #222 }
ul { padding-left: 1.2rem }
tbody tr { border-bottom: 1px solid #ddd } td code { white-space: nowrap }
.picture { overflow-x: auto }
@media screen and (max-width: 40rem) { body { font-size: 14px }
  table { display: block; overflow-x: auto } th, td { padding: .25rem .4rem }
  .picture svg { max-width: none; width: 48rem } }
svg { max-width: 100%; height: auto } code { font-size: .85rem; overflow-wrap: anywhere }
.chosen { font-weight: 600 } .note { color: #555 }
.proved { color: #1a7f37 } .not { color: #b35900 }
"""


def report_available() -> bool:
    """True if the extra `report` (matplotlib) is installed."""
    return importlib.util.find_spec("matplotlib") is not None


def drawable(replays: Sequence[Replay]) -> bool:
    """Whether replayed bags can be drawn: they have one output, and one was judged."""
    judged = any(entry.judged for entry in replays)
    return report_available() and judged and all(entry.half_width for entry in replays)


def write_report(path: Path, fit: Fit[Model], parts: Mapping[str, Dataset], *, robot: str) -> None:
    """Write the page; needs the extra `report`. parts: trials by what they are for."""
    files.write_atomically(path, page(fit, parts, robot=robot).encode())


def write_margins(path: Path, replays: Sequence[Replay]) -> None:
    """Draw replayed bags in their tubes as a PNG; needs the extra `report`."""
    from bags.pictures import plots

    plots.write_png(path, plots.margins(replays))


def write_catching(folder: Path, catching: Catching) -> list[Path]:
    """Write the picture of the faults that a funnel catches, and its section; return the files.

    Nothing without the extra `report`; no section where there is no report.
    """
    if not report_available():
        return []
    from bags.pictures import catching_plots, plots

    picture, report = folder / documents.CATCHING_PLOT, folder / documents.REPORT
    figure = catching_plots.catching(catching)
    plots.write_png(picture, figure)
    if not report.exists():
        return [picture]
    before, begins, rest = report.read_text(encoding="utf-8").partition(FUNNEL_BEGINS)
    _, ends, after = rest.partition(FUNNEL_ENDS)
    if not ends:
        return [picture]
    said = tables.html(lambda console: tables.say_catching(console, catching))
    section = f"""
<h2>The funnel: what it can catch</h2>
{said}
<p class="note">The trials had no part in the model or in the funnel; each fault was put into a copy
of each. CUSUM and 3σ watch the innovation, the box the difference from the nominal.</p>
{plots.svg(figure)}
"""
    files.write_atomically(report, f"{before}{begins}{section}{ends}{after}".encode())
    return [picture, report]


def page(fit: Fit[Model], parts: Mapping[str, Dataset], *, robot: str) -> str:
    """The whole HTML page as text."""
    from bags.pictures import model_plots, plots  # matplotlib only where a report is drawn

    chosen, test = fit.chosen, parts["test"]
    outputs = range(test.trajectories[0].y.shape[1])
    drawn = {c.method.title: c.model for c in (*fit.candidates[:1], chosen)}
    simulated = "".join(plots.svg(model_plots.simulations(test, drawn, i)) for i in outputs)
    columns = [name for name in ("test", "validation", "train") if name in fit.errors]
    listed = "".join(
        f"<tr><td>{escape(t.name)}</td><td>{len(t)}</td><td>{use}</td><td>{escape(t.group)}</td>"
        f"<td><code>{escape(t.digest[:19])}…</code></td></tr>"
        for use, data in parts.items()
        for t in data
    )
    counts = ", ".join(f"{len(data)} {use}" for use, data in parts.items())
    methods = tables.methods_table(fit, test, columns)
    model, proved = chosen.model, tables.stability_sentence(chosen)
    answers, drives = (
        ", ".join(s.label for s in (part if isinstance(part, tuple) else (part,)))
        for part in (model.y, model.u)
    )
    calibrated = ", calibration trials for neither: they scale the tube"
    return f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{escape(robot)}: identified model</title>
<style>{STYLE}</style>
<meta name="viewport" content="width=device-width, initial-scale=1">
<h1>{escape(robot)}: identified model</h1>
{MODEL_BEGINS}<p>{escape(f"{model}; y = {answers}, u = {drives}")}</p>
<p class="{"not" if chosen.proof is None else "proved"}">{escape(proved)}</p>
<h2>How well it simulates</h2>
{tables.html(lambda console: console.print(methods))}
<p class="note">Error: 100·‖y - ŷ‖/‖y - mean(y)‖ over all samples of each trial but the first
ones, which show where it starts, ŷ simulated with the recorded input.
Trials: {counts}; test trials were only used
for this table and the pictures below{calibrated if "calibration" in parts else ""}.</p>
<h2>Measured and simulated, test trials</h2>{simulated}
{_residuals(chosen, test)}
{FUNNEL_BEGINS}{FUNNEL_ENDS}
<h2>Recordings</h2>
<details><summary>{counts}</summary><table class="left">
<thead><tr><th>trial</th><th>samples</th><th>use</th><th>repeats of</th><th>digest</th></tr></thead>
<tbody>{listed}</tbody></table></details>{MODEL_ENDS}
<p class="note">Made {datetime.now(UTC):%Y-%m-%d %H:%M} UTC by nlsid.</p>
</html>
"""


def _residuals(chosen: Candidate[Model], test: Dataset) -> str:
    """The tests of the residuals in words and pictures."""
    from bags.pictures import model_plots, plots

    try:
        scores = chosen.validate(test)
    except DataError as reason:
        return f'<h2>Residuals, test trials</h2><p class="note">{escape(str(reason))}</p>'
    figure = plots.svg(model_plots.residuals(chosen, scores, test))
    items = "".join(f"<li>{escape(line)}</li>" for line in str(scores).splitlines())
    return f"""<h2>Residuals, test trials</h2>
<ul>{items}</ul>{figure}
<p class="note">Shaded: where 99 % of the values would lie if the one-step residual were white, or
independent of the input. White noise on the measurement leaves the simulation residual white, white
noise in the equation the one-step residual; if neither is white, the model leaves dynamics
unexplained, the noise is coloured, or there is noise of both kinds.</p>"""
