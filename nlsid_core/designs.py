"""`Design`: a model, a policy and a funnel that belong together, with their proof: one folder."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar

from nlsid_core import files, proofs
from nlsid_core.arrays import Json
from nlsid_core.documents import read
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import CertificateMismatch, DataError, DocumentError
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.funnels.sampled import SampledFunnel
from nlsid_core.funnels.tube import TubeFunnel
from nlsid_core.kernel import Verdict
from nlsid_core.models import StableModel
from nlsid_core.models.measured_state import MeasuredState
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.policies.sampled import SampledPolicy
from nlsid_core.policies.tube import TubePolicy

# The files in a design's folder; a claim calls each by its name without the ending.
MODEL = "model.json"
VECTOR_FIELD = "vector_field.json"
POLICY = "policy.json"
FUNNEL = "funnel.json"
PROOF = "funnel.proof.json"
COMPOSITION = "composition.proof.json"  # of funnels that follow each other, its stages beside it

D = TypeVar("D", bound=StableModel | MeasuredState | VectorField)
P = TypeVar("P", bound=TubePolicy | SampledPolicy | ContinuousPolicy | None)
F = TypeVar("F", bound=SampledFunnel | ContinuousFunnel | TubeFunnel)
S = TypeVar("S")


@dataclass(frozen=True, eq=False)
class Design(Generic[D, P, F, S]):
    """What a robot runs and is held against, and the verdict of the kernel about it.

    model: of the robot, or its vector field in continuous time. policy: None where the funnel is
    around the model itself, whatever drives it. claim: its kind, and what it states
    beside these files; proof: the witnesses. found: what the search leaves beside them; nothing of
    a design that was read from files.
    """

    model: D
    policy: P
    funnel: F
    claim: Json
    proof: Json
    verdict: Verdict
    found: S

    @classmethod
    def proved(
        cls, model: D, policy: P, funnel: F, *, claim: Json, proof: Json, found: S
    ) -> "Design[D, P, F, S]":
        """A design whose proof the kernel has decided; CertificateRejected says why it has not."""
        documents = _documents(model, policy, funnel)
        verdict = proofs.decide(_proof_document(documents, claim, proof), documents)
        return cls(model, policy, funnel, claim, proof, verdict, found)

    def __str__(self) -> str:
        return str(self.verdict) if self.found is None else f"{self.verdict}\n{self.found}"

    def decided(self) -> Verdict:
        """What the kernel says of it as it stands; CertificateRejected with the reason."""
        documents = self.documents()
        return proofs.decide(documents[PROOF], documents)

    def documents(self) -> dict[str, Json]:
        """The content of its files by name, the proof last."""
        documents = _documents(self.model, self.policy, self.funnel)
        return documents | {PROOF: _proof_document(documents, self.claim, self.proof)}

    def save(self, folder: Path | str) -> tuple[Path, ...]:
        """Write model (or vector field), policy, funnel and proof; the paths, the proof last.

        Raises DataError if there is a file in the folder's place; other OS errors pass through.
        """
        folder = Path(folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError) as error:
            raise DataError(
                f"{error.filename} is a file, not a folder to save a design in"
            ) from error
        documents = self.documents()
        for name, document in documents.items():
            files.write_document(folder / name, document)
        return tuple(folder / name for name in documents)


AnyDesign: TypeAlias = Design[Any, Any, Any, Any]


def load_design(folder: Path | str) -> AnyDesign:
    """The design in a folder that `Design.save` wrote, its proof checked by the kernel.

    Raises CertificateRejected if the proof proves nothing, CertificateMismatch if the files changed
    while they were read, DocumentError if it is not the proof of one funnel. OS errors for the
    proof itself pass through.
    """
    path = Path(folder) / PROOF
    several = path.with_name(COMPOSITION)
    if not path.exists() and several.exists():
        raise DocumentError(f"{several} is about several funnels, not about one")
    verdict = proofs.check(path)
    document = _read(path, verdict.digests["proof"])
    about = document["claim"]["about"]
    dynamics = "vector_field" if "vector_field" in about else "model"
    if set(about) not in ({dynamics, "policy", "funnel"}, {"model", "funnel"}):
        raise DocumentError(f"{path} is about {', '.join(about)}, not about one funnel")
    nouns: dict[str, Any] = {"policy": None}
    for role in about:
        file = path.with_name(about[role]["file"])
        nouns[role] = read(_read(file, verdict.digests[role]), source=str(file))
    model, policy, funnel = nouns[dynamics], nouns["policy"], nouns["funnel"]
    claim = {key: part for key, part in document["claim"].items() if key != "about"}
    return Design(model, policy, funnel, claim, document["proof"], verdict, None)


def _read(path: Path, digest: str) -> Json:
    """The document whose bytes the kernel has read."""
    content = path.read_bytes()
    if files.digest(content) != digest:
        raise CertificateMismatch(f"{path} changed while it was read")
    return files.parse_document(content, source=str(path))


def _documents(model: Any, policy: Any, funnel: Any) -> dict[str, Json]:
    """The documents by file name."""
    name = VECTOR_FIELD if isinstance(model, VectorField) else MODEL
    documents: dict[str, Json] = {name: model.document()}
    if policy is not None:
        documents[POLICY] = policy.document()
    return documents | {FUNNEL: funnel.document()}


def _proof_document(documents: dict[str, Json], claim: Json, proof: Json) -> Json:
    about = {
        name.removesuffix(".json"): proofs.binding(name, document)
        for name, document in documents.items()
    }
    return proofs.proof_document({"kind": claim["kind"], "about": about} | claim, proof)
