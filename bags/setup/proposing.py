"""From chosen signals to a whole configuration that the later steps take: each value with a reason.

What is proposed is tried: the bags are read with it as identification reads them, and what is
refused there is changed (gaps cut out, responses resampled) or said.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from bags.chain.identification_config import section_of
from bags.chain.steps import Trials, read_trials
from bags.recordings.bag import Bag
from bags.recordings.definitions import read_definitions
from bags.recordings.folders import trial_name
from bags.recordings.message_types import is_stamped, standard_types
from bags.setup import ladder
from bags.setup.candidates import Found, Pair, Unfit, is_named, slope_window
from bags.setup.direction import say_direction
from bags.setup.grid import read_paces, say_grid
from bags.setup.proposal import GRADES, POOR, Proposal
from bags.signals.columns import read_columns
from bags.signals.expressions import Expression, factors, parse_factors
from bags.signals.signal import SignalPath
from bags.signals.timing import RELATED
from nlsid_core.data.repeats import by_excitation
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import BagError, DataError, NlsidError
from nlsid_core.identification import Choice
from nlsid_core.identification.choosing import STRETCHES
from nlsid_core.progress import Progress, silent

TEST_EVERY: Final = 5  # bags: every fifth only scores
SHARE: Final = 0.25  # of every bag that only scores where there are few
MOST_OPTIMISM: Final = 5.0
SAFETY: Final = 1.2  # on the disturbance's amplitude, the funnel's own default
ROUNDED: Final = 1e-9  # relative: what varies by less is the same number, rounded
WASHOUT: Final = 2.0  # s
OTHERS: Final = 3  # commands that are named besides
SHOWN: Final = 6  # of the models that were tried


@dataclass(frozen=True)
class Chosen:
    """What a configuration is made of: signals, what people call the robot, files of types.

    named: the signals that a person named.
    """

    responses: tuple[str, ...]
    excitations: tuple[str, ...]
    robot: str = "robot"
    definitions: tuple[Path, ...] = ()
    named: tuple[str, ...] = ()


def propose(
    bags: Sequence[Path],
    found: Found,
    chosen: Chosen,
    *,
    widen: bool = False,
    progress: Progress = silent,
) -> Proposal:
    """A configuration of these signals for these bags, tried on them.

    widen: where models of one excitation are poor, take those too that the response follows
    besides, if that is better.

    Raises BagError and DataError if the bags cannot be read as any configuration says.
    """
    responses, excitations, definitions = chosen.responses, chosen.excitations, chosen.definitions
    types = read_definitions(definitions)
    texts = [*responses, *excitations]
    if twice := next((text for text in texts if texts.count(text) > 1), None):
        raise BagError(f"{twice} is named twice")
    sides = {"response": responses, "excitation": excitations}
    proposal = Proposal({"robot": chosen.robot})
    _say_signals(proposal, sides, found, chosen.named)
    if all(any(map(_unwrapped, side)) for side in sides.values()):
        proposal.walls.append(
            "an angle drives and an angle answers: if a trial begins near half a turn, they may "
            "begin a whole turn apart; leave such trials out, or take |derivative of both"
        )
    if definitions:
        proposal.content["definitions"] = [str(path) for path in definitions]
    with Bag(bags[0], definitions=types) as bag:
        _say_clock(proposal, sides, bag)
    read = read_paces(bags, sides, proposal.content["clock"], types)
    _refuse_constant(excitations, read.u_ranges, "drives", "these bags")
    _refuse_constant(responses, read.y_ranges, "answers", "these bags")
    say_grid(proposal, read)
    _say_split(proposal, bags)
    linear = len(responses) == len(excitations) == 1
    section: dict[str, Any] = {"model": "linear", "lags": 4}
    if not linear:
        ranges = [[float(f"{low:.4g}"), float(f"{high:.4g}")] for low, high in read.u_ranges]
        section = {"model": "state_affine", "lags": 2, "input_range": ranges}
        proposal.why["input_range"] = "of each excitation in these bags; inputs are clipped to it"
    proposal.content["identification"] = section
    trials = _tried(proposal, bags, definitions)
    in_training = _ranges(trials.train)
    if all(_is_constant(*ends) for ends in in_training):
        _refuse_constant(excitations, in_training, "drives", "the training trials")
    asked = len(proposal.doubts)
    say_direction(proposal, found, trials.every)
    is_swapped = len(proposal.doubts) > asked
    proposal.walls += trials.apart
    if _say_motions(proposal, trials.every):
        trials = _tried(proposal, bags, definitions)
    choice = ladder.tried(trials.train, ladder.LINEAR, progress=progress)
    _say_model(proposal, choice, trials.train)
    if linear and _may_add_up(proposal, found):
        washed = f"{responses[0]}|washout({WASHOUT:g} s)"
        moved = propose(bags, found, replace(chosen, responses=(washed,)), progress=progress)
        if moved.error <= proposal.error / 2.0:
            _say_washed_out(moved, proposal.error)
            return moved
    others = [pair.command.text for pair in followed(proposal, found)]
    if widen and proposal.error > POOR and others:
        both = replace(chosen, excitations=(*excitations, *others))
        wider = propose(bags, found, both, progress=progress)
        if wider.error < proposal.error:
            without = f"; without it models are off by {proposal.error:.3g} %"
            wider.why |= {text: wider.why[text] + without for text in others}
            return wider
    if choice is not None and not is_swapped:  # who swapped them has to say so first
        more = ladder.choose(choice.held_out, ladder.BEYOND, choice.rows, progress=progress)
        _say_model(proposal, more, trials.train)
    _say_funnel(proposal, len(trials.train) if len(trials.train) > 1 else STRETCHES)
    if POOR < proposal.error < math.inf:
        _say_poor(proposal, found)
    return proposal


def _ranges(trials: Dataset) -> list[tuple[float, float]]:
    """The least and the greatest value of each excitation."""
    u = np.concatenate([trial.u for trial in trials])
    return list(zip(u.min(axis=0).tolist(), u.max(axis=0).tolist(), strict=True))


def _is_constant(low: float, high: float) -> bool:
    return high - low <= ROUNDED * max(abs(low), abs(high))


def _refuse_constant(
    texts: Sequence[str], ranges: Sequence[tuple[float, float]], does: str, where: str
) -> None:
    """Raise Unfit for the first signal that does not vary by more than rounding."""
    for text, (low, high) in zip(texts, ranges, strict=True):
        if _is_constant(low, high):
            raise Unfit(
                f"{text} is what {does}, and it is always {low:g} in {where}: a model is "
                "identified from how a response follows a command that varies"
            )


def _may_add_up(proposal: Proposal, found: Found) -> bool:
    """Whether the response is a position, of which no model is good."""
    text = proposal.content["signals"]["response"][0]["path"]
    position = any(c.is_position for c in found.candidates if c.text == text)
    return position and "|washout" not in text and proposal.error > GRADES[0][0]


def _say_washed_out(proposal: Proposal, error: float) -> None:
    """Why the response is not taken as it is: the error of its own models."""
    text = proposal.content["signals"]["response"][0]["path"]
    tried = (
        f"models of it are off by {error:.3g} %"
        if math.isfinite(error)
        else "no number of lags gave a model of it that is proved stable"
    )
    whole = text.rpartition("|")[0]
    before = f"{proposal.why[text]}; " if proposal.why[text] else ""
    proposal.why[text] = f"{before}what {whole} moved in the last {WASHOUT:g} s or so: {tried}"
    proposal.walls.append(
        f"{whole} seems to add up its command, so |washout({WASHOUT:g} s) of it is proposed: the "
        f"tube is of what it moved of late, and after {WASHOUT:g} s a third is left of an error "
        "that does not grow; another time may suit better"
    )


def beside(proposal: Proposal, found: Found) -> list[str]:
    """How the responses of the chosen one's kind are added, with what each of them follows."""
    signals = proposal.content["signals"]
    responses, excitations = (
        [signal["path"] for signal in signals[role]] for role in ("response", "excitation")
    )
    chosen = next((c for c in found.candidates if c.text == responses[0]), None)
    others = {
        pair.response.text: pair
        for pair in reversed(found.pairs)  # the best of each response stays
        if chosen is not None
        and pair.response.text not in (*responses, *excitations)
        and pair.response.kind == chosen.kind
        and pair.command.text not in responses
        and abs(pair.correlation) >= RELATED
    }
    if not others:
        return []
    said = "; ".join(
        f"{text} follows {pair.command.text} ({pair.correlation:+.2f})"
        for text, pair in sorted(others.items())
    )
    every_u = dict.fromkeys([*excitations, *(pair.command.text for pair in others.values())])
    options = " ".join(
        f"{option} '{text}'"
        for option, texts in (("-y", sorted([*responses, *others])), ("-u", sorted(every_u)))
        for text in texts
    )
    return [
        f"only one response is modelled here, and there are others like it: {said}. If they move "
        f"each other, one model of all of them is better: run init with {options}. If not, make a "
        "configuration of each, with its own -y and -u"
    ]


