"""Disturbances and uncertain parameters: the certificate states their bounds and means them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.thesis.soundness import Simulation
from nlsid import ContinuousTracking, VectorField, check, integrate_nominal
from nlsid_core.design import FunnelDesign, design_funnel
from tests.core.kernel import refusals
from tests.edits import put
from tests.funnel_files import FIELD, PROOF, files_of, forged_by


def disturbed(x: Any, u: Any, w: Any) -> Any:
    """A hanging pendulum that the wind pushes."""
    return np.array([x[1], -x[0] + x[0] ** 3 / 6 - x[1] / 5 + u[0] + w[0]])


def unknown(x: Any, u: Any, w: Any) -> Any:
    """Its stiffness, damping and drive known within bounds."""
    return np.array([x[1], -w[0] * (x[0] - x[0] ** 3 / 6) - w[1] * x[1] + w[2] * u[0]])


def pushed(x: Any, u: Any, w: Any) -> Any:
    """Three pushes: bounded together, without corners."""
    return np.array([x[1] + w[1], -x[0] + x[0] ** 3 / 6 - x[1] / 5 + u[0] + w[0] - 2 * w[2]])


KINDS: dict[str, tuple[Any, list[list[float]], str]] = {
    "disturbance": (disturbed, [[-0.05, 0.05]], "w0 in [-0.05, 0.05]"),
    "parameters": (unknown, [[0.8, 1.2], [0.1, 0.3], [0.9, 1.1]], "w1 in [0.1, 0.3]"),
    "pushes": (pushed, [[-0.003, 0.003], [-0.002, 0.002], [-0.01, 0.01]], "w2 in [-0.01, 0.01]"),
}

WIDER = {"disturbance": 30.0, "parameters": 6.0, "pushes": 30.0}  # times the bounds: some leave


@pytest.fixture(scope="module", params=list(KINDS))
def kind(request: pytest.FixtureRequest) -> str:
    """One kind of uncertainty after the other."""
    return str(request.param)


@pytest.fixture(scope="module")
def design(kind: str) -> FunnelDesign:
    """The pendulum held at rest for 2 s, whatever w does."""
    dynamics, bounds, _ = KINDS[kind]
    field = VectorField.from_function(dynamics, 2, 1, uncertain=bounds)
    t = np.linspace(0, 2, 21)
    nominal = integrate_nominal(field, lambda _: np.zeros(1), t=t, start=np.zeros(2))
    return design_funnel(ContinuousTracking(field, nominal, goal=20 * np.eye(2)))


def test_the_certificate_states_the_bounds(kind: str, design: FunnelDesign, tmp_path: Path) -> None:
    proof = design.save(tmp_path)[-1]
    assert any(KINDS[kind][2] in text for text in check(proof).assumptions)


def test_the_worst_w_at_every_instant_breaks_nothing_and_a_larger_one_does(
    kind: str, design: FunnelDesign
) -> None:
    parts = (design.policy, design.funnel)
    runs = []
    for adversary in (False, True):
        rng = np.random.default_rng(8)
        runs.append(
            Simulation(design.model, *parts).boundary(starts=2000, rng=rng, adversary=adversary)
        )
    assert [run.violations for run in runs] == [0, 0]
    assert runs[0].max_v <= runs[1].max_v
    middle = design.model.uncertain.mean(axis=1, keepdims=True)
    wide = replace(design.model, uncertain=middle + WIDER[kind] * (design.model.uncertain - middle))
    rng = np.random.default_rng(9)
    run = Simulation(wide, *parts).boundary(starts=500, rng=rng, adversary=True)
    assert run.violations > 0


def test_wider_bounds_after_the_fact_are_refused(design: FunnelDesign) -> None:
    """By 1 %: the claim is then more than the proof shows."""
    low, high = design.model.uncertain[0].tolist()
    more = 0.005 * (high - low)
    wider = put(f"{FIELD} uncertain 0", [low - more, high + more])
    refusals.refused_with_fresh_digests(forged_by(wider, files_of(design)), "not_positive")


def test_a_corner_left_out_is_refused(kind: str, design: FunnelDesign) -> None:
    files = files_of(design)
    pieces = files[PROOF]["proof"]["pieces"]
    last = max(piece["vertex"] for piece in pieces)
    assert (last == 0) is (kind == "pushes")
    kept = [piece for piece in pieces if piece["vertex"] < last] or pieces[:-1]
    fewer = put(f"{PROOF} proof pieces", kept)
    refusals.refused_with_fresh_digests(forged_by(fewer, files), "not_covered")
