"""Claim `stability`: a model forgets its initial conditions, at a stated rate.

V = x̄'Px̄ of the difference x̄ of any two solutions with the same input satisfies V⁺ <= rate² V: at
every vertex of the model's increment form diag(0, rate² P) - F'PF + sym(N E) ≻ 0. At x̄ = 0 this is
also why an implicit step has one solution. Source: docs/certificate_stability.md.
"""

from fractions import Fraction

from . import text
from .decision import Decision
from .exact import block_diagonal, combined, congruence, definite, scaled, zero
from .files import Node, Read, Rejected, bound_files
from .increments import MAX_WORK, positive, read_model
from .polynomials import Work


def decide(claim: Node, proof: Node, read: Read) -> Decision:
    """Decide {kind, about: {model}, rate} by {P, multipliers}."""
    parts = claim.members("kind about rate")
    documents, digests = bound_files(parts["about"], read, "model")
    model = read_model(documents["model"])
    rate = parts["rate"].number()
    if not 0 < rate < 1:
        raise Rejected("the rate should satisfy 0 < rate < 1")
    given = proof.members("P", "multipliers")
    P = given["P"].array(model.states, model.states)
    definite(P, "P")
    supply = block_diagonal(zero(model.unknowns), scaled(P, rate**2))
    gap = combined(supply, congruence(model.F, P), -1)
    what = "the decrease of V = x'Px at the stated rate"
    positive(model, given.get("multipliers"), [(what, gap)], Work(MAX_WORK))
    return Decision(
        statement=(
            f"incremental stability: two solutions with the same input approach each other, in "
            f"the norm of P, by a factor of {shown_rate(rate)} or less a sample of "
            f"{text.exact(model.period)} s, {model.inputs}"
        ),
        margin=1 - rate,
        assumptions=(),
        digests=digests,
    )


def shown_rate(rate: Fraction) -> str:
    """A decimal number above `rate` and below 1."""
    digits = text.DIGITS
    while Fraction(shown := text.above(rate, digits)) >= 1:
        digits += 1
    return shown
