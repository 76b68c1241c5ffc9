"""Claim: funnels that follow each other in time, each ending inside the next, are one funnel.

With F_a on [t_a, t_b] and F_b on [t_b, t_c], F_a(t_b) ⊂ F_b(t_b) is all that is needed. It is
decided in rationals by the S-lemma, and every stage's own proof is decided here too: nothing is
taken on trust from an earlier check. Dynamics and policy may change from stage to stage.
Source: thesis Section 5.1.3.
"""

from collections.abc import Mapping
from fractions import Fraction

from nlsid_core import _json
from nlsid_core._types import Json
from nlsid_core.certificate import containment, trajectory_funnel
from nlsid_core.certificate import polynomial_data as data
from nlsid_core.certificate.check import read_proof
from nlsid_core.certificate.identity import Mode
from nlsid_core.certificate.verdict import Decision
from nlsid_core.continuous.funnel import Funnel
from nlsid_core.errors import CertificateMismatch, CertificateRejected

KIND = "funnel_composition"
MAX_STAGES = 100
PROOF = "proof"


def role(stage: int, part: str) -> str:
    """The name under which a composition binds one file of one stage, counted from 1."""
    return f"stage{stage}.{part}"


def decide(claim: Json, proof: Json, about: Mapping[str, Json], mode: Mode) -> Decision:
    """Decide every stage, and that each but the last ends inside the next."""
    data.only(claim, {"kind", "about"}, source="claim")
    data.only(proof, {"multipliers"}, source="proof")
    multipliers = _json.array(proof, "multipliers", (None,), source="proof").tolist()
    count = len(multipliers) + 1
    parts = (*trajectory_funnel.ABOUT, PROOF)
    stages = range(1, min(count, MAX_STAGES) + 1)
    expected = {role(i, part) for i in stages for part in parts}
    if not 2 <= count <= MAX_STAGES or set(about) != expected:
        raise CertificateRejected(
            f"a {KIND} of {count} stages is about {', '.join(parts)} of each of them, 2 to "
            f"{MAX_STAGES} of them; this one is about {len(about)} files"
        )
    decisions = [_stage(i, about, mode) for i in stages]
    funnels = [
        Funnel.from_document(about[role(i, "funnel")], source=role(i, "funnel")) for i in stages
    ]
    for i, multiplier in enumerate(multipliers, start=1):
        refuse_step(i, funnels[i - 1], funnels[i], multiplier)
    times = ", ".join(f"{funnel.tf:g}" for funnel in funnels[:-1])
    return Decision(
        statement=(
            f"composition of {count} funnels from {funnels[0].t0:g} to {funnels[-1].tf:g} s, "
            f"changing at {times} s: every solution in one of them at a time of its own stays in "
            f"it and in those that follow; the last is a {decisions[-1].statement}"
        ),
        margin=min(decision.margin for decision in decisions),
        assumptions=tuple(
            f"stage {i}: {text}"
            for i, decision in enumerate(decisions, start=1)
            for text in decision.assumptions
        ),
    )


def refuse_step(stage: int, before: Funnel, after: Funnel, multiplier: float) -> None:
    """Raise CertificateRejected unless `before` ends when and inside where `after` starts."""
    if before.n != after.n:
        raise CertificateRejected(f"stages {stage} and {stage + 1} differ in their states")
    if before.tf != after.t0:
        raise CertificateRejected(
            f"stage {stage} ends at {before.tf!r} s, stage {stage + 1} starts at {after.t0!r} s"
        )
    inner = rational_shape(before, -1)
    outer = rational_shape(after, 0)
    centres = before.x.ends()[-1].tolist(), after.x.ends()[0].tolist()
    if not containment.ellipsoid_inside(centres[0], inner, centres[1], outer, multiplier):
        raise CertificateRejected(
            f"stage {stage} is not proved to end inside stage {stage + 1} at {before.tf:g} s"
        )


def rational_shape(funnel: Funnel, knot: int) -> list[list[Fraction]]:
    """P/ρ at a knot, exactly."""
    rho = Fraction(float(funnel.rho[knot]))
    return [[Fraction(entry) / rho for entry in row] for row in funnel.P[knot].tolist()]


def _stage(stage: int, about: Mapping[str, Json], mode: Mode) -> Decision:
    """Decide one stage's own proof from the documents that the composition binds."""
    name = role(stage, PROOF)
    claim, proof = read_proof(about[name], source=name)
    if claim.get("kind") != trajectory_funnel.KIND:
        raise CertificateRejected(f"{name} should claim a {trajectory_funnel.KIND}")
    bound = _json.member(claim, "about", dict, source=name)
    documents = {part: about[role(stage, part)] for part in trajectory_funnel.ABOUT}
    for part, document in documents.items():
        stated = _json.member(bound, part, dict, source=name).get("digest")
        if stated != _json.digest(document):
            raise CertificateMismatch(f"{name} is about another {part} than {role(stage, part)}")
    try:
        return trajectory_funnel.decide(claim, proof, documents, mode)
    except CertificateRejected as refusal:
        raise type(refusal)(f"stage {stage}: {refusal}") from refusal
