"""The searches beside the sweep: the sampled relaxation, which proves nothing, and alternations."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.thesis.alternation import exponential_start
from benchmarks.thesis.relaxation import sample_funnel
from benchmarks.thesis.soundness import Simulation
from nlsid import ContinuousTracking, Design, Nominal, VectorField, check, integrate_nominal
from nlsid_core.design import FunnelDesign, design_funnel
from nlsid_core.design.continuous.pieces import prove_pieces
from nlsid_core.design.continuous.setting import Setting, prepare
from nlsid_core.design.continuous.shape import solve_ends
from nlsid_core.design.continuous.vstep import enlarging, samples_of
from nlsid_core.design.continuous.vstep_program import GAP
from nlsid_core.designs import AnyDesign
from nlsid_core.errors import CertificateRejected, DataError, Infeasible
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.polynomial.values import monomial_values
from tests.funnel_problem import hanging, hung

GOAL = 20 * np.eye(2)
WEIGHTS: Any = {"Q": np.eye(2), "R": np.eye(1)}
DEFAULTS: Any = {"policy": None} | WEIGHTS


def pulsed() -> tuple[VectorField, Nominal]:
    """Stable at 0, 1 and 2 s, and unstable in between, where knots do not look."""
    field = VectorField.from_function(
        lambda t, x: np.array([x[0] * (20 * (t * (1 - t) * (2 - t)) ** 2 - 0.5)]), 1, 0
    )
    t = np.array([0.0, 1.0, 2.0])
    return field, integrate_nominal(field, lambda _: np.zeros(0), t=t, start=[0.0])


# -- time samples ----------------------------------------------------------------------------


def test_what_holds_at_samples_is_left_in_between_and_cannot_be_made_proved(
    tmp_path: Path,
) -> None:
    field, nominal = pulsed()
    options: Any = {"goal": np.eye(1), "Q": np.zeros((1, 1))}
    found = sample_funnel(ContinuousTracking(field, nominal, **options), samples=2)
    assert str(found).startswith("NOT PROVED")
    assert not hasattr(found, "certificate")
    assert not hasattr(found, "save")
    setting = prepare(ContinuousTracking(field, nominal, **options))
    parts = (field, setting.policy, found.funnel)
    run = Simulation(*parts).boundary(starts=100, rng=np.random.default_rng(1), substeps=50)
    assert run.violations == 100
    proved = prove_pieces(setting.steps, found.funnel)
    assert proved.unproved
    # What was proved of it, written as if it were all there is to prove.
    basis = proved.pieces.basis.tolist()
    proof = {
        "margin": 1.0,
        "basis": basis,
        "multiplier": basis,
        "pieces": [],
        "goal_multiplier": 0.995,
    }
    goal = {"centre": setting.goal.centre.tolist(), "P": setting.goal.P.tolist()}
    claim = {"kind": "continuous_funnel", "goal": goal}
    forged: AnyDesign = Design(*parts, {"claim": claim, "proof": proof})
    with pytest.raises(CertificateRejected, match="pieces should be a list of 1 to"):
        check(forged.save(tmp_path)[-1])


def test_more_samples_see_more_and_agree_with_the_proof_where_it_is_smooth() -> None:
    with pytest.raises(Infeasible, match=r"no funnel at t = 1\.5 s"):
        sample_funnel(ContinuousTracking(*pulsed(), goal=np.eye(1), Q=np.zeros((1, 1))), samples=3)
    sampled = sample_funnel(ContinuousTracking(*hanging(), goal=GOAL))
    assert 0.999 <= sampled.volumes[0] / volume_of(hung()) < 1.01


def test_a_sample_at_one_end_only_is_refused() -> None:
    with pytest.raises(DataError, match="its two ends are the least"):
        sample_funnel(ContinuousTracking(*hanging(), goal=GOAL), samples=1)


# -- the general P(t) --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def setting() -> Setting:
    return prepare(ContinuousTracking(*hanging(), goal=GOAL, **DEFAULTS))


def test_v_steps_grow_the_funnel_and_it_is_proved() -> None:
    found = hung("P")
    assert volume_of(found) > 1.05 * volume_of(hung())
    assert np.min(found.found.proved.margins) > 0
    volumes = [volume for _, volume in found.found.history[1:]]
    assert (np.diff(volumes) > 0).all()


def volume_of(design: FunnelDesign) -> float:
    return design.funnel.volume_integral()


def no_start_leaves(design: FunnelDesign) -> bool:
    """Pushed at every step as is worst."""
    run = Simulation(design.model, design.policy, design.funnel).boundary(
        starts=500, rng=np.random.default_rng(4), adversary=True
    )
    return run.violations == 0 and run.max_v > 0.9


def test_the_trust_region_holds_and_without_it_the_linearised_volume_runs_further(
    setting: Setting,
) -> None:
    """Σ trace(D) is the volume's slope at D = 0; far from there it is no volume."""
    steps = setting.steps
    rho = exponential_start(steps, setting.P).rho
    P = setting.P / rho[:, None, None]
    funnel = ContinuousFunnel(setting.policy.x, (P + P.transpose(0, 2, 1)) / 2, np.ones(9), "", "")
    samples = samples_of(steps, funnel.P, solve_ends(steps, funnel), 0.0)
    v = monomial_values(steps.program.basis, steps.program.points)
    largest = {}
    for trust in (0.05, 0.2):
        D = enlarging(samples, v, np.ones(8), [np.zeros((0, 2))] * 8, trust)
        largest[trust] = np.abs(np.linalg.eigvalsh(D)).max()
        assert largest[trust] <= trust + 1e-4
    assert largest[0.05] == pytest.approx(0.05, rel=GAP)
    assert largest[0.2] > 0.1


