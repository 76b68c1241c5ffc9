"""`nlsid report`: one page of a whole design folder, whatever its kind, to read, send and print.

The page stands alone: no script, no link outside, pictures inside. Proofs are decided again while
it is made. What `nlsid identify` and `nlsid funnel` have drawn into the folder's report is in it.
"""

import base64
import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from html import escape
from importlib.metadata import version
from pathlib import Path

from bags.designs import documents
from bags.monitoring.replay import Replay
from bags.pictures.equations_report import equations_chapter
from bags.pictures.report import MODEL_BEGINS, MODEL_ENDS, STYLE, drawable, report_available
from bags.tools.info import GAP, BagInfo, TopicInfo
from nlsid_core import files, proofs
from nlsid_core.designs import AnyDesign
from nlsid_core.errors import CertificateRejected, DocumentError, NlsidError
from nlsid_core.funnels.tube import TubeFunnel
from nlsid_core.kernel import Verdict

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
ROBOT = re.compile(r"<h1>([^<]*): identified model</h1>")
FUNNEL_CAPTION = "The funnel: the tube around the motion"
PICTURES = {
    documents.FREE_RUN_PLOT: "The model in free run",
    documents.FUNNEL_PLOT: FUNNEL_CAPTION,
    documents.CATCHING_PLOT: "What the funnel can catch",
    documents.MARGIN_PLOT: "Recordings held against the funnel, when they were last replayed",
}
REJECTED = "REJECTED"
LARGEST_PICTURE = 20 * 2**20  # bytes


@dataclass(frozen=True)
class Held:
    """Bags that a page lists: their losses, how they were held against the funnel, and lines about
    those that the design was made with.
    """

    recordings: Sequence[BagInfo] = ()
    replays: Sequence[Replay] = ()
    used: Sequence[str] = ()


def write_folder_report(folder: Path, out: Path, held: Held | None = None) -> None:
    """Write the page of a design folder.

    Raises DocumentError if the folder has neither a proof nor a report.
    """
    files.write_atomically(out, folder_page(folder, held or Held()).encode())


def folder_page(folder: Path, held: Held) -> str:
    """The whole page as text."""
    proofs = {path.name: _decided(path) for path in sorted(folder.glob("*.proof.json"))}
    decided = "".join(_proof(name, found) for name, found in proofs.items())
    model = _model_chapter(folder / documents.REPORT)
    if model and REJECTED in decided:
        model = f'<p class="not">A proof of this folder does not hold now.</p>{model}'
    if not proofs and not model:
        raise DocumentError(f"{folder}: no proof and no {documents.REPORT} to make a report of")
    design = None if REJECTED in decided else _design(folder)
    funnel = "" if design is None else equations_chapter(design)
    in_model = {documents.CATCHING_PLOT} if "what it can catch" in model else set()
    chapters = {
        "proofs": ("What is proved", decided),
        "model": ("The model", model),
        "funnel": ("The funnel of these equations", funnel),
        "pictures": ("Pictures", _pictures(folder, design, without=in_model)),
        "replays": ("Recordings held against the funnel", _replays(held)),
        "recordings": ("Recordings and their losses", _recordings(held.recordings)),
        "files": ("Files", _files(folder, proofs)),
    }
    present = {key: found for key, found in chapters.items() if found[1]}
    links = "".join(f'<a href="#{key}">{title}</a>' for key, (title, _) in present.items())
    body = "".join(
        f'<section id="{key}"><h2>{title}</h2>{text}</section>'
        for key, (title, text) in present.items()
    )
    name = escape(folder.resolve().name)
    robot = _robot(folder / documents.REPORT) or name
    return f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{robot}: design</title>
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>{STYLE}{PRINT}</style>
<h1>{robot}</h1>
<p class="note">Folder {name}, {datetime.now(UTC):%Y-%m-%d %H:%M} UTC, nlsid {version("nlsid")}</p>
<nav>{links}</nav>
{body}
</html>
"""


def _robot(report: Path) -> str:
    """What the configuration calls the robot, as the model's own page has it; or nothing."""
    if not report.is_file():
        return ""
    found = ROBOT.search(report.read_text(encoding="utf-8", errors="replace"))
    return found[1] if found else ""


def _decided(path: Path) -> Verdict | str:
    """A certificate, decided now: the verdict, or why it is none."""
    try:
        return proofs.check(path)
    except (CertificateRejected, OSError) as refusal:
        return str(refusal)


def _proof(name: str, found: Verdict | str) -> str:
    """What was decided of it, in words."""
    if isinstance(found, str):
        return f'<h3>{escape(name)}</h3><p class="not">{REJECTED}: {escape(found)}</p>'
    said, *assuming = str(found).split("\n")
    assumptions = "".join(f"<li>{escape(line.strip())}</li>" for line in assuming)
    return f'<h3>{escape(name)}</h3><p class="proved">{escape(said)}</p><ul>{assumptions}</ul>'


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


def _pictures(folder: Path, design: AnyDesign | None, *, without: set[str]) -> str:
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
    if not (folder / documents.FUNNEL_PLOT).is_file() and (drawn := _drawn(design)):
        figures.append(f"<figure>{drawn}<figcaption>{FUNNEL_CAPTION}</figcaption></figure>")
    return "".join(figures)


def _design(folder: Path) -> AnyDesign | None:
    """The design of a folder; None where there is none that is proved."""
    try:
        return documents.load(folder)
    except (NlsidError, OSError):
        return None  # the chapter on the proofs says why


