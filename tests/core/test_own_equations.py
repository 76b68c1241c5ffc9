"""Funnels of equations as a user writes them: motion, design, refusals that name their cause."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bags.pictures.tubes import draw_tube
from benchmarks.first_try import Truth, dubins, flexible_arm, lines_of, rocket, van_der_pol
from benchmarks.thesis.soundness import Simulation
from nlsid import (
    ContinuousTracking,
    Goal,
    NlsidError,
    Nominal,
    check,
    design,
    integrate_nominal,
    load,
    plan_motion,
)
from nlsid_core.arrays import FloatArray
from nlsid_core.design import design_funnel
from nlsid_core.design.continuous.diagnosis import TERMS, Diagnosis
from nlsid_core.dynamics import PiecewisePolynomial, Rates
from nlsid_core.errors import DataError, Infeasible, ShapeError
from tests.verbs import nlsid

MASSES = {"arm": 2.0}  # in kg; a rate that asks for another mass is wrong
PAGE = Path(__file__).parents[2] / "docs" / "howto-funnels.md"


def pendulum(x: Any, u: Any) -> Any:
    """An angle from upright in rad and its rate, and a torque."""
    return [x[1], 9.81 * np.sin(x[0]) + u[0]]


def upright(knots: int = 9, seconds: float = 1.0) -> Nominal:
    """At rest."""
    t = np.linspace(0, seconds, knots)
    return integrate_nominal(pendulum, lambda _: [0.0], t=t, start=[0.0, 0.0])


@pytest.mark.slow
def test_the_page_about_own_equations_says_what_its_code_does(tmp_path: Path) -> None:
    code = re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)[0]
    told = [float(number) for number in re.findall(r"# \[(.*?)\]", code)[0].split()]
    names: dict[str, Any] = {}
    exec(code.replace('"lane_change"', repr(str(tmp_path))), names)
    found = names["found"]
    assert found.funnel.widths(0.0) == pytest.approx(told, rel=0.02)
    assert check(tmp_path / "funnel.proof.json").margin > 0
    truth = Truth(names["rate"], found, 0)
    rng = np.random.default_rng(0)
    run = Simulation(truth, found.policy, found.funnel).boundary(starts=1000, rng=rng, substeps=10)
    assert run.violations == 0
    assert run.max_v > 0.9


@pytest.mark.slow
def test_the_page_writes_a_problem_for_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    (code,) = (block for block in blocks if "spring.json" in block)
    exec(code, {})
    said = nlsid("funnel", "spring", "--problem", "spring.json")
    assert "is applied every 0.0452548" in said
    assert "with a hold of 0.0452548 s, 0.283 of the half-widths are left" in said


@pytest.mark.slow
def test_a_rocket_lands_at_the_first_try_and_no_start_leaves() -> None:
    rate, problem = rocket()
    found = design(problem)
    assert found.funnel.widths(0.0)[0] > 0.3
    assert lines_of(rocket) <= 20
    rng = np.random.default_rng(0)
    truth = Truth(rate, found, 0)
    run = Simulation(truth, found.policy, found.funnel).boundary(starts=1000, rng=rng, substeps=10)
    assert run.violations == 0
    assert found.found.proved.pieces.kappa is not None
    assert np.ptp(np.log2(found.found.proved.pieces.kappa), axis=0).max() > 1  # it follows ρ


@pytest.mark.slow
def test_a_stiff_arm_gets_the_knots_that_its_springs_need() -> None:
    rate, problem = flexible_arm()
    found = design(problem)
    assert len(found.funnel.t) > len(problem.nominal.t)
    truth = Truth(rate, found, 0)
    rng = np.random.default_rng(0)
    run = Simulation(truth, found.policy, found.funnel).boundary(starts=1000, rng=rng, substeps=10)
    assert run.violations == 0
    assert run.max_v > 0.9


def test_an_oscillator_without_an_input_is_proved() -> None:
    found = design(van_der_pol()[1])
    assert (found.funnel.widths(0.0) > [0.9, 1.1]).all()


@pytest.mark.pictures
def test_a_design_that_is_read_again_has_its_policy_and_is_drawn(tmp_path: Path) -> None:
    design(ContinuousTracking(pendulum, upright(), goal=[0.2, 0.5])).save(tmp_path)
    read = load(tmp_path)
    with pytest.raises(ShapeError, match=r"states \(\.\.\., 2\), is given \(3,\)"):
        read.policy(0.0, [1, 2, 3])
    assert len(draw_tube(read).axes) == 3, "the two states against each other, and over time"


# -- the motion ----------------------------------------------------------------------------------


def test_a_motion_that_stays_at_an_equilibrium_is_one() -> None:
    def rate(x: Any, u: Any) -> Any:
        return [np.exp(-8 * x[1]) / 3 - 0.1 / x[0], (u[0] - x[1]) / 0.4]

    rest = np.nextafter(np.log(2.1 / 0.3) / 8, 1.0)
    found = plan_motion(rate, start=[2.1, rest], end=[2.1, rest], seconds=10, u=[rest])
    assert np.abs(rate(np.array([2.1, rest]), [rest])).max() > 0  # by rounding
    np.testing.assert_allclose(found.x.control, [[[2.1, rest]] * 4] * 24, atol=1e-9)


@pytest.mark.parametrize("gap", [1e-12, 1e-9, 1e-7])
def test_an_equilibrium_that_is_known_to_some_digits_is_one(gap: float) -> None:
    def rate(x: Any, u: Any) -> Any:
        return [np.tanh(x[1]) - np.tanh(0.3) + gap, u[0] - x[1]]

    found = plan_motion(rate, start=[0.3, 0.3], end=[0.3, 0.3], seconds=1, u=[0.3])
    assert np.ptp(found.x.control, axis=(0, 1)).max() < 10 * gap
    assert found.defect(Rates.numeric(rate, 2, 1))[0] < 1e-3 * max(10 * gap, 1e-9)


def test_one_state_may_rest_while_another_moves() -> None:
    def rate(x: Any, u: Any) -> Any:
        return [u[0] - np.tanh(x[0]), np.exp(u[1]) - np.exp(x[1])]

    found = plan_motion(rate, start=[0, 0.3], end=[1, 0.3], seconds=2, u=[0, 0.3])
    np.testing.assert_allclose(found.x.control[:, :, 1], 0.3, atol=1e-12)
    np.testing.assert_allclose(found.x.ends()[-1], [1, 0.3], atol=1e-12)


def test_a_pressure_that_rests_is_a_motion_though_its_rate_is_rounded_coarsely() -> None:
    def rate(x: Any, u: Any) -> Any:
        return [1e12 * (1e-5 * u[0] - 1e-8 * np.sqrt(x[0])), u[1] - x[1]]

    rest = [1e-3 * np.sqrt(1.1e6) * (1 + 1e-15), 0]
    assert abs(rate([1.1e6, 0], rest)[0]) > 1e-9  # Pa/s, of 1e7
    found = plan_motion(rate, start=[1.1e6, 0], end=[1.1e6, 0], seconds=1, u=rest)
    np.testing.assert_allclose(found.x.control[:, :, 0], 1.1e6, rtol=1e-12)


@pytest.mark.slow
def test_a_planned_motion_obeys_the_equations_and_its_limits() -> None:
    end = [np.pi / 2, 0.0]
    limits = [[-14.0, 14.0]]
    found = plan_motion(pendulum, start=[0, 0], end=end, seconds=2, u=[0], limits=limits)
    gap, _, _ = found.defect(Rates.numeric(pendulum, 2, 1))
    assert gap < 1e-3 * np.abs(found.x.derivative().control).max()
    assert found.x.ends()[-1] == pytest.approx(end)
    assert np.abs(found.u.ends()).max() <= 14.0
    followed = integrate_nominal(pendulum, found.u, t=found.t, start=[0.0, 0.0])
    assert followed.x.ends()[-1] == pytest.approx(end, abs=0.02)


@pytest.mark.slow
def test_an_uncertain_that_cannot_move_adds_nothing() -> None:
    def rate(x: Any, u: Any, w: Any) -> list[Any]:
        return [x[1], u[0] - np.sin(x[0]) + w[0]]

    box = [[0.0, 0.0]]
    still = lambda x, u: rate(x, u, [0.0])  # noqa: E731
    motion = plan_motion(still, start=[0, 0], end=[1, 0], seconds=2, u=[0])
    found = design(ContinuousTracking(rate, motion, goal=[0.2, 0.2], uncertain=box))
    assert found.verdict.margin > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate", "start", "end", "why"),
    [
        (pendulum, [0, 0], [3, 0], "more seconds"),
        (lambda x, u: [x[1], -(u[0] ** 2) * x[1]], [0, 1], [1, 1.2], r"x1 changes by 0\.2 more"),
        (lambda x, u: [x[1], u[0] ** 2 * x[1]], [0, 1], [1, 0.8], r"x1 changes by 0\.2 less"),
    ],
    ids=["too weak", "only brakes", "only pushes"],
)
def test_what_is_no_motion_is_not_returned(
    rate: Any, start: list[float], end: list[float], why: str
) -> None:
    with pytest.raises(Infeasible, match=why):
        plan_motion(rate, start=start, end=end, seconds=1, u=[0], limits=[[-1, 1]])


# -- goals, limits, weights ----------------------------------------------------------------------


@pytest.mark.slow
def test_half_widths_a_matrix_and_a_goal_are_the_same_goal() -> None:
    widths = np.array([0.2, 0.5])
    P = np.diag(widths**-2)
    skewed = P.copy()
    skewed[0, 1] += 4e-15
    found = [
        design_funnel(ContinuousTracking(pendulum, upright(), goal=goal)).funnel.rho
        for goal in (widths, P, skewed, Goal(np.zeros(2), P))
    ]
    for rho in found[1:]:
        assert rho == pytest.approx(found[0], rel=1e-9)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"goal": [0.2, -0.5]}, "half-widths should be positive"),
        ({"goal": [0.2]}, "2 half-widths, or an ellipsoid's"),
        ({"goal": [[25.0, 1.0], [0.0, 4.0]]}, "symmetric positive definite"),
        ({"goal": [0.2, 0.5], "limits": [-1, 1]}, "limits should be rows"),
        ({"goal": [0.2, 0.5], "uncertain": [[-1, 1]]}, "no argument w|function of some of"),
        ({"goal": [0.2, 0.5], "hold": 50.0}, "the hold of 50 s is longer than the motion"),
        ({"goal": "small"}, "the goal should be numbers, of one shape, is 'small'"),
        ({"goal": ["0.2", "0.5"]}, "the goal should be numbers"),
        ({"goal": [0.2, 0.5], "uncertain": 0.1}, "uncertain should be rows|function of some of"),
    ],
)
def test_what_cannot_be_right_says_so(options: Any, said: str) -> None:
    with pytest.raises(DataError, match=said):
        design_funnel(ContinuousTracking(pendulum, upright(), **options))


@pytest.mark.slow
def test_limits_are_pairs_too() -> None:
    found = design_funnel(
        ContinuousTracking(pendulum, upright(), goal=[0.2, 0.5], limits=[[-6, 6]])
    )
    assert found.policy.limits.tolist() == [[0, -6, 6]]


# -- refusals ------------------------------------------------------------------------------------


def refusal(rate: Any, nominal: Nominal, **options: Any) -> str:
    with pytest.raises(Infeasible) as told:
        design(ContinuousTracking(rate, nominal, **options))
    return str(told.value)


def blown(x: Any, u: Any, w: Any) -> Any:
    """The pendulum, pushed."""
    return [x[1], 9.81 * np.sin(x[0]) + u[0] + w[0]]


@pytest.mark.slow
def test_a_disturbance_that_is_too_strong_is_named() -> None:
    text = refusal(blown, upright(), goal=[0.02, 0.05], uncertain=[[-9.0, 9.0]])
    assert "The diagonal of Q is (2e+04, 3.2e+03) and of R is (50)" in text
    assert re.search(r"Because of the disturbance w: take a larger goal", text)
    assert re.search(r"the disturbance w takes .* 1/s \(\d+ %\)", text)


@pytest.mark.slow
def test_a_refusal_tells_of_the_place_that_was_not_passed_however_often_it_was_tried() -> None:
    rate, problem = dubins(1.0)
    text = refusal(rate, problem.nominal, goal=problem.goal, uncertain=problem.uncertain)
    found = re.search(r"lets V fall by (\S+) 1/s, and the disturbance w takes (\S+) 1/s", text)
    assert found
    assert float(found[1]) < float(found[2]), "else nothing was in the way"


@pytest.mark.slow
def test_a_goal_wider_than_the_equations_are_defined_gets_a_narrower_funnel() -> None:
    level = integrate_nominal(tank, lambda _: [1.0], t=np.linspace(0, 1, 5), start=[1.0])
    found = design(ContinuousTracking(tank, level, goal=[1.5]))
    assert 0.5 < found.funnel.widths(1.0)[0] < 1.0, "below an empty tank there is no root"
    assert found.verdict.margin > 0


def tank(x: Any, u: Any) -> Any:
    """A level, and what flows in."""
    return [u[0] - np.sqrt(x[0])]


def test_what_cannot_be_expanded_is_told_with_its_line_time_and_state() -> None:
    def filled(x: Any, u: Any) -> Any:
        return [u[0], np.log(x[0]) - x[1]]

    t = np.linspace(0, 1, 3)
    inflow, wet = np.full((2, 2, 1), 1.0), np.stack([[[0.0], [0.5]], [[0.5], [1.0]]])
    x = np.concatenate([wet, 0 * wet], axis=2)
    motion = Nominal(PiecewisePolynomial(t, x), PiecewisePolynomial(t, inflow))
    text = refusal(filled, motion, goal=[0.1, 0.1])
    assert re.search(r"cannot be expanded between 0 and 0\.0\d+ s: the logarithm of a value", text)
    assert "in `return [u[0], np.log(x[0]) - x[1]]`, because of x0 in [-" in text


def test_a_jump_of_rounding_is_none() -> None:
    t = np.linspace(0, 1, 3)
    x = PiecewisePolynomial(t, np.zeros((2, 2, 1)))
    for jump, kept in ((1e-17, False), (1e-9, True)):
        u = np.full((2, 2, 1), 0.1)
        u[1, 0] += jump + np.spacing(0.1)
        assert Nominal(x, PiecewisePolynomial(t, u)).u.is_continuous() is not kept
    with pytest.raises(DataError, match=r"x0 jumps by 1e-09 at 0\.5 s"):
        Nominal(PiecewisePolynomial(t, u - 0.1), x)


def test_a_term_that_leaves_v_falling_is_not_blamed() -> None:
    taken = dict.fromkeys(TERMS, 0.0) | {"disturbance": 386.0}
    fast = Diagnosis(11.0, 7990.0, taken, (0.1, 0.2))
    assert fast.dominant == "knots"
    assert "V falls by 7.6e+03 1/s at this instant" in str(fast)
    assert "take more knots, or feedback that acts slower (a larger R)" in str(fast)
    assert "disturbance" not in str(fast)
    assert Diagnosis(11.0, 380.0, taken, (0.1, 0.2)).dominant == "disturbance"


def test_a_shape_that_cannot_be_found_keeps_what_is_proved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: Any, **__: Any) -> FloatArray:
        raise Infeasible("nothing better")

    monkeypatch.setattr("nlsid_core.design.continuous.design.enlarge_shape", refuse)
    t = np.linspace(0, 1, 5)
    rate = lambda x: [-x[0] + x[0] ** 3, -x[1]]  # noqa: E731 - a function of x alone
    still = integrate_nominal(rate, lambda _: np.zeros(0), t=t, start=[0.0, 0.0])
    found = design_funnel(ContinuousTracking(rate, still, goal=[0.3, 0.3], shape="P"))
    assert "shape rho kept: nothing better" in found.found.history[-1][0]
    assert found.verdict.margin > 0


@pytest.mark.parametrize(
    ("rate", "options", "said"),
    [
        (lambda x, u: [x[1], x[2] + u[0]], {}, r"an entry that is not there.*x has 2 entries"),
        (lambda x, u: [x[1], np.sin(x[0]) + u[1]], {}, r"that is not there.*u has 1"),
        (blown, {"uncertain": 0.1}, r"rows \(low, high\) of w, is 0\.1"),
        (np.eye(2), {}, "dynamics should be a function or a VectorField"),
        (lambda x, u: [x[1], (x[0] + 2) ** 1.5 - 2**1.5 + u[0]], {}, "whatever the state"),
        (lambda x, u: [x[1], u[0] / (x[0] - x[0])], {}, "the dynamics divide by zero"),
        (lambda x, u: [x[1], u[0] * MASSES["load"]], {}, "cannot be expanded .KeyError: 'load'"),
        (lambda x, u: [x[1], np.sinc(x[0]) + u[0]], {}, "cannot be expanded .AttributeError"),
        (pendulum, {"policy": "lqr"}, "policy is 'lqr'; it should be a ContinuousPolicy"),
    ],
)
def test_equations_that_cannot_be_called_say_so(rate: Any, options: Any, said: str) -> None:
    with pytest.raises(NlsidError, match=said):
        design(ContinuousTracking(rate, upright(), goal=[0.2, 0.5], **options))


def test_what_is_no_problem_is_not_designed() -> None:
    with pytest.raises(DataError, match="one of OutputTube, SampledTracking, ContinuousTracking"):
        design(pendulum)  # type: ignore[call-overload]


def test_a_design_without_a_motion_says_what_is_missing() -> None:
    with pytest.raises(DataError, match="nominal is None; it should be a Nominal"):
        ContinuousTracking(pendulum, None, goal=[0.1, 0.1])  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"start": [np.nan, 0]}, "start and end should be finite"),
        ({"start": ["a", 0]}, "start should be numbers"),
        ({"seconds": "2"}, "seconds should be above 0, is '2'"),
        ({"u": None}, "give u"),
        ({"dynamics": lambda x, u: [x[1], u[0] * MASSES["load"]]}, "no value.*KeyError: 'load'"),
        ({"start": [0.3], "end": [0.0]}, "an entry that is not there"),
        ({"dynamics": lambda x, u: [x[1], 1j * u[0]]}, "have no value at t = 0, x = "),
        ({"dynamics": lambda x, u: [x[1], u[0] + math.sqrt(x[0] - 1)]}, "have no value at t"),
    ],
)
def test_a_motion_that_cannot_be_asked_for_says_so(changed: Any, said: str) -> None:
    asked: dict[str, Any] = {
        "dynamics": pendulum,
        "start": [0.3, 0],
        "end": [0, 0],
        "seconds": 1,
        "u": [0],
    }
    asked |= changed
    with pytest.raises(DataError, match=said):
        plan_motion(asked.pop("dynamics"), **asked)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_guess_where_the_equations_have_no_value_is_named() -> None:
    with pytest.raises(Infeasible, match="not finite on the path that is guessed: dx0/dt between"):
        plan_motion(lambda x, u: [u[0] - np.sqrt(x[0] - 2)], start=[0], end=[1], seconds=1, u=[0])


def test_a_state_to_integrate_from_that_is_no_state_is_named() -> None:
    t = np.linspace(0, 1, 5)
    with pytest.raises(DataError, match="the state should be n finite numbers"):
        integrate_nominal(pendulum, lambda _: [0.0], t=t, start=[np.nan, 0])
    with pytest.raises(DataError, match="an entry that is not there"):
        integrate_nominal(pendulum, lambda _: [0.0], t=t, start=[0.1])


@pytest.mark.parametrize(
    ("u", "t", "said"),
    [
        (None, [0, 1], "u should be a function of the time, is None"),
        (lambda t: [1 / (t - 1)], [0, 1], "u has no value at t = 1 .ZeroDivisionError"),
        (lambda t: [0.0] * (1 + (t > 0.5)), [0, 1], r"as many inputs at all times, returns \[1, 2"),
        (lambda _: ["a"], [0, 1], r"u\(0\) should be numbers"),
        (lambda _: [0.0], "0 1", "t should be numbers"),
        (lambda _: [0.0], [0, np.inf], "two or more times that increase"),
    ],
)
def test_inputs_that_cannot_be_followed_say_so(u: Any, t: Any, said: str) -> None:
    with pytest.raises(DataError, match=said):
        integrate_nominal(pendulum, u, t=t, start=[0.0, 0.0])


def test_functions_of_math_are_refused_with_what_to_take() -> None:
    def falls(x: Any, u: Any) -> Any:
        return [x[1], math.sin(x[0]) + u[0]]

    with pytest.raises(NlsidError, match=r"take NumPy's, such as np\.sin"):
        design_funnel(ContinuousTracking(falls, upright(), goal=[0.2, 0.5]))
