"""`Scene`: what is known of a watched robot now, for whatever shows it.

A monitor feeds it, live or replayed; several servers read it from threads of their own. It decides
nothing: it repeats the monitor's word, and takes it back when the word or the samples grow old.
"""

import math
import threading
import time
import unicodedata
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

from nlsid_core.running.reading import cause

OK, WARN, ERROR, STALE = range(4)  # as diagnostic_msgs/DiagnosticStatus has them
SILENT: Final = 2.5  # s without the monitor's status, which it repeats every second
LATE: Final = 1.0  # s without a sample from a monitor that says inside
MOST_SAMPLES: Final = 20_000  # kept: 20 s at 1 kHz
MOST_FORECASTS: Final = 400  # kept: 20 s at 20 a second
MOST_EVENTS: Final = 200
MOST_NODES: Final = 32
LONGEST_TEXT: Final = 300  # characters of anything that came from outside
WORDS: Final = ("inside", "warning", "unknown", "assumption violated", "outside")
MONITORING: Final = ("margin", "assumption", "time_to_exit", "latency")


class Sample(NamedTuple):
    """One judged sample: stamp in ns, when it came in s of `time.monotonic`, its numbers by name
    (`margin`, `assumption`, `nominal`, `measured`, `half_width`; indexed where there are several).

    Or a forecast, at the stamp that it is about: `low`, `high`, and `ahead`, s since it was made.
    """

    stamp_ns: int
    came: float
    numbers: Mapping[str, float]

    def signal(self, name: str, index: int) -> float:
        """`nominal`, `measured`, `half_width`, `low` or `high` of a signal; NaN if unknown."""
        found = self.numbers.get(f"{name}[{index}]", self.numbers.get(name) if index == 0 else None)
        return math.nan if found is None else found

    @property
    def signals(self) -> int:
        """How many signals are measured."""
        return sum(name.partition("[")[0] == "measured" for name in self.numbers)


class Said(NamedTuple):
    """What a node said last, at which level, and when it came in s of `time.monotonic`."""

    level: int
    text: str
    came: float


class Event(NamedTuple):
    """A node's new message: stamp in ns, level, node and text."""

    stamp_ns: int
    level: int
    node: str
    text: str


@dataclass(frozen=True)
class Verdict:
    """What is to be shown large. word: `inside` only while the monitor says so and samples come."""

    word: str
    level: int
    text: str


