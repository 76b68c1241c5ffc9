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
from bags.chain.steps import Trials, by_use, read_signals_of
from bags.chain.training import decoded, encoded
from bags.fleet.manifest import Manifest
from bags.fleet.run import Answer, ask
from bags.fleet.workers import Workers
from bags.recordings.definitions import read_definitions, texts_of
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import BagError, DataError, NlsidError
from nlsid_core.progress import Progress, silent

MANIFEST = "fleet.sqlite"


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
        return encoded({"": read_signals_of([bag], self.config, names=[name])})


@dataclass(frozen=True, eq=False)
class FleetTrials:
    """The trials by use, every bag's answer, and those that are left out, with the reason."""

    trials: Trials
    answers: tuple[Answer, ...]
    left_out: dict[str, str]


def read_fleet(
    bags: Mapping[str, Path],
    config: Config,
    out: Path,
    *,
    workers: Workers,
    strict: bool = False,
    progress: Progress = silent,
) -> FleetTrials:
    """`read_trials` of bags by name, by workers; what they read is kept in OUT/fleet.sqlite.

    A bag that cannot be read or used is left out, and so is a second copy of one recording; with
    `strict` the first of them raises. Raises DataError if no bag is left, or for the split.
    """
    with Manifest(out / MANIFEST) as manifest:
        given = ask(ReadTrials(config), bags, workers, manifest, strict=strict, progress=progress)
        answers, trials, left_out = usable_trials(given)
    if strict and left_out:
        name, reason = next(iter(left_out.items()))
        raise BagError(f"{bags[name]}: {reason}")
    if not trials:
        some = "; ".join(f"{name}: {reason}" for name, reason in list(left_out.items())[:3])
        raise DataError(f"none of {len(bags)} bags can be used: {some}")
    return FleetTrials(by_use(Dataset(tuple(trials)), config), tuple(answers), left_out)


def usable_trials(
    given: Iterable[Answer],
) -> tuple[list[Answer], list[Trajectory], dict[str, str]]:
    """The answers without what they say, their trials, and who is left out, with the reason.

    Left out is what was not read, what does not go with the first trial, and the second copy of a
    recording: another with its digest, or with the same samples, which noise does not repeat.
    """
    answers: list[Answer] = []
    trials: list[Trajectory] = []
    left_out: dict[str, str] = {}
    recorded: dict[str, str] = {}
    for answer in given:
        answers.append(replace(answer, content=b""))
        if answer.reason:
            left_out[answer.name] = answer.reason
            continue
        own = decoded(answer.content, source=f"{answer.name}: not trials")[""].trajectories
        marks = [own[0].digest, *samples_digest(own)]
        if known := [recorded[mark] for mark in marks if mark in recorded]:
            left_out[answer.name] = f"the same recording as {known[0]}"
            continue
        recorded |= dict.fromkeys(marks, answer.name)
        try:
            Dataset((*trials[:1], *own))
        except NlsidError as error:
            left_out[answer.name] = str(error)
            continue
        trials += own
    return answers, trials, left_out


def samples_digest(trials: Sequence[Trajectory]) -> list[str]:
    """One digest of all samples of a bag; none if every response rests, as that may come twice."""
    if not any(np.ptp(trial.y, axis=0).any() for trial in trials):
        return []
    digest = hashlib.sha256()
    for trial in trials:
        for values in (trial.t, trial.y, trial.u):
            digest.update(f"{values.shape}".encode() + values.tobytes())
    return [digest.hexdigest()]