def followed(proposal: Proposal, found: Found) -> list[Pair]:
    """The pairs of the first response with commands that were not chosen and that it follows."""
    signals = proposal.content["signals"]
    chosen = {signal["path"] for signal in signals["excitation"]}
    pairs = found.best_for(signals["response"][0]["path"])
    follows = [p for p in pairs if p.command.text not in chosen and abs(p.correlation) >= RELATED]
    return follows[:OTHERS]


def _say_poor(proposal: Proposal, found: Found) -> None:
    signals = proposal.content["signals"]
    wall = (
        f"nothing that was tried has less than {proposal.error:.3g} % error: the tube will be "
        "wide; another pair of signals, or more of them, may say more"
    )
    if len(signals["response"]) == len(signals["excitation"]) == 1 and (
        also := followed(proposal, found)
    ):
        said = ", ".join(f"{pair.command.text} ({pair.correlation:+.2f})" for pair in also)
        wall += f": it follows {said} too (-u, once for each)"
    proposal.walls.append(wall)


def _unwrapped(text: str) -> bool:
    """Whether it is an angle that goes on over a turn."""
    return "|unwrap" in text and "|derivative" not in text


def _unit_and_why(found: Found, text: str, named: Sequence[str]) -> tuple[str, str]:
    """A signal's unit for people, and why it is taken."""
    known = next((c for c in found.candidates if is_named(c.text, text)), None)
    if known is None:
        path = text.partition("|")[0]
        numbers = (
            c for c in found.candidates if is_named(c.text, path) and "|derivative" not in c.text
        )
        recorded = None if len(factors(text)) > 1 else next((c.unit for c in numbers), None)
        unit = "" if recorded is None else Expression.parse(text).unit_of(recorded)
        return unit.partition(" or ")[0], "named by you" if text in named else ""
    unit = known.unit.partition(" or ")[0]
    why = f"{known.low:.4g} to {known.high:.4g} {unit}".strip()
    return unit, f"{why} at {known.rate:.4g} Hz; {known.why}"


