"""`nlsid report`: one page of a whole design folder, whatever its kind, to read, send and print.

The page stands alone: no script, no link outside, pictures inside. Proofs are decided again while
it is made. What `nlsid identify` and `nlsid funnel` have drawn into the folder's report is in it.
"""

import base64
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from importlib.metadata import version
from pathlib import Path

from rich.console import Console

from bags.commands import bag_show, show
from bags.designs import documents
from bags.monitoring.replay import Replay
from bags.pictures.report import MODEL_BEGINS, MODEL_ENDS, STYLE, drawable, report_available
from bags.pictures.tables import html
from bags.tools.info import BagInfo
from nlsid_core import proofs
from nlsid_core.designs import AnyDesign
from nlsid_core.errors import CertificateRejected, DocumentError, NlsidError
from nlsid_core.funnels.tube import TubeFunnel

# Nothing but what stands in the page itself is shown or run, whatever a folder's files say.
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
PRINT = """
nav a { margin-right: 1rem; display: inline-block }
figure { margin: 1rem 0 } figure img { max-width: 100% }
section { overflow-x: auto } h2 { font-size: 1.3rem } h3 { font-size: 1.05rem }
@media screen and (max-width: 40rem) { body { font-size: 14px } th, td { padding: .25rem .4rem }
  svg, figure img { max-width: 200% } }
@page { size: A4; margin: 15mm }
@media print { nav { display: none } h2, h3 { break-after: avoid }
  figure, tr, svg { break-inside: avoid } section { overflow: visible }
  table { font-size: .8em } th, td { padding: .2rem .4rem }
  th, td:first-child, td[colspan] { white-space: normal }
  body { max-width: none; margin: 0; font-size: 11pt } }
"""
FUNNEL_CAPTION = "The funnel: the tube around the motion"
PICTURES = {
    documents.FREE_RUN_PLOT: "The model in free run",
    documents.FUNNEL_PLOT: FUNNEL_CAPTION,
    documents.CATCHING_PLOT: "What the funnel can catch",
    documents.MARGIN_PLOT: "Recordings held against the funnel, when they were last replayed",
}
REJECTED = "REJECTED"
LARGEST_PICTURE = 20 * 2**20  # bytes


def folder_page(folder: Path, held: Mapping[str, str] | None = None) -> str:
    """Give the whole page as text.

    held: chapters of recordings by their titles (`recorded`).

    Raises DocumentError if the folder has neither a proof nor a report.
    """
    decided = "".join(map(_proof, sorted(folder.glob("*.proof.json"))))
    is_rejected = REJECTED in decided
    model = _model_chapter(folder / documents.REPORT)
    if not decided and not model:
        raise DocumentError(
            f"{folder}: no proof and no {documents.REPORT} to make a report of; `nlsid learn` "
            "makes both"
        )
    if model and is_rejected:
        model = f'<p class="not">A proof of this folder does not hold now.</p>{model}'
    in_model = {documents.CATCHING_PLOT} if "what it can catch" in model else set()
    design = None if is_rejected else _loaded(folder)
    drawn = "" if design is None else _drawn(folder, design)
    short = (
        f"<p>{escape(show.promise(design))}</p>"
        if design is not None and isinstance(design.funnel, TubeFunnel)
        else ""
    )
    chapters = {
        "What is proved": short + decided,
        **(held or {}),
        "The model": model,
        "Pictures": _pictures(folder, without=in_model) + drawn,
    }
    present = [(title, text) for title, text in chapters.items() if text]
    links = "".join(f'<a href="#c{k}">{title}</a>' for k, (title, _) in enumerate(present))
    body = "".join(
        f'<section id="c{k}"><h2>{title}</h2>{text}</section>'
        for k, (title, text) in enumerate(present)
    )
    name = escape(folder.resolve().name)
    return f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{name}: design</title>
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>{STYLE}{PRINT}</style>
<h1>{name}</h1>
<p class="note">Folder {name}, {datetime.now(UTC):%Y-%m-%d %H:%M} UTC, nlsid {version("nlsid")}</p>
<nav>{links}</nav>
{body}
</html>
"""


def recorded(
    recordings: Sequence[BagInfo], replays: Sequence[Replay], used: Sequence[str]
) -> dict[str, str]:
    """Give the chapters of recordings: how they were held against the funnel, and their losses.

    used: lines about those that the design was made with.
    """

    def say_losses(console: Console) -> None:
        for info in recordings:
            bag_show.show_info(console, info)

    lines = "".join(f"<p>{escape(line[0].upper() + line[1:])}.</p>" for line in used)
    drawn = ""
    if drawable(replays):
        from bags.pictures import plots  # matplotlib only where something is drawn

        drawn = plots.svg(plots.margins(replays))
    said = html(lambda console: show.say_replays(console, replays))
    return {
        "Recordings held against the funnel": f"{said}{lines}{drawn}",
        "Recordings and their losses": html(say_losses),
    }


def _proof(path: Path) -> str:
    """A proof, decided now, in words: what holds and what it assumes, or why it is none."""
    name = escape(path.name)
    try:
        said, *assuming = str(proofs.check(path)).split("\n")
    except (CertificateRejected, OSError) as refusal:
        return f'<h3>{name}</h3><p class="not">{REJECTED}: {escape(str(refusal))}</p>'
    assumptions = "".join(f"<li>{escape(line.strip())}</li>" for line in assuming)
    return f'<h3>{name}</h3><p class="proved">{escape(said)}</p><ul>{assumptions}</ul>'


def _model_chapter(report: Path) -> str:
    """What `nlsid identify` and `nlsid funnel` have written, or nothing."""
    if not report.is_file():
        return ""
    text = report.read_text(encoding="utf-8", errors="replace")
    _, begins, rest = text.partition(MODEL_BEGINS)
    chapter, ends, _ = rest.partition(MODEL_ENDS)
    if not (begins and ends):
        return ""
    chapter = chapter.replace("<h2>", "<h3>").replace("</h2>", "</h3>")
    return f'<p class="note">As it was written when model and funnel were made.</p>{chapter}'


def _pictures(folder: Path, *, without: set[str]) -> str:
    figures = []
    for name, caption in PICTURES.items():
        path = folder / name
        if name in without or not path.is_file() or path.stat().st_size > LARGEST_PICTURE:
            continue
        content = path.read_bytes()
        if content.startswith(b"\x89PNG"):
            data = base64.b64encode(content).decode()
            figures.append(
                f'<figure><img alt="{caption}" src="data:image/png;base64,{data}">'
                f"<figcaption>{caption}</figcaption></figure>"
            )
    return "".join(figures)


def _loaded(folder: Path) -> AnyDesign | None:
    """The folder's design, if there is one that holds; the chapter on the proofs says why not."""
    try:
        return documents.load(folder)
    except (NlsidError, OSError):
        return None


def _drawn(folder: Path, design: AnyDesign) -> str:
    """The tube around a motion, where no picture of it lies in the folder; empty without one.

    One around a simulation is as wide always, or as the commands move it: `catching.png` has it.
    """
    if (
        isinstance(design.funnel, TubeFunnel)
        or (folder / documents.FUNNEL_PLOT).is_file()
        or not report_available()
    ):
        return ""
    from bags.pictures import plots, tubes  # matplotlib only where something is drawn

    figure = plots.svg(tubes.draw_tube(design))
    return f"<figure>{figure}<figcaption>{FUNNEL_CAPTION}</figcaption></figure>"
