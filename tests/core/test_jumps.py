"""Funnels that jump into each other: what a bouncing body does, the files, and what is refused."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from bags.commands.cli import app
from bags.designs.bundle import Bundle
from bags.designs.documents import funnel_of
from examples import bouncer, compass_gait
from nlsid_core import documents
from nlsid_core.arrays import FloatArray
from nlsid_core.design import (
    ContinuousTracking,
    Goal,
    compose_jumps,
    design,
    goal_before,
    integrate_nominal,
)
from nlsid_core.designs import COMPOSITION, HYBRID
from nlsid_core.dynamics import Jump
from nlsid_core.errors import (
    CertificateRejected,
    DataError,
    DocumentError,
    Infeasible,
    OptionError,
    ShapeError,
)
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.proofs import check
from tests.core.kernel.oracle_hybrid import worst_jump

Found = tuple[Path, Jump]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Found:
    """The proof of the bouncer's flight, and its landing."""
    design, landing = bouncer.designed()
    return design.save(tmp_path_factory.mktemp("flight"))[-1], landing


def landings(
    rate: Callable[[FloatArray, FloatArray], FloatArray], policy: ContinuousPolicy, jump: Jump,
    X: FloatArray, step: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """States (N, n) where the guard is first 0 after its start, and when, by Runge-Kutta steps.

    A step in which it falls below 0 is halved until the guard is 0 to 1e-12.
    """

    def moved(t: FloatArray, X: FloatArray, h: FloatArray) -> FloatArray:
        def f(when: FloatArray, at: FloatArray) -> FloatArray:
            away = at - policy.x(when)
            u = policy.clipped(policy.u(when) - np.einsum("nij,nj->ni", policy.K(when), away))
            return rate(at, u)

        half, h_ = h / 2, h[:, None]
        a = f(t, X)
        b = f(t + half, X + h_ / 2 * a)
        c = f(t + half, X + h_ / 2 * b)
        return X + h_ / 6 * (a + 2 * b + 2 * c + f(t + h, X + h_ * c))

    t, X = np.full(len(X), policy.x.t[0]), X.copy()
    last = float(policy.x.t[-1])
    flying = np.ones(len(X), dtype=bool)
    while flying.any() and t[flying].min() < last - 1e-9:
        h = np.minimum(step, last - t[flying])
        before, at = X[flying], t[flying]
        then = moved(at, before, h)
        hit = (at + h >= jump.start) & (jump.height(then) <= 0)
        low, high = np.zeros(int(hit.sum())), h[hit]
        for _ in range(40 if hit.any() else 0):
            middle = (low + high) / 2
            above = jump.height(moved(at[hit], before[hit], middle)) > 0
            low, high = np.where(above, middle, low), np.where(above, high, middle)
        if hit.any():
            then[hit] = moved(at[hit], before[hit], high)
        X[flying], t[flying] = then, at + np.where(hit, 0.0, h)
        landed = np.flatnonzero(flying)[hit]
        t[landed] += high
        flying[landed] = False
    assert not flying.any(), "the guard was not met before the funnel ends"
    return X, t


def boundary(funnel: ContinuousFunnel, count: int) -> FloatArray:
    """Points of its start's boundary."""
    z = np.random.default_rng(4).normal(size=(count, funnel.n))
    return funnel.boundary(funnel.t0, z / np.linalg.norm(z, axis=1)[:, None])


def bounced(found: Found, count: int, step: float) -> tuple[int, FloatArray]:
    """How many of the starts on the boundary leave the funnel's start at the jump, and V after."""
    funnel = ContinuousFunnel.load(found[0].with_name("funnel.json"))
    policy = ContinuousPolicy.load(found[0].with_name("policy.json"))

    def rate(X: FloatArray, U: FloatArray) -> FloatArray:
        return np.stack([X[:, 1], U[:, 0] - bouncer.GRAVITY], axis=1)

    X, t = landings(rate, policy, found[1], boundary(funnel, count), step)
    assert (t > found[1].start).all()
    assert np.ptp(t) > 0.05, "landings are far apart in time"
    V = funnel.value(funnel.t0, np.array(found[1](X)))
    return int((V > 1).sum()), V


def test_every_bounce_from_the_boundary_is_inside_again_and_some_come_near(found: Found) -> None:
    left, V = bounced(found, 60, 0.02)
    assert left == 0
    assert V.max() > 0.4, "the claim is not far from what happens"


@pytest.mark.slow
def test_no_bounce_of_a_thousand_leaves(found: Found) -> None:
    left, V = bounced(found, 1000, 0.005)
    print("largest V after the landing", V.max())
    assert left == 0


@pytest.fixture(scope="module")
def gait(tmp_path_factory: pytest.TempPathFactory) -> Found:
    """The proof of the compass gait's step, and its strike, composed into a cycle."""
    design, strike = compass_gait.designed()
    path = design.save(tmp_path_factory.mktemp("step"))[-1]
    whole = compose_jumps([path], [strike], path.parent / "gait")
    said = str(check(whole))
    assert "stage1 jumps into stage1, so for ever" in said
    assert "cubic Taylor models" in said
    return path, strike


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_no_step_of_a_thousand_compass_gaits_leaves(gait: Found) -> None:
    """The true dynamics and the true strike, from the boundary, in the states of the funnel."""
    funnel = ContinuousFunnel.load(gait[0].with_name("funnel.json"))
    policy = ContinuousPolicy.load(gait[0].with_name("policy.json"))

    def rate(X: FloatArray, U: FloatArray) -> FloatArray:
        return np.stack(compass_gait.shaped(X.T, U.T), axis=1)

    X, t = landings(rate, policy, gait[1], boundary(funnel, 1000), 0.002)
    V = funnel.value(
        funnel.t0, np.stack(compass_gait.shaped_struck(X.T), axis=1) @ compass_gait.SHAPE.T
    )
    print("strikes from", t.min(), "to", t.max(), "s; largest V after the strike", V.max())
    assert (t > gait[1].start).all()
    assert int((V > 1).sum()) == 0
    assert V.max() > 0.02, "starts are not all the same"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_compass_gait_is_the_published_one(gait: Found) -> None:
    """The swing leg is ahead, and the foot in the air, from before the guard is watched."""
    start, seconds = compass_gait.striking()
    apart = (start[1] - start[0]) / 2
    assert (apart, seconds) == pytest.approx(compass_gait.PUBLISHED, abs=7e-4)
    funnel = ContinuousFunnel.load(gait[0].with_name("funnel.json"))
    legs = compass_gait.BACK[:2]
    for t in np.linspace(0.5, gait[1].start, 50):
        centre, around = legs @ funnel.nominal(t), legs @ np.linalg.inv(funnel.shape(t)) @ legs.T
        lift = centre.sum() + 2 * compass_gait.SLOPE
        assert lift > np.sqrt(around.sum()), "above the ground"
        assert centre[0] - centre[1] > 0.3, "legs apart, the swing leg ahead"


@pytest.mark.slow
def test_no_point_of_the_ground_in_the_funnel_is_taken_out_of_its_start(found: Found) -> None:
    funnel = ContinuousFunnel.load(found[0].with_name("funnel.json")).document()
    worst, points = worst_jump(found[1].document(), funnel, funnel, 300, np.random.default_rng(0))
    assert points > 2000
    assert 0.4 < worst < 1


def test_the_command_line_composes_with_jumps_and_checks(found: Found, tmp_path: Path) -> None:
    found[1].save(tmp_path / "landing.json")
    runner, whole = CliRunner(), tmp_path / "whole"
    made = runner.invoke(app, ["compose", str(found[0]), "--jump", str(tmp_path / "landing.json"),
                               "--out", str(whole)])  # fmt: skip
    assert made.exit_code == 0, made.output
    assert "5 files of its stages and jumps" in " ".join(made.output.split())
    checked = runner.invoke(app, ["check", str(whole / HYBRID)])
    assert checked.exit_code == 0
    assert "PROVED hybrid funnel of 1 stage" in checked.output
    jump = documents.load(whole / "jump1.json")
    assert isinstance(jump, Jump)
    assert jump.document() == found[1].document()


def test_what_runs_beside_a_robot_refuses_it_with_the_reason(found: Found, tmp_path: Path) -> None:
    path = compose_jumps([found[0]], [found[1]], tmp_path)
    assert check(path).margin > 0
    with pytest.raises(CertificateRejected, match="are proved and not run"):
        Bundle.load(funnel_of(tmp_path))
    shutil.copytree(tmp_path, tmp_path / "renamed")
    renamed = (tmp_path / "renamed" / HYBRID).rename(tmp_path / "renamed" / COMPOSITION)
    with pytest.raises(CertificateRejected, match="are proved and not run"):
        Bundle.load(renamed)
    names = [p.name for p in tmp_path.glob("*.json") if p.name != HYBRID]
    roles = {n.removesuffix(".json").removesuffix(".proof"): n for n in names}
    contents = {role: (tmp_path / name).read_bytes() for role, name in roles.items()}
    forged = Bundle(contents | {"proof": path.read_bytes()})
    with pytest.raises(CertificateRejected, match="are proved and not run"):
        forged.decided()


def test_stages_and_jumps_that_do_not_fit_are_refused(found: Found, tmp_path: Path) -> None:
    path, landing = found
    with pytest.raises(DataError, match="1 funnels take 0 jumps, or one more for a cycle"):
        compose_jumps([path], [landing, landing], tmp_path)
    with pytest.raises(DataError, match="2 funnels take 1 jumps"):
        compose_jumps([path, path], [], tmp_path)
    late = Jump.of(lambda x: [x[0]], bouncer.landed, 2, start=0.51)
    with pytest.raises(DataError, match=r"0\.51 s on, which is no knot .* take 0\.5 s"):
        compose_jumps([path], [late], tmp_path)
    one = Jump.of(lambda x: [x[0]], lambda x: [x[0]], 1, start=landing.start)
    with pytest.raises(DataError, match="leads from 1 states to 1"):
        compose_jumps([path], [one], tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_jump_that_is_not_proved_says_where(found: Found, tmp_path: Path) -> None:
    springy = Jump.of(lambda x: [x[0]], lambda x: [x[0], -x[1]], 2, start=found[1].start)
    with pytest.raises(Infeasible, match=r"jump 1: .* between \d"):
        compose_jumps([found[0]], [springy], tmp_path)
    early = Jump.of(lambda x: [x[0] - 0.7], bouncer.landed, 2, start=found[1].start)
    with pytest.raises(Infeasible, match=r"not above 0 on all of the funnel at 0\.5 s"):
        compose_jumps([found[0]], [early], tmp_path)
    never = Jump.of(lambda x: [x[0] + 1.0], bouncer.landed, 2, start=found[1].start)
    with pytest.raises(Infeasible, match=r"not below 0 on all of the funnel at 1\.1 s"):
        compose_jumps([found[0]], [never], tmp_path)


def test_a_goal_before_a_jump_is_what_leads_into_the_inlet_to_first_order() -> None:
    """Steady flight, no thruster beside it: a deviation moves the landing, and the reset's image.

    By hand: at the landing (0, -v) a deviation (a, b) crosses at (0, b - a·(acceleration)/v) to
    first order, with the acceleration of that time.
    """
    field, nominal = bouncer.flight()
    landing = Jump.of(lambda x: [x[0]], bouncer.landed, 2, start=0.5)
    inlet = Goal(np.array([0.0, bouncer.SPEED]), np.diag([1e-12, 1.0]))
    goal = goal_before(landing, field, nominal, inlet)
    v = float(nominal.x(bouncer.SECONDS)[1])
    pull = float(nominal.u(bouncer.SECONDS)[0]) - bouncer.GRAVITY
    late = nominal.t[-1] - bouncer.SECONDS
    at_end = np.array([0.01, 0.02])
    a, b = at_end[0] - late * at_end[1], at_end[1]
    after = -bouncer.RESTITUTION * (b - a * pull / v)
    beyond = nominal.x.ends()[-1][0]
    known = after**2 + (at_end[0] / (0.9 * beyond)) ** 2
    assert at_end @ goal.P @ at_end == pytest.approx(known, rel=1e-4)
    early = Jump.of(lambda x: [x[0] + 2.0], bouncer.landed, 2, start=0.5)
    with pytest.raises(DataError, match=r"should cross the guard after 0\.5 s and end beyond it"):
        goal_before(early, field, nominal, inlet)


def test_a_reset_that_is_no_polynomial_is_covered_by_its_remainder() -> None:
    """The true reset is between the vertices of the stored one, all over the box."""

    def reset(x: Any) -> list[Any]:
        return [x[1], x[0] * np.cos(x[1])]

    box = np.array([[-0.5, 0.3], [0.1, 0.6]])
    jump = Jump.of(lambda x: [x[0] - x[1]], reset, 2, start=0.0, box=box)
    assert len(jump.uncertain) == 1
    assert "Taylor" in jump.expansion
    X = np.random.default_rng(2).uniform(box[:, 0], box[:, 1], (2000, 2))
    true = np.array([reset(x) for x in X])
    low, high = jump(X, [-1.0]), jump(X, [1.0])
    assert (np.minimum(low, high) <= true + 1e-12).all()
    assert (np.maximum(low, high) >= true - 1e-12).all()
    assert 0 < np.abs(high - low).max() < 0.02
    again = Jump.from_document(jump.document())
    assert again.document() == jump.document()
    with pytest.raises(DataError, match="give a box"):
        Jump.of(lambda x: [x[0]], reset, 2, start=0.0)


def test_a_reset_that_is_extended_along_a_flow_is_the_same_on_the_guard() -> None:
    def reset(x: Any) -> list[Any]:
        return [x[1] * x[2], x[0] + x[2] ** 3, x[0] * x[1] - 2.0]

    jump = Jump.of(lambda x: [x[0] + 2 * x[1] - 0.3], reset, 3, start=0.0)
    flow = np.array([1.0, -3.0, 0.7])
    along = jump.along(flow)
    rng = np.random.default_rng(3)
    X = rng.normal(size=(50, 3))
    X[:, 0] = 0.3 - 2 * X[:, 1]
    assert along(X) == pytest.approx(jump(X), abs=1e-12)
    assert along(X) == pytest.approx(np.array([reset(x) for x in X]), abs=1e-12)
    moved = X + 0.01 * flow
    by_flow, by_itself = np.abs(along(moved) - jump(X)), np.abs(jump(moved) - jump(X))
    assert by_flow.max() < 0.05 * by_itself.max(), "direction is rounded to few bits only"
    with pytest.raises(DataError, match="should be affine, and the flow should cross it"):
        jump.along([2.0, -1.0, 5.0])


def test_what_is_multiplied_after_an_expansion_has_no_more_remainders() -> None:
    def reset(x: Any) -> list[Any]:
        return [x[1], np.sin(x[0])]

    M = np.array([[1.0, -2.0], [0.5, 3.0], [0.0, 1.0]])
    box = [[-0.3, 0.3], [-1.0, 1.0]]
    jump = Jump.of(lambda x: [x[0]], reset, 2, start=0.0, box=box, then=M)
    assert (len(jump.uncertain), len(jump.reset)) == (1, 3)
    X = np.random.default_rng(1).uniform(-0.3, 0.3, (200, 2))
    true = np.stack(reset(X.T), axis=1) @ M.T
    spread = np.abs(jump(X, [1.0]) - jump(X, [-1.0])) / 2
    assert (np.abs(true - jump(X)) <= spread + 1e-12).all()
    with pytest.raises(ShapeError, match="then should have shape"):
        Jump.of(lambda x: [x[0]], reset, 2, start=0.0, box=box, then=np.eye(3))


def test_a_damaged_jump_is_refused(found: Found) -> None:
    document = found[1].document()
    for damage in ({"states": 0}, {"guard": None}, {"reset": [1]}, {"valid": [[9, 0.0, 1.0]]}):
        with pytest.raises((DocumentError, DataError)):
            Jump.from_document(document | damage)
    square = [{"exponents": [[0, 0, 2]], "coefficients": [1.0]}] * 2
    with pytest.raises(DataError, match="not affine in each uncertain w"):
        Jump.from_document(document | {"uncertain": [[0.0, 1.0]], "reset": square})


def draining(x: Any, u: Any, w: Any) -> list[Any]:
    """The level of a tank in m, under a flow that is not known to 0.01 m/s."""
    return [-0.6 * np.sqrt(x[0]) + u[0] + w[0]]


def drained(start: float = 0.0, **options: Any) -> tuple[ContinuousTracking, Jump]:
    """From 1 m to below 0.4 m, where another stage begins, and the guard of that."""
    still = lambda x, u: draining(x, u, [0.0])  # noqa: E731
    motion = integrate_nominal(still, lambda _: [0.0], t=np.linspace(0, 1.6, 9), start=[1.0])
    low = Jump.of(lambda x: [x[0] - 0.4], lambda x: [x[0]], 1, start=start)
    goal = goal_before(low, still, motion, Goal(np.array([0.4]), np.array([[400.0]])))
    goal = Goal(goal.centre, goal.P / 0.8**2)
    return ContinuousTracking(
        draining, motion, goal=goal, uncertain=[[-0.01, 0.01]], **options
    ), low


def test_a_funnel_keeps_above_the_guard_where_it_begins_to_be_watched() -> None:
    problem, low = drained()
    free = design(problem).funnel
    assert free.widths(0.0)[0] > 0.6  # the motion begins 0.6 m above the guard
    kept = design(replace(problem, jump=low)).funnel
    assert kept.widths(0.0)[0] == pytest.approx(0.9 * 0.6)
    assert kept.widths(1.6) == pytest.approx(free.widths(1.6))


@pytest.mark.parametrize(
    ("start", "options", "reason"),
    [
        (0.1, {}, "which is no knot of the motion: take"),
        (1.4, {}, "the motion is not above the guard at 1.4 s"),
        (0.0, {"hold": 0.01}, "held into the next stage"),
        (0.0, {"shape": "P"}, "without hold, error, decay or jump"),
    ],
)
def test_a_stage_that_cannot_end_with_its_jump_is_refused(
    start: float, options: Any, reason: str
) -> None:
    problem, low = drained(**options)
    t = problem.nominal.t
    near = float(t[np.abs(t - start).argmin()])
    start = near if abs(near - start) < 1e-9 else start
    with pytest.raises(DataError, match=reason):
        design(replace(problem, jump=replace(low, start=start)))


def test_a_jump_of_other_states_or_none_is_refused() -> None:
    problem, _ = drained()
    other = Jump.of(lambda x: [x[0]], lambda x: [x[0], x[1]], 2, start=0.0)
    with pytest.raises(DataError, match="the jump is of 2 states, the motion of 1"):
        design(replace(problem, jump=other))
    with pytest.raises(OptionError, match="a Jump, or None"):
        replace(problem, jump="landing")  # type: ignore[arg-type]