def _name(text: str) -> str:
    """A name for people: the joint or the last words of the path, and what is done to it."""
    if len(parts := factors(text)) > 1:
        return " times ".join(map(_name, parts))
    path, *operations = text.split("|")
    topic, _, fields = path.partition(":")
    steps = [
        step for step in fields.split(".") if step not in ("twist", "pose", "data", "transform")
    ]
    words = " ".join(steps[-2:])
    words = words.replace("[", " ").replace("]", "").replace("name=", "").replace("=", " ")
    done = {"derivative": " rate", "washout": " washed out"}
    after = "".join(
        word for name, word in done.items() if any(op.startswith(name) for op in operations)
    )
    return f"{topic.strip('/').replace('/', ' ')} {words}{after}".strip()


def _say_signals(
    proposal: Proposal, sides: Mapping[str, Sequence[str]], found: Found, named: Sequence[str]
) -> None:
    names: list[str] = []
    for role, texts in sides.items():
        listed = proposal.content.setdefault("signals", {}).setdefault(role, [])
        for text in texts:
            names.append(_name(text))
            count = names.count(names[-1])
            name = f"{names[-1]} {count}" if count > 1 else names[-1]  # of an earlier one
            unit, proposal.why[text] = _unit_and_why(found, text, named)
            listed.append({"name": name, "unit": unit, "path": text})
    for text in sides["response"]:
        pairs = [p for p in found.best_for(text) if p.command.text in sides["excitation"]]
        if pairs:
            best = pairs[0]
            before = f"{proposal.why[text]}; " if proposal.why[text] else ""
            proposal.why[text] = f"{before}follows {best.command.text}: {best}"
            washed = "|washout" in text
            if best.response.is_position and not best.command.is_position and not washed:
                proposal.walls.append(
                    f"{text} is a position: if it adds up its command for ever, it is in no "
                    f"model class; take |derivative({slope_window(best.response.rate):g} s) of it"
                )


