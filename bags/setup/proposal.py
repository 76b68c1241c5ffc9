"""From chosen signals to a whole configuration that the later steps take: each value with a reason.

What is proposed is tried: the bags are read with it as identification reads them, and what is
refused there is changed (gaps cut out, responses resampled) or said.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.signal import welch

from bags.chain.config import Config
from bags.chain.steps import Trials, read_trials
from bags.recordings.bag import Bag
from bags.recordings.definitions import Definition
from bags.recordings.folders import trial_name
from bags.recordings.message_types import is_stamped, standard_types
from bags.setup.candidates import Found, Pair, slope_window
from bags.setup.curved import ENOUGH, SAMPLES, START, tried_classes
from bags.signals.columns import read_columns
from bags.signals.delays import RELATED
from bags.signals.expressions import Expression, factors, parse_factors
from bags.signals.reader import HEADER_STAMP, LOG_TIME, Samples, read_signals
from bags.signals.repeats import same_excitation
from bags.signals.signal import SignalPath
from bags.signals.timing import held
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import BagError, DataError, NlsidError
from nlsid_core.identification import LeastSquares, LinearClass, Rse, StateAffineClass, identify
from nlsid_core.identification.searches import hold_out
from nlsid_core.progress import silent
from nlsid_core.running.grid import TOLERANCE

LAGS: Final = (1, 2, 3, 4, 6, 8, 10)  # tried on a part of the training trials
FEW_LAGS: Final = (1, 2, 3)  # tried with several signals, the inputs at all delays or at one,
DEGREES: Final = (1, 2, 3, 4)  # with these degrees in the inputs
MOST_TERMS: Final = 150  # of a polynomial in the inputs that is tried
TRIED_ITERATIONS: Final = 8  # of the robust simulation error, enough to tell lags apart
LAGS_BETTER: Final = 0.98  # of the error that more lags have to reach
ON_GRID: Final = 0.95  # of the steps near the period: samples are used as they come
ROUND: Final = 0.002  # relative: a period this near a round number is that number
FEW_GAPS: Final = 5.0  # periods: gaps up to here are filled in, longer ones cut out
DYNAMICS: Final = 40.0  # samples in a period of the fastest motion that are enough
TEST_EVERY: Final = 5  # bags: every fifth only scores
SHARE: Final = 0.25  # of every bag that only scores where there are few
SAFETY: Final = 1.5  # on the disturbance's amplitude, the funnel's own default
POOR: Final = 50.0  # % of error in simulation, above which a model says little
CLASS_BETTER: Final = 0.8  # of the linear model's error, that another class has to reach
NOT_TRIED: Final = (
    ". Of several responses these were not tried: `implicit` for forces that are not linear, and "
    "each response alone, for which there are more classes"
)
GRADES: Final = ((ENOUGH, "good"), (25.0, "fair"), (POOR, "weak: the tube will be wide"))
LONG_HELD: Final = 20.0  # periods a command is held: lost ones are then noticed late
SIMULATED: Final = "/clock"
ONE_PACE: Final = 0.02  # relative: simulators keep real time no better
SHOWN: Final = 4  # of the classes that were tried
OTHERS: Final = 3  # commands that are named besides


@dataclass(frozen=True)
class Signal:
    """A chosen signal: name and unit for people, its path, its range in the bags, and why it."""

    name: str
    unit: str
    path: str
    why: str


@dataclass
class Proposal:
    """A configuration as nested keys (`content`), a reason for keys (`why`), and later walls."""

    content: dict[str, Any]
    why: dict[str, str] = field(default_factory=dict)
    walls: list[str] = field(default_factory=list)
    error: float = math.inf  # %, of the best model that was tried, in simulation
    tried_on: str = "trials held back"
    varies: str = ""  # by how much the response does in these

    @property
    def expectation(self) -> str:
        """How good a model will be, as far as what was tried says."""
        if math.isinf(self.error):
            return "no model that was tried is stable: expect identification to refuse"
        grade = next((word for most, word in GRADES if self.error <= most), "poor: it says little")
        of = self.tried_on + self.varies
        return f"expect {self.error:.3g} % error in simulation (of {of}): {grade}"

    def config(self, definitions: Sequence[Path] = ()) -> Config:
        """As the later steps read it."""
        return Config.model_validate(self.content).model_copy(
            update={"definitions": tuple(definitions)}
        )


def choose(
    found: Found, responses: Sequence[str] = (), excitations: Sequence[str] = ()
) -> tuple[list[str], list[str]]:
    """The signals that were named, and for a side that was not the best that goes with the other.

    Raises BagError if nothing goes with anything.
    """
    if responses and excitations:
        return list(responses), list(excitations)
    best = []
    for response in responses or [""]:
        pairs = [
            pair
            for pair in found.pairs
            if (not response or _same(pair.response.text, response))
            and (not excitations or _same(pair.command.text, excitations[0]))
            and (pair.score > 0.0 or response or excitations)
        ]
        if not pairs:
            what = f"{response} follows no command" if response else "no number follows another"
            still = f"; always the same: {', '.join(found.still)}" if found.still else ""
            raise BagError(
                f"{what}; name them with --excitation and --response (nlsid bag signals lists what "
                f"there is){still}"
            )
        best.append(pairs[0])
    commands = dict.fromkeys(pair.command.text for pair in best)
    return list(responses) or [best[0].response.text], list(excitations) or list(commands)


def propose(
    bags: Sequence[Path],
    found: Found,
    *,
    responses: Sequence[str],
    excitations: Sequence[str],
    robot: str,
    definitions: Sequence[Path] = (),
    types: Mapping[str, Definition] | None = None,
    widen: bool = False,
) -> Proposal:
    """A configuration of these signals for these bags, tried on them.

    widen: where models of one excitation are poor, take those too that the response follows
    besides, if that is better. Raises BagError and DataError if the bags cannot be read as any
    configuration says.
    """
    texts = [*responses, *excitations]
    if twice := next((text for text in texts if texts.count(text) > 1), None):
        raise BagError(f"{twice} is named twice")
    signals = _named_apart([_signal(found, text) for text in texts])
    chosen = {"response": signals[: len(responses)], "excitation": signals[len(responses) :]}
    proposal = Proposal({"robot": robot})
    _say_signals(proposal, chosen, found)
    if all(any(_unwrapped(s.path) for s in signals) for signals in chosen.values()):
        proposal.walls.append(
            "an angle drives and an angle answers: if a trial begins near half a turn, they may "
            "begin a whole turn apart; leave such trials out, or take |derivative of both"
        )
    if definitions:
        proposal.content["definitions"] = [str(path) for path in definitions]
    with Bag(bags[0], definitions=types) as bag:
        _say_clock(proposal, chosen, bag)
    read = _read(bags, chosen, proposal.content["clock"], types)
    _say_grid(proposal, read)
    _say_split(proposal, bags)
    linear = len(responses) == len(excitations) == 1
    section: dict[str, Any] = {"model": "linear", "lags": 4}
    if not linear:
        ranges = [[float(f"{low:.4g}"), float(f"{high:.4g}")] for low, high in read.u_ranges]
        section = {"model": "state_affine", "lags": 2, "input_range": ranges}
        proposal.why["input_range"] = "of each excitation in these bags; inputs are clipped to it"
    if len(responses) > 1:
        section["method"] = "sem_certified"
        proposal.why["method"] = "steps among stable models, the quickest for several responses"
    proposal.content["identification"] = section
    trials = _tried(proposal, bags, definitions)
    proposal.walls += trials.apart
    if _say_motions(proposal, trials.every):
        trials = _tried(proposal, bags, definitions)
    if linear:
        _say_lags(proposal, trials.train)
    else:
        _say_degree(proposal, trials.train)
    _say_funnel(proposal)
    others = [pair.command.text for pair in _followed(proposal, found)]
    if widen and proposal.error > POOR and others:
        wider = propose(
            bags, found, responses=responses, excitations=[*excitations, *others], robot=robot,
            definitions=definitions, types=types,
        )  # fmt: skip
        if wider.error < proposal.error:
            without = f"; without it models are off by {proposal.error:.3g} %"
            wider.why |= {text: wider.why[text] + without for text in others}
            return wider
    alone = len(responses) == 1
    if alone and ENOUGH < proposal.error < math.inf:
        _say_class(proposal, trials.train)
    if POOR < proposal.error < math.inf:
        also = _others(proposal, found) if linear else ""
        proposal.walls.append(_poor(proposal) + (also if alone else also + NOT_TRIED))
    return proposal


@dataclass(frozen=True)
class _Read:
    """What the chosen signals of all bags show: the responses' steps, the commands' ages.

    longest_tail: s of responses after the last command, where those have come to an end and the
    last is not held.
    """

    period: float
    on_grid: float
    repeated: int
    longest_gap: float
    band: float
    command_period: float
    longest_held: float
    longest_tail: float
    u_ranges: tuple[tuple[float, float], ...]
    topics: int


def _unwrapped(text: str) -> bool:
    """Whether it is an angle that goes on over a turn."""
    return "|unwrap" in text and "|derivative" not in text


def _same(candidate: str, named: str) -> bool:
    return candidate == named or candidate.partition("|")[0] == named


def _signal(found: Found, text: str) -> Signal:
    known = next((c for c in found.candidates if c.text == text), None)
    known = known or next((c for c in found.candidates if _same(c.text, text)), None)
    if known is None:
        path = text.partition("|")[0]
        numbers = (
            c for c in found.candidates if _same(c.text, path) and "|derivative" not in c.text
        )
        recorded = None if len(factors(text)) > 1 else next((c.unit for c in numbers), None)
        unit = "" if recorded is None else Expression.parse(text).unit_of(recorded)
        return Signal(_name(text), unit.partition(" or ")[0], text, "named by you")
    unit = known.unit.partition(" or ")[0]
    why = f"{known.low:.4g} to {known.high:.4g} {unit}".strip()
    return Signal(_name(text), unit, text, f"{why} at {known.rate:.4g} Hz; {known.why}")


def _named_apart(signals: Sequence[Signal]) -> list[Signal]:
    """With a number behind a name that an earlier signal has."""
    names = [signal.name for signal in signals]
    counts = [names[: k + 1].count(name) for k, name in enumerate(names)]
    return [
        replace(signal, name=f"{signal.name} {count}") if count > 1 else signal
        for signal, count in zip(signals, counts, strict=True)
    ]


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
    rate = " rate" if any(op.startswith("derivative") for op in operations) else ""
    return f"{topic.strip('/').replace('/', ' ')} {words}{rate}".strip()


def _say_signals(proposal: Proposal, chosen: Mapping[str, Sequence[Signal]], found: Found) -> None:
    proposal.content["signals"] = {
        role: [{"name": s.name, "unit": s.unit, "path": s.path} for s in signals]
        for role, signals in chosen.items()
    }
    for signals in chosen.values():
        for signal in signals:
            proposal.why[signal.path] = signal.why
    for y in chosen["response"]:
        pairs = [p for p in found.best_for(y.path)
                 if p.command.text in {u.path for u in chosen["excitation"]}]  # fmt: skip
        if pairs:
            best = pairs[0]
            proposal.why[y.path] += f"; follows {best.command.text}: {best}"
            if abs(best.correlation) < RELATED:
                proposal.walls.append(
                    f"{y.path} hardly follows {best.command.text} ({best}); is it the right one?"
                )
            if best.response.is_position and not best.command.is_position:
                proposal.walls.append(
                    f"{y.path} is a position: if it adds up its command for ever, it is in no "
                    f"model class; take |derivative({slope_window(best.response.rate):g} s) of it"
                )


def _say_clock(proposal: Proposal, chosen: Mapping[str, Sequence[Signal]], bag: Bag) -> None:
    unstamped: dict[str, str] = {}
    for signals in chosen.values():
        for expression in (e for signal in signals for e in parse_factors(signal.path)):
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
        pace = _pace(bag)
        if abs(pace - 1.0) > ONE_PACE:
            proposal.walls.append(
                f"simulated time on {SIMULATED} runs at {pace:.3g} times the pace of the times of "
                "logging: the model is one by the wall's clock, and a live monitor with "
                "use_sim_time goes by the simulated one; record with `ros2 bag record "
                "--use-sim-time`, or give commands a header"
            )


def _stamps_are_zero(bag: Bag, path: SignalPath) -> bool:
    """Whether the publisher of a signal does not fill its header stamps in."""
    stamps = read_columns(bag, {str(path): path})[path.topic].stamp_ns
    return stamps is not None and len(stamps) > 0 and not stamps.any()


def _pace(bag: Bag) -> float:
    """Simulated seconds in one of the times of logging; 1 without simulated time."""
    if SIMULATED not in bag.topics:
        return 1.0
    paths = {part: SignalPath.parse(f"{SIMULATED}:clock.{part}") for part in ("sec", "nanosec")}
    with suppress(BagError):  # of another type
        columns = read_columns(bag, paths)[SIMULATED]
        simulated = columns.values["sec"] + 1e-9 * columns.values["nanosec"]
        logged = (columns.log_ns - columns.log_ns[:1]) / 1e9
        if len(columns) > 1 and logged[-1] > 0.0:
            return float((simulated[-1] - simulated[0]) / logged[-1])
    return 1.0


def _read(
    bags: Sequence[Path],
    chosen: Mapping[str, Sequence[Signal]],
    clock: str,
    types: Mapping[str, Definition] | None,
) -> _Read:
    y_paths = [signal.path for signal in chosen["response"]]
    drives = [factors(signal.path) for signal in chosen["excitation"]]
    u_paths = list(dict.fromkeys(part for parts in drives for part in parts))
    steps, commanded, bands, ranges, u_steps = [], [], [], [], []
    repeated = 0
    for path in bags:
        read = read_signals(
            path, [*y_paths, *u_paths], clock=HEADER_STAMP if clock == "header" else LOG_TIME,
            sort=True, gaps_in=y_paths, definitions=types,
        )  # fmt: skip
        for name in y_paths:
            diffs = np.diff(read[name].stamp_ns) / 1e9
            repeated += int((diffs <= 0).sum())
            steps.append(diffs[diffs > 0])
            bands.append(_band(read[name]))
        last = max(int(read[name].stamp_ns[-1]) for name in y_paths)
        for name in u_paths:
            stamps = read[name].stamp_ns
            commanded.append(held(stamps, last))
            u_steps.append(np.diff(stamps) / 1e9)
        ranges.append([_range([read[name] for name in parts]) for parts in drives])
    every, u_every = np.concatenate(steps), np.concatenate(u_steps)
    if not len(every):
        raise BagError(f"{y_paths[0]} has one sample a bag; a period needs two")
    median = float(np.median(every))
    near = np.abs(every / median - np.rint(every / median)) <= TOLERANCE
    lows, highs = np.array(ranges).min(axis=0)[:, 0], np.array(ranges).max(axis=0)[:, 1]
    return _Read(
        period=_round(median),
        on_grid=float(near.mean()),
        repeated=repeated,
        longest_gap=float(every.max()),
        band=float(np.median([b for b in bands if b > 0] or [0.0])),
        command_period=float(np.median(u_every)) if len(u_every) else math.inf,
        longest_held=max(each.longest for each in commanded),
        longest_tail=max(each.tail for each in commanded),
        u_ranges=tuple(zip(lows.tolist(), highs.tolist(), strict=True)),
        topics=len({name.partition(":")[0] for name in y_paths}),
    )


def _range(parts: Sequence[Samples]) -> tuple[float, float]:
    """The least and the greatest that a product of signals can be."""
    low, high = 1.0, 1.0
    for part in parts:
        ends = [x * y for x in (low, high) for y in (part.values.min(), part.values.max())]
        low, high = float(min(ends)), float(max(ends))
    return low, high


def _band(samples: Samples) -> float:
    """Hz below which a response has 99 % of its power; 0 if it cannot be said."""
    steps = np.diff(samples.stamp_ns) / 1e9
    if len(samples) < 64 or not (steps > 0).any() or not np.ptp(samples.values) > 0:
        return 0.0
    rate = 1.0 / float(np.median(steps[steps > 0]))
    x = samples.values - samples.values.mean()
    f, power = welch(x, fs=rate, nperseg=min(len(x), 4096))
    return float(f[np.searchsorted(np.cumsum(power) / power.sum(), 0.99)])


def _round(period: float) -> float:
    """A round rate or period if one is near: 0.025 of 0.02498."""
    for round_one in (
        1.0 / max(round(1.0 / period), 1),
        float(f"{period:.1g}"),
        float(f"{period:.2g}"),
    ):
        if abs(round_one / period - 1.0) <= ROUND:
            return float(f"{round_one:.6g}")
    return float(f"{period:.4g}")


def _up(value: float) -> float:
    """The next number of two digits."""
    digits = 1 - math.floor(math.log10(value))
    return float(f"{math.ceil(value * 10**digits - 1e-9) / 10**digits:.2g}")


def _say_grid(proposal: Proposal, read: _Read) -> None:
    grid: dict[str, Any] = {"period": read.period}
    why, walls = proposal.why, proposal.walls
    why["period"] = f"the response's median step; {100 * read.on_grid:.0f} % of steps are near it"
    regular = read.on_grid >= ON_GRID and read.topics == 1 and not read.repeated
    factor = 1
    if read.band > 0:
        factor = max(int(1.0 / (DYNAMICS * read.band) / read.period), 1)
    if factor > 1:
        grid["period"] = float(f"{factor * read.period:.4g}")
        why["period"] = (
            f"{factor} times {read.period:g} s: 99 % of the response's power is below "
            f"{read.band:.3g} Hz"
        )
        regular = False
    if not regular:
        grid["resample"] = "last" if factor > 1 and read.on_grid >= ON_GRID else "linear"
        why["resample"] = (
            "fewer samples than are recorded" if factor > 1
            else "responses come from several topics" if read.topics > 1
            else f"only {100 * read.on_grid:.0f} % of steps are near the period"
        )  # fmt: skip
    most = FEW_GAPS * read.period
    grid["max_gap"] = _up(max(min(1.2 * read.longest_gap, most), 2.0 * grid["period"]))
    why["max_gap"] = f"the longest step of a response is {read.longest_gap:.3g} s"
    if read.longest_gap > grid["max_gap"]:
        grid["split_gaps"] = True
        why["split_gaps"] = "longer gaps end a trial and begin the next"
        walls.append(
            f"a response is missing for up to {read.longest_gap:.3g} s: trials are cut there, and "
            "a monitor says unknown from there on"
        )
    if read.longest_held > grid["max_gap"]:
        grid["hold"] = _up(1.1 * read.longest_held)
        why["hold"] = f"one was held for {read.longest_held:.3g} s in these bags"
        if read.longest_held > LONG_HELD * min(read.command_period, 1.0):
            walls.append(
                f"commands are held for up to {read.longest_held:.3g} s: a lost one is not noticed "
                "before"
            )
    if read.longest_tail > grid.get("hold", grid["max_gap"]):
        grid["split_gaps"] = True
        why.setdefault("split_gaps", "what comes after the last command is not fitted")
        walls.append(
            f"commands end up to {read.longest_tail:.3g} s before the responses do: what the robot "
            "does there is not fitted, as nothing says what it was told"
        )
    proposal.content["grid"] = grid
    if read.repeated:
        walls.append(
            f"{read.repeated} stamps of the response repeat the one before, which identification "
            "refuses; is the topic published twice?"
        )


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
            "one bag: a tube is designed on one trial and its level measured on another; record "
            "more, or cut it: nlsid bag split BAG --out PART --every 5"
        )


def _say_motions(proposal: Proposal, trials: Dataset) -> bool:
    """Spread repeated motions over training, calibration and test; whether there are any.

    Bags by name often come motion after motion, or in turn: every fifth may be of one motion only.
    """
    motions: list[list[Trajectory]] = []
    for trial in trials:
        known = next((m for m in motions if same_excitation(m[0].u[:, 0], trial.u[:, 0])), None)
        if known is None:
            motions.append([trial])
        else:
            known.append(trial)
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


def _say_lags(proposal: Proposal, train: Dataset) -> None:
    """The fewest lags whose simulation of a part of the training trials is about as good as any."""
    names = train.names
    held_back = list(names[1::3]) or list(names[:1])
    alone = len(held_back) == len(names)
    fitted = train if alone else train.without(held_back)
    errors: dict[int, float] = {}
    for lags in LAGS:
        try:
            fit = identify(
                fitted, LinearClass(lags), method=Rse(iterations=TRIED_ITERATIONS),
                comparators=(), test=train.select(held_back),
            )  # fmt: skip
        except NlsidError:  # too few samples for so many, or no proof
            continue
        errors[lags] = float(fit.errors["test"]["rse"])
    known = {lags: error for lags, error in errors.items() if math.isfinite(error)}
    section = proposal.content["identification"]
    if not known:
        proposal.why["lags"] = "a first guess"
        window = slope_window(1.0 / proposal.content["grid"]["period"])
        proposal.walls.append(
            "no number of lags gave a model that is proved stable: identification will refuse; a "
            f"response that adds up its command for ever needs |derivative({window:g} s)"
        )
        return
    best = proposal.error = min(known.values())
    proposal.varies = _varies(train.select(held_back))
    good = min(lags for lags, error in known.items() if error * LAGS_BETTER <= best)
    others = sorted(set(LAGS) - {good}, key=lambda lags: (known.get(lags, math.inf), -lags))
    for lags in (good, *others):
        section["lags"] = lags
        with suppress(NlsidError):  # more data and iterations may end without a proof: the next
            identify(train, LinearClass(lags), comparators=())
            break
    said = ", ".join(f"{lags}: {error:.3g} %" for lags, error in known.items())
    proposal.tried_on = "what it was fitted to" if alone else proposal.tried_on
    proposal.why["lags"] = f"proved models simulated on {proposal.tried_on} are off by {said}"


def _followed(proposal: Proposal, found: Found) -> list[Pair]:
    """The pairs of the first response with commands that were not chosen and that it follows."""
    signals = proposal.content["signals"]
    chosen = {signal["path"] for signal in signals["excitation"]}
    pairs = found.best_for(signals["response"][0]["path"])
    follows = [p for p in pairs if p.command.text not in chosen and abs(p.correlation) >= RELATED]
    return follows[:OTHERS]


def _others(proposal: Proposal, found: Found) -> str:
    said = ", ".join(f"{p.command.text} ({p.correlation:+.2f})" for p in _followed(proposal, found))
    return f": it follows {said} too (-u, once for each)" if said else ""


def _say_degree(proposal: Proposal, train: Dataset) -> None:
    """Lags, delays and degree in the inputs of a class for several, by trials held back."""
    section = proposal.content["identification"]
    ranges = tuple((float(low), float(high)) for low, high in section["input_range"])
    names = train.names
    held_back = list(names[1::3]) or list(names[:1])
    fitted = train if len(held_back) == len(names) else train.without(held_back)
    known: dict[StateAffineClass, float] = {}
    for lags, degree in product(FEW_LAGS, DEGREES):
        for delays in (None, *((k,) for k in range(1, lags + 1))):
            tried = StateAffineClass(lags, delays, right_degree=degree, input_range=ranges)
            if _terms(tried) > MOST_TERMS:
                continue
            with suppress(NlsidError):
                fit = identify(
                    fitted, tried, method=LeastSquares(), comparators=(),
                    test=train.select(held_back), allow_unproved=True,
                )  # fmt: skip
                error = float(fit.errors["test"]["least_squares"])
                if math.isfinite(error):
                    known[tried] = error
    if not known:
        return
    best = proposal.error = min(known.values())
    proposal.varies = _varies(train.select(held_back))
    good = min((c for c, error in known.items() if error * LAGS_BETTER <= best),
               key=lambda c: c.lags + _terms(c))  # fmt: skip
    section |= {"lags": good.lags, "right_degree": good.right_degree}
    if good.delays is not None:
        section["delays"] = list(good.delays)
        proposal.why["delays"] = "as the lags"
    ranked = sorted(known, key=known.__getitem__)
    shown = [(c, known[c]) for c in dict.fromkeys([*ranked[:SHOWN], good])]
    said = ", ".join(
        f"{c.lags}, {'all' if c.delays is None else c.delays[0]}, {c.right_degree}: {error:.3g} %"
        for c, error in shown
    )
    proposal.why["lags"] = f"least squares on trials held back; lags, delays, right_degree: {said}"
    proposal.why["right_degree"] = "as the lags"


def _varies(trials: Dataset) -> str:
    """What a percentage of these trials is of: calmer trials have a larger one."""
    first = trials.trajectories[0]
    if len(first.y_names) != 1:
        return ""
    spread = float(np.std(np.concatenate([trial.y for trial in trials])))
    of = f"{first.y_names[0]} varies by {spread:.3g} {first.y_units[0]}".rstrip()
    return f", in which {of}, rms; of calmer test trials it is more"


def _terms(tried: StateAffineClass) -> int:
    """Of the polynomial in the inputs."""
    window = len(tried.window(len(tried.input_range or ())))
    return math.comb(window + tried.right_degree, tried.right_degree)


def _say_class(proposal: Proposal, train: Dataset) -> None:
    """Another class, where its proved model simulates trials held back far better."""
    names = train.names[1::3]
    fitted, held_back = (train.without(names), train.select(names)) if names else hold_out(train)
    section = proposal.content["identification"]
    (_, error), *others = tried_classes(section, fitted, held_back)
    if not others:
        return
    best, least = min(others, key=lambda tried: tried[1])
    said = ", ".join(f"{s['model']}: {e:.3g} %" for s, e in [(section, error), *others])
    proposal.why["model"] = (
        f"proved models of {SAMPLES} samples or fewer, simulated on trials held back without "
        f"their first {START} samples, are off by {said}"
    )
    if least <= min(CLASS_BETTER * error, POOR):
        proposal.content["identification"] = dict(best)
        proposal.error, proposal.tried_on = least, "trials held back"
        for key in ("lags", "delays", "right_degree", "input_range", "method"):
            proposal.why.pop(key, None)


def _poor(proposal: Proposal) -> str:
    return (
        f"nothing that was tried simulates {proposal.tried_on} with less than "
        f"{proposal.error:.3g} % error: the tube will be wide; another pair of signals, or more "
        "of them, may say more"
    )


def _say_funnel(proposal: Proposal) -> None:
    proposal.content["funnel"] = {"safety_factor": SAFETY}
    proposal.why["safety_factor"] = "a wider tube raises fewer false alarms and catches less"
