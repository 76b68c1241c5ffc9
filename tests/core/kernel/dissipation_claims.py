"""A model of each class with its proved gain, and one passivity, as documents."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from nlsid_core import files, proofs
from nlsid_core.arrays import Json
from nlsid_core.identification.dissipation import prove_gain, prove_passivity
from nlsid_core.models import DifferenceEquation, Signal, StateAffineModel
from nlsid_core.models.polynomials import Polynomials
from tests.core.kernel import stability_claims, tube_claims
from tests.core.kernel.stability_claims import CONSTANT, U, Y, state_affine

MODEL = "model.json"


def curved() -> StateAffineModel:
    """Constant factors of the outputs, a cubic of both inputs."""
    return replace(
        state_affine((CONSTANT, [1.0]), (CONSTANT, [-0.5])),
        p=Polynomials(np.array([[1, 0], [3, 0], [0, 2]]), np.array([[-1.0], [0.05], [0.1]])),
    )


def moving() -> StateAffineModel:
    """A factor of the outputs that moves with the input, so the outputs are in a box."""
    return state_affine(([[0, 0], [1, 0]], [1.5, 0.1]), (CONSTANT, [-0.5]))


def feedthrough() -> DifferenceEquation:
    """Passive: y = u + 0.5 y(t-1), all of its response in the right half plane."""
    return DifferenceEquation(np.array([0.5]), np.array([1.0, 0.0]), 0.0, 0.1, Y, U, (-1.0, 1.0))


def integrator() -> DifferenceEquation:
    """y = y(t-1) + 0.1 u(t-1): a gain with a discount only."""
    return DifferenceEquation(np.array([1.0]), np.array([0.0, 0.1]), 0.0, 0.1, Y, U, (-1.0, 1.0))


MODELS: dict[str, Callable[[], Any]] = {
    **{name: stability_claims.MODELS[name] for name in
       ("linear", "constant", "cascade", "network", "monotone", "straight")},
    **{name: tube_claims.MODELS[name] for name in
       ("implicit_ray", "implicit_linear", "implicit_box")},
    "curved": curved, "moving": moving, "passive": feedthrough, "short": stability_claims.linear,
    "integrator": integrator,
}  # fmt: skip
BOXES: dict[str, Json] = {
    "moving": {"y": [[-1.0, 1.0]]},
    "implicit_box": {"y": [[-1.5, 1.5]], "u": [[-1.0, 1.5]]},
}


@cache
def _written(name: str) -> str:
    model = MODELS[name]()
    prove = prove_passivity if name in ("passive", "short") else prove_gain
    scales = (2.0, 0.25) if name == "constant" else None
    found = prove(
        model,
        box=BOXES.get(name),
        discount=0.875 if name == "integrator" else 1.0,
        y_scales=scales,
    )
    assert found is not None, name
    return json.dumps([model.document(), found.document(model, MODEL)])


def claim(name: str) -> tuple[Json, Json]:
    """Fresh copies of a model's document and its proof's."""
    model, proof = json.loads(_written(name))
    return model, proof


def decide(model: Json, proof: Json) -> proofs.Verdict:
    """The verdict, with the digest made to fit: only the mathematics can refuse."""
    proof["claim"]["about"]["model"]["digest"] = files.digest(model)
    return proofs.decide(proof, {MODEL: model})


def slower(model: Any) -> Any:
    """A linear model whose output is the other's input and back: m/s of V in, V of m/s out."""
    return replace(model, y=Signal("voltage", "V"), u=Signal("heard", "m/s"))


@cache
def _loop() -> str:
    one = DifferenceEquation(np.array([0.5]), np.array([0.25, 0.2]), 0.0, 0.1, Y, U, (-1.0, 1.0))
    two = slower(
        DifferenceEquation(np.array([0.25]), np.array([0.1, 0.3]), 0.0, 0.1, Y, U, (-1.0, 1.0))
    )
    found, about = {}, {}
    for role, model in (("first", one), ("second", two)):
        proof = prove_gain(model)
        assert proof is not None
        found[f"{role}.model.json"] = model.document()
        found[f"{role}.proof.json"] = proof.document(model, f"{role}.model.json")
        about[role] = proofs.binding(f"{role}.proof.json", found[f"{role}.proof.json"])
    document = proofs.proof_document({"kind": "small_gain", "about": about}, {})
    return json.dumps([document, found])


def loop() -> tuple[Json, dict[str, Json]]:
    """Fresh copies of a loop's proof and of the files that it is about."""
    document, about = json.loads(_loop())
    return document, about
