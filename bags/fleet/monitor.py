"""Every bag of a fleet held against one design: who left it, when, and is the fleet what it was."""

import hashlib
import json
import math
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path

from scipy.stats import mannwhitneyu

from bags.chain.training import load_held_back, load_training
from bags.designs import documents
from bags.fleet.bags import COPY, UNREAD, Recordings, robots_of, same_as
from bags.fleet.check import iso
from bags.fleet.manifest import Manifest
from bags.fleet.run import ask
from bags.fleet.workers import Workers
from bags.monitoring.replay import Definitions, Replay, replay_bag
from bags.recordings.definitions import texts_of
from bags.signals.reader import bag_origin
from nlsid_core import files
from nlsid_core.data.calibration import recording
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.designs import AnyDesign
from nlsid_core.funnels.tube import TubeFunnel
from nlsid_core.progress import Progress, silent
from nlsid_core.running.comparison import Centre
from nlsid_core.running.monitor import Monitor
from nlsid_core.running.reading import Reading, Status, cause

RARE = 0.01  # probability of the second bound that is stated, where there are bags enough
BINS = 10  # of the histogram, of what the assumption allows
LEAST = 3  # bags of a month, and calibration trials, that are compared


@dataclass(frozen=True)
class Judged:
    """One bag: its verdict, and the numbers behind it.

    verdict: of `Replay`, `not read` or `copy`. reason: why it is not inside. assumption: what of it
    was broken first, without numbers. spent: the largest part of what is assumed that was used
    (None: not measured), at spent_at, s of the run. margin: the least (None: nothing judged),
    margin_at: s. start: the bag's first log time, spent_when, and bad_from: of the first bad
    sample, all ISO 8601 in UTC; bad_at: s of the run. alarm: of the second alarm. unjudged: the
    first samples that were not judged, and why, also of a bag that is bad. clock: where its stamps
    go back. judged, span: s. filled: samples nobody measured. digest: of the recording.
    """

    bag: str
    robot: str
    verdict: str
    reason: str = ""
    assumption: str = ""
    spent: float | None = None
    spent_at: float = 0.0
    spent_when: str = ""
    margin: float | None = None
    margin_at: float = 0.0
    start: str = ""
    bad_from: str = ""
    bad_at: float = 0.0
    alarm: str = ""
    unjudged: str = ""
    clock: str = ""
    judged: float = 0.0
    span: float = 0.0
    filled: int = 0
    digest: str = ""

    @property
    def month(self) -> str:
        """The month of its start, `2026-11`; empty if unknown."""
        return self.start[:7]

    @property
    def has_trouble(self) -> bool:
        """Whether there is something to look at; a copy is looked at where it counts."""
        return bool(self.alarm or self.clock) or self.verdict not in (Status.INSIDE.value, COPY)


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
        """A Judged, as JSON."""
        replay = replay_bag(self.design, bag, centre=self.centre, definitions=self.definitions)
        return files.canonical(asdict(judged_of(replay, bag, name)))


def judged_of(replay: Replay, bag: Path, name: str) -> Judged:
    """What `replay` says of `bag`, which is called `name`, in a few numbers."""
    stamps = dict(zip(map(id, replay.readings), replay.stamps_ns, strict=True))
    most, worst, bad = most_spent(replay.judged), replay.worst, replay.first_bad
    alarm = replay.first_alarm
    return Judged(
        bag=name,
        robot="-",  # told from the others at home
        verdict=replay.verdict,
        reason=replay.reason,
        assumption="" if bad is None or bad.status is Status.OUTSIDE else _broken(bad.reason),
        spent=None if most is None else most.assumption,
        spent_at=0.0 if most is None else most.t,
        spent_when="" if most is None else iso(stamps[id(most)]),
        margin=None if worst is None else max(worst.margin, -1e300),
        margin_at=0.0 if worst is None else worst.t,
        start=iso(replay.start_ns),
        bad_from="" if bad is None else iso(stamps[id(bad)]),
        bad_at=0.0 if bad is None else bad.t,
        alarm="" if alarm is None else alarm.alarm,
        unjudged=_unjudged(replay),
        clock=replay.clock,
        judged=replay.judged_span,
        span=replay.span,
        filled=replay.filled,
        digest=bag_origin(bag)["digest"],
    )


