"""Falsifications of proved tubes, as documents: runs of a model whose sensor breaks.

Those of the corpus were made of `broken_run` by `found`, as a slow test does again.
"""

import numpy as np

from nlsid_core import files, proofs
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.design import OutputTubeDesign
from nlsid_core.errors import CertificateRejected
from nlsid_core.funnels.tube import TubeFunnel
from nlsid_core.models import StableModel
from nlsid_core.running.falsification import falsifications
from nlsid_core.running.stepping import Stepper
from tests.core.kernel.mutations import corpus
from tests.core.kernel.tube_claims import FUNNEL, HIGH, LOW, MODEL

PROOF = "funnel.proof.json"
MODELS = ("linear", "quadratic", "moving_lags", "two_outputs", "following")
RECORDING = {"name": "a run", "digest": "sha256:" + 64 * "5"}


def claim(name: str) -> tuple[Json, dict[str, Json]]:
    """Fresh copies of a falsification of the corpus and of the files that it is about."""
    (case,) = (c for c in corpus() if (c.kind, c.name) == ("falsification", name))
    copied = case.copied()
    return copied.document, copied.about


def binding(about: dict[str, Json]) -> Json:
    """How a falsification names the tube's proof."""
    return {"tube": proofs.binding(PROOF, about[PROOF])}


def broken_run(
    model: StableModel, samples: int = 80, seed: int = 7
) -> tuple[FloatArray, FloatArray]:
    """(y, u) of a run of the model itself, whose first output reads 1 more from half of it on."""
    rng, stepper = np.random.default_rng(seed), Stepper(model)
    lags = max(stepper.lags, 1)
    u = np.repeat(rng.uniform(LOW, HIGH, (samples // 10, len(stepper.u))), 10, axis=0)
    y = np.zeros((samples, len(stepper.y)))
    x = stepper.begin(y[:lags], u[:lags])[None]
    for t in range(lags, samples):
        after, x = stepper.advance(x, u[t])
        y[t] = after[0]
    y[samples // 2 :, 0] += 1.0
    return y, u


def found(made: OutputTubeDesign) -> tuple[Json, dict[str, Json]]:
    """The first falsification of a broken run that the kernel proves, and what it is about."""
    about = files_of(made)
    y, u = broken_run(made.model)
    for each in falsifications(made.model, made.funnel, y, u):
        document = proofs.proof_document(each.claim(binding(about), RECORDING), each.proof())
        try:
            proofs.decide(document, about)
        except CertificateRejected:
            continue
        return document, about
    raise AssertionError("no falsification was found")


def files_of(made: OutputTubeDesign) -> dict[str, Json]:
    """A proved tube's files by their names."""
    model, funnel = made.model.document(), made.funnel.document()
    bindings = {"model": proofs.binding(MODEL, model), "funnel": proofs.binding(FUNNEL, funnel)}
    said = proofs.proof_document({"kind": "tube", "about": bindings}, made.proof)
    return {MODEL: model, FUNNEL: funnel, PROOF: said}


def funnel_of(about: dict[str, Json]) -> TubeFunnel:
    """The funnel of these files."""
    return TubeFunnel.from_document(about[FUNNEL])


def bind_again(about: dict[str, Json]) -> None:
    """The digests of a tube's files, as an adversary would write them."""
    about[FUNNEL]["model"] = files.digest(about[MODEL])
    bindings = about[PROOF]["claim"]["about"]
    for role in bindings:
        bindings[role] = proofs.binding(f"{role}.json", about[f"{role}.json"])
