"""What the commands of the chain print."""

import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from bags.chain.config import Config
from bags.chain.steps import Identified
from bags.commands.options import details, progress_bar
from bags.designs import documents
from bags.designs.displacement import displacement_half_width, washouts_of
from bags.designs.provenance import of_funnel
from bags.monitoring.replay import Replay, replay_bag
from bags.pictures import tables
from bags.pictures.report import report_available
from bags.recordings.definitions import read_definitions
from bags.signals.grid import said_restarts
from bags.signals.sampling import said_filled
from nlsid_core.design import OutputTubeDesign
from nlsid_core.designs import AnyDesign
from nlsid_core.errors import DataError, counted, percent
from nlsid_core.funnels.tube import Tube
from nlsid_core.identification.prediction import history
from nlsid_core.identification.validation import unscored
from nlsid_core.kernel import text
from nlsid_core.running.comparison import Centre
from nlsid_core.running.reading import Status

COLOURS = {
    Status.INSIDE.value: "green",
    Status.OUTSIDE.value: "red",
    Status.ASSUMPTION_VIOLATED.value: "dark_orange3",
    Status.UNKNOWN.value: "magenta",
}
MOST_SAID = 100.0  # of what is assumed: nobody reads more of it
COLUMNS = 80  # of a terminal that is not asked
UNJUDGED_SAID = 3  # of the samples of a bag that are not judged, then their number


def say_identified(console: Console, result: Identified) -> None:
    """What the model is worth in a sentence, every method, what to know, and the files."""
    say(console, worth(result))
    console.print(tables.methods_table(result.fit, result.test))
    for line in (str(result.fit.history), result.fit.slowest, *_residuals(result)):
        say(details, line)
    for line in notes(result):
        say(console, line)
    say_written(console, result.files)
    if not report_available():
        say(console, f"no {documents.REPORT}: install matplotlib (pip install 'nlsid[report]')")


def worth(result: Identified) -> str:
    """How well the model simulates, and what is proved of it."""
    chosen, test = result.fit.chosen, result.test
    error = result.fit.errors["test"][result.fit.method.name]
    scored = max(history(chosen.model), unscored(test, chosen.transient))
    return (
        f"The model simulates {counted(len(test), 'test trial')} with an error of "
        f"{percent(error)}{tables.in_unit(test, error, first=scored)}. "
        f"{tables.stability_sentence(chosen)}"
    )


def say(console: Console, line: str) -> None:
    """Print a line as it is, whatever is in it."""
    console.print(line, soft_wrap=True, markup=False, highlight=False)


def say_written(console: Console, paths: Sequence[Path]) -> None:
    """The files by name, and their folder."""
    names = ", ".join(dict.fromkeys(path.name for path in paths))
    say(console, f"wrote {names} in {paths[0].parent}")


def _residuals(result: Identified) -> list[str]:
    """What is left in the errors of the test trials, or why that is not known."""
    try:
        return str(result.fit.chosen.validate(result.test)).splitlines()
    except DataError as reason:
        return [f"residuals not tested: {reason}"]


def notes(result: Identified) -> list[str]:
    """What a user should know beside the table: what was skipped, filled or not proved."""
    lines = []
    if result.trials.skipped:
        lines.append(f"{result.trials.skipped} samples skipped in gaps")
    if said := said_filled(result.trials.filled, sum(map(len, result.trials.every))):
        lines.append(said)
    return [*lines, *said_restarts(result.trials.every), *result.trials.apart]


def promise(design: OutputTubeDesign) -> str:
    """What the tube promises and on what, without its formulas."""
    tube = _plainest(design)
    scaled = " times sqrt(g), g of the commands," if tube.follows is not None else ""
    widths = zip(design.signals[0], tube.half_widths.tolist(), strict=True)
    stays = " and ".join(
        f"{signal.name} stays within {text.above(Fraction(width))} {signal.unit}".rstrip()
        for signal, width in widths
    )
    lasting = "for ever" if tube.samples is None else f"for {tube.samples} samples"
    measured, count = tube.measured, len(tube.measured.measured_on)
    trials = counted(count, "trial")
    if measured.rank > 1:
        trials = f"{count + 1 - measured.rank} of {trials}"
    return (
        f"Proved: the measured {stays}{scaled} of the model's simulation, {lasting}. It holds "
        f"while the model's one-step errors are at most {measured.safety_factor:g} times as large "
        f"as in {trials}; the monitor watches that."
    )


