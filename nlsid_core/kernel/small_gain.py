"""Claim: two models of gains γ₁ γ₂ < 1, each driven by the other's output, have a bounded loop.

u₁ = r₁ ± y₂, u₂ = r₂ ± y₁: with |·| the root of the sum of squares up to any sample,
|ȳ₁| <= γ₁(|r̄₁| + γ₂(|r̄₂| + |ȳ₁|)). Within a sample each model's output moves by at most its gain
times its input, so the loop's equations are a contraction and have one solution. Both claims of
gains are decided here too; each binds its own model. Source: docs/certificate_small_gain.md.
"""

from fractions import Fraction

from . import text
from .decision import Decision
from .dissipation import Dissipation, decide_dissipation, in_units
from .files import Node, Read, Rejected, bound_files
from .signals import apart

ROLES = "first second"


def decide(claim: Node, proof: Node, read: Read) -> Decision:
    """Decide both gains, that the models fit, and that the product of the gains is below 1."""
    proof.members("")
    documents, digests = bound_files(claim.members("kind about")["about"], read, ROLES)
    found = {}
    for role in ROLES.split():
        try:
            stage = documents[role].document("proof", "claim proof")
            if stage["claim"].kind() != "dissipation":
                raise Rejected("it should claim a dissipation")
            decision, found[role] = decide_dissipation(stage["claim"], stage["proof"], read)
            _refuse_partial(found[role])
        except Rejected as refusal:
            raise type(refusal)(f"{role}: {refusal}") from refusal
        digests |= {f"{role}.{part}": digest for part, digest in decision.digests.items()}
    first, second = found["first"], found["second"]
    if first.model.period != second.model.period:
        raise Rejected("the models differ in their periods")
    _fits(first, second, "the first's outputs are not the second's inputs")
    _fits(second, first, "the second's outputs are not the first's inputs")
    used = first.number * second.number
    if used >= 1:
        raise Rejected("the product of the gains is not below 1")
    return Decision(_statement(first, second, 1 - used), 1 - used, (), digests)


def _refuse_partial(found: Dissipation) -> None:
    if found.kind != "gain" or found.discount != 1:
        raise Rejected("it should claim a gain, with the discount 1")
    if not found.everywhere:
        raise Rejected("its gain does not hold for every input and output")


def _fits(one: Dissipation, other: Dissipation, what: str) -> None:
    """The outputs of one are the inputs of the other: as many, in the same units and scales."""
    if [s.unit for s in one.model.y] != [s.unit for s in other.model.u]:
        raise Rejected(f"{what}: the units differ")
    if one.y_scales != other.u_scales:
        raise Rejected(f"{what}: the scales differ")


def _statement(first: Dissipation, second: Dissipation, room: Fraction) -> str:
    both, own = (1 - room) / room, [text.above(part.number / room) for part in (first, second)]
    cross = text.above(both)
    said = [
        f"{part.model.inputs}: dy{i} the difference of {in_units(part.model.y, part.y_scales)}, "
        f"du{i} that of {in_units(apart(part.model.u, part.model.y), part.u_scales)}"
        for i, part in enumerate((first, second), 1)
    ]
    return (
        "small gain: with u1 = r1 + y2 and u2 = r2 + y1, or either sum a difference, two models "
        "have one next sample from every past; two runs of their loop satisfy "
        f"|dy1| <= {own[0]} |dr1| + {cross} |dr2| and |dy2| <= {cross} |dr1| + {own[1]} |dr2|, "
        "|.| the root of the sum of squares up to any sample, where both have one past; with one "
        "r1 and one r2 the squares of dy1 and dy2 have finite sums from any two pasts; "
        f"(1) {said[0]}; (2) {said[1]}"
    )
