"""Identification from many bags: each is read by a worker, which sends its samples home.

What is sent is the trials themselves, resampled: 16 bytes a sample of a response and an excitation
(docs/decisions/0027 has the sizes of what else could be). Everything after that is what one machine
does, on the same numbers in the same order, so its result is the same to the last bit.
"""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path

import numpy as np

from bags.chain.config import Config
from bags.chain.steps import Trials, by_use, check_split, read_signals_of
from bags.chain.training import decoded, encoded
from bags.designs import documents
from bags.fleet.bags import Recordings, same_as
from bags.fleet.manifest import Manifest
from bags.fleet.run import Answer, ask, without_name
from bags.fleet.workers import Workers
from bags.recordings.definitions import read_definitions, texts_of
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError, NlsidError
from nlsid_core.progress import Progress, silent

MANIFEST = documents.FLEET


@dataclass(frozen=True)
class ReadTrials:
    """The configured signals of a bag, as trials called by its name."""

    config: Config

    @cached_property
    def asked(self) -> str:
        """Signals, grid, clock and the types' definitions; another version may read otherwise."""
        types = texts_of(read_definitions(self.config.definitions))
        said = self.config.model_dump_json(include={"signals", "grid", "clock"})
        return f"trials {version('nlsid')} {said} {types}"

    def __call__(self, bag: Path, name: str) -> bytes:
        """The trials, as `training.encoded` writes them."""
        return encoded({"": read_signals_of({name: bag}, self.config)}, compressed=False)


@dataclass(frozen=True, eq=False)
class FleetTrials:
    """What was read of every bag, without what it says; the trials of all that can be used; and who
    is left out, by name with the reason.
    """

    config: Config
    answers: tuple[Answer, ...]
    read: tuple[Trajectory, ...]
    left_out: Mapping[str, str]

    @cached_property
    def trials(self) -> Trials:
        """The trials by use; DataError if there is none, or for the split."""
        if not self.read:
            raise DataError(f"none of {len(self.answers)} bags can be used")
        return by_use(Dataset(self.read), self.config, left_out=list(self.left_out))


def read_fleet(
    bags: Mapping[str, Path],
    config: Config,
    out: Path,
    *,
    workers: Workers,
    progress: Progress = silent,
) -> FleetTrials:
    """`read_trials` of bags by name, by workers; what they read is kept in DIR/fleet.sqlite.

    A bag that cannot be read or used is left out, and so is a second copy of one recording.
    DataError, before any is read, if their names leave
    nothing to train on, or nothing for a use that the configuration names bags for.
    """
    check_split(list(bags), config)
    with Manifest(out / MANIFEST) as manifest:
        given = ask(ReadTrials(config), bags, workers, manifest, progress=progress)
        return usable_trials(given, config)


def usable_trials(given: Iterable[Answer], config: Config) -> FleetTrials:
    """The answers and the trials in them.

    Left out is what was not read, what does not go with the first trial, and the second copy of a
    recording: another with its digest, or with the same samples, which noise does not repeat.
    """
    answers: list[Answer] = []
    trials: list[Trajectory] = []
    left_out: dict[str, str] = {}
    recordings = Recordings()
    for answer in given:
        name = answer.name
        answers.append(replace(answer, content=b""))
        if answer.reason:
            left_out[name] = answer.reason
            continue
        own = decoded(answer.content, source=f"{name}: not trials")[""].trajectories
        first = recordings.first(name, [own[0].digest, *samples_digest(own)])
        if first != name:
            left_out[name] = same_as(first)
            continue
        try:
            Dataset((*trials[:1], *own))
        except NlsidError as error:
            left_out[name] = without_name(str(error), answer.bag, name)
            continue
        trials += own
    return FleetTrials(config, tuple(answers), tuple(trials), left_out)


def samples_digest(trials: Sequence[Trajectory]) -> list[str]:
    """One digest of all samples of a bag; none if every response rests, as that may come twice."""
    if not any(np.ptp(trial.y, axis=0).any() for trial in trials):
        return []
    digest = hashlib.sha256()
    for trial in trials:
        for values in (trial.t, trial.y, trial.u):
            digest.update(f"{values.shape}".encode() + values.tobytes())
    return [digest.hexdigest()]
