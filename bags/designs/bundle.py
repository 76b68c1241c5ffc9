"""A design's files as one text, which is published once and decided again by whoever receives it.

What arrives is untrusted. It is decided in a process of its own, with limits of time and memory, so
that neither a large proof nor a hostile one holds up the loop that waits for it.
"""

import contextlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, get_args

from bags.designs.provenance import of_funnel
from nlsid_core import designs, files
from nlsid_core.arrays import Json
from nlsid_core.deciding import USUAL, Deciding, Limits
from nlsid_core.designs import AnyDesign, Design, Wiring
from nlsid_core.documents import read
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import CertificateMismatch, CertificateRejected, DocumentError
from nlsid_core.funnels import ContinuousFunnel, SampledFunnel, TubeFunnel
from nlsid_core.kernel import Verdict
from nlsid_core.kernel.checking import read_regular
from nlsid_core.models import StableModel, StateModel
from nlsid_core.policies import ContinuousPolicy, SampledPolicy, TubePolicy
from nlsid_core.running.stage import Stage

FORMAT: Final = "nlsid/bundle"
PROOF: Final = "proof"  # the role of the file that names the others
MAX_BYTES: Final = 16 * 2**20  # of a bundle; real ones have about 1 MB
MAX_ROLES: Final = 401  # of a composition of 100 stages


@dataclass(frozen=True)
class Bundle:
    """The bytes of a design's files by role: `proof`, and those that its claim is about."""

    contents: Mapping[str, bytes]

    @classmethod
    def load(cls, path: Path | str) -> "Bundle":
        """The files of the proof in a design's folder, or beside its funnel; of a composition's
        proof, those of its stages.

        Raises CertificateMismatch if the proof is about another funnel, DocumentError if it is no
        proof, the folder has none or the files are too large to be published; OS errors for the
        proof pass through.
        """
        path = Path(path)
        funnel = _funnel_of(path) if path.is_dir() else path
        folder = funnel.parent
        composed = funnel.name == designs.COMPOSITION
        named = funnel.read_bytes()
        proof = named if composed else (folder / designs.PROOF).read_bytes()
        contents = {PROOF: proof, **_beside(folder, proof)}
        for stage in list(contents) if composed else []:
            if stage != PROOF:
                inner = _beside(folder, contents[stage])
                contents |= {f"{stage}.{role}": content for role, content in inner.items()}
        if not composed and contents.get("funnel") != named:
            raise CertificateMismatch(
                f"{designs.PROOF} beside {funnel} is not about it: give the design's folder"
            )
        bundle = cls(contents)
        _refuse_size(bundle.text())
        return bundle

    @classmethod
    def parse(cls, text: str) -> "Bundle":
        """Read what `text` wrote; DocumentError says what is wrong with it."""
        _refuse_size(text)
        document = files.parse_document(text, source="bundle")
        files.header(document, FORMAT, source="bundle")
        texts = files.member(document, "files", dict, source="bundle")
        if len(texts) > MAX_ROLES or not all(isinstance(each, str) for each in texts.values()):
            raise DocumentError(f"bundle: files should be at most {MAX_ROLES} texts by role")
        # The kernel refuses what is no text.
        return cls({role: each.encode("utf-8", "surrogatepass") for role, each in texts.items()})

    def text(self) -> str:
        """One line of JSON: the files' texts by role."""
        texts = {
            role: content.decode("utf-8", "replace") for role, content in self.contents.items()
        }
        return json.dumps({"format": FORMAT, "version": files.VERSION, "files": texts})

    @property
    def digest(self) -> str:
        """The digest of the funnel's file, which names its model and its policy.

        Of a composition it is that of the proof, which names the stages.
        """
        return files.digest(self.contents.get(PROOF if self._stages else "funnel", b""))

    @property
    def _stages(self) -> list[str]:
        """The roles of a composition's stages, in their order; none of a funnel."""
        known = (f"stage{i}" for i in range(1, len(self.contents)))
        return [role for role in known if role in self.contents]

    def _files(self) -> dict[str, bytes]:
        """The bytes by the names that the proof, or a stage's, calls them."""
        found = {}
        for role in [PROOF, *self._stages]:
            inner = "" if role == PROOF else f"{role}."
            for part, name in _names(self.contents[role]).items():
                if inner + part in self.contents:
                    found[name] = self.contents[inner + part]
        return found

    def decided(self, limits: Limits = USUAL) -> Verdict:
        """The kernel's verdict about these files and no others.

        Raises CertificateRejected or CertificateMismatch with the reason.
        """
        verdict = self.deciding(limits).wait()
        self.refuse_others(verdict)
        return verdict

    def deciding(self, limits: Limits = USUAL) -> Deciding:
        """The kernel at work on these files; CertificateRejected if there is no proof."""
        if PROOF not in self.contents:
            raise CertificateRejected("there is no proof in the bundle")
        return Deciding.of(self.contents[PROOF], self._files(), limits)

    def refuse_others(self, verdict: Verdict) -> None:
        """Raise CertificateMismatch if the verdict is about other files than these."""
        found = {role: files.digest(content) for role, content in self.contents.items()}
        if found != verdict.digests or not ("funnel" in found or self._stages):
            raise CertificateMismatch(
                f"the proof is about {', '.join(sorted(verdict.digests))}; with a funnel come "
                f"{', '.join(sorted(found))}"
            )

    def design(self, wiring: Wiring | None = None, decision: Verdict | None = None) -> AnyDesign:
        """The files as what a robot runs; decides nothing.

        wiring: of a continuous funnel.
        decision: what the kernel said of these files, if it was asked.

        Raises DocumentError or CertificateMismatch if they are not a design, DataError if samples
        come less often than is proved, CertificateRejected if what was measured contradicts it.
        """
        proof = files.parse_document(self.contents.get(PROOF, b"{}"), source=PROOF)
        if not self._stages:
            return _design(self.contents, proof, wiring, decision)
        stages = []
        for stage in self._stages:
            parts = {
                role.removeprefix(f"{stage}."): content
                for role, content in self.contents.items()
                if role.startswith(f"{stage}.")
            }
            own = files.parse_document(self.contents[stage], source=stage)
            stages.append(_design(parts, own, wiring, None))
        return replace(stages[0], certificate=proof, decision=decision, parts=tuple(stages))


