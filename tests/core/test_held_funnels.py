"""Funnels whose input is held between samples and whose state is measured wrong."""

import re
from typing import Any

import numpy as np
import pytest

from benchmarks.thesis.soundness import Simulation
from nlsid import (
    ContinuousTracking,
    Monitor,
    Status,
    VectorField,
    design,
    integrate_nominal,
    plan_motion,
)
from nlsid_core import proofs
from nlsid_core.design import FunnelDesign
from nlsid_core.errors import DataError, Infeasible, OptionError
from nlsid_core.running.held import Held, slowest
from nlsid_core.running.stage import Stage
from tests.core.kernel import refusals
from tests.falling_pendulum import tracking
from tests.forged_held import HELD_FORGERIES
from tests.funnel_files import PROOF, Files, bind, files_of, forged_by
from tests.marks import slow_among

HOLD = 0.01  # s
ERROR = [0.002, 0.01]


@pytest.fixture(scope="module")
def held() -> FunnelDesign:
    """Held and measured wrong."""
    return design(tracking(hold=HOLD, error=ERROR))


@pytest.fixture
def files(held: FunnelDesign) -> Files:
    """Its documents."""
    return files_of(held)


def largest(found: FunnelDesign, *, hold: float) -> float:
    """The largest V of simulated runs from the boundary, with the input held."""
    parts = found.model, found.policy, found.funnel
    error = np.asarray(found.claim.get("error", np.zeros(found.funnel.n)))
    run = Simulation(*parts).held(hold=hold, error=error, starts=500, rng=np.random.default_rng(5))
    return run.max_v


@pytest.mark.slow
def test_a_design_says_what_the_hold_and_the_errors_cost(held: FunnelDesign) -> None:
    free = design(tracking(hold=1e-6))  # its gain is linear, as a held policy's is
    widths, unheld = (found.funnel.widths(found.funnel.t0) for found in (held, free))
    said = str(held)
    named = "with a hold of 0.01 s and the errors of the measured state"
    part = re.search(rf"{named}, ([\d.]+) of the half-widths are left", said)
    assert part, said
    proved = widths[0] / unheld[0]  # what was found without is a little more than is proved
    assert 0.97 * proved < float(part[1]) <= proved
    assert f"at 0 s: x0 {widths[0]:.3g}, x1 {widths[1]:.3g}; without, x0 " in said
    assert "samples should come every 0.008 s or more often" in said
    assert "left" not in str(design(tracking())), "without a hold nothing is lost to one"


def test_runs_that_are_held_and_measured_wrong_stay_inside(held: FunnelDesign) -> None:
    assert largest(held, hold=HOLD) < 1
    assert largest(held, hold=HOLD / 3) < 1
    assert largest(held, hold=20 * HOLD) > 1, "the simulation does hold"


@pytest.mark.slow
def test_the_claim_says_how_often_and_how_wrong(held: FunnelDesign) -> None:
    said = held.verdict.assumptions[0]
    assert "applied every 0.01 s or more often" in said
    assert "measured wrong by at most: x0 by 0.002, x1 by 0.01" in said
    assert "no hold" in design(tracking()).verdict.assumptions[0]


def test_a_hold_is_only_proved_of_what_starts_inside(held: FunnelDesign) -> None:
    """An input that remembers a state from outside drives a solution out that has come in."""
    assert "every solution that starts in it at a time from 0 to 1 s" in str(held.verdict)
    assert "not before the solution's start" in str(held.verdict)
    period = slowest(HOLD)
    monitor = Monitor([Stage(held.model, held.policy, held.funnel, Held(period, HOLD))])
    outside = held.funnel.nominal(0.0) + np.array([2.0, 0.0])
    said = [monitor.update(0.0, outside, held.policy(0.0, outside))]
    for t in period * np.arange(1, 5):
        x = held.funnel.nominal(t)
        said.append(monitor.update(t, x, held.policy(t, x)))
    assert Status.INSIDE not in {reading.status for reading in said}
    assert all("did not start in the funnel" in reading.reason for reading in said)


def test_an_input_is_not_held_from_stage_to_stage(files: Files) -> None:
    bind(files)
    about = {stage: proofs.binding(PROOF, files[PROOF]) for stage in ("stage1", "stage2")}
    claim = {"kind": "funnel_composition", "about": about}
    document = proofs.proof_document(claim, {"multipliers": [1.0]})
    with refusals.refused("not_valid"):
        proofs.decide(document, files)


@pytest.mark.slow
def test_holding_costs_room(held: FunnelDesign) -> None:
    free = design(tracking())
    assert 0.2 < held.funnel.volume(0.0) / free.funnel.volume(0.0) < 1


LONG = {"an input that turns more slowly", "rates of one sign", "a rate piece less"}


@pytest.mark.parametrize("what", slow_among(HELD_FORGERIES, LONG))
def test_what_is_a_little_more_than_was_proved_is_refused(files: Files, what: str) -> None:
    forge, reason = HELD_FORGERIES[what]
    refusals.refused_with_fresh_digests(forged_by(forge, files), reason)


