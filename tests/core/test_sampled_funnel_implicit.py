"""Funnels of identified implicit models: bounded roots, exact proofs, and what they refuse."""

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nlsid_core import files, proofs
from nlsid_core.arrays import Json
from nlsid_core.design.sampled.design import TrackingDesign
from nlsid_core.errors import CertificateMismatch, CertificateRejected
from nlsid_core.proofs import check
from nlsid_core.running.monitor import Monitor
from nlsid_core.running.reading import Status
from nlsid_core.running.stage import Stage
from tests import forged_tracking
from tests.implicit_funnels import STEPS, designed
from tests.implicit_pendulum import PERIOD, truth
from tests.marks import slow_among
from tests.tracked import resigned, step, write

ROLES = ("model", "policy", "funnel")


def test_a_funnel_of_an_implicit_model_is_proved_exactly(tmp_path: Path) -> None:
    verdict = check(write(designed(), tmp_path))
    assert verdict.margin > 0
    assert "response" in verdict.assumptions[0]
    assert "roots" in verdict.assumptions[2]


@pytest.mark.slow
def test_the_reaches_of_an_implicit_model_are_tight_to_one_percent() -> None:
    design = designed()
    rng = np.random.default_rng(1)
    z = rng.standard_normal((2000, 2))
    z /= np.linalg.norm(z, axis=1)[:, None]
    for k in (0, STEPS // 2, STEPS - 1):
        x = design.policy.x[k] + design.funnel.inlet[k] * z @ np.linalg.inv(design.funnel.S[k]).T
        moved = (step(design, k, x) - design.policy.x[k + 1]) @ design.funnel.S[k + 1].T
        farthest = np.linalg.norm(moved, axis=1).max()
        reach = design.proof["steps"][k]["inlet"]["reach"]
        assert 0.99 * reach < farthest <= reach


def test_the_worst_disturbance_of_an_implicit_model_stays_in_the_tube() -> None:
    design = designed()
    funnel, policy = design.funnel, design.policy
    rng = np.random.default_rng(2)
    closest = 0.0
    for run in range(60):
        z = rng.standard_normal(2)
        x = policy.x[0] + np.linalg.solve(funnel.S[0], z / np.linalg.norm(z) * funnel.tube[0])
        r = np.zeros(2)
        for k in range(STEPS):
            away = funnel.S[k + 1] @ (step(design, k, x) - policy.x[k + 1])
            worst = np.linalg.solve(funnel.S[k + 1], away / np.linalg.norm(away))
            d = 0.999 * funnel.assumption.bound * worst
            d = (1 if run % 2 else -1) * d - funnel.A[k] @ r
            r = funnel.A[k] @ r + d
            x = step(design, k, x) + d
            size = float(np.linalg.norm(funnel.S[k + 1] @ (x - policy.x[k + 1])))
            assert size <= funnel.radius[k + 1]
            closest = max(closest, size / funnel.radius[k + 1])
    assert closest > 0.95


def forged(design: TrackingDesign, what: str) -> TrackingDesign:
    """The design with one thing made better than it is, and all digests made to fit."""
    funnel = design.funnel
    assert funnel.roots is not None
    if what == "no bound on the roots":
        return resigned(design, funnel=replace(funnel, roots=None))
    if what == "a bound that lets spurious roots in":
        return resigned(design, funnel=replace(funnel, roots=1e4 * funnel.roots))
    if what in OF_EVERY_MODEL:
        return forged_tracking.forged(design, what)
    if what == "another nominal":
        return resigned(design, policy=designed(goal=0.05).policy)
    if what == "another model":
        heavier = replace(design.model, coefficients=1.02 * design.model.coefficients)
        return resigned(design, model=heavier)
    if what == "narrower data box":
        return resigned(design, model=replace(design.model, x_range=0.2 * design.model.x_range))
    proof = copy.deepcopy(design.proof)
    taken = proof["steps"][3]
    if what == "equation left out of the proof":
        taken["tube"]["equations"]["rows"] = [[0] * len(row) for row in rows_of(taken)]
    elif what == "multiplier of the bound on the roots left out":
        taken["tube"]["roots"]["squares"]["factors"] = [[]]
    elif what == "spread of the roots made smaller":
        taken["tube"]["spread"] *= 0.9
    elif what == "no spread of the roots":
        taken["tube"]["spread"] = 0.0
    elif what in ("first extent made smaller", "second extent made smaller"):
        taken["tube"]["extents"][["first", "second"].index(what.split()[0])] *= 0.9
    elif what == "next rates in smaller units":
        taken["T_next"] = [[0.5 * v for v in row] for row in taken["T_next"]]
    elif what == "another inverse":
        taken["inverse"] = [[0.5 * v for v in row] for row in taken["inverse"]]
    elif what.startswith("smaller bound "):
        name = what.removeprefix("smaller bound ")
        taken[name] = 0.9 * taken[name]
    elif what == "curvature made smaller":
        taken["curvature"] = [0.9 * v for v in taken["curvature"]]
    else:
        raise ValueError(what)
    return replace(design, certificate=design.certificate | {"proof": proof})


def rows_of(entry: Json) -> list[list[int]]:
    """The equations' multipliers of a step of the tube."""
    rows: list[list[int]] = entry["tube"]["equations"]["rows"]
    return rows


OF_EVERY_MODEL = [
    "tube cut by 2 %",
    "levels and reaches cut by 2 %",
    "assumption made smaller",
]
FORGERIES = [
    *OF_EVERY_MODEL,
    "no bound on the roots",
    "a bound that lets spurious roots in",
    "another nominal",
    "another model",
    "narrower data box",
    "equation left out of the proof",
    "multiplier of the bound on the roots left out",
    "spread of the roots made smaller",
    "no spread of the roots",
    "first extent made smaller",
    "second extent made smaller",
    "next rates in smaller units",
    "another inverse",
    "smaller bound kappa",
    "smaller bound kappa_next",
    "smaller bound state",
    "smaller bound rates",
    "smaller bound direct",
    "smaller bound through",
    "curvature made smaller",
]


@pytest.mark.parametrize("what", slow_among(FORGERIES, {"another nominal"}))
def test_a_forged_implicit_funnel_is_refused_though_every_digest_fits(
    what: str, tmp_path: Path
) -> None:
    proof = write(forged(designed(), what), tmp_path)
    with pytest.raises(CertificateRejected) as refusal:
        check(proof)
    assert not isinstance(refusal.value, CertificateMismatch)  # refused for what it says


def test_the_bound_on_the_roots_is_no_decoration(tmp_path: Path) -> None:
    """The same files, the model called explicit: the equation's roots are then no part of it."""
    design = designed()
    explicit = design.model.document() | {"kind": "state_map"}
    documents = {"model.json": explicit}
    policy = replace(design.policy, model=files.digest(explicit))
    documents["policy.json"] = policy.document()
    funnel = replace(design.funnel, model=policy.model, policy=files.digest(policy.document()))
    documents["funnel.json"] = funnel.document()
    about = {role: proofs.binding(f"{role}.json", documents[f"{role}.json"]) for role in ROLES}
    claim = {"kind": "sampled_funnel", "about": about}
    documents["funnel.proof.json"] = proofs.proof_document(claim, design.proof)
    for name, document in documents.items():
        files.write_document(tmp_path / name, document)
    with pytest.raises(CertificateRejected, match="should have shape"):
        check(tmp_path / "funnel.proof.json")


def test_the_monitor_flags_a_step_that_ends_at_a_root_beyond_the_proved_ones() -> None:
    design = designed()
    assert design.funnel.roots is not None
    narrow = replace(design.funnel, roots=1e-9 * design.funnel.roots)
    for funnel, status in ((design.funnel, Status.INSIDE), (narrow, Status.ASSUMPTION_VIOLATED)):
        monitor = Monitor([Stage(design.model, design.policy, funnel)])
        x = design.policy.x[0] + np.linalg.solve(funnel.S[0], [0.1 * funnel.tube[0], 0.0])
        u = design.policy(0, x)
        assert monitor.update(0.0, x, u).status is Status.INSIDE
        after = design.model(x, u)
        reading = monitor.update(PERIOD, after, design.policy(1, after))
        assert reading.status is status, reading.reason
        assert ("root" in reading.reason) == (status is not Status.INSIDE)


def test_the_monitor_reads_unknown_where_the_model_has_no_next_state() -> None:
    design = designed()
    model = replace(
        truth(), exponents=np.array([[0, 2, 0], [0, 0, 1]]), coefficients=np.array([[1e3], [1.0]])
    )  # w = v + 10 (v² + w²) has no root from v = 1 on
    other = resigned(design, model=model)
    monitor = other.monitor()
    start = other.policy.x[0] + np.array([0.0, 1.0])
    monitor.update(0.0, start, other.policy(0, start))
    reading = monitor.update(PERIOD, start, np.zeros(1))
    assert reading.status is Status.UNKNOWN
    assert "no next state" in reading.reason
