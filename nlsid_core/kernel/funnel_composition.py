"""Claim: funnels that follow each other in time, each ending inside the next, are one funnel.

With F_a on [t_a, t_b] and F_b on [t_b, t_c], F_a(t_b) ⊂ F_b(t_b) is all that is needed: the
S-lemma. Every stage's own proof is decided here too; it binds its own files. Dynamics and policy
may change from stage to stage. Source: thesis Section 5.1.3.
"""

from fractions import Fraction
from itertools import pairwise

from . import text
from .closed_loop import Motion
from .continuous_funnel import decide_funnel, inside
from .exact import scaled
from .files import Node, Read, Rejected, bound_files, limit, refuse_if

MAX_STAGES = 100
SENTENCE = (
    "composition of {count} funnels from {start:exact} to {end:exact} s, changing at {changes} s: "
    "every solution that is in one of them at a time of its own stays in it and in those that "
    "follow; the last is a {last}"
)


def decide(claim: Node, proof: Node, read: Read) -> text.Verdict:
    """Decide every stage, and that each but the last ends inside the next."""
    multipliers = proof.read({"multipliers": (None,)})["multipliers"]
    count = limit(len(multipliers) + 1, MAX_STAGES, "stages", least=2)
    roles = [f"stage{i}" for i in range(1, count + 1)]
    documents, digests = bound_files(claim.members("kind about")["about"], read, " ".join(roles))
    verdicts, funnels, assumptions = [], [], []
    for role in roles:
        try:
            verdict, funnel = _decide_stage(documents[role], read)
        except Rejected as refusal:
            raise type(refusal)(f"{role}: {refusal}", refusal.reason) from refusal
        verdicts.append(verdict)
        funnels.append(funnel)
        assumptions += [f"{role}: {assumption}" for assumption in verdict.assumptions]
        digests |= {f"{role}.{part}": digest for part, digest in verdict.digests.items()}
    for role, multiplier, pair in zip(roles, multipliers, pairwise(funnels), strict=False):
        _decide_step(role, multiplier, *pair)
    said = text.say(
        SENTENCE,
        count=count,
        start=funnels[0].t[0],
        end=funnels[-1].t[-1],
        changes=", ".join(text.exact(funnel.t[0]) for funnel in funnels[1:]),
        last=verdicts[-1].statement,
    )
    margin = min(verdict.margin for verdict in verdicts)
    return text.Verdict(said, margin, tuple(assumptions), digests)


def _decide_stage(node: Node, read: Read) -> tuple[text.Verdict, Motion]:
    """A continuous funnel whose input is not held into the next stage: that is not covered."""
    stage = node.document("proof", {"claim": None, "proof": None})
    claim = stage["claim"]
    claim.require({"a stage should claim a funnel": claim.kind() == "continuous_funnel"})
    held = "hold" in claim.members("kind about goal? hold? error?")
    claim.require({"an input held into the next stage is not covered": not held}, "not_valid")
    return decide_funnel(claim, stage["proof"], read)


def _decide_step(role: str, multiplier: Fraction, before: Motion, after: Motion) -> None:
    """`before` ends when `after` starts, and inside it there."""
    refuse_if(before.n != after.n, f"{role} and the next differ in their states")
    end = text.exact(before.t[-1])
    meets = before.t[-1] == after.t[0]
    refuse_if(not meets, f"{role} ends at {end} s, the next starts at another time", "not_covered")
    last, first = scaled(before.P[-1], 1 / before.rho[-1]), scaled(after.P[0], 1 / after.rho[0])
    what = f"that {role} ends inside the next at {end} s, by the S-lemma,"
    inside(before.x[-1][-1], last, after.x[0][0], first, multiplier, what)
