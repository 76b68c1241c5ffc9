"""A level that follows the commands: g(k) = Σ_i w_i G_i(k), read and put into words.

    G(k) = fading G(k-1) + v(k)²,   G = 0 before the run
v = (s - centre)/scale, or the change of s since the last sample over scale, s a product of inputs.
Whatever g is, a bound E <= level g(k) at every sample is the tube theorem's; that g >= 0 and that
it is known from the commands up to k is all that is needed. Source: docs/certificate_tube.md.
"""

import json
from dataclasses import dataclass
from fractions import Fraction

from . import text
from .files import Node, Rejected, refuse_if
from .signals import Signal

MAX_TERMS = 200
MAX_FACTORS = 4
WORDS = ("E", "e", "g", "i", "x", "sum", "change")  # of a formula: names that are these are quoted


@dataclass(frozen=True)
class Term:
    """One G; change: of s since the last sample, else s - centre."""

    inputs: tuple[int, ...]
    change: bool
    centre: Fraction
    scale: Fraction
    fading: Fraction


@dataclass(frozen=True)
class CommandLevel:
    """weights: one of each term, not negative, some positive."""

    terms: list[Term]
    weights: list[Fraction]


def read_level(node: Node, inputs: int) -> CommandLevel:
    """{terms, weights} for a model with so many inputs."""
    parts = node.members("terms weights")
    terms = [_term(entry, inputs) for entry in parts["terms"].items(1, MAX_TERMS)]
    (weights,) = parts["weights"].array(1, len(terms))
    refuse_if(
        min(weights) < 0 or not sum(weights),
        f"{node.where}: weights should be 0 or more, some positive",
        "not_below",
    )
    return CommandLevel(terms, weights)


def _term(node: Node, inputs: int) -> Term:
    parts = node.members("inputs of centre scale fading")
    factors, of = tuple(parts["inputs"].wholes(None)), parts["of"].text()
    if len(factors) > MAX_FACTORS or any(not 0 <= i < inputs for i in factors):
        wanted = f"at most {MAX_FACTORS}, among the model's {inputs}"
        raise Rejected(f"{node.where}: inputs should be {wanted}")
    refuse_if(
        of not in ("value", "change"), f"{node.where}: of should be value or change, not {of!r}"
    )
    centre, scale, fading = (parts[name].number() for name in ("centre", "scale", "fading"))
    if not scale > 0 or not 0 <= fading < 1:
        wanted = "scale should be positive, fading in [0, 1)"
        raise Rejected(f"{node.where}: {wanted}", "not_below")
    return Term(factors, of == "change", centre, scale, fading)


def formula(level: CommandLevel, u: tuple[Signal, ...]) -> str:
    """g as a sum, every number exact."""
    used = [pair for pair in zip(level.weights, level.terms, strict=True) if pair[0]]
    summands = []
    for weight, term in used:
        square = _square(term, u)
        if term.fading:
            square = f"(sum {text.exact(term.fading)}^i {square or '1'})"
        summands.append(f"{text.exact(weight)} {square}".rstrip())
    past = ""
    if any(term.fading for _, term in used):
        past = ", sums over the run's samples, each i samples ago"
    return " + ".join(summands) + past


def _square(term: Term, u: tuple[Signal, ...]) -> str:
    """v² in words; empty where it is 1."""
    if not term.inputs and not term.change and term.centre == 0 and term.scale == 1:
        return ""
    product = " x ".join(_plain(u[i].name, "()+*^/-") for i in term.inputs) or "1"
    unit = Signal("", " ".join(_plain(u[i].unit, "()+*^") for i in term.inputs if u[i].unit))
    if term.change:
        product = f"change of {product}"
    elif term.centre:
        product = f"({product} - {unit.quantity(text.exact(term.centre))})"
    return f"({product} / {unit.quantity(text.exact(term.scale))})^2"


def _plain(word: str, operators: str) -> str:
    """A name or unit in a formula: quoted if it could be read as a part of it."""
    own = not word.startswith('"') and (word in WORDS or any(sign in operators for sign in word))
    return json.dumps(word) if own else word
