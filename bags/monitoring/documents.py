"""The files of one design folder, by name, and reading them back as nouns."""

from dataclasses import dataclass
from pathlib import Path

from nlsid_core import _json
from nlsid_core.certificate import Verdict, check
from nlsid_core.errors import CertificateMismatch
from nlsid_core.funnel import Funnel
from nlsid_core.models import DifferenceEquation
from nlsid_core.monitor import Monitor, Nominal
from nlsid_core.policy import Policy

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


@dataclass(frozen=True, eq=False)
class ProvedFunnel:
    """A funnel whose proof was checked when it was loaded, with its model and policy."""

    model: DifferenceEquation
    policy: Policy
    funnel: Funnel
    verdict: Verdict

    def monitor(self, nominal: Nominal = Nominal.COMMAND) -> Monitor:
        """A monitor for one run."""
        return Monitor(self.model, self.policy, self.funnel, nominal=nominal)


def load_model(path: Path | str) -> DifferenceEquation:
    """Read a model file; DocumentError says what is wrong with it."""
    path = Path(path)
    return DifferenceEquation.from_document(_json.load_document(path), source=str(path))


def load_proved_funnel(path: Path | str) -> ProvedFunnel:
    """Read a funnel with the model, policy and proof beside it, and check the proof.

    Raises CertificateRejected or CertificateMismatch if the proof does not prove this funnel.
    """
    path = Path(path)
    verdict = check(path.with_name(FUNNEL_PROOF))
    funnel_document = _json.load_document(path)
    model_document = _json.load_document(path.with_name(MODEL))
    policy_document = _json.load_document(path.with_name(POLICY))
    for role, document in (
        ("funnel", funnel_document),
        ("model", model_document),
        ("policy", policy_document),
    ):
        if verdict.digests.get(role) != _json.digest(document):
            raise CertificateMismatch(f"{FUNNEL_PROOF} beside {path} is not about this {role}")
    return ProvedFunnel(
        model=DifferenceEquation.from_document(model_document, source=MODEL),
        policy=Policy.from_document(policy_document, source=POLICY),
        funnel=Funnel.from_document(funnel_document, source=str(path)),
        verdict=verdict,
    )