class Scene:
    """Thread-safe. source: what is watched, in words; monitor: the node whose word counts."""

    def __init__(self, source: str, monitor: str) -> None:
        self.source, self.monitor = clean(source), clean(monitor)
        self._lock = threading.Lock()
        self._samples: deque[Sample] = deque(maxlen=MOST_SAMPLES)
        self._forecasts: deque[Sample] = deque(maxlen=MOST_FORECASTS)
        self._events: deque[Event] = deque(maxlen=MOST_EVENTS)
        # How many samples, forecasts and events there have been.
        self._sampled = self._foreseen = self._told = 0
        self._nodes: dict[str, Said] = {}
        self._names: tuple[str, ...] = ()
        self._ended = ""

    def sample(self, stamp_ns: int, numbers: Mapping[str, float]) -> None:
        """A sample was judged."""
        with self._lock:
            self._samples.append(Sample(stamp_ns, time.monotonic(), dict(numbers)))
            self._sampled += 1

    def forecast(self, stamp_ns: int, numbers: Mapping[str, float]) -> None:
        """Said of a sample that has not come yet."""
        with self._lock:
            self._forecasts.append(Sample(stamp_ns, time.monotonic(), dict(numbers)))
            self._foreseen += 1

    def forecasts_after(self, seen: int) -> tuple[int, list[Sample]]:
        """How many there have been, and those after the first `seen` ones that are still kept."""
        with self._lock:
            fresh = min(self._foreseen - seen, len(self._forecasts))
            return self._foreseen, list(self._forecasts)[len(self._forecasts) - fresh :]

    def say(
        self, stamp_ns: int, node: str, level: int, text: str, *, names: Sequence[str] = ()
    ) -> None:
        """A node said what it does; names: of the measured signals, if it told them."""
        node, text = clean(node), clean(text)
        with self._lock:
            if node not in self._nodes and len(self._nodes) >= MOST_NODES and node != self.monitor:
                return
            before = self._nodes.get(node)
            self._nodes[node] = Said(level, text, time.monotonic())
            if node == self.monitor and names:
                self._names = tuple(clean(name) for name in names)
            if before is None or (before.level, cause(before.text)) != (level, cause(text)):
                self._events.append(Event(stamp_ns, level, node, text))
                self._told += 1

    def end(self, verdict: str) -> None:
        """Nothing more comes: the recording is over."""
        with self._lock:
            self._ended = clean(verdict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the measured signals, with units, as far as the monitor told them."""
        with self._lock:
            return self._names

    def nodes(self) -> dict[str, Said]:
        """What each node said last."""
        with self._lock:
            return dict(self._nodes)

    def samples_after(self, seen: int, most: int) -> tuple[int, list[Sample]]:
        """How many there have been, and those after the first `seen` ones.

        At most `most`: of each of as many equal parts the one with the least margin.
        """
        with self._lock:
            fresh = min(self._sampled - seen, len(self._samples))
            new = [self._samples[i] for i in range(len(self._samples) - fresh, len(self._samples))]
            return self._sampled, _worst_of_each(new, most)

    def events_after(self, seen: int) -> tuple[int, list[Event]]:
        """How many there have been, and those after the first `seen` ones that are still kept."""
        with self._lock:
            fresh = min(self._told - seen, len(self._events))
            return self._told, list(self._events)[len(self._events) - fresh :]

    def verdict(self) -> Verdict:
        """The monitor's word while it is fresh; otherwise why it does not count any more."""
        now = time.monotonic()
        with self._lock:
            said = self._nodes.get(self.monitor)
            newest = self._samples[-1] if self._samples else None
            ended = self._ended
        if ended:
            return Verdict("recording over", STALE, ended)
        if said is None:
            return Verdict("waiting", STALE, f"{self.monitor} has said nothing yet")
        if (silent := now - said.came) > SILENT:
            what = f"{self.monitor} has said nothing for {silent:.0f} s; it said: {said.text}"
            return Verdict("stale", STALE, what)
        word = next((word for word in WORDS if said.text.startswith(word)), "unknown")
        text = said.text.removeprefix(word).lstrip(":; ")
        if word == "unknown" or said.level == STALE:
            return Verdict("unknown", STALE, text)
        if word not in ("inside", "warning"):
            return Verdict(word, said.level, text)
        if newest is None or now - newest.came > LATE:
            for_how_long = "" if newest is None else f" for {now - newest.came:.1f} s"
            return Verdict("late", STALE, f"no sample has come{for_how_long}")
        if not newest.numbers.get("margin", math.nan) >= 0.0:
            return Verdict("unknown", STALE, "the newest sample is not judged inside")
        if word == "inside" and said.level != OK:
            return Verdict("error", said.level, said.text)
        return Verdict(word, said.level, text)


def clean(text: str) -> str:
    """Printable characters only and not too many: names come from whoever is on the network."""
    kept = (c if unicodedata.category(c)[0] not in "CZ" else " " for c in text[: 2 * LONGEST_TEXT])
    cut = " ".join("".join(kept).split())
    return cut if len(cut) <= LONGEST_TEXT else cut[: LONGEST_TEXT - 1] + "…"


def _worst_of_each(samples: list[Sample], parts: int) -> list[Sample]:
    if len(samples) <= parts:
        return samples
    edges = [round(i * len(samples) / parts) for i in range(parts + 1)]
    return [min(samples[a:b], key=_margin) for a, b in pairwise(edges)]


def _margin(sample: Sample) -> float:
    """What is not judged is worse than inside and better than outside."""
    margin = sample.numbers.get("margin", math.nan)
    return -0.0 if math.isnan(margin) else margin
