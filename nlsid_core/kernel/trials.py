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
DIGEST = re.compile(r"sha256:[0-9a-f]{64}")  # one spelling, so that a recording has one name
WINDOW = re.compile(r"([0-9]{1,12}):([0-9]{1,12})\]")


@dataclass(frozen=True)
class Recorded:
    """A trial: the digest of its recording, and which samples of it: [0, LONGEST) is all."""

    recording: str
    first: int = 0
    end: int = LONGEST


def read_trials(trials: Node) -> list[Recorded]:
    """A list of {name, digest}; a digest may end in [first:end], samples of the recording."""
    found = []
    for trial in trials.items(0, MAX_TRIALS):
        parts = trial.members("name digest")
        parts["name"].text()
        recording, cut, samples = parts["digest"].text().partition("[")
        if not DIGEST.fullmatch(recording):
            raise Rejected(
                f"{trial.where}: a trial should have the digest of its recording, sha256: and 64 "
                "digits or letters a-f"
            )
        if not cut:
            found.append(Recorded(recording))
            continue
        window = WINDOW.fullmatch(samples)
        if window is None or not int(window[1]) < int(window[2]) < LONGEST:
            raise Rejected(f"{trial.where}: a window should be [first:end] with first < end")
        found.append(Recorded(recording, int(window[1]), int(window[2])))
    return found


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


def calibration(
    measured: Fraction, factor: Fraction, trials: list[Recorded], fitted_to: list[Recorded] | None
) -> str:
    """On what a level was measured, and what is known of a next trial.

    fitted_to: what made the model; None if it does not say.
    """
    count = distinct(trials)
    kind = "window" if any(trial.end < LONGEST for trial in trials) else "trial"
    those = f"{count} distinct {kind}s, each" if count > 1 else f"1 distinct {kind},"
    return (
        f"largest of {those} taken whole, "
        f"{text.above(measured)}, safety factor {text.below(factor)} in amplitude; "
        f"{_rank_bound(trials, fitted_to, count)}"
    )


def _rank_bound(trials: list[Recorded], fitted_to: list[Recorded] | None, count: int) -> str:
    """How often a next trial exceeds the largest of those measured, if that can be said.

    The largest of m + 1 exchangeable numbers is the last with probability at most 1/(m + 1). The
    numbers are exchangeable only if the model and the tube were fixed before they were seen.
    """
    none = "no probability is stated of a next trial, as"
    if any(trial.end < LONGEST for trial in trials):
        return f"{none} windows of one recording are hardly exchangeable"
    if fitted_to is None:
        return f"{none} the model does not name what it was fitted to"
    if seen := shared(trials, fitted_to):
        return f"{none} the model was fitted to {seen} of them"
    return (
        "a next trial that is exchangeable with them exceeds their largest with probability at "
        f"most 1/{count + 1}"
    )
