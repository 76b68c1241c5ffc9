"""`nlsid report`: one page of a whole design folder, whatever its kind, to read, send and print.

The page stands alone: no script, no link outside, pictures inside. Proofs are decided again while
it is made. What `nlsid identify` and `nlsid funnel` have drawn into the folder's report is in it.
"""

import base64
import math
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime
from html import escape
from pathlib import Path

from bags.designs import documents
from bags.monitoring.replay import Replay
from bags.pictures.equations_report import equations_chapter
from bags.pictures.report import MODEL_BEGINS, MODEL_ENDS, STYLE
from bags.tools.info import GAP, BagInfo, TopicInfo
from nlsid_core import files, kernel
from nlsid_core.errors import DataError, DocumentError

# Nothing but what stands in the page itself is shown or run, whatever a folder's files say.
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
PRINT = """
nav a { margin-right: 1rem; display: inline-block }
figure { margin: 1rem 0 } figure img { max-width: 100% }
section { overflow-x: auto } h2 { font-size: 1.3rem } h3 { font-size: 1.05rem }
td code { white-space: nowrap } .digests td code { white-space: normal }
@media screen and (max-width: 40rem) { body { font-size: 14px } th, td { padding: .25rem .4rem }
  svg, figure img { max-width: 200% } }
@page { size: A4; margin: 15mm }
@media print { nav { display: none } h2, h3 { break-after: avoid }
  figure, tr, svg { break-inside: avoid } section { overflow: visible }
  table { font-size: .8em } th, td { padding: .2rem .4rem }
  th, td:first-child, td[colspan] { white-space: normal }
  body { max-width: none; margin: 0; font-size: 11pt } }
"""
PICTURES = {
    documents.SELECTION_PLOT: "Orders and bases, chosen by validation",
    documents.COMPARISON_PLOT: "Classes and methods on the same test trials",
    documents.FREE_RUN_PLOT: "The model in free run",
    documents.MOTION_PLOT: "The motion that the policy tracks",
    documents.FUNNEL_PLOT: "The funnel",
    documents.CATCHING_PLOT: "What the funnel can catch",
    documents.MARGIN_PLOT: "Recordings held against the funnel, when they were last replayed",
}
REJECTED = "REJECTED"
LARGEST_PICTURE = 20 * 2**20  # bytes
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PATIENCE = 120.0  # s for one of them to print a page


def write_folder_report(
    folder: Path,
    out: Path,
    *,
    recordings: Sequence[BagInfo] = (),
    replays: Sequence[Replay] = (),
    used: Sequence[str] = (),
    drawn: str = "",
) -> None:
    """Write the page of a design folder.

    recordings: bags whose losses are listed, with the topics to list. replays: bags held against
    its funnel, `drawn` their picture as <svg> or empty; used: lines about bags that the design was
    made with. Raises DocumentError if the folder has
    neither a proof nor a report.
    """
    page = folder_page(folder, recordings=recordings, replays=replays, used=used, drawn=drawn)
    files.write_atomically(out, page.encode())


def print_page(page: Path, out: Path) -> None:
    """Print a page to a PDF file by Chromium or Chrome; DataError if there is none, or it fails."""
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        raise DataError(
            f"a PDF is printed by Chromium or Chrome; none of {', '.join(BROWSERS)} is on PATH; "
            f"install one (Debian, Ubuntu: apt install chromium), or open {page} and print it"
        )
    with tempfile.TemporaryDirectory() as scratch:
        printed = Path(scratch) / "page.pdf"
        options = ["--headless", "--disable-gpu", "--no-first-run", "--no-pdf-header-footer",
                   f"--user-data-dir={scratch}/profile", f"--print-to-pdf={printed}"]  # fmt: skip
        if os.geteuid() == 0:  # as root it does not start with one; the page may run nothing anyway
            options.append("--no-sandbox")
        command = [browser, *options, page.resolve().as_uri()]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=PATIENCE, check=False
            )
        except subprocess.TimeoutExpired as error:
            raise DataError(f"{browser} did not print {page} in {PATIENCE:g} s") from error
        if not printed.is_file():
            raise DataError(f"{browser} printed no {out.name}: {done.stderr[-500:].strip()}")
        files.write_atomically(out, printed.read_bytes())


