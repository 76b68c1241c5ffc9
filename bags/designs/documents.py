"""The files of one design folder, by name, and reading them back."""

from pathlib import Path
from typing import Any, cast, get_args

from bags.designs.bundle import Bundle
from nlsid_core import designs, files
from nlsid_core.designs import AnyDesign, Design, Wiring
from nlsid_core.documents import load as load_noun
from nlsid_core.errors import DocumentError
from nlsid_core.models import DifferenceEquation, StableModel
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.running.stage import Stage

MODEL, VECTOR_FIELD = designs.MODEL, designs.VECTOR_FIELD
POLICY, FUNNEL, FUNNEL_PROOF = designs.POLICY, designs.FUNNEL, designs.PROOF
MODEL_PROOF = "model.proof.json"
TRIALS = "trials.npz"
FLEET = "fleet.sqlite"  # what was read of many bags
REPORT = "report.html"
DESIGN_REPORT = "design.html"
MARGIN_PLOT = "monitor.png"
FUNNEL_PLOT = "funnel.png"
CATCHING_PLOT = "catching.png"
FREE_RUN_PLOT = "free_run.png"
PUSH = "push.json"  # what recordings differ from given equations by


def load(path: Path | str, *, wiring: Wiring | None = None) -> AnyDesign:
    """The design in a folder, or that of a funnel's or a composition's file; its proof is decided.

    wiring: of a continuous funnel, where its signals are.

    Raises CertificateRejected if the proof proves nothing or what was measured contradicts it,
    CertificateMismatch if a file is another than the proof is about, DocumentError if it is not the
    proof of a funnel. OS errors for funnel and proof pass through.
    """
    bundle = Bundle.load(path)
    return bundle.design(wiring, bundle.decided())


def load_unproved(folder: Path | str, *, wiring: Wiring | None = None) -> AnyDesign:
    """policy.json in `folder` with its model or vector field: nothing is proved of it.

    Raises DocumentError if they are none, CertificateMismatch if they do not belong together.
    """
    folder = Path(folder)
    policy: Any = load_noun(folder / POLICY)
    is_continuous = isinstance(policy, ContinuousPolicy)
    model: Any = load_noun(folder / (VECTOR_FIELD if is_continuous else MODEL))
    Stage(model, policy, None).refuse_mismatch()
    return Design(model, policy, None, wiring=wiring)


def load_model(path: Path | str) -> DifferenceEquation:
    """Read the model of one linear equation; DocumentError says what is wrong with the file."""
    return DifferenceEquation.from_document(files.load_document(Path(path)), source=str(path))


def load_stable_model(path: Path | str) -> StableModel:
    """Read a model of any class that tubes are proved for; DocumentError if the file has none."""
    model = load_noun(path)
    if not isinstance(model, get_args(StableModel)):
        raise DocumentError(f"{path}: not a model that `nlsid identify` writes")
    return cast(StableModel, model)
