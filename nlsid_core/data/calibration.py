"""Which trials design a tube, and which others scale its level.

Let s be a number of a trial, fixed before m calibration trials are seen that are exchangeable with
the next one. Then P(s of the next > the largest of the m) <= 1/(m + 1): the largest of m + 1
exchangeable numbers is the last with probability at most 1/(m + 1). Nothing like it holds where the
same trials choose what s is. Source: V. Vovk, A. Gammerman, G. Shafer, Algorithmic Learning in a
Random World, Section 2.2.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

from nlsid_core import files
from nlsid_core.data.shared import shared_stretch
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError


@dataclass(frozen=True, eq=False)
class CalibrationTrials:
    """The trials that design a tube, and those that scale it: different recordings, or windows.

    cut: whether they are windows of one recording, which are hardly exchangeable.
    """

    design: Dataset
    calibration: Dataset
    cut: bool = False

    @property
    def designed_on(self) -> tuple[tuple[str, str], ...]:
        """(name, digest) of the trials of the design."""
        return _named(self.design)

    @property
    def measured_on(self) -> tuple[tuple[str, str], ...]:
        """(name, digest) of the trials of the calibration."""
        return _named(self.calibration)


def calibration_trials(
    train: Dataset, calibration: Dataset | None = None, *, least: int
) -> CalibrationTrials:
    """`train` designs and `calibration` scales; without the latter every second recording does.

    That is the 2nd, 4th, ... of the distinct recordings in `train`. If there is but one, it is cut
    into windows of `least` samples, and every second window scales. Raises DataError if a recording
    is on both sides or twice among `calibration`, or if there are not two windows.
    """
    if calibration is not None:
        twice = {recording(trial) for trial in train} & {recording(trial) for trial in calibration}
        for trial in calibration:
            if recording(trial) in twice:
                raise DataError(
                    f"{trial.name}: this recording is for the design and for the calibration; the "
                    "largest of trials that designed the tube says nothing of the next one"
                )
        check_apart(train, calibration)
        return CalibrationTrials(train, calibration)
    recordings = list(dict.fromkeys(recording(trial) for trial in train))
    if len(recordings) == 1:
        cut = windows(train, least)
        if len(cut) < 2:
            raise DataError(
                f"one recording, from which {len(cut)} windows of {least} samples can be cut; a "
                "tube is designed on one trial and its level measured on another: record more"
            )
        return CalibrationTrials(Dataset(cut[::2]), Dataset(cut[1::2]), cut=True)
    scaling = set(recordings[1::2])
    design, scales = (
        Dataset(tuple(trial for trial in train if (recording(trial) in scaling) is scaled))
        for scaled in (False, True)
    )
    check_apart(design, scales)
    return CalibrationTrials(design, scales)


def check_apart(others: Iterable[Trajectory], calibration: Iterable[Trajectory]) -> None:
    """Raise DataError if a calibration trial has samples of another trial, whatever its digest.

    See `shared_stretch` for what that can see and what it cannot.
    """
    if found := shared_stretch(others, calibration):
        raise DataError(
            f"{found}. A calibration trial is a recording of its own; the largest of trials that "
            "designed the tube, or of one that is there twice, says nothing of the next one: "
            "leave one of the two out"
        )


def windows(trials: Iterable[Trajectory], samples: int) -> tuple[Trajectory, ...]:
    """The trials of one recording cut into windows of so many samples, what is left over dropped.

    A window's digest is the recording's with `[first:end]`, samples counted through all its trials.
    """
    cut, before = [], 0
    for trial in trials:
        for first in range(0, len(trial) - samples + 1, samples):
            where = f"[{before + first}:{before + first + samples}]"
            part = trial.rows(slice(first, first + samples), trial.name + where)
            cut.append(replace(part, digest=recording(trial) + where))
        before += len(trial)
    return tuple(cut)


def recording(trial: Trajectory) -> str:
    """The digest of the recording that a trial came from; of its samples if it names none."""
    if trial.digest:
        return trial.digest
    return files.digest(b"".join(values.tobytes() for values in (trial.t, trial.y, trial.u)))


def _named(trials: Dataset) -> tuple[tuple[str, str], ...]:
    return tuple((trial.name, recording(trial)) for trial in trials)
