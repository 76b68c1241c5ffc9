"""What `nlsid bag` prints."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from bags.tools.fitness import Fitness, Level
from bags.tools.info import BagInfo, TopicInfo
from bags.tools.listing import Listed

WORDS = {Level.GOOD: "good", Level.LOOK: "look", Level.BAD: "bad"}
STYLES = {Level.GOOD: "green", Level.LOOK: "dark_orange3", Level.BAD: "red"}
VERDICTS = {
    Level.GOOD: "fit for identification",
    Level.LOOK: "usable, with care",
    Level.BAD: "not fit for identification",
}
JITTER_KEY = "jitter: intervals of <0.5 0.5 0.8 0.95 1.05 1.25 2 >5 times the median"


def show_info(console: Console, info: BagInfo) -> None:
    """The bag in a line, its state, its topics in a table, and what is odd about them."""
    files = f"{info.files} file{'s' if info.files != 1 else ''}"
    console.print(
        f"{info.path}: {info.messages} messages on {len(info.topics)} topics, "
        f"{info.duration:.3f} s, {files}, {info.size / 1e6:.2f} MB",
        soft_wrap=True,
        markup=False,
        highlight=False,
    )
    if info.ending is not None:
        _say(console, f"unfinished: {info.ending}; `nlsid bag recover` makes a whole bag of it")
    for note in info.notes:
        _say(console, f"not as stated: {note}")
    table = Table(box=None, pad_edge=False)
    for name in ("topic", "type"):
        table.add_column(name, overflow="fold")
    for name in ("count", "rate", "jitter", "gaps", "longest", "size"):
        table.add_column(name, justify="right", no_wrap=True)
    for topic in info.topics:
        table.add_row(
            Text(topic.topic),
            Text(topic.msgtype.replace("/msg/", "/")),
            str(topic.count),
            "-" if math.isnan(topic.times.rate) else f"{topic.times.rate:.4g} Hz",
            topic.times.jitter,
            str(topic.times.gaps) if topic.times.gaps else "-",
            "-" if math.isnan(topic.times.longest) else f"{topic.times.longest:.3g} s",
            _size(topic.size),
        )
    console.print(table)
    for topic in info.topics:
        if topic.stamps is not None and (clock := topic.stamps.clock) is not None:
            latency, spread = 1e3 * clock.latency, 1e3 * clock.spread
            said = f"{clock}, latency {latency:.3g} ms (95 % {spread:.3g} ms)"
            _say(console, f"{topic.topic}: {said}")
        for what in topic.odd:
            _say(console, f"{topic.topic}: {what}")
    for key, value in info.custom.items():
        _say(console, f"{key}: {value}")
    console.print(JITTER_KEY, style="dim", highlight=False)


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
    return _json(
        {
            "bag": str(info.path),
            "messages": info.messages,
            "duration": info.duration,
            "files": info.files,
            "size": info.size,
            "unfinished": info.ending,
            "not_as_stated": list(info.notes),
            "custom": dict(info.custom),
            "topics": [_topic(topic) for topic in info.topics],
        }
    )


def _topic(topic: TopicInfo) -> dict[str, object]:
    stamps = topic.stamps
    return {
        "topic": topic.topic,
        "type": topic.msgtype,
        "count": topic.count,
        "size": topic.size,
        "rate": topic.times.rate,
        "gaps": topic.times.gaps,
        "longest_interval": topic.times.longest,
        "first_log_time_ns": topic.times.first_ns if topic.count else None,
        "last_log_time_ns": topic.times.last_ns if topic.count else None,
        "stamps_back": stamps.backward if stamps else 0,
        "stamps_repeated": stamps.duplicates if stamps else 0,
        "stamps_zero": stamps is not None and stamps.clock is None,
        "missing": topic.missing,
        "clock": asdict(stamps.clock) if stamps and stamps.clock else None,
        "unreadable": topic.unreadable or None,
    }


def signals_json(found: Sequence[Listed]) -> str:
    """The signals as JSON."""
    return _json([asdict(listed) for listed in found])


def fitness_json(results: Sequence[Fitness]) -> str:
    """The verdicts and their reasons as JSON; levels: good, look, bad."""
    return _json(
        [
            {
                "bag": str(result.bag),
                "verdict": WORDS[result.verdict],
                "findings": [
                    {"level": WORDS[found.level], "check": found.check, "what": found.what}
                    for found in result.findings
                ],
            }
            for result in results
        ]
    )


def _json(content: object) -> str:
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
        line = Text(f"  {WORDS[finding.level]} ", style=STYLES[finding.level])
        line.append(f"{finding.check}: {finding.what}", style="default")
        console.print(line, soft_wrap=True)


def _say(console: Console, text: str) -> None:
    console.print(text, soft_wrap=True, markup=False, highlight=False)


def _size(size: int) -> str:
    if size < 10_000:
        return f"{size} B"
    return f"{size / 1e3:.0f} kB" if size < 10_000_000 else f"{size / 1e6:.1f} MB"
