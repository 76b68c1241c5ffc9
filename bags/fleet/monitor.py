"""Every bag of a fleet held against one design: who left it, and when."""

import hashlib
import math
import pickle
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path

from bags.fleet.rows import Row, iso
from bags.monitoring.replay import Definitions, Replay, replay_bag
from bags.recordings.bag import Bag
from bags.recordings.definitions import texts_of
from bags.signals.reader import bag_origin
from nlsid_core import files
from nlsid_core.designs import AnyDesign
from nlsid_core.running.comparison import Centre

RARE = 0.01  # probability of the second bound that is stated, where there are bags enough


@dataclass(frozen=True, eq=False)
class JudgeBag:
    """What `nlsid monitor` says of a bag, in a few numbers. The design was decided at home."""

    design: AnyDesign
    centre: Centre
    definitions: Definitions

    @cached_property
    def asked(self) -> str:
        """The design and what it is around."""
        types = texts_of(self.definitions)
        wiring = hashlib.sha256(pickle.dumps(self.design.wiring)).hexdigest()
        return f"judge {version('nlsid')} {self.design.digest} {self.centre} {wiring} {types}"

    def __call__(self, bag: Path, name: str) -> bytes:
        """A Row, as JSON."""
        replay = replay_bag(self.design, bag, centre=self.centre, definitions=self.definitions)
        return judged_of(replay, bag, name).content()


def judged_of(replay: Replay, bag: Path, name: str) -> Row:
    """What `replay` says of `bag`, which is called `name`, in a few words and numbers.

    said: `alarm`, the second one; `beyond`, what was commanded that no training trial had;
    `unjudged`, the first samples that were not judged, and why, also of a bag that is bad.
    numbers: the least `margin`; the largest part of the assumption that was `spent`, at `spent_at`
    s of the run; `bad_at`, the first bad sample; s that were `judged` of the `span`; samples that
    were `filled` in.
    """
    said = {"beyond": replay.beyond, "unjudged": _unjudged(replay)}
    numbers: dict[str, float] = {
        "judged": replay.judged_span,
        "span": replay.span,
        "filled": replay.filled,
    }
    if replay.first_alarm is not None:
        said["alarm"] = replay.first_alarm.alarm
    measured = [reading for reading in replay.judged if not math.isnan(reading.assumption)]
    if measured:
        most = max(measured, key=lambda reading: reading.assumption)
        numbers |= {"spent": min(most.assumption, 1e300), "spent_at": most.t}
    if replay.worst is not None:
        numbers |= {"margin": max(replay.worst.margin, -1e300)}
    if replay.first_bad is not None:
        numbers["bad_at"] = replay.first_bad.t
    with Bag(bag) as source:
        start_ns, marks = source.start_ns, [bag_origin(source)["digest"]]
    if replay.judged:
        marks.append(files.digest({"start": start_ns, **said, **numbers}))
    return Row(
        name,
        replay.verdict,
        replay.reason,
        start=iso(start_ns),
        marks=tuple(marks),
        said={what: text for what, text in said.items() if text},
        numbers=numbers,
    )


def _unjudged(replay: Replay) -> str:
    """The first stretch that was not judged, and how many more are; empty if there is none."""
    if not replay.unjudged:
        return ""
    first, *more = replay.unjudged
    said = f"{first.where}: {first.why}"
    return f"{said} (and later in {len(more)} more places)" if more else said


@dataclass(frozen=True, eq=False)
class FleetVerdict:
    """What the rows of a fleet say together.

    made_of: digests of the recordings that designed or scaled the design.
    """

    rows: tuple[Row, ...]
    made_of: frozenset[str]

    @property
    def own(self) -> list[Row]:
        """The bags that the design was made of."""
        return [row for row in self.rows if not self.made_of.isdisjoint(row.marks)]

    @property
    def others(self) -> list[Row]:
        """The bags of which the assumption was measured and that the design was not made of."""
        return [row for row in self._measured if self.made_of.isdisjoint(row.marks)]

    @property
    def worst(self) -> list[Row]:
        """Ten bags that spent the most."""
        return sorted(self._measured, key=lambda row: -row.numbers["spent"])[:10]

    @property
    def _measured(self) -> list[Row]:
        return [row for row in self.rows if "spent" in row.numbers]

    @property
    def ranks(self) -> list[str]:
        """What m bags say of the next, if it is exchangeable with them: of two ranks that are fixed
        before anything is looked at. Source: see `nlsid_core.data.calibration`.
        """
        spent = sorted((row.numbers["spent"] for row in self.others), reverse=True)
        m = len(spent)
        ranks = [1] if m else []
        if (rare := math.floor(RARE * (m + 1))) > 1:
            ranks.append(rare)
        return [
            f"the next bag spends more than {in_percent(spent[rank - 1])} of what is assumed with "
            f"probability {rank}/{m + 1} = {_above(rank / (m + 1))} at most, if it is exchangeable "
            f"with these {m}"
            for rank in ranks
        ]


def in_percent(part: float) -> str:
    """The used part of an assumption in %, three digits, rounded up."""
    return f"{_above(100.0 * part)} %"


def _above(value: float) -> str:
    """Three digits, rounded up."""
    if value <= 0.0:
        return "0"
    unit = 10.0 ** (math.floor(math.log10(value)) - 2)
    return f"{math.ceil(value / unit * (1.0 - 1e-12)) * unit:.3g}"