def _say_clock(proposal: Proposal, sides: Mapping[str, Sequence[str]], bag: Bag) -> None:
    unstamped: dict[str, str] = {}
    for texts in sides.values():
        for expression in (e for text in texts for e in parse_factors(text)):
            msgtype, types = bag.types_on(expression.path.topic)
            expression.path.check(msgtype, types)
            named = f"{expression.path.topic} ({msgtype})"
            if not is_stamped(msgtype, types) and msgtype != "tf2_msgs/msg/TFMessage":
                unstamped[named] = "has no header stamp"
            elif _stamps_are_zero(bag, expression.path):
                unstamped[named] = "has header stamps that are all 0"
            if msgtype not in standard_types().fielddefs:
                proposal.walls.append(
                    f"{expression.path.topic} is of type {msgtype}: live, its package has to be "
                    "installed beside the nodes"
                )
    proposal.content["clock"] = "log" if unstamped else "header"
    if unstamped:
        said = ", ".join(f"{name} {why}" for name, why in unstamped.items())
        proposal.why["clock"] = said
        proposal.walls.append(
            f"{said}: samples are paired by the times of logging, live of "
            "arrival, whose jitter becomes part of the model's error"
        )


def _stamps_are_zero(bag: Bag, path: SignalPath) -> bool:
    """Whether the publisher of a signal does not fill its header stamps in."""
    stamps = read_columns(bag, {str(path): path})[path.topic].stamp_ns
    return stamps is not None and len(stamps) > 0 and not stamps.any()


def _say_split(proposal: Proposal, bags: Sequence[Path]) -> None:
    names = sorted(map(trial_name, bags))
    if len(names) >= TEST_EVERY:
        proposal.content["split"] = {"test": names[TEST_EVERY - 1 :: TEST_EVERY]}
        proposal.why["test"] = f"every {TEST_EVERY}th of {len(names)} bags, by name"
    elif len(names) > 1:
        proposal.content["split"] = {"test": names[-1:]}
        proposal.why["test"] = f"the last of {len(names)} bags"
    else:
        proposal.content["split"] = {"share": SHARE}
        proposal.why["share"] = "there is one bag: its end scores what its beginning taught"
        proposal.walls.append(
            "one bag: windows of it design the tube and set its level, so nothing is said of how "
            "often a next recording raises an alarm; record more"
        )


