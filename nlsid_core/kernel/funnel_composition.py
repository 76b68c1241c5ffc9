"""Claim: funnels that follow each other in time, each ending inside the next, are one funnel.

With F_a on [t_a, t_b] and F_b on [t_b, t_c], F_a(t_b) ⊂ F_b(t_b) is all that is needed: the
S-lemma. Every stage's own proof is decided here too; it binds its own files. Dynamics and policy
may change from stage to stage. Source: thesis Section 5.1.3.
"""

from fractions import Fraction
from itertools import pairwise

from . import text
from .continuous_funnel import decide_funnel, inside
from .decision import Decision
from .files import Node, Read, Rejected, bound_files, refuse_if
from .trajectory import Funnel

MAX_STAGES = 100
SENTENCE = (
    "composition of {count} funnels from {start:exact} to {end:exact} s, changing at {changes} s: "
    "every solution that is in one of them at a time of its own stays in it and in those that "
    "follow; the last is a {last}"
)


def decide(claim: Node, proof: Node, read: Read) -> Decision:
    """Decide every stage, and that each but the last ends inside the next."""
    multipliers = proof.members("multipliers")["multipliers"].array(None)
    count = len(multipliers) + 1
    refuse_if(
        not 2 <= count <= MAX_STAGES,
        f"a composition has 2 to {MAX_STAGES} stages, not {count}",
        "too_large",
    )
    roles = [f"stage{i}" for i in range(1, count + 1)]
    documents, digests = bound_files(claim.members("kind about")["about"], read, " ".join(roles))
    decisions, funnels, assumptions = [], [], []
    for role in roles:
        try:
            stage = documents[role].document("proof", "claim proof")
            refuse_if(
                stage["claim"].kind() != "continuous_funnel",
                "a stage should claim a continuous_funnel",
            )
            refuse_if(
                "hold" in stage["claim"].members("kind about", "goal hold error"),
                "an input that is held into the next stage is not covered",
                "not_valid",
            )
            decision, funnel = decide_funnel(stage["claim"], stage["proof"], read)
        except Rejected as refusal:
            raise type(refusal)(f"{role}: {refusal}", refusal.reason) from refusal
        decisions.append(decision)
        funnels.append(funnel)
        assumptions += [f"{role}: {assumption}" for assumption in decision.assumptions]
        digests |= {f"{role}.{part}": digest for part, digest in decision.digests.items()}
    for role, multiplier, pair in zip(roles, multipliers, pairwise(funnels), strict=False):
        _decide_step(role, multiplier, *pair)
    said = text.say(
        SENTENCE,
        count=count,
        start=funnels[0].t[0],
        end=funnels[-1].t[-1],
        changes=", ".join(text.exact(funnel.t[0]) for funnel in funnels[1:]),
        last=decisions[-1].statement,
    )
    margin = min(decision.margin for decision in decisions)
    return Decision(said, margin, tuple(assumptions), digests)


def _decide_step(role: str, multiplier: Fraction, before: Funnel, after: Funnel) -> None:
    """`before` ends when `after` starts, and inside it there."""
    refuse_if(
        len(before.x[0][0]) != len(after.x[0][0]), f"{role} and the next differ in their states"
    )
    end, start = before.t[-1], after.t[0]
    refuse_if(
        end != start,
        f"{role} ends at {text.exact(end)} s, the next starts at {text.exact(start)} s",
        "not_covered",
    )
    shape = [[entry / after.rho[0] for entry in row] for row in after.P[0]]
    what = f"that {role} ends inside the next at {text.exact(end)} s, by the S-lemma,"
    inside(before.x[-1][-1], before.P[-1], before.rho[-1], after.x[0][0], shape, multiplier, what)