@pytest.mark.slow
def test_p_of_a_pushed_field_grows_and_no_push_leads_out() -> None:
    """Three pushes, each bounded with κ."""
    field = VectorField.from_function(
        lambda x, w: np.array([x[1] + w[0], -x[0] - x[1] + w[1] + x[0] ** 3 / 9 + w[2]]),
        2,
        0,
        uncertain=[[-0.01, 0.01]] * 3,
    )
    t = np.linspace(0, 2, 9)
    nominal = integrate_nominal(field, lambda _: np.zeros(0), t=t, start=[0.0, 0.0])
    rho, design = (
        design_funnel(ContinuousTracking(field, nominal, goal=GOAL, shape=s)) for s in ("rho", "P")
    )
    assert design.model.is_pushed
    assert volume_of(design) > 1.25 * volume_of(rho)
    assert no_start_leaves(design)


@pytest.mark.slow
def test_p_of_a_limited_torque_grows_and_no_start_leaves() -> None:
    rho, design = (
        design_funnel(ContinuousTracking(*hanging(5), goal=GOAL, limits=[[-0.4, 0.4]], shape=s))
        for s in ("rho", "P")
    )
    assert volume_of(design) > 1.1 * volume_of(rho)
    assert no_start_leaves(design)
    edge = design.funnel.outline(0.0, (0, 1))
    asked = (edge - design.policy.x(0.0)) @ design.policy.K(0.0).T
    assert np.abs(asked).max() > 0.4, "more than there is"


@pytest.mark.slow
def test_p_stays_where_a_taylor_polynomial_is_valid() -> None:
    def boat(x: Any, u: Any) -> Any:  # across its course, heading
        return np.array([np.sin(x[1]), u[0]])

    t = np.linspace(0, 2, 9)
    nominal = integrate_nominal(boat, lambda _: np.zeros(1), t=t, start=np.zeros(2))
    rho, design = (
        design_funnel(ContinuousTracking(boat, nominal, goal=GOAL, shape=s)) for s in ("rho", "P")
    )
    assert volume_of(design) > 1.09 * volume_of(rho) > 1.09, "a best cubic is valid far out"
    for k, t0 in enumerate(design.funnel.t[:-1].tolist()):
        box = {entry: (low, high) for entry, low, high in design.model.validity(k)}
        for at in (t0, float(design.funnel.t[k + 1])):
            widths = np.sqrt(np.diag(np.linalg.inv(design.funnel.shape(at))))
            for entry in set(box) & {0, 1}:
                assert box[entry][0] <= -widths[entry]
                assert widths[entry] <= box[entry][1]


def test_a_design_knows_how_it_was_found() -> None:
    assert set(hung().found.seconds) == {"policy", "rho", "proof"}
    assert hung().found.history[0] == ("rho", volume_of(hung()))
