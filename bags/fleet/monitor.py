"""Every bag of a fleet held against one design: who left it, when, and is the fleet what it was."""

import hashlib
import math
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path

from scipy.stats import mannwhitneyu

from bags.chain.training import load_held_back, load_training
from bags.designs import documents
from bags.fleet.rows import Row, iso
from bags.monitoring.replay import Definitions, Replay, replay_bag
from bags.recordings.definitions import texts_of
from bags.signals.reader import bag_origin
from nlsid_core import files
from nlsid_core.data.calibration import recording
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.designs import AnyDesign
from nlsid_core.funnels.tube import TubeFunnel
from nlsid_core.running.comparison import Centre
from nlsid_core.running.monitor import Monitor
from nlsid_core.running.reading import Reading, Status

RARE = 0.01  # probability of the second bound that is stated, where there are bags enough
LEAST = 3  # bags of a month, and calibration trials, that are compared


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
        digest = self.design.digest
        return f"judge {version('nlsid')} {digest} {self.centre} {wiring} {types}"

    def __call__(self, bag: Path, name: str) -> bytes:
        """A Row, as JSON."""
        replay = replay_bag(self.design, bag, centre=self.centre, definitions=self.definitions)
        return judged_of(replay, bag, name).content()


def judged_of(replay: Replay, bag: Path, name: str) -> Row:
    """What `replay` says of `bag`, which is called `name`, in a few words and numbers.

    said: `alarm`, the second one; `unjudged`, the first samples that were not judged, and why, also
    of a bag that is bad; `clock`, where its stamps go back.
    numbers: the least `margin`; the largest part of the assumption that was `spent`, at `spent_at`
    s of the run; `bad_at`, the first bad sample; s that were `judged` of the `span`; samples that
    were `filled` in.
    """
    said = {"clock": replay.clock, "unjudged": _unjudged(replay)}
    numbers: dict[str, float] = {
        "judged": replay.judged_span,
        "span": replay.span,
        "filled": replay.filled,
    }
    if replay.first_alarm is not None:
        said["alarm"] = replay.first_alarm.alarm
    if (most := most_spent(replay.judged)) is not None:
        numbers |= {"spent": most.assumption, "spent_at": most.t}
    if replay.worst is not None:
        numbers |= {"margin": max(replay.worst.margin, -1e300)}
    if replay.first_bad is not None:
        numbers["bad_at"] = replay.first_bad.t
    marks = [bag_origin(bag)["digest"]]
    if replay.judged:
        marks.append(files.digest({"start": replay.start_ns, **said, **numbers}))
    return Row(
        name,
        replay.verdict,
        replay.reason,
        start=iso(replay.start_ns),
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


def most_spent(readings: Sequence[Reading]) -> Reading | None:
    """The reading that uses the most of what is assumed; None if none measures it."""
    measured = [reading for reading in readings if math.isfinite(reading.assumption)]
    return max(measured, key=lambda reading: reading.assumption, default=None)


@dataclass(frozen=True)
class Drift:
    """Is the newest month what the calibration was? The rank test of Wilcoxon, Mann and Whitney of
    what was spent, two-sided; a small p speaks against exchangeable ones, a large one for nothing.

    larger: the part of pairs in which the month's bag spends more than the calibration trial.
    """

    month: str
    bags: int
    trials: int
    p: float
    larger: float

    def __str__(self) -> str:
        return (
            f"drift: of {self.bags} bags of {self.month} and {self.trials} calibration trials, a "
            f"bag spends more than a trial in {100 * self.larger:.0f} % of the pairs. Were they "
            f"exchangeable, they would differ as much with p = {self.p:.2g} (rank test)"
        )


@dataclass(frozen=True, eq=False)
class FleetVerdict:
    """What the rows of a fleet say together.

    calibration: what each trial that scaled the design spent. made_of: digests of the recordings
    that designed or scaled it.
    """

    rows: tuple[Row, ...]
    calibration: tuple[float, ...]
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

    @property
    def drift(self) -> Drift | None:
        """Of the newest month; None if it or the calibration has fewer than LEAST."""
        month = max((row.start[:7] for row in self.others), default="")
        newest = [row.numbers["spent"] for row in self.others if row.start.startswith(month)]
        if not month or min(len(newest), len(self.calibration)) < LEAST:
            return None
        test = mannwhitneyu(newest, self.calibration, alternative="two-sided")
        pairs = len(newest) * len(self.calibration)
        return Drift(
            month,
            len(newest),
            len(self.calibration),
            float(test.pvalue),
            float(test.statistic) / pairs,
        )


def calibration_spent(folder: Path, design: AnyDesign) -> tuple[float, ...]:
    """What each trial that scaled the design spends of what it assumes; empty if none is there.

    They are found by their digests in training.npz and held_back.npz in the design's folder.
    """
    if not isinstance(design.funnel, TubeFunnel):
        return ()
    wanted = {digest for _, digest in design.funnel.tubes[0].measured_on}
    training = folder / documents.TRAINING
    digest = files.digest(design.model.document())
    held_back = load_held_back(folder / documents.HELD_BACK, model=digest)
    trials: list[Trajectory] = [trial for data in held_back.values() for trial in data]
    if training.exists():
        trials += load_training(training, digest=design.model.training)
    monitor = design.monitor(Centre.COMMAND)
    own = [trial for trial in trials if recording(trial) in wanted]
    most = [most_spent(_readings(monitor, trial)) for trial in own]
    return tuple(reading.assumption for reading in most if reading is not None)


def _readings(monitor: Monitor, trial: Trajectory) -> list[Reading]:
    """What the monitor says of a trial, sample by sample, in a run of its own."""
    monitor.restart()
    single = trial.y.shape[1] == trial.u.shape[1] == 1
    samples = zip(trial.t.tolist(), trial.y, trial.u, strict=True)
    said = [
        monitor.update(t, float(y[0]), float(u[0])) if single else monitor.update(t, y, u)
        for t, y, u in samples
    ]
    return [reading for reading in said if reading.status is not Status.UNKNOWN]


def in_percent(part: float) -> str:
    """A part of what is assumed, three digits, rounded up."""
    return f"{_above(100.0 * part)} %"


def _above(value: float) -> str:
    """Three digits, rounded up."""
    if value <= 0.0:
        return "0"
    unit = 10.0 ** (math.floor(math.log10(value)) - 2)
    return f"{math.ceil(value / unit * (1.0 - 1e-12)) * unit:.3g}"
