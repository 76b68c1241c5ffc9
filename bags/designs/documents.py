"""The files of one design folder, by name, and reading them back as nouns."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar, cast, get_args

from bags.designs.bundle import Bundle
from bags.designs.design import AnyDesign, SampledDesign, WiredDesign, WiredTube, Wiring
from nlsid_core import designs, files
from nlsid_core.documents import load
from nlsid_core.errors import DocumentError
from nlsid_core.funnels.sampled import SampledFunnel
from nlsid_core.funnels.tube import TubeFunnel
from nlsid_core.kernel import Verdict
from nlsid_core.models import DifferenceEquation, StableModel
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.policies.protocol import AnyPolicy, read_policy
from nlsid_core.running.monitor import refuse_mismatch

MODEL, VECTOR_FIELD = designs.MODEL, designs.VECTOR_FIELD
POLICY, FUNNEL, FUNNEL_PROOF = designs.POLICY, designs.FUNNEL, designs.PROOF
MODEL_PROOF = "model.proof.json"
TRAINING = "training.npz"
HELD_BACK = "held_back.npz"
FLEET = "fleet.sqlite"  # what was read of many bags
REPORT = "report.html"
DESIGN_REPORT = "design.html"
SELECTION_PLOT = "select.png"
COMPARISON_PLOT = "compare.png"
MARGIN_PLOT = "monitor.png"
FUNNEL_PLOT = "funnel.png"
CATCHING_PLOT = "catching.png"
FREE_RUN_PLOT = "free_run.png"
MOTION_PLOT = "motion.png"
PUSH = "push.json"  # what recordings differ from given equations by


def load_stable_model(path: Path | str) -> StableModel:
    """Read a model file of any class that tubes are proved for; DocumentError if it is none."""
    model = load(path)
    if not isinstance(model, get_args(StableModel)):
        raise DocumentError(f"{path}: not a model that `nlsid identify` writes")
    found: StableModel = model
    return found


D_co = TypeVar("D_co", covariant=True)


@dataclass(frozen=True, eq=False)
class Proved(Generic[D_co]):
    """A design whose proof was checked when it was loaded."""

    design: D_co
    verdict: Verdict


def load_model(path: Path | str) -> DifferenceEquation:
    """Read a model file; DocumentError says what is wrong with it."""
    path = Path(path)
    return DifferenceEquation.from_document(files.load_document(path), source=str(path))


def funnel_of(folder: Path) -> Path:
    """What `load_proved` reads in a design folder: a proof of several funnels, or its funnel."""
    several = folder / designs.COMPOSITION
    return several if several.is_file() else folder / FUNNEL


def load_proved(path: Path | str, *, wiring: Wiring | None = None) -> Proved[AnyDesign]:
    """Read a funnel with the model, policy and proof beside it, and check the proof.

    Of a continuous funnel the vector field is read in the place of the model. Raises
    CertificateRejected or CertificateMismatch if the proof does not prove this funnel.
    """
    bundle = Bundle.load(path)
    verdict = bundle.decided()
    return Proved(bundle.design(wiring), verdict)


def load_unproved(
    folder: Path | str, *, wiring: Wiring | None = None
) -> WiredDesign[Any, AnyPolicy, None]:
    """policy.json in `folder` with its model or vector field: nothing is proved of it.

    Raises DocumentError if they are none, CertificateMismatch if they do not belong together.
    """
    folder = Path(folder)
    policy = read_policy(files.load_document(folder / POLICY))
    continuous = isinstance(policy, ContinuousPolicy)
    model: Any = load(folder / (VECTOR_FIELD if continuous else MODEL))
    refuse_mismatch(model, policy, None)
    return WiredDesign(model, policy, None, wiring)


def load_proved_funnel(path: Path | str) -> Proved[WiredTube]:
    """`load_proved` for a tube; DocumentError if it is another."""
    proved: Proved[Any] = load_proved(path)
    if not isinstance(proved.design.funnel, TubeFunnel):
        raise DocumentError(f"{path}: not a tube; this reads tubes only")
    return cast(Proved[WiredTube], proved)


def load_proved_tracking(path: Path | str) -> Proved[SampledDesign]:
    """`load_proved` for a sampled funnel; DocumentError if it is another."""
    proved: Proved[Any] = load_proved(path)
    if not isinstance(proved.design.funnel, SampledFunnel):
        raise DocumentError(f"{path}: not a sampled funnel; `nlsid monitor` reads tubes")
    return cast(Proved[SampledDesign], proved)
