"""What `nlsid bag` prints."""

import math

from rich.console import Console
from rich.table import Table
from rich.text import Text

from bags.recordings.bag import Bag
from bags.signals.signal import numeric_paths
from bags.signals.units import implied_unit
from bags.tools.fitness import Fitness, Level
from bags.tools.info import BagInfo, TopicInfo
from nlsid_core.errors import BagError

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
            "-" if math.isnan(topic.rate) else f"{topic.rate:.4g} Hz",
            topic.jitter,
            str(topic.gaps) if topic.gaps else "-",
            "-" if math.isnan(topic.longest) else f"{topic.longest:.3g} s",
            _size(topic.size),
        )
    console.print(table)
    for topic in info.topics:
        for what in _odd(topic):
            _say(console, f"{topic.topic}: {what}")
    for key, value in info.custom.items():
        _say(console, f"{key}: {value}")
    console.print(JITTER_KEY, style="dim", highlight=False)


def signals_table(bag: Bag) -> Table:
    """Every number of every topic: signal, number type, unit."""
    table = Table(box=None, pad_edge=False)
    table.add_column("signal", overflow="fold")
    table.add_column("number")
    table.add_column("unit")
    for topic in bag.topics:
        try:
            kind = bag.types_on(topic)
            for path, number, owners in numeric_paths(*kind):
                table.add_row(Text(f"{topic}:{path}"), number, implied_unit(owners))
        except BagError as error:
            table.add_row(Text(topic), "-", Text(str(error)[:200], style="dim"))
    return table


def show_fitness(console: Console, fitness: Fitness) -> None:
    """The verdict on a bag and its reasons."""
    verdict = VERDICTS[fitness.verdict]
    console.print(Text(f"{fitness.bag}: {verdict}", style=STYLES[fitness.verdict]), soft_wrap=True)
    for finding in sorted(fitness.findings, key=lambda found: -found.level):
        line = Text(f"  {WORDS[finding.level]} ", style=STYLES[finding.level])
        line.append(f"{finding.check}: {finding.what}", style="default")
        console.print(line, soft_wrap=True)


def _odd(topic: TopicInfo) -> list[str]:
    odd = []
    if topic.clock is not None:
        latency, spread = 1e3 * topic.clock.latency, 1e3 * topic.clock.spread
        odd.append(f"{topic.clock}, latency {latency:.3g} ms (95 % {spread:.3g} ms)")
    if topic.unstamped:
        odd.append("every header stamp is 0: its publisher does not fill it in; use log time")
        return odd
    if topic.backward:
        odd.append(f"header stamps go back in {topic.backward} places")
    if topic.duplicates:
        odd.append(f"{topic.duplicates} header stamps repeat the one before")
    if topic.missing:
        odd.append(f"{topic.missing} sequence numbers are missing: messages were lost")
    if topic.unreadable:
        odd.append(f"cannot be read: {topic.unreadable[:300]}")
    return odd


def _say(console: Console, text: str) -> None:
    console.print(text, soft_wrap=True, markup=False, highlight=False)


def _size(size: int) -> str:
    if size < 10_000:
        return f"{size} B"
    return f"{size / 1e3:.0f} kB" if size < 10_000_000 else f"{size / 1e6:.1f} MB"
