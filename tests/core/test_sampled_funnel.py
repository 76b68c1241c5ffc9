"""Sampled funnels of identified models: what is proved holds, its neighbours are refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bags.designs.provenance import of_proof
from nlsid import SampledTracking, check
from nlsid_core import proofs
from nlsid_core.arrays import FloatArray
from nlsid_core.design.sampled.design import TrackingDesign, design_state_funnel
from nlsid_core.design.sampled.motion import plan_motion
from nlsid_core.errors import CertificateRejected, DataError, Infeasible
from tests.core.kernel import refusals
from tests.decided import decided
from tests.forged_tracking import CONTRADICTIONS, FORGERIES
from tests.funnel_files import PROOF, files_of, forged_by, write
from tests.marks import slow_among
from tests.tracked import (
    STEPS,
    assumption,
    designed,
    pendulum,
    step,
    tracked,
)


def test_a_funnel_of_a_nonlinear_model_is_proved_exactly(tmp_path: Path) -> None:
    verdict = check(designed().save(tmp_path)[-1])
    assert verdict.margin > 0
    assert "response" in verdict.assumptions[0]


def test_reaches_are_tight_to_one_percent_of_what_starts_on_the_boundary_do() -> None:
    design = designed()
    rng = np.random.default_rng(1)
    z = rng.standard_normal((4000, 2))
    z /= np.linalg.norm(z, axis=1)[:, None]
    for k in range(0, STEPS, 6):
        x = design.policy.x[k] + design.funnel.inlet[k] * z @ np.linalg.inv(design.funnel.S[k]).T
        moved = (step(design, k, x) - design.policy.x[k + 1]) @ design.funnel.S[k + 1].T
        farthest = np.linalg.norm(moved, axis=1).max()
        reach = design.proof["steps"][k]["inlet"]["reach"]
        assert 0.99 * reach < farthest <= reach


def test_the_worst_disturbance_inside_the_assumption_stays_in_the_tube() -> None:
    design = designed()
    largest = adversary(design, design.funnel.tube[0] * circle(180), np.zeros((180, 2)), 0)
    assert max(largest) <= 1.0
    assert largest[0] > 0.999  # of the radius; later samples cannot all be worst in one run


def test_every_step_of_the_tube_is_tight_to_one_percent_under_the_worst_disturbance() -> None:
    """From all that the claim allows at a sample, radius and response, to the next sample."""
    design = designed()
    funnel = design.funnel
    for k in range(STEPS):
        start = funnel.tube[k] * circle(360)
        for response in (-1.0, 0.0, 1.0):
            r = response * funnel.assumption.bound * circle(360)
            assert adversary(design, start, r, k, last=k + 1)[0] <= 1.0
        assert adversary(design, start, np.zeros((360, 2)), k, last=k + 1)[0] > 0.99


def circle(count: int) -> FloatArray:
    """(count, 2) directions."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def adversary(
    design: TrackingDesign, xi: FloatArray, r: FloatArray, k: int, *, last: int = STEPS
) -> list[float]:
    """Largest |S x̄|/radius at samples k + 1 … last, from x̄ = ξ + r in units of S at sample k.

    The disturbance pushes away from the nominal, and against what comes, as far as is allowed.
    """
    funnel, policy, bound = design.funnel, design.policy, 0.9999 * design.funnel.assumption.bound
    found = []
    for sign in (1.0, -1.0):
        r_now = r @ np.linalg.inv(funnel.S[k]).T
        x = policy.x[k] + xi @ np.linalg.inv(funnel.S[k]).T + r_now
        sizes = []
        for i in range(k, last):
            S, after = funnel.S[i + 1], step(design, i, x)
            carried = r_now @ funnel.A[i].T
            away = (after - carried - policy.x[i + 1]) @ S.T
            pushed = away / np.linalg.norm(away, axis=1)[:, None] @ np.linalg.inv(S).T
            r_now = sign * bound * pushed
            x = after - carried + r_now
            size = np.linalg.norm((x - policy.x[i + 1]) @ S.T, axis=1)
            sizes.append(float(np.max(size)) / float(funnel.radius[i + 1]))
        found.append(sizes)
    return [max(pair) for pair in zip(*found, strict=True)]


@pytest.mark.parametrize("what", slow_among(FORGERIES, {"another nominal"}))
def test_a_forged_funnel_is_refused_though_every_digest_fits(what: str) -> None:
    forge, reason = FORGERIES[what]
    refusals.refused_with_fresh_digests(forged_by(forge, files_of(designed())), reason)


@pytest.mark.parametrize("what", CONTRADICTIONS)
def test_an_assumption_that_contradicts_what_was_measured_is_named(
    what: str, tmp_path: Path
) -> None:
    true, forged = files_of(designed()), forged_by(CONTRADICTIONS[what], files_of(designed()))
    assert not of_proof(write(true, tmp_path)).wrong
    proof = write(forged, tmp_path)
    assert decided(proof)
    assert of_proof(proof).wrong


def test_a_policy_swapped_without_new_digests_is_a_mismatch() -> None:
    swapped = forged_by(FORGERIES["gain 3 % smaller"][0], files_of(designed()))
    with refusals.refused("mismatch"):
        proofs.decide(swapped[PROOF], swapped)


def test_commissioning_on_the_fitting_bags_is_refused_before_anything_is_written() -> None:
    base = tracked()
    borrowed = replace(assumption(), measured_on=base.model.bags)
    with pytest.raises(CertificateRejected, match="fitted on"):
        design_state_funnel(
            SampledTracking(base.model, base.policy, base.feedback, assumption=borrowed)
        )


def test_a_disturbance_too_large_for_the_goal_is_infeasible_and_says_where() -> None:
    base = tracked()
    with pytest.raises(Infeasible, match="at sample"):
        design_state_funnel(
            SampledTracking(base.model, base.policy, base.feedback, assumption=assumption(1.0))
        )


def test_a_motion_out_of_reach_of_the_data_is_infeasible() -> None:
    with pytest.raises(Infeasible, match="out of reach"):
        plan_motion(pendulum(), [0.0, 0.0], [1.1, 0.0], steps=5)
    with pytest.raises(DataError, match="angle"):
        plan_motion(pendulum(), [0.0, 0.0], [1.3, 0.0], steps=50)