def _broken(reason: str) -> str:
    """What was broken, whenever and by however much."""
    return cause(reason.partition(" at t = ")[0]).replace("#", "...").rstrip(",")


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
    """Every bag's row, in order.

    calibration: what each trial that scaled the design spent. made_of: digests of the recordings
    that designed or scaled it. known: how many rows were in the manifest before.
    """

    rows: tuple[Judged, ...]
    calibration: tuple[float, ...]
    made_of: frozenset[str]
    known: int = 0

    @property
    def others(self) -> list[Judged]:
        """The bags of which the assumption was measured and that the design was not made of."""
        return [r for r in self.rows if r.spent is not None and r.digest not in self.made_of]

    @property
    def unrecognised(self) -> bool:
        """Whether no bag here is known to be one that the design was made of."""
        return bool(self.made_of) and not any(row.digest in self.made_of for row in self.rows)

    @property
    def own(self) -> int:
        """How many bags the design was made of."""
        return sum(row.digest in self.made_of for row in self.rows)

    @property
    def worst(self) -> list[Judged]:
        """Ten bags that spent the most."""
        measured = [row for row in self.rows if row.spent is not None]
        return sorted(measured, key=lambda row: -(row.spent or 0.0))[:10]

    @property
    def histogram(self) -> list[int]:
        """How many bags spent 0 to 10 %, ..., 90 to 100 % of what is assumed, and more."""
        counts = [0] * (BINS + 1)
        for row in self.rows:
            if row.spent is not None:
                counts[min(BINS, math.ceil(max(BINS * row.spent - 1.0, 0.0)))] += 1
        return counts

    def by(self, key: str) -> dict[str, list[Judged]]:
        """The rows by `robot` or by `day` (empty: unknown), those with the most trouble first."""
        found: dict[str, list[Judged]] = {}
        for row in self.rows:
            found.setdefault(row.start[:10] if key == "day" else row.robot, []).append(row)
        return dict(sorted(found.items(), key=lambda e: (-trouble_in(e[1]), e[0])))

    @property
    def ranks(self) -> list[str]:
        """What m bags say of the next, if it is exchangeable with them: of two ranks that are fixed
        before anything is looked at. Source: see `nlsid_core.data.calibration`.
        """
        spent = sorted((row.spent or 0.0 for row in self.others), reverse=True)
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
        month = max((row.month for row in self.others), default="")
        newest = [row.spent for row in self.others if row.month == month and row.spent is not None]
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


def trouble_in(rows: Sequence[Judged]) -> int:
    """How many of them have trouble."""
    return sum(row.has_trouble for row in rows)


def monitor_fleet(
    bags: Mapping[str, Path],
    task: JudgeBag,
    calibration: Sequence[float],
    *,
    workers: Workers,
    manifest: Path | None = None,
    progress: Progress = silent,
) -> FleetVerdict:
    """Each bag as `nlsid monitor` judges it; one that cannot be read or judged is `not read`.

    calibration: what each trial that scaled the design spent (`calibration_spent`).
    """
    robots, known, rows = robots_of(bags), 0, []
    with Manifest(manifest) as kept:
        for answer in ask(task, bags, workers, kept, progress=progress):
            known += answer.kept
            row = (
                Judged(answer.name, "", UNREAD, answer.reason)
                if answer.reason
                else Judged(**json.loads(answer.content))
            )
            rows.append(replace(row, robot=robots[row.bag]))
    made_of = frozenset(task.design.made_with)
    return FleetVerdict(tuple(counted_once(rows)), tuple(calibration), made_of, known)


def counted_once(rows: Sequence[Judged]) -> list[Judged]:
    """The rows, but the second of a recording (by its digest, or all numbers) is a `copy`."""
    recordings, counted = Recordings(), []
    for row in rows:
        numbers = replace(row, bag="", robot="", digest="") if row.judged else None
        marks = [mark for mark in (row.digest, numbers) if mark]
        if (first := recordings.first(row.bag, marks)) != row.bag:
            row = Judged(row.bag, row.robot, COPY, same_as(first), start=row.start)
        counted.append(row)
    return counted


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
