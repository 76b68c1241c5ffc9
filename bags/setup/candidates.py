"""Which numbers in bags may drive a robot, which may answer, and how clearly one follows another.

Nothing here is certain: types and names give a number its likely role, the correlation over a few
bags says which response follows which command. A person, or who reads the reasons, decides.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from bags.recordings.bag import Bag
from bags.recordings.definitions import Definition
from bags.signals.columns import Columns, expand_path, read_columns
from bags.signals.expressions import derivative, turn_of
from bags.signals.signal import ANGLES, SignalPath
from bags.signals.timing import Delay, delay
from bags.signals.units import per_second
from bags.tools.listing import Listed, bag_signals
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.errors import BagError, DataError

SHOWN: Final = 4  # of what never varies
EXPLORED: Final = 5  # bags that are looked into, spread over all of them
MOST_ELEMENTS: Final = 16  # of an unnamed array that are candidates; more is a picture or a scan
MOST_CANDIDATES: Final = 256
MOST_SAMPLES: Final = 4000  # of a pair whose correlation is computed
MOST_COMMANDS: Final = 24  # and responses, by their roles, whose pairs are compared
LONGEST_DELAY: Final = 3.0  # s, of what still counts as an answer
WINDOW: Final = 5  # messages of a slope
OTHER_KIND_LIKED: Final = 0.7  # a rate for a reference position; positions that add up a command
HELD: Final = 0.5  # of the messages repeat the value before: a command, or a robot at rest
COMMANDS_SURELY: Final = 0.7  # the share by which type and names say that a number drives
HELD_IS_DRIVEN: Final = 0.05  # for what neither type nor name says the role of
LEAP: Final = 0.9  # of a turn, from one message to the next: the angle begins again
ROOM: Final = 1.1  # turns that such an angle, with its noise, lies in
SLOPES_LIKED: Final = 0.95  # against a rate that is measured
OTHER_JOINT_LIKED: Final = 0.8  # against the same joint's
COMMANDS: Final = {  # message types that command; the others are taken by their names
    "geometry_msgs/msg/Twist",
    "geometry_msgs/msg/TwistStamped",
    "geometry_msgs/msg/Wrench",
    "geometry_msgs/msg/WrenchStamped",
    "ackermann_msgs/msg/AckermannDrive",
    "ackermann_msgs/msg/AckermannDriveStamped",
    "std_msgs/msg/Float32",
    "std_msgs/msg/Float64",
    "std_msgs/msg/Float64MultiArray",
    "std_msgs/msg/Float32MultiArray",
    "trajectory_msgs/msg/JointTrajectory",
}
RESPONSES: Final = {
    "nav_msgs/msg/Odometry",
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/JointState",
    "tf2_msgs/msg/TFMessage",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TwistWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
}
SAYS_COMMAND: Final = re.compile(
    r"cmd|command|control|ctrl|setpoint|desired|target|reference|(^|_|/)ref|throttle|steer|input"
    r"|teleop|joy|thruster|fin\b|voltage|effort"
)
SAYS_RESPONSE: Final = re.compile(
    r"odom|imu|state|measured|vicon|mocap|encoder|pose|gps|dvl|depth|feedback|sensor|actual|(^|/)tf"
)
IGNORED_TOPICS: Final = re.compile(
    r"(^|/)(rosout|parameter_events|clock|tf_static|diagnostics\w*)$"
)
IGNORED_FIELDS: Final = re.compile(
    r"header|stamp|covariance|variance|layout|status|(^|\.)(id|seq|sec|nanosec|width|height)(\.|$)"
    r"|orientation\.[xyzw]$|rotation\.[xyzw]$"
)
POSITION: Final = re.compile(r"position|translation|(^|\.)(roll|pitch|yaw)$|angle$")


class Unfit(BagError):  # noqa: N818 - an answer, not a fault
    """Bags from which nothing can be identified, whatever a configuration says."""


@dataclass(frozen=True)
class Candidate:
    """A number that may be a signal.

    text: its path with operations. command: the share, 0 to 1, by which type and names say that it
    drives; why: those words. low, high: in the bags looked into. rate: Hz, the median.
    """

    text: str
    msgtype: str
    unit: str
    command: float
    why: str
    low: float
    high: float
    rate: float

    @property
    def topic(self) -> str:
        """The topic its messages are on."""
        return self.text.partition(":")[0]

    @property
    def kind(self) -> tuple[str, str, str]:
        """What numbers of several joints or sensors have in common: type, unit and operations."""
        return self.msgtype, self.unit, self.text.partition("|")[2]

    @property
    def is_position(self) -> bool:
        """Whether it is a position or an angle, which may add up what drives it for ever."""
        named = POSITION.search(_field(self.text)) or "|unwrap" in self.text
        return "|derivative" not in self.text and bool(named)

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        return (
            f"{self.text}: {self.low:.4g} to {self.high:.4g}{unit}, {self.rate:.4g} Hz, {self.why}"
        )


@dataclass(frozen=True)
class Pair:
    """A response that may follow a command.

    delay, correlation: over the bags looked into, the median and the mean. score: the correlation,
    weighted by how likely the roles are.
    """

    command: Candidate
    response: Candidate
    delay: float
    correlation: float
    score: float

    def __str__(self) -> str:
        return f"correlation {self.correlation:+.2f} after {self.delay:.3g} s"


@dataclass(frozen=True)
class Found:
    """What a look into bags found: candidates vary, pairs are the best first, constant never do."""

    candidates: tuple[Candidate, ...]
    pairs: tuple[Pair, ...]
    constant: tuple[Candidate, ...] = ()

    @property
    def still(self) -> list[str]:
        """Some signals that measure and never vary."""
        return [c.text for c in self.constant if c.command < 0.5][:SHOWN]

    @property
    def constant_commands(self) -> list[str]:
        """Some signals that surely command and never vary, on topics where nothing varies."""
        moving = {c.topic for c in self.candidates}
        surely = [c for c in self.constant if c.command > COMMANDS_SURELY]
        return [c.text for c in surely if c.topic not in moving][:SHOWN]

    def best_for(self, response: str) -> list[Pair]:
        """The pairs of one response, the best first."""
        return [pair for pair in self.pairs if pair.response.text == response]


def look(bags: Sequence[Path], *, definitions: Mapping[str, Definition] | None = None) -> Found:
    """Every number that varies in a few of the bags, and the pairs that go together.

    Raises BagError if a bag cannot be read or nothing in them varies.
    """
    explored = [
        bags[k] for k in np.unique(np.linspace(0, len(bags) - 1, EXPLORED).round(0).astype(int))
    ]
    candidates: dict[str, Candidate] = {}
    series: list[dict[str, tuple[IntArray, FloatArray]]] = []
    for path in explored:
        with Bag(path, definitions=definitions) as bag:
            found, read = _of_bag(bag)
        series.append(read)
        for new in found:
            old = candidates.get(new.text)
            low, high = (
                (new.low, new.high)
                if old is None
                else (min(old.low, new.low), max(old.high, new.high))
            )
            candidates[new.text] = replace(old or new, low=low, high=high)
    varying = tuple(c for c in candidates.values() if c.high > c.low)
    if not varying:
        raise Unfit(f"no number varies in {', '.join(path.name for path in explored)}")
    constant = tuple(c for c in candidates.values() if c.low == c.high)
    return Found(varying, tuple(_pairs(varying, series)), constant)


def choose(
    found: Found, responses: Sequence[str] = (), excitations: Sequence[str] = ()
) -> tuple[list[str], list[str]]:
    """The signals that were named, and for a side that was not the best that goes with the other.

    Raises Unfit if nothing goes with anything.
    """
    if responses and excitations:
        return list(responses), list(excitations)
    constant = {each.text for each in found.constant}
    unmoved = [u for u in excitations if u in constant] if excitations else _unmoved(found)
    if unmoved:
        raise Unfit(
            f"the command never varies ({', '.join(unmoved)}): a model is identified from how a "
            "robot answers to one that does; if another number drives it, name that with -u"
        )
    best = []
    for response in responses or [""]:
        pairs = [
            pair
            for pair in found.pairs
            if (not response or is_named(pair.response.text, response))
            and (not excitations or is_named(pair.command.text, excitations[0]))
            and (pair.score > 0.0 or response or excitations)
        ]
        if not pairs:
            what = f"{response} follows no command" if response else "no number follows another"
            still = f"; always the same: {', '.join(found.still)}" if found.still else ""
            raise Unfit(
                f"{what}; name them with --excitation and --response (nlsid bag signals lists what "
                f"there is){still}"
            )
        best.append(pairs[0])
    commands = dict.fromkeys(pair.command.text for pair in best)
    return list(responses) or [best[0].response.text], list(excitations) or list(commands)


def _unmoved(found: Found) -> list[str]:
    """Commands that never vary, where nothing else that may be one leads anything."""
    others = any(pair.command.command >= 0.5 and pair.score > 0.0 for pair in found.pairs)
    return [] if others else found.constant_commands


def is_named(candidate: str, named: str) -> bool:
    """Whether a candidate is what was named, with operations or without."""
    return candidate == named or candidate.partition("|")[0] == named


def _of_bag(
    bag: Bag,
) -> tuple[list[Candidate], dict[str, tuple[IntArray, FloatArray]]]:
    """The candidates of a bag, and their numbers by log time."""
    paths = {str(path): listed for listed in bag_signals(bag) for path in _elements(bag, listed)}
    found: list[Candidate] = []
    series: dict[str, tuple[IntArray, FloatArray]] = {}
    for topic in bag.topics:
        mine = {text: SignalPath.parse(text) for text in paths if text.startswith(f"{topic}:")}
        with suppress(BagError):  # what cannot be read is no candidate
            columns = read_columns(bag, mine)[topic] if mine else None
            if columns is None or len(columns) < WINDOW:
                continue
            msgtype, _ = bag.types_on(topic)
            for text, values in columns.values.items():
                for signal, numbers, unit in _forms(text, paths[text].unit, columns, values):
                    finite = np.isfinite(numbers)
                    if finite.sum() < WINDOW:
                        continue
                    stamps = columns.log_ns[finite]
                    command, why = _role(signal, msgtype)
                    if command < 1.0 and float((np.diff(numbers[finite]) == 0.0).mean()) > HELD:
                        command, why = command + HELD_IS_DRIVEN, f"{why}, mostly held"
                    series[signal] = stamps, numbers[finite]
                    found.append(
                        Candidate(
                            signal,
                            msgtype,
                            unit,
                            command,
                            why,
                            float(numbers[finite].min()),
                            float(numbers[finite].max()),
                            _rate(stamps),
                        )
                    )
    return found[:MOST_CANDIDATES], series


def _elements(bag: Bag, listed: Listed) -> list[SignalPath]:
    """The single signals of a row that may be candidates."""
    topic, _, field = listed.signal.partition(":")
    if not field or IGNORED_TOPICS.search(topic) or IGNORED_FIELDS.search(field):
        return []
    if listed.number == "bool" or listed.elements > MOST_ELEMENTS:
        return []
    with suppress(BagError):
        return expand_path(bag, SignalPath.parse(listed.signal))
    return []


def _forms(
    text: str, unit: str, columns: Columns, values: FloatArray
) -> Iterator[tuple[str, FloatArray, str]]:
    """The number, and of a position its slope too: what integrates a command follows it in that."""
    written, unit, turn = text, *_turning(text, unit, values)
    if turn:
        written = f"{text}|unwrap" if unit != "deg" else f"{text}|unit(deg)|unwrap"
    finite = turn and np.isfinite(values).all()
    numbers = np.unwrap(np.r_[0.0, values], period=turn)[1:] if finite else values
    yield written, numbers, unit
    if not (turn or POSITION.search(_field(text))):
        return
    stamps = columns.log_ns if columns.stamp_ns is None else columns.stamp_ns
    usable = np.isfinite(numbers) & (np.diff(stamps, prepend=stamps[:1] - 1) > 0)
    window = slope_window(_rate(stamps[usable])) if usable.sum() > WINDOW else 0.0
    if not 0.0 < window < 1e3:
        return
    slopes = np.full(len(numbers), np.nan)
    with suppress(BagError):
        slopes[usable] = derivative(numbers[usable], stamps[usable], window)
        yield f"{written}|derivative({window:g} s)", slopes, per_second(unit)


def _turning(text: str, unit: str, values: FloatArray) -> tuple[str, float]:
    """The unit of an angle that begins again after a whole turn, and that turn; else 0.

    An angle is known by its name, or by leaps of a turn, as a compass from 0 to 360 makes.
    """
    if text.rpartition(".")[2] in ANGLES:
        return unit, turn_of(unit)
    steps = np.abs(np.diff(values[np.isfinite(values)]))
    if unit in ("", "rad", "deg") and len(steps):
        for named, turn in (("deg", turn_of("deg")), ("rad", turn_of("rad"))):
            leaps = float(steps.max()) > LEAP * turn and np.ptp(values) < ROOM * turn
            if leaps and unit in ("", named):
                return named, turn
    return unit, 0.0


def slope_window(rate: float) -> float:
    """Seconds of a slope over WINDOW messages at `rate` [Hz], two digits."""
    return float(f"{WINDOW / rate:.2g}")


def _field(text: str) -> str:
    return re.sub(r"\[[^\]]*\]", "", text.partition(":")[2].partition("|")[0])


def _rate(stamps: IntArray) -> float:
    steps = np.diff(stamps)
    steps = steps[steps > 0]
    return float(1e9 / np.median(steps)) if len(steps) else float("nan")


def _role(text: str, msgtype: str) -> tuple[float, str]:
    """How likely a number drives, as its type and its names say, and the words for it."""
    topic, _, field = text.lower().partition(":")
    share, why = 0.5, []
    if msgtype in COMMANDS:
        share, why = share + 0.3, [f"{msgtype} is mostly a command's type"]
    if msgtype in RESPONSES:
        share, why = share - 0.3, [f"{msgtype} is measured"]
    for words, sign in ((SAYS_COMMAND, 1.0), (SAYS_RESPONSE, -1.0)):
        if named := words.search(topic):
            share += 0.3 * sign
            why.append(f"named '{named[0].strip('/')}'")
        elif named := words.search(field):
            share += 0.2 * sign
            why.append(f"field '{named[0]}'")
    return float(np.clip(share, 0.0, 1.0)), ", ".join(why) or "type and names do not say its role"


def _pairs(
    candidates: Sequence[Candidate],
    series: Sequence[Mapping[str, tuple[IntArray, FloatArray]]],
) -> list[Pair]:
    """Each likely command with each likely response on another field, the best first."""
    driving = [c for c in candidates if "|derivative" not in c.text]
    driving = sorted(driving, key=lambda c: -c.command)[:MOST_COMMANDS]
    answering = sorted(candidates, key=lambda c: c.command)[: MOST_COMMANDS * 2]
    pairs = []
    for u in driving:
        for y in answering:
            if u.command < y.command or (_field(u.text) == _field(y.text) and u.topic == y.topic):
                continue
            found = [
                _delay(read[u.text], read[y.text])
                for read in series
                if u.text in read and y.text in read
            ]
            known = [one for one in found if one is not None]
            if not known:
                continue
            correlation = float(np.mean([one.correlation for one in known]))
            roles = u.command * (1.0 - y.command)
            is_reference = u.is_position and u.unit == _position_unit(y.unit)
            liked = 1.0 if is_reference == y.is_position else OTHER_KIND_LIKED
            liked *= SLOPES_LIKED if "|derivative" in y.text else 1.0
            liked *= OTHER_JOINT_LIKED if _other_joint(u.text, y.text) else 1.0
            pairs.append(
                Pair(
                    u,
                    y,
                    float(np.median([one.seconds for one in known])),
                    correlation,
                    abs(correlation) * roles * liked,
                )
            )
    return sorted(pairs, key=lambda pair: -pair.score)


def _delay(
    command: tuple[IntArray, FloatArray], response: tuple[IntArray, FloatArray]
) -> Delay | None:
    """How the response follows the held command, on its rate; None if it cannot be said."""
    (u_ns, u), (y_ns, y) = command, response
    start, end = max(u_ns[0], y_ns[0]), min(max(u_ns[-1], y_ns[-1]), y_ns[-1])
    steps = np.diff(y_ns)
    if end <= start or not (steps > 0).any():
        return None
    step = max(int(np.median(steps[steps > 0])), int(end - start) // MOST_SAMPLES, 1)
    at = np.arange(start, end, step)
    if len(at) < 2 * WINDOW:
        return None
    held = u[np.searchsorted(u_ns, at, side="right") - 1]
    with suppress(DataError):  # constant here, or too short
        return delay(
            held, np.interp(at, y_ns, y), step / 1e9, min(LONGEST_DELAY, (end - start) / 4e9)
        )
    return None


def _position_unit(unit: str) -> str:
    """The unit of the position whose unit, or whose rate's unit, this is."""
    return " or ".join(part.removesuffix("/s") for part in unit.split(" or "))


def _other_joint(command: str, response: str) -> bool:
    """Whether both name an element of an array, and another one."""
    named = [re.findall(r"\[\w+=([^\]]+)\]", text) for text in (command, response)]
    return all(named) and named[0] != named[1]
