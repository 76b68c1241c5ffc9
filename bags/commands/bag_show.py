"""What `nlsid bag` prints."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from bags.tools.fitness import Fitness
    from bags.tools.info import BagInfo, Messages, TopicInfo
    from bags.tools.listing import Listed

STYLES = ("green", "dark_orange3", "red")
VERDICTS = ("fit for identification", "usable, with care", "not fit for identification")


def show_info(console: Console, info: BagInfo) -> None:
    """The bag in a line, its state, its topics in a table, and what is odd about them."""
    files = f"{info.files} file{'s' if info.files != 1 else ''}"
    first_ns, last_ns = info.span_ns
    _say(
        console,
        f"{info.path}: {info.messages} messages on {len(info.topics)} topics, "
        f"{(last_ns - first_ns) / 1e9:.3f} s, {files}, {_size(info.size)}",
    )
    if info.messages:
        _say(console, f"from {_date(first_ns)} to {_date(last_ns)} UTC")
    _say(console, ", ".join(f"{name} {said}" for name, said in info.made.items() if said))
    if info.ending is not None:
        _say(console, f"unfinished: {info.ending}; `nlsid bag recover` makes a whole bag of it")
    for note in info.notes:
        _say(console, f"not as stated: {note}")
    table = Table(box=None, pad_edge=False)
    for name in ("topic", "type"):
        table.add_column(name, overflow="fold")
    for name in ("count", "rate", "jitter", "gaps", "longest", "size"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("offered")
    for topic in info.topics:
        table.add_row(
            Text(topic.topic),
            Text(topic.msgtype.replace("/msg/", "/")),
            str(topic.count),
            "-" if math.isnan(topic.times.rate) else f"{topic.times.rate:.4g} Hz",
            "-" if math.isnan(topic.times.jitter) else f"{topic.times.jitter:.3g} s",
            str(topic.times.gaps) if topic.times.gaps else "-",
            "-" if math.isnan(topic.times.longest) else f"{topic.times.longest:.3g} s",
            "-" if topic.messages is None else _size(topic.messages.size),
            "; ".join(f"{p.reliability} {p.durability}" for p in topic.offered) or "-",
        )
    console.print(table)
    for topic in info.topics:
        for what in [] if topic.messages is None else _said_messages(topic.messages):
            _say(console, f"{topic.topic}: {what}")
    for key, value in info.custom.items():
        _say(console, f"{key}: {value}")


def _said_messages(found: Messages) -> list[str]:
    """How the stamps go beside the log times, and what is odd."""
    if found.stamps is None or (clock := found.stamps.clock) is None:
        return found.odd
    latency, spread = 1e3 * clock.latency, 1e3 * clock.spread
    return [f"{clock}, latency {latency:.3g} ms (95 % {spread:.3g} ms)", *found.odd]


def _date(stamp_ns: int) -> str:
    """A time in UTC to the millisecond."""
    return datetime.fromtimestamp(stamp_ns / 1e9, UTC).isoformat(" ", "milliseconds")[:23]


def signals_table(found: Sequence[Listed]) -> Table:
    """Every number of every topic: signal, number type, unit, smallest and largest value."""
    table = Table(box=None, pad_edge=False)
    table.add_column("signal", overflow="fold")
    table.add_column("number")
    table.add_column("unit")
    for name in ("elements", "lowest", "highest"):
        table.add_column(name, justify="right")
    for listed in found:
        elements = str(listed.elements) if "[*]" in listed.signal else ""
        ends = ["-" if math.isnan(end) else f"{end:.6g}" for end in (listed.low, listed.high)]
        table.add_row(Text(listed.signal), listed.number, listed.unit, elements, *ends)
        if listed.note and listed.number == "":
            table.add_row(Text(f"  {listed.note}", style="dim"))
    return table


def info_json(info: BagInfo) -> str:
    """What `show_info` shows, as JSON; times in s, sizes in bytes, null where nothing is known."""
    first_ns, last_ns = info.span_ns
    return as_json(
        {
            "bag": str(info.path),
            "messages": info.messages,
            "start_ns": first_ns,
            "end_ns": last_ns,
            "duration": (last_ns - first_ns) / 1e9,
            "files": info.files,
            "size": info.size,
            **info.made,
            "unfinished": info.ending,
            "not_as_stated": list(info.notes),
            "custom": dict(info.custom),
            "topics": [_topic(topic) for topic in info.topics],
        }
    )


def _topic(topic: TopicInfo) -> dict[str, object]:
    return {
        "topic": topic.topic,
        "type": topic.msgtype,
        "count": topic.count,
        **topic.times._asdict(),
        "offered_qos_profiles": [profile.document() for profile in topic.offered],
        "messages": None if topic.messages is None else asdict(topic.messages),
    }


def fitness_json(results: Sequence[Fitness]) -> str:
    """The verdicts and their reasons as JSON; levels: good, look, bad."""
    return as_json(
        [
            {
                "bag": str(result.bag),
                "verdict": result.verdict.name.lower(),
                "findings": [
                    {"level": found.level.name.lower(), "check": found.check, "what": found.what}
                    for found in result.findings
                ],
            }
            for result in results
        ]
    )


def as_json(content: object) -> str:
    """Numbers and texts as JSON; null where nothing is known."""
    return json.dumps(_without_nan(content), ensure_ascii=False, indent=2, allow_nan=False)


def _without_nan(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _without_nan(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_without_nan(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def show_fitness(console: Console, fitness: Fitness) -> None:
    """The verdict on a bag and its reasons."""
    verdict = VERDICTS[fitness.verdict]
    console.print(Text(f"{fitness.bag}: {verdict}", style=STYLES[fitness.verdict]), soft_wrap=True)
    for finding in sorted(fitness.findings, key=lambda found: -found.level):
        line = Text(f"  {finding.level.name.lower()} ", style=STYLES[finding.level])
        line.append(f"{finding.check}: {finding.what}", style="default")
        console.print(line, soft_wrap=True)


def _say(console: Console, text: str) -> None:
    console.print(text, soft_wrap=True, markup=False, highlight=False)


def _size(size: int) -> str:
    if size < 10_000:
        return f"{size} B"
    return f"{size / 1e3:.0f} kB" if size < 10_000_000 else f"{size / 1e6:.1f} MB"