def _plainest(design: OutputTubeDesign) -> Tube:
    """The tightest of those whose half-widths hold as they stand, and for ever, if there are."""
    return min(
        design.funnel.tubes,
        key=lambda tube: (tube.follows is not None, tube.samples or 0, tube.half_widths.prod()),
    )


def say_tube(console: Console, design: OutputTubeDesign) -> None:
    """What the tube promises, of positions and of a next trial too; its formulas are details."""
    say(console, promise(design))
    signals, tube = design.signals[0], _plainest(design)
    moving = zip(washouts_of(signals), tube.half_widths.tolist(), signals, strict=True)
    for time, width, signal in moving if tube.samples is None else ():
        if time is not None:
            moved = text.above(displacement_half_width(width, time, time))
            scaled = " times the largest sqrt(g) meanwhile" if tube.follows is not None else ""
            say(
                console,
                f"what {signal.name} moves in at most {text.below(time)} s is within {moved} "
                f"{signal.unit}{scaled} of what the simulation moves",
            )
    provenance = of_funnel(design.model.document(), design.funnel.document())
    for line in dict.fromkeys(provenance.promised):
        say(console, line)
    for line in (*str(design.verdict).splitlines(), *provenance.said):
        say(details, line)


def replayed(
    design: AnyDesign,
    bags: Sequence[Path],
    settings: Config | None,
    definitions: Sequence[Path] = (),
) -> list[Replay]:
    """Each bag held against the design, as the configuration says."""
    configured = settings.definitions if settings else ()
    types = read_definitions([*definitions, *configured])
    replays = []
    with progress_bar("replaying") as progress:
        for done, bag in enumerate(bags):
            progress(bag.name, done / len(bags))
            replays.append(replay_bag(design, bag, centre=centre_of(settings), definitions=types))
    return replays


def say_replays(console: Console, replays: Sequence[Replay]) -> None:
    """The table, and what is to be known of each bag."""
    console.print(replay_table(replays))
    lines = [line for replay in replays for line in replay_lines(replay)]
    for line in (*lines, *paced_lines(replays)):
        console.print(line, soft_wrap=True, markup=False, highlight=False)


def draw_tube(folder: Path, design: AnyDesign) -> list[Path]:
    """Draw the tube around a motion into the design's folder; the files written."""
    if not report_available():
        return []
    from bags.pictures.tubes import write_tube

    picture = folder / documents.FUNNEL_PLOT
    write_tube(picture, design)
    return [picture]


def replay_lines(replay: Replay) -> Iterator[str]:
    """Why a bag is not inside, what else was seen, and what was not judged."""
    left = replay.first_outside
    if replay.first_bad is not None:
        yield f"{replay.name}: {replay.reason}"
    if left is not None and left is not replay.first_bad:
        yield f"{replay.name}: outside at {left.t:.3f} s, the first time"
    if (alarm := replay.first_alarm) is not None:
        yield f"{replay.name}: from {alarm.t:.3f} s on, {alarm.alarm}"
    for said in filter(None, (replay.beyond, replay.said_filled, replay.said_wide)):
        yield f"{replay.name}: {said}"
    if not replay.judged:
        if not replay.paced:  # said of all such bags together
            yield f"{replay.name}: nothing was judged: {replay.reason}"
        return
    if replay.starting > len(replay.judged):
        yield (
            f"{replay.name}: only {len(replay.judged)} of {len(replay.readings)} samples were "
            f"judged: the first {replay.starting} start the run"
        )
    for stretch in replay.unjudged[:UNJUDGED_SAID]:
        yield f"{replay.name}: not judged: {stretch.where}: {stretch.why}"
    if more := replay.unjudged[UNJUDGED_SAID:]:
        samples = sum(stretch.samples for stretch in more)
        yield (
            f"{replay.name}: not judged: {samples} more samples in {len(more)} "
            f"{'place' if len(more) == 1 else 'places'}, the last {more[-1].where}"
        )


