"""A model of each class with its proof of stability, as documents."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from nlsid_core import files, proofs
from nlsid_core.arrays import Json
from nlsid_core.identification import prove_stability
from nlsid_core.models import (
    CellNetwork,
    DifferenceEquation,
    MonotoneEquation,
    PiecewiseLinear,
    Polynomials,
    Signal,
    StateAffineModel,
)
from tests.cascades import two_phases

Y, U = Signal("speed", "m/s", "/speed:data"), Signal("command", "V", "/command:data")


def linear() -> DifferenceEquation:
    return DifferenceEquation(
        np.array([1.2, -0.5, 0.1]),
        np.array([0.2, 0.1, 0.0, -0.3]),
        0.25,
        Y,
        U,
        (-1.0, 2.0),
        period=0.025,
    )


def state_affine(*blocks: Any, outputs: int = 1, most: float = 1.0) -> StateAffineModel:
    """`blocks`: (exponents, coefficients) of G_0 … G_n in w = (u(t), u(t-1))."""
    return StateAffineModel(
        G=tuple(
            Polynomials(np.array(e), np.array(c, dtype=float).reshape(-1, outputs, outputs))
            for e, c in blocks
        ),
        p=Polynomials(np.array([[1, 0]]), np.ones((1, outputs))),
        window=((0, 0), (0, 1)),
        y_offset=np.zeros(outputs),
        y_scale=np.full(outputs, 0.5),
        u_offset=np.array([0.1]),
        u_scale=np.array([0.7]),
        u_range=np.array([[-most, 2.0 * most]]),
        period=0.025,
        y=tuple(Signal(f"y{i}", "m/s") for i in range(outputs)),
        u=(U,),
    )


CONSTANT = [[0, 0]]


def quadratic() -> StateAffineModel:
    """One output, G_0 a quadratic of both inputs that are far from a sum of squares' corners."""
    return state_affine(
        ([[0, 0], [2, 0], [1, 1], [0, 2]], [1.0, 0.2, -0.1, 0.1]),
        (CONSTANT, [-0.9]),
        (CONSTANT, [0.3]),
    )


def moving_lags() -> StateAffineModel:
    """One output whose lagged coefficients depend on the input."""
    return state_affine(
        ([[0, 0], [1, 0]], [1.0, 0.1]), ([[0, 0], [0, 1]], [-0.7, 0.1]), ([[2, 0]], [0.03])
    )


def two_outputs() -> StateAffineModel:
    lead = [[[1.0, 0.3], [-0.2, 0.9]], [[0.1, 0.0], [0.05, -0.1]]]
    lagged = [[[-0.4, 0.1], [0.1, -0.3]], [[0.0, 0.05], [0.05, 0.0]]]
    return state_affine(([[0, 0], [1, 0]], lead), ([[0, 0], [0, 1]], lagged), outputs=2)


def constant() -> StateAffineModel:
    lead, lagged = [[[1.0, 0.3], [-0.2, 0.9]]], [[[-0.7, 0.1], [0.2, -0.5]]]
    return state_affine((CONSTANT, lead), (CONSTANT, lagged), outputs=2)


def split() -> StateAffineModel:
    """G_0 = 0.35 - w + w² on a wide box: positive there, but not its Bernstein coefficients."""
    return state_affine(
        ([[0, 0], [1, 0], [2, 0]], [0.35, -1.0, 1.0]),
        ([[0, 0], [1, 0]], [-0.05, 0.01]),
        most=0.7,
    )


def monotone() -> MonotoneEquation:
    return MonotoneEquation(
        np.array([3.0, 0.6, 1.0]),
        np.array([1.2, -0.5]),
        np.array([1.0]),
        0.1,
        ((0, 0),),
        0.0,
        np.zeros(1),
        Y,
        (U,),
        period=0.025,
    )


def straight() -> MonotoneEquation:
    """A linear e: lightly damped, which no multiplier of a ray proves."""
    return replace(monotone(), e=np.array([2.0, 0.0, 0.0]), a=np.array([3.6, -1.9]))


def network() -> CellNetwork:
    """Two cells: z = φ(x₁) + u, x₁⁺ = min(z, 1), x₂⁺ = ψ(x₂) + x₁ + 0.5 (z - 1)₊."""
    return CellNetwork(
        maps=(
            PiecewiseLinear(np.array([-1.0, 0.0, 1.0]), np.array([-0.5, 0.0, 0.75])),
            PiecewiseLinear(np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 1.0])),
            PiecewiseLinear(np.array([-1.0, 0.5, 1.0]), np.array([-0.25, 0.125, 0.5])),
        ),
        into=np.array([[0, 0, 0, 1, 0, 0, 0], [1, 0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 1, 0, 0]]),
        next=np.array([[0, 1, 0, 0, 0, 0, 0], [0.5, -0.5, 1, 1, 0, 0.5, 0]]),
        output=np.array([[0, 0, 0, 0, 2, 0, 0.25]]),
        start=np.zeros(2),
        start_samples=3,
        period=0.025,
        y=(Y,),
        u=(U,),
    )


MODELS: dict[str, Callable[[], Any]] = {
    "linear": linear,
    "quadratic": quadratic,
    "moving_lags": moving_lags,
    "two_outputs": two_outputs,
    "constant": constant,
    "split": split,
    "cascade": two_phases,
    "network": network,
    "monotone": monotone,
    "straight": straight,
}


@cache
def _written(name: str) -> str:
    model = MODELS[name]()
    proof = prove_stability(model)
    assert proof is not None, name
    return json.dumps([model.document(), proof.document(model, "model.json")])


def claim(name: str) -> tuple[Json, Json]:
    """Fresh copies of a model's document and its proof's."""
    model, proof = json.loads(_written(name))
    return model, proof


def decide(model: Json, proof: Json) -> proofs.Verdict:
    """The verdict, with the digest made to fit: only the mathematics can refuse."""
    proof["claim"]["about"]["model"]["digest"] = files.digest(model)
    return proofs.decide(proof, {"model.json": model})