def folder_page(
    folder: Path,
    *,
    recordings: Sequence[BagInfo] = (),
    replays: Sequence[Replay] = (),
    used: Sequence[str] = (),
    drawn: str = "",
) -> str:
    """The whole page as text."""
    proofs = sorted(folder.glob("*.proof.json"))
    decided = "".join(_proof(path) for path in proofs)
    model = _model_chapter(folder / documents.REPORT)
    if model and REJECTED in decided:
        model = f'<p class="not">A proof of this folder does not hold now.</p>{model}'
    if not proofs and not model:
        raise DocumentError(f"{folder}: no proof and no {documents.REPORT} to make a report of")
    funnel = "" if REJECTED in decided else equations_chapter(folder)
    in_model = {documents.CATCHING_PLOT} if "what it can catch" in model else set()
    chapters = {
        "proofs": ("What is proved", decided),
        "model": ("The model", model),
        "funnel": ("The funnel of these equations", funnel),
        "pictures": ("Pictures", _pictures(folder, without=in_model)),
        "recordings": ("Recordings and their losses", _recordings(recordings)),
        "replays": ("Recordings held against the funnel", _replays(replays, used, drawn)),
        "files": ("Files", _files(folder)),
    }
    present = {key: found for key, found in chapters.items() if found[1]}
    links = "".join(f'<a href="#{key}">{title}</a>' for key, (title, _) in present.items())
    body = "".join(
        f'<section id="{key}"><h2>{title}</h2>{text}</section>'
        for key, (title, text) in present.items()
    )
    name = escape(folder.resolve().name)
    return f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{name}: design</title>
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>{STYLE}{PRINT}</style>
<h1>{name}</h1>
<nav>{links}</nav>
{body}
<p class="note">Made {datetime.now(UTC):%Y-%m-%d %H:%M} UTC by nlsid.</p>
</html>
"""


def _proof(path: Path) -> str:
    """A certificate, decided now."""
    name = escape(path.name)
    try:
        verdict = kernel.check(path)
    except (kernel.Rejected, OSError) as refusal:
        return f'<h3>{name}</h3><p class="not">{REJECTED}: {escape(str(refusal))}</p>'
    said, *assuming = str(verdict).split("\n")
    assumptions = "".join(f"<li>{escape(line.strip())}</li>" for line in assuming)
    digests = "".join(
        f"<tr><td>{escape(role)}</td><td><code>{escape(digest)}</code></td></tr>"
        for role, digest in verdict.digests.items()
    )
    return (
        f'<h3>{name}</h3><p class="proved">{escape(said)}</p><ul>{assumptions}</ul>'
        f'<table class="left digests"><tbody>{digests}</tbody></table>'
    )


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


def _recordings(recordings: Sequence[BagInfo]) -> str:
    """A row for each topic of each bag: how much came, how regularly, and what was lost."""
    if not recordings:
        return ""
    names = ("bag", "topic", "messages", "rate", "gaps", "longest interval", "lost", "remarks")
    head = "".join(f"<th>{name}</th>" for name in names)
    rows = "".join(_recorded(info, topic) for info in recordings for topic in info.topics)
    return f"""<table class="left"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>
<p class="note">Gap: an interval of more than {GAP:g} times the median one. Lost: by
the recorder's count or by the sequence numbers in the file; "not counted" where neither
counts.</p>"""


def _recorded(info: BagInfo, topic: TopicInfo) -> str:
    lost = info.lost(topic)
    remarks = [*([f"unfinished: {info.ending}"] if info.ending else []), *topic.odd]
    cells = [
        info.path.name,
        topic.topic,
        str(topic.count),
        "-" if math.isnan(topic.rate) else f"{topic.rate:.4g} Hz",
        str(topic.gaps),
        "-" if math.isnan(topic.longest) else f"{topic.longest:.3g} s",
        "not counted" if lost is None else str(lost),
        "; ".join(remarks) or "none",
    ]
    return "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>"


def _replays(replays: Sequence[Replay], used: Sequence[str], drawn: str) -> str:
    if not replays:
        return ""
    rows = "".join(_replay(replay) for replay in replays)
    head = "".join(
        f"<th>{name}</th>"
        for name in ("bag", "verdict", "least margin", "at", "assumption used", "judged")
    )
    lines = "".join(f"<p>{escape(line[0].upper() + line[1:])}.</p>" for line in used)
    return f"""<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>{lines}
<p class="note">Margin: 1 on the nominal, 0 on the boundary of the tube. Used: the
most of what is assumed that any judged sample used.</p>{drawn}"""


def _replay(replay: Replay) -> str:
    tag = "proved" if replay.verdict == "inside" else "not"
    worst = replay.worst
    said = escape(f"{replay.verdict}: {replay.reason}" if replay.reason else replay.verdict)
    cells = ["-", "-", "-"]
    if worst is not None:
        cells = [f"{worst.margin:.3f}", f"{worst.t:.3f} s", f"{100 * replay.assumption:.0f} %"]
    cells.append(f"{replay.judged_span:.1f} of {replay.span:.1f} s")
    return (
        f'<tr><td>{escape(replay.name)}</td><td class="{tag}">{said}</td>'
        + "".join(f"<td>{cell}</td>" for cell in cells)
        + "</tr>"
    )


def _files(folder: Path) -> str:
    rows = "".join(
        f"<tr><td>{escape(path.name)}</td><td>{path.stat().st_size} B</td></tr>"
        for path in sorted(folder.iterdir())
        if path.is_file()
    )
    return f"<table><tbody>{rows}</tbody></table>"
