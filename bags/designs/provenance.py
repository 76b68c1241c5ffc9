"""The trials that an assumption was measured on: printed beside a verdict, and not proved.

The numbers are the file's word. What is looked at here is whether they agree with each other: a
level is not below what was measured, and no sample both chose a tube and scaled it. Of m + 1
exchangeable numbers the last is among the r largest with probability at most r/(m + 1), if model
and tube were fixed before they were seen; one number scales all levels of a tube. Source: V.
Vovk, A. Gammerman, G. Shafer, Algorithmic Learning in a Random World, Section 2.2.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from nlsid_core.errors import DocumentError
from nlsid_core.kernel import text

Json = dict[str, Any]
LONGEST = 10**12  # samples of a recording


@dataclass(frozen=True)
class Recorded:
    """A trial: the digest of its recording, and which samples of it: [0, LONGEST) is all."""

    recording: str
    first: int = 0
    end: int = LONGEST

    @classmethod
    def of(cls, digest: str) -> "Recorded":
        """`sha256:...`, perhaps with `[first:end]`."""
        recording, cut, window = digest.partition("[")
        if not cut:
            return cls(recording)
        first, _, end = window.removesuffix("]").partition(":")
        if not (first.isdigit() and end.isdigit() and int(first) < int(end) < LONGEST):
            raise DocumentError(f"{digest[:40]}: a window should be [first:end] with first < end")
        return cls(recording, int(first), int(end))

    def shares(self, other: "Recorded") -> bool:
        """Whether they have a sample in common."""
        apart = self.end <= other.first or other.end <= self.first
        return self.recording == other.recording and not apart


@dataclass(frozen=True)
class Provenance:
    """What is said of the trials behind a proved funnel, and what of it contradicts itself.

    promised: how often a next trial sets off an alarm, or why that is not known.
    """

    said: tuple[str, ...] = ()
    promised: tuple[str, ...] = ()
    wrong: tuple[str, ...] = ()


def of_proof(proof: Path) -> Provenance:
    """Read it from a proof that was decided; nothing where no bound was measured.

    Raises DocumentError for what the kernel does not read and is not as its page says.
    """
    about = json.loads(proof.read_bytes())["claim"]["about"]
    if not {"model", "funnel"} <= set(about):
        return Provenance()
    model, funnel = (
        json.loads((proof.parent / about[role]["file"]).read_bytes())
        for role in ("model", "funnel")
    )
    try:
        return of_funnel(model, funnel)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        what = "what its assumption was measured on is not as its page says"
        raise DocumentError(f"{about['funnel']['file']}: {what} ({error})") from error


def of_funnel(model: Json, funnel: Json) -> Provenance:
    """Read it from a funnel's document and that of its model."""
    fitted = model.get("bags")
    found = []
    if funnel["kind"] == "sampled":
        given = funnel["assumption"]
        most = Fraction(given["safety_factor"]) * Fraction(given["measured"])
        bounds = [("its bound", Fraction(given["bound"]), most)]
        found.append(_judged("disturbance", {"designed_on": fitted, **given}, fitted, bounds))
    for i, tube in enumerate(funnel.get("tubes", ()), 1):
        given = tube["assumption"]
        factor = Fraction(given["safety_factor"]) ** 2
        bounds = [("its level", Fraction(tube["level"]), factor * Fraction(given["measured"]))]
        peak = tube.get("peak", {})
        if "at_most" in peak:
            most = Fraction(given["safety_factor"])
            pairs = zip(peak["at_most"], peak["measured"], strict=True)
            bounds += [("a peak", Fraction(bound), most * Fraction(seen)) for bound, seen in pairs]
        found.append(_judged(f"innovation energy of tube {i}", given, fitted, bounds))
    said = tuple(f"{line}; {promise}" for line, promise, _ in found)
    promised = tuple(promise for _, promise, _ in found)
    return Provenance(said, promised, tuple(line for *_, lines in found for line in lines))


def _judged(
    what: str,
    given: Mapping[str, Any],
    fitted: list[Json] | None,
    bounds: Iterable[tuple[str, Fraction, Fraction]],
) -> tuple[str, str, list[str]]:
    """What was measured, what that promises of a next trial, and what contradicts it."""
    trials, before = (
        [Recorded.of(trial["digest"]) for trial in given.get(key) or ()]
        for key in ("measured_on", "designed_on")
    )
    wrong = [
        f"{what}: {name} is below what was measured times the safety factor"
        for name, bound, needed in bounds
        if bound < needed
    ]
    rank, count = given.get("rank", 1), distinct(trials)
    if type(rank) is not int:
        raise DocumentError("a rank is a whole number")
    faults = {
        "the safety factor is below 1": given["safety_factor"] < 1,
        "the rank is not from 1 to the number of trials": (
            bool(trials) and not 1 <= rank <= len(trials)
        ),
        "it was measured on no trial": not trials,
        "a trial that chose it cannot measure it": any(
            trial.shares(other) for trial in trials for other in before
        ),
    }
    wrong += [f"{what}: {fault}" for fault, holds in faults.items() if holds]
    measured, factor = Fraction(given["measured"]), Fraction(given["safety_factor"])
    kind = "window" if any(trial.end < LONGEST for trial in trials) else "trial"
    those = f"{count} distinct {kind}{'s' if count != 1 else ''}"
    scale = f"{text.above(measured)} by the scale of {those}"
    says = "raises an alarm of this funnel"
    if "rank" not in given:
        scale, says = f"largest of {those} {text.above(measured)}", "exceeds their largest"
    promise = _worthless(trials, fitted) or (
        f"a next trial like them (exchangeable with them) {says} with probability at most "
        f"{rank}/{count + 1}"
    )
    return f"{what}: {scale}, safety factor {text.below(factor)}", promise, wrong


def distinct(trials: Iterable[Recorded]) -> int:
    """How many share no sample with another that is counted: the most there can be."""
    reached: dict[str, int] = {}
    count = 0
    for trial in sorted(set(trials), key=lambda t: t.end):
        if trial.first >= reached.get(trial.recording, 0):
            reached[trial.recording] = trial.end
            count += 1
    return count


def _worthless(trials: list[Recorded], fitted: list[Json] | None) -> str:
    """Why nothing can be said of how often a next trial exceeds them; empty if it can."""
    none = "no probability is stated of a next trial, as "
    if any(trial.end < LONGEST for trial in trials):
        return none + "windows of one recording are hardly exchangeable"
    if fitted is None:
        return none + "the model does not name what it was fitted to"
    bags = [Recorded.of(bag["digest"]) for bag in fitted]
    seen = sum(any(trial.shares(bag) for bag in bags) for trial in set(trials))
    return f"{none}the model was fitted to {seen} of them" if seen else ""