def _drawn(design: AnyDesign | None) -> str:
    """The tube around a motion as <svg>; empty where there is none.

    One around a simulation is as wide always, or as the commands move it: `catching.png` has it.
    """
    if design is None or isinstance(design.funnel, TubeFunnel) or not report_available():
        return ""
    from bags.pictures import plots, tubes  # matplotlib only where something is drawn

    return plots.svg(tubes.draw_tube(design))


def _recordings(recordings: Sequence[BagInfo]) -> str:
    """A row for each topic of each bag: how much came, how regularly, and what was lost.

    Bags with nothing to say of a topic share one row.
    """
    if not recordings:
        return ""
    names = ("bag", "topic", "messages", "rate", "gaps", "longest interval", "lost", "remarks")
    head = "".join(f"<th>{name}</th>" for name in names)
    listed = [(info, topic) for info in recordings for topic in info.topics]
    quiet: dict[str, list[tuple[BagInfo, TopicInfo]]] = {}
    for info, topic in listed:
        if not (topic.times.gaps or info.lost(topic) or _remarks(info, topic)):
            quiet.setdefault(topic.topic, []).append((info, topic))
    together = {id(topic) for alike in quiet.values() for _, topic in alike}
    apart = [pair for pair in listed if id(pair[1]) not in together]
    rows = "".join(map(_recorded, [*([pair] for pair in apart), *quiet.values()]))
    return f"""<table class="left"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>
<p class="note">Gap: an interval of more than {GAP:g} times the median one. Lost: by
the recorder's count or by the sequence numbers in the file; "not counted" where neither
counts.</p>"""


def _remarks(info: BagInfo, topic: TopicInfo) -> list[str]:
    return [*([f"unfinished: {info.ending}"] if info.ending else []), *topic.odd]


def _recorded(alike: Sequence[tuple[BagInfo, TopicInfo]]) -> str:
    """One topic of a bag, or of several with nothing to say of it."""
    (info, topic), *others = alike
    topics = [topic for _, topic in alike]
    lost = [of.lost(each) for of, each in alike]
    cells = [
        f"{info.path.name} and {len(others)} more" if others else info.path.name,
        topic.topic,
        _between([each.count for each in topics]),
        _between([each.times.rate for each in topics], " Hz"),
        str(topic.times.gaps),
        _between([max(each.times.longest for each in topics)], " s"),
        "not counted" if None in lost else _between([of for of in lost if of is not None]),
        "; ".join(_remarks(info, topic)) or "none",
    ]
    return "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>"


def _between(values: Sequence[float], unit: str = "") -> str:
    """One number, or from the least to the largest; - where there is none."""
    known = [value for value in values if not math.isnan(value)]
    if not known:
        return "-"
    ends = dict.fromkeys(f"{value:.4g}" for value in (min(known), max(known)))
    return f"{' to '.join(ends)}{unit}"


def _replays(held: Held) -> str:
    if not held.replays:
        return ""
    rows = "".join(map(_replay, held.replays))
    names = ("bag", "verdict", "least margin", "at", "assumption used", "judged")
    head = "".join(f"<th>{name}</th>" for name in names)
    wide = "".join(
        f'<p class="not">{escape(f"{replay.name}: {replay.said_wide}")}</p>'
        for replay in held.replays
        if replay.said_wide
    )
    lines = "".join(f"<p>{escape(line[0].upper() + line[1:])}.</p>" for line in held.used)
    drawn = ""
    if drawable(held.replays):
        from bags.pictures import plots  # matplotlib only where something is drawn

        drawn = plots.svg(plots.margins(held.replays))
    return f"""<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>{lines}
<p class="note">Margin: 1 on the nominal, 0 on the boundary of the tube. Used: the
most of what is assumed that any judged sample used.</p>{wide}{drawn}"""


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


def _files(folder: Path, proofs: Mapping[str, Verdict | str]) -> str:
    """Every file with its digest, and of which proofs it is a part, byte for byte."""
    parts: dict[str, list[str]] = {}
    for name, found in proofs.items():
        for role, digest in {} if isinstance(found, str) else found.digests.items():
            part = "decided" if role == "proof" else f"{role} of {name}"
            parts.setdefault(digest, []).append(part)
    rows = []
    for path in sorted(folder.iterdir()):
        if path.is_file() and path.stem != Path(documents.DESIGN_REPORT).stem:
            with path.open("rb") as stream:
                digest = f"sha256:{hashlib.file_digest(stream, 'sha256').hexdigest()}"
            size = f"{path.stat().st_size / 1e3:,.1f}\N{NO-BREAK SPACE}kB"
            rows.append((path.name, size, digest, parts.get(digest, [])))
    here = {digest for _, _, digest, _ in rows}
    rows += [("not in this folder", "-", digest, parts[digest]) for digest in parts.keys() - here]
    body = "".join(
        f"<tr><td>{escape(name)}</td><td>{length}</td><td>{escape('; '.join(part)) or '-'}</td>"
        f"<td><code>{escape(digest)}</code></td></tr>"
        for name, length, digest, part in rows
    )
    head = "<tr><th>file</th><th>size</th><th>part of a proof</th><th>digest</th></tr>"
    return f'<table class="left digests"><thead>{head}</thead><tbody>{body}</tbody></table>'
