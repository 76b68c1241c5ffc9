"""`Design`: what a robot runs and is held against, and what is proved of it: one folder."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar

import numpy as np

from nlsid_core import files, proofs
from nlsid_core.arrays import Json
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import CertificateRejected, DataError, DocumentError
from nlsid_core.funnels import ContinuousFunnel, SampledFunnel, TubeFunnel
from nlsid_core.kernel import Verdict
from nlsid_core.models import Signal, StableModel, StateModel
from nlsid_core.policies import ContinuousPolicy, SampledPolicy, TubePolicy
from nlsid_core.running.comparison import Centre
from nlsid_core.running.controller import Controller, Limits
from nlsid_core.running.held import Held
from nlsid_core.running.monitor import Monitor
from nlsid_core.running.stage import Stage
from nlsid_core.shown import BLUE, POINTS, card, line

# The files in a design's folder; a claim calls each by its name without the ending.
MODEL = "model.json"
VECTOR_FIELD = "vector_field.json"
POLICY = "policy.json"
FUNNEL = "funnel.json"
PROOF = "funnel.proof.json"
COMPOSITION = "composition.proof.json"  # of funnels that follow each other, its stages beside it

D = TypeVar("D", bound=StableModel | StateModel | VectorField)
P = TypeVar("P", bound=TubePolicy | SampledPolicy | ContinuousPolicy | None)
F = TypeVar("F", bound=SampledFunnel | ContinuousFunnel | TubeFunnel | None)
S = TypeVar("S")


@dataclass(frozen=True)
class Wiring:
    """Where a continuous funnel's state and inputs are, as `topic:field.path`; s between samples.

    A vector field has equations and no signals, so whoever runs its funnel says this.
    """

    response: tuple[str, ...]
    command: tuple[str, ...]
    period: float


@dataclass(frozen=True, eq=False, repr=False)
class Design(Generic[D, P, F, S]):
    """A model, a policy and a funnel that belong together, with their proof.

    model: of the robot, or its vector field in continuous time.
    policy: None where the funnel is around the model itself, whatever drives it.
    funnel: None of a policy of which nothing is proved.
    certificate: the proof's document; empty where nothing is proved.
    decision: what the kernel said of it; None if it was not asked.
    found: what the search leaves beside them; None of a design that was read from files.
    wiring: of a continuous funnel, None until somebody says it.
    parts: of a composition, its stages. The first one's model, policy and funnel are its own.
    """

    model: D
    policy: P
    funnel: F
    certificate: Json = field(default_factory=dict)
    decision: Verdict | None = None
    found: S = None  # type: ignore[assignment]  # the search's own type where there was one
    wiring: Wiring | None = None
    parts: "tuple[Design[D, P, F, S], ...]" = ()

    @classmethod
    def proved(
        cls, model: D, policy: P, funnel: F, *, claim: Json, proof: Json, found: S
    ) -> "Design[D, P, F, S]":
        """A design whose proof the kernel has decided; CertificateRejected says why it has not."""
        documents = _documents(model, policy, funnel)
        certificate = _certificate(claim, proof, documents)
        verdict = proofs.decide(certificate, documents)
        return cls(model, policy, funnel, certificate, verdict, found)

    def __str__(self) -> str:
        return str(self.verdict) if self.found is None else f"{self.verdict}\n{self.found}"

    def __repr__(self) -> str:
        return f"<Design of {self.name}: {getattr(self.decision, 'statement', 'not decided')}>"

    def _repr_html_(self) -> str:
        """What is proved, and how wide the first signal's tube is over time."""
        funnel = self.funnel
        if funnel is None or self.decision is None:
            return card(repr(self))
        when = np.linspace(getattr(funnel, "t0", 0.0), min(funnel.last, 2.0 * POINTS), POINTS)
        width = np.array([funnel.widths(each)[0] for each in when.tolist()])
        span = np.append(width, -width)
        return card(
            str(self.decision), line(when, width, BLUE, span), line(when, -width, BLUE, span)
        )

    @property
    def verdict(self) -> Verdict:
        """What the kernel said of it; CertificateRejected if it was not asked."""
        if self.decision is None:
            raise CertificateRejected("no kernel has decided a proof of this design")
        return self.decision

    @property
    def claim(self) -> Json:
        """What the proof states: its kind, the files that it is about, and its numbers."""
        return dict(self.certificate.get("claim", {}))

    @property
    def proof(self) -> Json:
        """The witnesses."""
        return dict(self.certificate["proof"])

    def decided(self) -> Verdict:
        """What the kernel says of it as it stands; CertificateRejected with the reason."""
        documents = self.documents()
        return proofs.decide(documents[PROOF], documents)

    def documents(self) -> dict[str, Json]:
        """The content of its files by name, the proof last."""
        documents = _documents(self.model, self.policy, self.funnel)
        return documents | {PROOF: _certificate(self.claim, self.proof, documents)}

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

    @property
    def stages(self) -> "Sequence[Design[D, P, F, S]]":
        """The stages of a composition, one after another; of others this design."""
        return self.parts or (self,)

    @property
    def signals(self) -> tuple[tuple[Signal, ...], tuple[Signal, ...]]:
        """The model's outputs or states, and its inputs; those of equations are by number."""
        model: Any = self.model
        if isinstance(model, VectorField):
            return tuple(Signal(f"x{i}") for i in range(model.n)), tuple(
                Signal(f"u{j}") for j in range(model.m)
            )
        measured = model.x if isinstance(model, StateModel) else model.y
        y, u = ((s,) if isinstance(s, Signal) else s for s in (measured, model.u))
        return y, u

    @property
    def name(self) -> str:
        """What is measured, in words."""
        return ", ".join(signal.name for signal in self.signals[0])

    @property
    def is_single(self) -> bool:
        """One output and one input of an identified model: numbers, not vectors."""
        measured = isinstance(self.model, StateModel | VectorField)
        return not measured and all(len(part) == 1 for part in self.signals)

    @property
    def wired(self) -> Wiring:
        """Where the signals of equations are; DataError if nobody said it."""
        if self.wiring is None:
            raise DataError(
                "a vector field names no signals: say where the state and the inputs are "
                "(response, command) and how often they come (period)"
            )
        return self.wiring

    @property
    def period(self) -> float:
        """S between samples."""
        return self.wired.period if isinstance(self.model, VectorField) else self.model.period

    @property
    def held(self) -> Held | None:
        """How a policy of equations is applied; None where the model says it."""
        if not isinstance(self.model, VectorField):
            return None
        return Held.of_claim(self.claim, self.period)

    @property
    def digest(self) -> str:
        """The digest of the funnel, or of a composition's proof, as an announcement names it.

        Without a funnel of the policy's.
        """
        if self.parts:
            return files.digest(self.certificate)
        named: Any = self.policy if self.funnel is None else self.funnel
        return files.digest(named.document())

    @property
    def made_with(self) -> dict[str, str]:
        """What recordings were used for (training, calibration or both), by their digests."""
        trained: set[str] = set()
        calibrated: set[str] = set()
        for stage in self.stages:
            trained |= {digest for _, digest in getattr(stage.model, "bags", ())}
            for tube in stage.funnel.tubes if isinstance(stage.funnel, TubeFunnel) else ():
                trained |= {digest for _, digest in tube.measured.designed_on}
                calibrated |= {digest for _, digest in tube.measured.measured_on}
        parts = {"training": trained, "calibration": calibrated}
        return {
            digest: " and ".join(use for use, part in parts.items() if digest in part)
            for digest in trained | calibrated
        }

    def monitor(self, centre: Centre = Centre.COMMAND) -> Monitor:
        """A monitor for one run; centre: of a tube with a policy."""
        if self.funnel is None:
            raise DocumentError("nothing is proved of this policy: no funnel to hold a robot to")
        return Monitor(self._held_stages, centre=centre)

    def controller(self, limits: Limits, settling: float) -> Controller:
        """A controller for one run; `settling`: s to wait for a state where it may start.

        Raises DataError if there is no policy, or if a proof does not cover what a robot does: hold
        each input until the next sample.
        """
        if self.policy is None:
            raise DocumentError("this tube is around a model's simulation only: no policy to run")
        stage = self._held_stages[0]
        if stage.held is not None and stage.funnel is not None and not stage.held.hold:
            raise DataError(
                "the proof is about a policy that acts continuously, and a robot's input is held "
                "until the next sample: design it with a hold (hold: largest finds the longest)"
            )
        return Controller(stage, limits, settling)

    @property
    def _held_stages(self) -> list[Stage]:
        return [
            Stage(s.model, s.policy, s.funnel, replace(s, wiring=self.wiring).held)
            for s in self.stages
        ]


AnyDesign: TypeAlias = Design[Any, Any, Any, Any]


def _certificate(claim: Json, proof: Json, documents: dict[str, Json]) -> Json:
    """The proof's document, about these files."""
    about = {
        name.removesuffix(".json"): proofs.binding(name, document)
        for name, document in documents.items()
    }
    return proofs.proof_document({"kind": claim["kind"]} | claim | {"about": about}, proof)


def _documents(model: Any, policy: Any, funnel: Any) -> dict[str, Json]:
    """The documents by file name."""
    name = VECTOR_FIELD if isinstance(model, VectorField) else MODEL
    documents: dict[str, Json] = {name: model.document()}
    if policy is not None:
        documents[POLICY] = policy.document()
    return documents | {FUNNEL: funnel.document()}
