"""Claim `stability`: a model forgets its initial conditions, at a stated rate.

V = x̄'Px̄ of the difference x̄ of any two solutions with the same input satisfies V⁺ <= rate² V: the
inequality of `increments` with ρ = rate², G = F, Q = P and no innovation. At x̄ = 0 this is also why
an implicit step has one solution. Source: docs/certificate_stability.md.
"""

from fractions import Fraction

from . import text
from .exact import definite
from .files import Node, Read, bound_files, refuse_if
from .increments import gap, positive
from .models import read_model

SENTENCE = (
    "incremental stability: two solutions with the same input approach each other, in the norm of "
    "P, by a factor of {rate} or less a sample of {period:exact} s, {where}"
)


def decide(claim: Node, proof: Node, read: Read) -> text.Verdict:
    """Decide {kind, about: {model}, rate} by {P, multipliers}."""
    stated = claim.read({"kind": None, "about": None, "rate": ()})
    documents, digests = bound_files(stated["about"], read, "model")
    model, rate = read_model(documents["model"]), stated["rate"]
    refuse_if(not 0 < rate < 1, "the rate should satisfy 0 < rate < 1", "not_below")
    given = proof.read({"P": (model.states, model.states), "multipliers?": None})
    P = given["P"]
    definite(P, "P")
    form = gap(model, rate**2, P, [], model.F, P)
    positive(model, given["multipliers"], [("the decrease of V = x'Px at the stated rate", form)])
    said = text.say(SENTENCE, rate=_shown(rate), period=model.period, where=model.where)
    return text.Verdict(said, 1 - rate, (), digests)


def _shown(rate: Fraction) -> str:
    """A decimal number at least `rate` and below 1."""
    digits = text.DIGITS
    while Fraction(shown := text.above(rate, digits)) >= 1:
        digits += 1
    return shown