def _say_motions(proposal: Proposal, trials: Dataset) -> bool:
    """Spread repeated motions over training, calibration and test; whether there are any.

    Bags by name often come motion after motion, or in turn: every fifth may be of one motion only.
    """
    motions = by_excitation(trials)
    repeats = min(map(len, motions))
    if proposal.content["split"].get("share") or repeats < TEST_EVERY:
        return False
    names = [trial.name for motion in motions for trial in motion]
    tests, scales = names[TEST_EVERY - 1 :: TEST_EVERY], names[TEST_EVERY // 2 :: TEST_EVERY]
    proposal.content["split"] = {"test": sorted(tests), "calibration": sorted(scales)}
    what = f"{len(motions)} motions, each recorded {repeats} times or more"
    proposal.why["test"] = f"{what}: every {TEST_EVERY}th of each"
    proposal.why["calibration"] = f"{what}: another {TEST_EVERY}th sets the tube's level"
    return True


def _tried(proposal: Proposal, bags: Sequence[Path], definitions: Sequence[Path]) -> Trials:
    """The trials as identification reads them; what it refuses is changed as it says."""
    grid = proposal.content["grid"]
    changes: list[tuple[str, Any, str]] = [
        ("resample", "linear", "off a grid"),
        ("split_gaps", True, "split_gaps"),
        ("resample", "linear", "one stamp each sample"),
    ]
    while True:
        try:
            return read_trials(bags, proposal.config(definitions), progress=silent)
        except DataError as error:
            change = next(
                (c for c in changes if c[2] in str(error) and grid.get(c[0]) != c[1]), None
            )
            if change is None:
                raise
            key, value, _ = change
            grid[key] = value
            proposal.why[key] = f"without it: {error}"[:120].rpartition(" ")[0]


def _say_funnel(proposal: Proposal, trials: int) -> None:
    """Where half of so many trials set the level, and the model was fitted to them, it is too low.

    The next trial exceeds the largest of m the oftener the fewer they are: factors of 1 + 1/m keep
    that at about one in twenty where the sizes of errors differ by a third from trial to trial.
    """
    times, why = 1.0, "a wider tube raises fewer false alarms and catches less"
    if proposal.choice is not None and not proposal.content["split"].get("calibration"):
        few = 1.0 + 1.0 / max(1, trials // 2)
        times = few * min(proposal.choice.optimism, MOST_OPTIMISM)
        why += (
            f"; {SAFETY:g} times {times:.3g}: no trial is left for calibration, errors are larger "
            "on what was held out than where models were fitted, and few trials set the level"
        )
    proposal.content["funnel"] = {"safety_factor": float(f"{SAFETY * times:.2g}")}
    proposal.why["safety_factor"] = why


def _say_model(proposal: Proposal, choice: Choice | None, train: Dataset) -> None:
    """Take what the rule takes, say what else was tried, and what to expect."""
    if choice is None or not choice.found:
        _say_untried(proposal, train)
        return

    known = proposal.content["identification"]
    section: dict[str, Any] = section_of(choice.best.attempt, choice.held_out.data)
    if section["model"] == "state_affine" and "input_range" in known:
        section["input_range"] = known["input_range"]
    proposal.content["identification"] = section
    proposal.choice = choice
    said = "; ".join(f"{row.attempt}: {row.percent:.3g} %" for row in choice.ranked[:SHOWN])
    proposal.why["model"] = (
        f"{len(choice.rows)} were tried on {choice.held_out.on} that were held out, and the "
        f"simplest that is as good as the best is taken: {said}"
    )


def take_next(proposal: Proposal, refusal: object) -> str:
    """Take the next best attempt, as the best was refused; its name, or empty if none is left."""
    choice = proposal.choice
    if choice is None or len(choice.ranked) < 2:
        return ""
    left = replace(choice, rows=tuple(row for row in choice.rows if row is not choice.best))
    _say_model(proposal, left, left.held_out.data)
    proposal.why["model"] += f"; {choice.best.attempt} has no tube: {refusal}"
    return str(left.best.attempt)


def _say_untried(proposal: Proposal, train: Dataset) -> None:
    """What identification does with the first guess, where nothing could be held out."""
    proposal.why["model"] = "a first guess"
    try:
        proposal.config().identification.identify(train)
    except NlsidError as reason:
        wall = (
            f"identification will refuse ({reason}); a response that adds up its command for ever "
            "needs |derivative or |washout behind its path"
        )
    else:
        wall = (
            "no class has a proved model of a part of these trials: the model is a first guess, "
            "and nothing says how well it simulates other data"
        )
    proposal.walls.append(wall)
