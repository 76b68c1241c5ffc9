"""The trials that an assumption was measured on, and what they are worth for a next one."""

import re
from bisect import bisect_left
from dataclasses import dataclass
from fractions import Fraction
from itertools import accumulate

from . import text
from .files import Node, Rejected

LONGEST = 10**12  # samples of a recording
MAX_TRIALS = 10**5  # that one assumption was measured on, or one tube designed on
MEASURED = "measured safety_factor designed_on measured_on"
DIGEST = re.compile(r"sha256:[0-9a-f]{64}")  # one spelling, so that a recording has one name
WINDOW = re.compile(r"([0-9]{1,12}):([0-9]{1,12})\]")


@dataclass(frozen=True)
class Recorded:
    """A trial: the digest of its recording, and which samples of it: [0, LONGEST) is all."""

    recording: str
    first: int = 0
    end: int = LONGEST


@dataclass(frozen=True)
class Measured:
    """The largest value that was measured on trials, and its safety factor."""

    value: Fraction
    factor: Fraction
    trials: list[Recorded]


def read_measured(parts: dict[str, Node], what: str) -> Measured:
    """The members of MEASURED; Rejected if what was measured has samples that chose its bound."""
    measured, factor = parts["measured"].number(), parts["safety_factor"].number()
    trials = read_trials(parts["measured_on"])
    if measured < 0 or factor < 1:
        raise Rejected("measured should be 0 or more, the safety factor 1 or more")
    if not trials:
        raise Rejected(f"the {what} was measured on no trial")
    if shared(trials, read_trials(parts["designed_on"])):
        raise Rejected(f"a trial that the {what} was designed on cannot measure it")
    return Measured(measured, factor, trials)


def read_trials(trials: Node) -> list[Recorded]:
    """A list of {name, digest}; a digest may end in [first:end], samples of the recording."""
    return [read_trial(trial) for trial in trials.items(0, MAX_TRIALS)]


def read_trial(trial: Node) -> Recorded:
    """One {name, digest}."""
    parts = trial.members("name digest")
    parts["name"].text()
    recording, cut, samples = parts["digest"].text().partition("[")
    if not DIGEST.fullmatch(recording):
        raise Rejected(
            f"{trial.where}: a trial should have the digest of its recording, sha256: and 64 "
            "digits or letters a-f"
        )
    if not cut:
        return Recorded(recording)
    window = WINDOW.fullmatch(samples)
    if window is None or not int(window[1]) < int(window[2]) < LONGEST:
        raise Rejected(f"{trial.where}: a window should be [first:end] with first < end")
    return Recorded(recording, int(window[1]), int(window[2]))


def shared(trials: list[Recorded], others: list[Recorded]) -> int:
    """How many distinct trials have samples that others have."""
    spans: dict[str, list[tuple[int, int]]] = {}
    for other in others:
        spans.setdefault(other.recording, []).append((other.first, other.end))
    reached = {
        recording: ([first for first, _ in found], list(accumulate((e for _, e in found), max)))
        for recording, found in ((key, sorted(value)) for key, value in spans.items())
    }
    count = 0
    for trial in set(trials):
        firsts, ends = reached.get(trial.recording, ([], []))
        begun = bisect_left(firsts, trial.end)  # those that begin before the trial ends
        count += begun > 0 and ends[begun - 1] > trial.first
    return count


def distinct(trials: list[Recorded]) -> int:
    """How many of them share no sample with another that is counted: the most there can be."""
    reached: dict[str, int] = {}
    count = 0
    for trial in sorted(set(trials), key=lambda t: t.end):
        if trial.first >= reached.get(trial.recording, 0):
            reached[trial.recording] = trial.end
            count += 1
    return count


def calibration(measured: Measured, fitted_to: list[Recorded] | None) -> str:
    """On what a bound was measured, and how often a next trial exceeds it, if that can be said.

    The largest of m + 1 exchangeable numbers is the last with probability at most 1/(m + 1). The
    numbers are exchangeable only if the model and the tube were fixed before they were seen.
    fitted_to: what made the model; None if it does not say.
    """
    count, cut = distinct(measured.trials), any(t.end < LONGEST for t in measured.trials)
    kind = "window" if cut else "trial"
    those = f"{count} distinct {kind}s, each" if count > 1 else f"1 distinct {kind},"
    worth = "no probability is stated of a next trial, as "
    if cut:
        worth += "windows of one recording are hardly exchangeable"
    elif fitted_to is None:
        worth += "the model does not name what it was fitted to"
    elif seen := shared(measured.trials, fitted_to):
        worth += f"the model was fitted to {seen} of them"
    else:
        worth = "a next trial that is exchangeable with them exceeds their largest with probability"
        worth += f" at most 1/{count + 1}"
    return (
        f"largest of {those} taken whole, {text.above(measured.value)}, safety factor "
        f"{text.below(measured.factor)} in amplitude; {worth}"
    )
