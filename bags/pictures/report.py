"""`report.html`: one file that shows what was identified, how well, and what is proved."""

import importlib.util
from collections.abc import Sequence
from datetime import UTC, datetime
from html import escape
from pathlib import Path

from bags.monitoring.replay import Replay
from nlsid_core import _json
from nlsid_core.identification import FIRST, AnyCandidate, AnyFit, Candidate
from nlsid_core.models import DifferenceEquation
from nlsid_core.trajectory import Dataset

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 62rem; margin: 2rem auto;
       padding: 0 1rem }
h1 { font-size: 1.5rem } h2 { font-size: 1.1rem; margin-top: 2rem }
table { border-collapse: collapse } th, td { padding: .3rem .8rem; text-align: right }
th:first-child, td:first-child, .left th, .left td { text-align: left }
thead { border-bottom: 2px solid #222 }
tbody tr { border-bottom: 1px solid #ddd } tr.chosen { background: #e8f1fa; font-weight: 600 }
svg { max-width: 100%; height: auto } code { font-size: .85rem; overflow-wrap: anywhere }
.note { color: #555 } .proved { color: #1a7f37 } .not { color: #b35900 }
"""


def report_available() -> bool:
    """True if the extra `report` (matplotlib) is installed."""
    return importlib.util.find_spec("matplotlib") is not None


def write_report(path: Path, fit: AnyFit, train: Dataset, test: Dataset, *, robot: str) -> None:
    """Write the page; needs the extra `report`."""
    _json.write_atomically(path, page(fit, train, test, robot=robot).encode())


def write_margins(path: Path, replays: Sequence[Replay]) -> None:
    """Draw replayed bags in their tubes as a PNG; needs the extra `report`."""
    from bags.pictures import plots

    _json.write_atomically(path, plots.png(plots.margins(replays)))


def page(fit: AnyFit, train: Dataset, test: Dataset, *, robot: str) -> str:
    """The whole HTML page as text."""
    from bags.pictures import plots  # matplotlib only where a report is drawn

    chosen = fit.chosen
    rows = "\n".join(_row(c, train, test, c is chosen) for c in fit.candidates)
    simulated = plots.svg(plots.simulations(chosen, fit[FIRST], test))
    return f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{escape(robot)}: identified model</title>
<style>{STYLE}</style>
<h1>{escape(robot)}: identified model</h1>
<p>{escape(_equation(chosen))}</p>
<p class="proved">Incrementally stable for every input, decided exactly: two solutions with the same
input approach each other at {fit.proof.rate:.4f} a sample or faster.</p>
<h2>How well it simulates</h2>
<table><thead><tr><th>method</th><th>test error</th><th>training error</th><th>time</th>
<th>stability</th></tr></thead><tbody>{rows}</tbody></table>
<p class="note">Error: 100·‖y - ŷ‖/‖y - mean(y)‖ over all samples after the first
{len(chosen.model)} of each trial, ŷ simulated from those with the recorded input.
{len(train)} training trials, {len(test)} test trials; test trials were only used for this
table and the pictures below.</p>
<h2>Measured and simulated, test trials</h2>{simulated}
<h2>Residuals, test trials</h2>{plots.svg(plots.residuals(chosen, test))}
<p class="note">Shaded: where 99 % of a white residual's autocorrelation would lie. Outside it the
model leaves something unexplained.</p>
{_poles(chosen)}
<h2>Recordings</h2>
<table class="left">
<thead><tr><th>trial</th><th>use</th><th>repeats of</th><th>digest</th></tr></thead>
<tbody>{_recordings(train, "training")}{_recordings(test, "test")}</tbody></table>
<p class="note">Made {datetime.now(UTC):%Y-%m-%d %H:%M} UTC by nlsid.</p>
</html>
"""


def _row(candidate: AnyCandidate, train: Dataset, test: Dataset, chosen: bool) -> str:
    proved = (
        '<span class="proved">proved</span>'
        if candidate.proof is not None
        else '<span class="not">not proved</span>'
    )
    cells = [
        escape(candidate.method),
        f"{candidate.error_percent(test):.2f} %",
        f"{candidate.error_percent(train):.2f} %",
        f"{candidate.seconds * 1e3:.0f} ms",
        proved,
    ]
    tag = '<tr class="chosen">' if chosen else "<tr>"
    return tag + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


def _equation(candidate: AnyCandidate) -> str:
    m = candidate.model
    if not isinstance(m, DifferenceEquation):
        terms = sum(len(g.exponents) for g in m.G) + len(m.p.exponents)
        outputs, inputs = (", ".join(f"{s.name} [{s.unit}]" for s in part) for part in (m.y, m.u))
        return (
            f"0 = sum G_k(w) y(t-k) + p(w), {len(m)} lags, {terms} terms in w = the last "
            f"{len(m.window)} inputs; y = {outputs}, u = {inputs}, one sample = {m.period:g} s"
        )
    past = " ".join(f"{a:+.4f} y(t-{k})" for k, a in enumerate(m.a, 1))
    drive = " ".join(f"{b:+.4f} u(t-{j})" if j else f"{b:+.4f} u(t)" for j, b in enumerate(m.b))
    return (
        f"y(t) = {past.removeprefix('+')} {drive} {m.c:+.5f}, "
        f"y = {m.y.name} [{m.y.unit}], u = {m.u.name} [{m.u.unit}], one sample = {m.period:g} s"
    )


def _poles(candidate: AnyCandidate) -> str:
    """The pole plot of a linear model; a nonlinear one has none."""
    from bags.pictures import plots

    model = candidate.model
    if not isinstance(model, DifferenceEquation):
        return ""
    linear = Candidate(candidate.method, model, candidate.proof, candidate.seconds)
    return f"<h2>Poles</h2>{plots.svg(plots.poles(linear))}"


def _recordings(dataset: Dataset, use: str) -> str:
    return "".join(
        f"<tr><td>{escape(t.name)}</td><td>{use}</td><td>{escape(t.group)}</td>"
        f"<td><code>{escape(t.digest[:19])}…</code></td></tr>"
        for t in dataset
    )
