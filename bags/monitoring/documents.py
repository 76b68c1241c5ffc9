"""The files of one design folder, by name, and reading them back as nouns."""

from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from bags.monitoring.designs import Design, LinearDesign, TrackingDesign, read_design
from nlsid_core import _json
from nlsid_core.certificate import Verdict, check
from nlsid_core.errors import CertificateMismatch, DocumentError
from nlsid_core.models import DifferenceEquation

MODEL = "model.json"
MODEL_PROOF = "model.proof.json"
TRAINING = "training.npz"
REPORT = "report.html"
SELECTION_PLOT = "select.png"
COMPARISON_PLOT = "compare.png"
POLICY = "policy.json"
FUNNEL = "funnel.json"
FUNNEL_PROOF = "funnel.proof.json"
MARGIN_PLOT = "monitor.png"
FUNNEL_PLOT = "funnel.png"
FREE_RUN_PLOT = "free_run.png"
MOTION_PLOT = "motion.png"


D = TypeVar("D", bound=Design)


@dataclass(frozen=True, eq=False)
class Proved(Generic[D]):
    """A design whose proof was checked when it was loaded."""

    design: D
    verdict: Verdict


def load_model(path: Path | str) -> DifferenceEquation:
    """Read a model file; DocumentError says what is wrong with it."""
    path = Path(path)
    return DifferenceEquation.from_document(_json.load_document(path), source=str(path))


def load_proved(path: Path | str) -> Proved[Design]:
    """Read a funnel with the model, policy and proof beside it, and check the proof.

    Raises CertificateRejected or CertificateMismatch if the proof does not prove this funnel.
    """
    path = Path(path)
    verdict = check(path.with_name(FUNNEL_PROOF))
    names = {"model": MODEL, "policy": POLICY, "funnel": path.name}
    found = {role: _json.load_document(path.with_name(name)) for role, name in names.items()}
    for role, document in found.items():
        if verdict.digests.get(role) != _json.digest(document):
            raise CertificateMismatch(f"{FUNNEL_PROOF} beside {path} is not about this {role}")
    return Proved(read_design(found), verdict)


def load_proved_funnel(path: Path | str) -> Proved[LinearDesign]:
    """`load_proved` for a tube of a difference equation; DocumentError if it is another."""
    proved = load_proved(path)
    if not isinstance(proved.design, LinearDesign):
        raise DocumentError(f"{path}: a discrete funnel; use `nlsid track` for it")
    return Proved(proved.design, proved.verdict)


def load_proved_tracking(path: Path | str) -> Proved[TrackingDesign]:
    """`load_proved` for a discrete funnel; DocumentError if it is another."""
    proved = load_proved(path)
    if not isinstance(proved.design, TrackingDesign):
        raise DocumentError(f"{path}: no discrete funnel; use `nlsid monitor` for it")
    return Proved(proved.design, proved.verdict)
