"""Tolerances for what already watches robots, each from a proved claim: YAML files and a table.

A proved half-width bounds how far an output is from what a claim is about. So a check with at least
this tolerance, on the same difference, does not stop a robot that keeps what the claim assumes.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import yaml

from bags.designs import documents
from nlsid_core import files
from nlsid_core.arrays import Json
from nlsid_core.errors import DataError
from nlsid_core.funnels import ContinuousFunnel, SampledFunnel
from nlsid_core.kernel import Verdict, text
from nlsid_core.models.signal import Signal

CONTROLLER, VALIDATOR, TABLE = (
    "joint_trajectory_controller.yaml",
    "validator.yaml",
    "tolerances.txt",
)
POSITIONS, VELOCITIES = ("rad", "m"), ("rad/s", "m/s")
SIMULATED = (
    "these numbers are about the model's simulation, and a controller compares with its reference. "
    "Add to each how far the simulation is from the reference (docs/tutorial-arm.md, step 4)."
)
NAMED = re.compile(r"\[name=([^\]]+)\]")  # an element of a message that is found by its name


@dataclass(frozen=True)
class Tolerance:
    """Tolerances of one signal: path, the most at any sample of the claim; goal, at its last.

    Both in the signal's unit, as decimal numbers rounded up. Raises DataError if one is 0, which
    readers of these files take for "not checked".
    """

    signal: Signal
    path: str
    goal: str

    def __post_init__(self) -> None:
        if not (float(self.path) > 0.0 and float(self.goal) > 0.0):
            raise DataError(
                f"the tolerances of {self.signal.name} are {self.path} and {self.goal}; a "
                "tolerance of 0 would be no check at all"
            )

    @property
    def joint(self) -> str:
        """What the path says the signal's element is called, else the signal's name."""
        named = NAMED.search(self.signal.path)
        return named[1] if named else self.signal.name.replace(" ", "_")


@dataclass(frozen=True)
class Tolerances:
    """What a proved funnel says of every signal.

    about: what the signals are compared with. verdict: the claim that each number comes from.
    before_use: what has to be added to each number first; empty where nothing has.
    """

    entries: tuple[Tolerance, ...]
    about: str
    verdict: Verdict
    before_use: str = ""

    def write(self, folder: Path) -> list[Path]:
        """The table, and the files that these signals have entries in."""
        contents = {TABLE: f"{self}\n"}
        for name, parameters in ((CONTROLLER, self.controller()), (VALIDATOR, self.validator())):
            if parameters:
                body = yaml.safe_dump(parameters, sort_keys=False, allow_unicode=True)
                contents[name] = f"{self._source()}{body}"
        for name, content in contents.items():
            files.write_atomically(folder / name, content.encode())
        return [folder / name for name in contents]

    def controller(self) -> Json:
        """Constraints of ros2_control's joint_trajectory_controller; empty without a position."""
        positions = self._of(POSITIONS)
        if not positions:
            return {}
        joints = [entry.joint for entry in positions]
        if len(set(joints)) < len(joints):  # elements called alike in two messages
            joints = [entry.signal.name for entry in positions]
        constraints: Json = {
            joint: {"trajectory": float(entry.path), "goal": float(entry.goal)}
            for joint, entry in zip(joints, positions, strict=True)
        }
        if rates := [float(entry.goal) for entry in self._of(VELOCITIES)]:
            constraints["stopped_velocity_tolerance"] = max(rates)
        return {"joint_trajectory_controller": {"ros__parameters": {"constraints": constraints}}}

    def validator(self) -> Json:
        """Thresholds of Autoware's control and planning validators; empty without m or m/s.

        Of one signal each, the widest, as a validator has one threshold. A ratio of 0 leaves the
        offset alone: |v| > |target| + offset.
        """
        thresholds: Json = {}
        if speeds := [float(entry.path) for entry in self._of(["m/s"])]:
            names = ("over_velocity_offset", "velocity_deviation")
            thresholds = {"over_velocity_ratio": 0.0} | dict.fromkeys(names, max(speeds))
        if distances := [float(entry.path) for entry in self._of(["m"])]:
            thresholds["distance_deviation"] = max(distances)
        return {"/**": {"ros__parameters": {"thresholds": thresholds}}} if thresholds else {}

    def __str__(self) -> str:
        names = ["signal", *(entry.signal.name for entry in self.entries)]
        width = max(map(len, names))
        lines = [f"{'signal':{width}}  {'path':>10}  {'goal':>10}  unit"]
        lines += [
            f"{e.signal.name:{width}}  {e.path:>10}  {e.goal:>10}  {e.signal.unit}".rstrip()
            for e in self.entries
        ]
        last = ["", f"BEFORE USE: {self.before_use}"] if self.before_use else []
        return "\n".join([*lines, "", *self._claim(), *last])

    def _of(self, units: Sequence[str]) -> list[Tolerance]:
        return [entry for entry in self.entries if entry.signal.unit in units]

    def _claim(self) -> list[str]:
        return [
            *str(self.verdict).splitlines(),
            f"proof {self.verdict.digests['proof']}",
            f"Compare with {self.about}.",
        ]

    def _source(self) -> str:
        """What the numbers are, as a comment."""
        units = ", ".join(f"{entry.signal.name} in {entry.signal.unit}" for entry in self.entries)
        first = [f"BEFORE USE: {self.before_use}", ""] if self.before_use else []
        said = [*first, f"Every number is a bound of this claim, rounded up: {units}"]
        return "".join(f"# {line}".rstrip() + "\n" for line in (*said, *self._claim()))


def tolerances(folder: Path | str) -> Tolerances:
    """Read them from the design in a folder, its proof checked.

    Raises CertificateRejected if nothing is proved, DataError if its claim bounds no signal.
    """
    design = documents.load(folder)
    funnel: Any = design.funnel
    before_use = ""
    if isinstance(funnel, ContinuousFunnel):
        raise DataError(
            f"{folder}: a funnel of given equations has sets of states and no signals; tolerances "
            "are written of funnels of identified models"
        )
    if isinstance(funnel, SampledFunnel):
        path, goal = funnel.half_widths.max(axis=0), funnel.half_widths[-1]
        about = (
            "the plan in policy.json, sample by sample; the claim is about the observer's estimate "
            "of the state, which a measurement can be off by its noise"
        )
    else:
        if any(tube.follows for tube in funnel.tubes):
            raise DataError(
                f"{folder}: the tube's half-width follows the commands, and a tolerance is one "
                "number; design it with `funnel: {level: constant}` for tolerances"
            )
        path = goal = funnel.half_widths
        about = "what the model simulates from the commands that were sent, not with the commands"
        before_use = SIMULATED
        if design.policy is not None:
            about += "; or with the plan in policy.json where the policy drives"
    rows = zip(design.signals[0], path.tolist(), goal.tolist(), strict=True)
    entries = (Tolerance(s, text.above(Fraction(p)), text.above(Fraction(g))) for s, p, g in rows)
    return Tolerances(tuple(entries), about, design.verdict, before_use)