def paced_lines(replays: Sequence[Replay]) -> Iterator[str]:
    """Once for all bags of which nothing was judged as their samples have another period."""
    if not (other := [replay for replay in replays if replay.paced]):
        return
    named = [f"{replay.name} {replay.paced:.4g} s" for replay in other[:UNJUDGED_SAID]]
    more = f" and {len(other) - len(named)} more" if len(other) > len(named) else ""
    bags = "1 bag has samples" if len(other) == 1 else f"{len(other)} bags have samples"
    yield (
        f"nothing was judged: {bags} of another period than the model's {other[0].period:g} s: "
        f"{', '.join(named)}{more}; record at the model's, or identify a model at theirs; "
        "of a table on another grid than its bag's, end the response's path in |linear(0.1 s)"
    )


def replay_table(replays: Sequence[Replay]) -> Table:
    """One row per bag: verdict, worst margin, when, nearest bound, assumption, first bad sample.

    The nearest bound is left out where all have the same. COLUMNS wide or less: where a row is
    longer it goes on in the next line between words; numbers never do.
    """
    table = Table(
        title="held against the funnel",
        caption="margin: the worst; 1 in the middle of the tube, 0 on its edge. used: how much "
        "of the assumption",
        title_justify="left",
        caption_justify="left",
        box=SIMPLE_HEAD,
        show_edge=False,
        padding=0,
    )
    rows = [_replay_row(replay) for replay in replays]
    axes = {row["axis"] for row in rows if row["axis"] != "-"}
    names = [name for name in rows[0] if name != "axis" or len(axes) > 1]
    cells = {name: [name, *(row[name] for row in rows)] for name in names}
    kept = {k: max(len(Text.from_markup(cell)) for cell in cells[k]) for k in names}
    least = {
        "verdict": 10,
        "axis": max(len(word) for row in rows for word in ("axis", *row["axis"].split())),
        "judged": 8,
        "bag": 8,
    }
    for name in (name for name in least if name in kept):
        over = max(sum(kept.values()) + len(kept) - COLUMNS, 0)
        kept[name] = max(kept[name] - over, min(kept[name], least[name]))
    for name in names:
        table.add_column(
            name,
            justify="left" if name in ("bag", "verdict", "axis") else "right",
            width=kept[name],
            overflow="fold",
        )
    for row in rows:
        table.add_row(*(row[name] for name in names))
    return table


def _replay_row(replay: Replay) -> dict[str, str]:
    worst, bad = replay.worst, replay.first_bad
    alarm = ", alarm" if bad is None and replay.first_alarm is not None else ""
    return {
        "bag": escape(replay.name),
        "verdict": f"[{COLOURS[replay.verdict]}]{replay.verdict}[/]{alarm}",
        "margin": "-" if worst is None else f"{worst.margin:.3f}",
        "at": "-" if worst is None else f"{worst.t:.3f} s",
        "axis": "-" if worst is None else escape(worst.worst_axis),
        "used": "-" if worst is None else _percent(replay.assumption),
        "bad from": "-" if bad is None else f"{bad.t:.3f} s",
        "judged": f"{replay.judged_span:.1f} of {replay.span:.1f} s",
    }


def _percent(part: float) -> str:
    """The part of the assumption that is used; a continuous funnel's is not measured."""
    if math.isnan(part):
        return "not measured"
    return f"{100 * part:.0f} %" if part < MOST_SAID else f"> {100 * MOST_SAID:.0f} %"


def centre_of(settings: Config | None) -> Centre:
    """What a tube is configured to be around; without a configuration the received commands."""
    return Centre.COMMAND if settings is None else settings.monitor.nominal_source
