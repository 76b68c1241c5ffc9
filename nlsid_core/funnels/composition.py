"""`compose_funnels`: funnels in files that follow each other in time, and the proof that they fit.

Source: thesis Section 5.1.3.
"""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from nlsid_core import _json
from nlsid_core._types import Json
from nlsid_core.certificate.check import files_named_in, proof_document, read_proof
from nlsid_core.certificate.funnel_composition import KIND, PROOF, refuse_step, role
from nlsid_core.certificate.trajectory_funnel import ABOUT
from nlsid_core.continuous import Funnel
from nlsid_core.continuous.funnel import ellipsoid_inside
from nlsid_core.errors import CertificateRejected, DataError, Infeasible

COMPOSITION_PROOF = "composition.proof.json"
LARGEST = 1e6  # overlap factor past which the search for it stops


def compose_funnels(proofs: Sequence[Path | str], folder: Path | str) -> Path:
    """Bind the funnels of these proof files, in this order, into one claim that `check` decides.

    Copies every stage's four files to `folder`, named stage1.policy.json and so on, each still a
    proof of its own, and writes composition.proof.json, whose path is returned.

    Raises CertificateRejected or CertificateMismatch if a proof is not one of a funnel or its files
    are not beside it, DataError if stages do not follow each other in time, Infeasible if one does
    not end inside the next: the message says by how much.
    """
    if len(proofs) < 2:
        raise DataError(f"a composition needs two or more funnels, got {len(proofs)}")
    stages = [_Stage.read(i, Path(path)) for i, path in enumerate(proofs, start=1)]
    steps = enumerate(pairwise(stages), start=1)
    multipliers = [_multiplier(i, before, after) for i, (before, after) in steps]
    about = {}
    folder = Path(folder)
    for stage in stages:
        for part, document in stage.documents.items():
            name = role(stage.number, part)
            about[name] = {"file": f"{name}.json", "digest": _json.digest(document)}
            _json.write_document(folder / f"{name}.json", document)
    path = folder / COMPOSITION_PROOF
    claim = {"kind": KIND, "about": about}
    _json.write_document(path, proof_document(claim, {"multipliers": multipliers}))
    return path


class _Stage:
    """One stage's documents, its proof renamed to speak of the composition's files."""

    def __init__(self, number: int, path: Path, documents: dict[str, Json]) -> None:
        self.number, self.path, self.documents = number, path, documents
        self.funnel = Funnel.from_document(documents["funnel"], source=str(path))

    @classmethod
    def read(cls, number: int, path: Path) -> "_Stage":
        claim, proof = read_proof(_json.load_document(path), source=str(path))
        about = files_named_in(claim, path)
        if set(about) != set(ABOUT):
            raise CertificateRejected(f"{path} is no proof of a funnel around a trajectory")
        renamed = {
            part: {"file": f"{role(number, part)}.json", "digest": _json.digest(document)}
            for part, document in about.items()
        }
        own = proof_document(claim | {"about": renamed}, proof)
        return cls(number, path, {**about, PROOF: own})


def _multiplier(number: int, before: _Stage, after: _Stage) -> float:
    """The S-lemma's multiplier that the checker accepts for this step."""
    a, b = before.funnel, after.funnel
    if a.n != b.n or a.tf != b.t0:
        raise DataError(
            f"{after.path} ({b.n} states, from {b.t0!r} s) does not follow {before.path} ({a.n} "
            f"states, until {a.tf!r} s)"
        )
    found = _inside(a, b, 1.0)
    if found is None:
        low, high = 1.0, 2.0
        while high < LARGEST and _inside(a, b, high) is None:
            low, high = high, 2 * high
        while high / low > 1.001:
            middle = (low * high) ** 0.5
            low, high = (middle, high) if _inside(a, b, middle) is None else (low, middle)
        raise Infeasible(
            f"stage {number} does not end inside stage {number + 1}: V of the next reaches "
            f"{high:.4g} on its end, at {a.tf:g} s. Design it with the next one's start as its "
            "goal (Goal.start_of)"
        )
    try:
        refuse_step(number, a, b, found)
    except CertificateRejected as refusal:
        raise Infeasible(f"{refusal}: they touch; make one slightly smaller") from refusal
    return found


def _inside(a: Funnel, b: Funnel, level: float) -> float | None:
    """A multiplier for {a at its end} ⊂ {V_b ≤ level at b's start}."""
    return ellipsoid_inside(
        a.x.ends()[-1], a.P[-1] / a.rho[-1], b.x.ends()[0], b.P[0] / (b.rho[0] * level)
    )
