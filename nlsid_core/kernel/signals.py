"""Signals as files state them, and their names and units as words that change no sentence."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from .files import Node, refuse_if

MAX_SIGNALS = 50

# No `speed/1000` and no `speed*1000`: they would be read as other quantities.
_NAME = re.compile(
    r"(?!e[-+0-9]|(?i:inf|infinity|nan|pi)$)"
    r"[A-Za-z_/%°µ](?:(?<![/-])[0-9.]|[A-Za-z_/()\[\]%°µ-])*",
    re.ASCII,
)

# Digits in exponents only: "0.2 m/1000" would be another number, and so would "0.2 sqrt(g)" be.
_UNIT = re.compile(
    r"(?![eE][-+^0-9]|.*sqrt|(?i:inf|infinity|nan|pi)$)(1/)?[A-Za-z_%°µ](?:\^-?[0-9]|[A-Za-z_/.*()%°µ·²³⁻¹])*",
    re.ASCII,
)


@dataclass(frozen=True)
class Signal:
    """A signal's name and unit, as words of a sentence."""

    name: str
    unit: str

    def quantity(self, number: str) -> str:
        """The number with the unit, if there is one."""
        return f"{number} {self.unit}".rstrip()


def name_label(name: str) -> str:
    """A name as one word of a sentence: as it is if it is plain, else quoted.

    Quoted are spaces, punctuation, other scripts, and what could be read as a number.
    """
    return name if _NAME.fullmatch(name) else json.dumps(name)


def unit_label(unit: str) -> str:
    """A unit behind a number: as it is if it cannot change how the number is read, else quoted."""
    closed = set("()").isdisjoint(re.sub(r"\([^()]*\)", "", unit))
    return unit if not unit or (closed and _UNIT.fullmatch(unit)) else json.dumps(unit)


def read_signal(node: Node) -> Signal:
    """One {name, unit, path}."""
    given = node.read({"name": Node.text, "unit": Node.text, "path": None})
    return Signal(name_label(given["name"]), unit_label(given["unit"]))


def signals(what: str, least: int = 0, most: int = MAX_SIGNALS) -> Callable[[Node], Any]:
    """A reader of a list of `least` to `most` of `what`, each with a name of its own."""

    def read(node: Node) -> tuple[Signal, ...]:
        found = tuple(map(read_signal, node.items(least, most)))
        names = {signal.name for signal in found}
        refuse_if(len(names) < len(found), f"{node.where}: two {what} have the same name")
        return found

    return read


def apart(inputs: Sequence[Signal], outputs: Sequence[Signal]) -> list[Signal]:
    """The inputs, named `input NAME` where an output, or a state, has the name."""
    names = {signal.name for signal in outputs}
    return [
        Signal(f"input {signal.name}" if signal.name in names else signal.name, signal.unit)
        for signal in inputs
    ]


def ranges(signals: Sequence[Signal], shown: Sequence[str]) -> str:
    """`NAME in [LOW, HIGH] UNIT, ...` for ranges that are printed already."""
    pairs = zip(signals, shown, strict=True)
    return ", ".join(signal.quantity(f"{signal.name} in {ends}") for signal, ends in pairs)