# What goes with a funnel of each kind: a policy of which type (None: or none), and which models.
KINDS: Final[Mapping[type, tuple[tuple[type, ...], tuple[type, ...]]]] = {
    TubeFunnel: ((TubePolicy, type(None)), get_args(StableModel)),
    SampledFunnel: ((SampledPolicy,), (StateModel,)),
    ContinuousFunnel: ((ContinuousPolicy,), (VectorField,)),
}


def _design(
    contents: Mapping[str, bytes], proof: Json, wiring: Wiring | None, decision: Verdict | None
) -> AnyDesign:
    """The design of these files by role."""
    parts = {
        role: files.parse_document(content, source=role)
        for role, content in contents.items()
        if role != PROOF
    }
    nouns: dict[str, Any] = {role: read(part, source=role) for role, part in parts.items()}
    model = nouns.pop("vector_field" if "vector_field" in nouns else "model", None)
    policy, funnel = nouns.pop("policy", None), nouns.pop("funnel", None)
    policies, models = KINDS.get(type(funnel), ((), ()))
    if nouns or type(policy) not in policies or type(model) not in models:
        raise DocumentError(f"{', '.join(parts)}: these files are no design of one funnel")
    Stage(model, policy, funnel).refuse_mismatch()
    design = Design(model, policy, funnel, proof, decision, None, wiring)
    if wiring is not None:
        _ = design.held  # which refuses samples that come too slowly for it
    if wrong := of_funnel(model.document(), funnel.document()).wrong:
        raise CertificateRejected(f"what was measured contradicts the design: {'; '.join(wrong)}")
    return design


def _funnel_of(folder: Path) -> Path:
    """What is read of a design folder: a proof of several funnels, or its funnel."""
    for name in (designs.COMPOSITION, designs.FUNNEL):
        if (folder / name).is_file():
            return folder / name
    raise DocumentError(
        f"{folder} has no {designs.FUNNEL}: `nlsid funnel {folder}` writes it. A design's folder "
        "stands before the bags"
    )


def _beside(folder: Path, proof: bytes) -> dict[str, bytes]:
    """The files by role that a proof in `folder` is about; the kernel says which is missing."""
    found = {}
    for role, name in _names(proof).items():
        with contextlib.suppress(OSError):
            found[role] = read_regular(folder / name)
    return found


def _names(proof: bytes) -> dict[str, str]:
    """The plain file names by role that a proof's claim is about."""
    document = files.parse_document(proof, source=PROOF)
    claim = files.member(document, "claim", dict, source=PROOF)
    about = files.member(claim, "about", dict, source=PROOF)
    names = {role: files.member(about[role], "file", str, source=PROOF) for role in about}
    return {role: name for role, name in names.items() if Path(name).name == name}


def _refuse_size(text: str) -> None:
    if len(text) > MAX_BYTES:
        raise DocumentError(f"bundle: {len(text)} characters; one has at most {MAX_BYTES}")