@pytest.mark.slow
def test_an_input_that_is_clipped_may_be_held_too() -> None:
    """ẋ = x - x³/3 + clip(u), which asks for more than it gets at its funnel's edge."""
    field = VectorField.from_function(lambda x, u: x - x**3 / 3 + u, 1, 1)
    nominal = integrate_nominal(field, lambda _: [0.0], t=np.linspace(0, 0.5, 5), start=[0.0])
    found = design(
        ContinuousTracking(
            field, nominal, goal=[[1.0]], limits=[[0, -0.6, 0.8]], hold=0.02, Q=[[1.0]], R=[[1.0]]
        )
    )
    edge = found.funnel.widths(0.0)[0]
    assert found.policy.K.control[0, 0, 0, 0] * edge > 1.5, "more than twice what it gets"
    assert largest(found, hold=0.02) < 1
    assert "every 0.02 s or more often" in found.verdict.assumptions[0]


@pytest.mark.slow
def test_a_clipped_input_of_several_states_may_be_held_too() -> None:
    """The angle enters nonlinearly and the rate does not: the proof takes the rate first."""
    found = design(tracking(limits=[[-4.5, 3.0]], hold=HOLD))
    assert "u0 clipped to [-4.5, 3]" in found.verdict.assumptions[0]
    assert largest(found, hold=HOLD) < 1


def test_without_an_input_there_is_nothing_to_hold() -> None:
    field = VectorField.from_function(lambda x: -x, 1, 0)
    nominal = integrate_nominal(field, lambda _: np.zeros(0), t=np.linspace(0, 1, 5), start=[0.0])
    with pytest.raises(DataError, match="there is no input to hold"):
        design(ContinuousTracking(field, nominal, goal=[[1.0]], hold=0.01))


@pytest.mark.slow
def test_errors_of_0_are_none() -> None:
    found = design(tracking(error=[0.0, 0.0]))
    assert "error" not in found.claim
    assert (found.funnel.rho == design(tracking()).funnel.rho).all()


@pytest.mark.slow
def test_where_limits_are_far_away_a_refusal_blames_the_hold() -> None:
    def rate(x: Any, u: Any) -> Any:
        return [x[1], 5 * x[0] + u[0]]

    motion = plan_motion(rate, start=[0, 0], end=[0, 0], seconds=1, u=[0])
    with pytest.raises(Infeasible, match="Because of an input that is held") as refusal:
        design(ContinuousTracking(rate, motion, goal=[0.1, 0.3], limits=[[-50, 50]], hold=0.1))
    assert "the inputs' limits" not in str(refusal.value)


@pytest.mark.slow
def test_a_hold_that_no_funnel_survives_is_refused_with_what_it_does() -> None:
    with pytest.raises(Infeasible, match=r"may be 1 s old.*of which .* is the plan's own change"):
        design(tracking(hold=1.0))


@pytest.mark.slow
def test_the_largest_hold_is_found_and_said() -> None:
    found = design(tracking(hold="largest"))
    assert HOLD <= found.claim["hold"] < 0.1
    assert f"every {found.claim['hold']} s or" in found.verdict.assumptions[0]
    assert largest(found, hold=found.claim["hold"]) < 1


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"hold": 0.0}, "hold is 0.0"),
        ({"hold": "longest"}, "hold is 'longest'"),
        ({"hold": True}, "seconds above 0"),
        ({"error": "small"}, "2 bounds of 0 or more"),
        ({"error": [0.1]}, "2 bounds of 0 or more"),
        ({"error": [0.1, -0.1]}, "2 bounds of 0 or more"),
    ],
)
def test_what_cannot_be_held_is_refused(options: Any, reason: str) -> None:
    with pytest.raises(OptionError, match=reason):
        design(tracking(**options))


@pytest.mark.slow
def test_a_hold_of_inputs_that_are_not_affine_is_proved_of_a_function() -> None:
    def squared(x: Any, u: Any) -> Any:
        return [u[0] + u[0] ** 2 - 0.1 * x[0]]

    field = VectorField.from_function(squared, 1, 1)
    nominal = integrate_nominal(field, lambda _: [0.1], t=np.linspace(0, 1, 5), start=[0.0])
    with pytest.raises(DataError, match="affine in each input: give them as a function"):
        design(ContinuousTracking(field, nominal, goal=[[25.0]], hold=0.01))
    found = design(ContinuousTracking(squared, nominal, goal=[[25.0]], hold=0.01))
    assert found.claim["hold"] == 0.01
    assert not found.model.squares_inputs
    ran = Simulation(field, found.policy, found.funnel).held(
        hold=0.01, error=np.zeros(1), starts=200, rng=np.random.default_rng(0)
    )
    assert ran.violations == 0
    assert ran.max_v > 0.9
