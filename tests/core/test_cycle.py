"""Funnels that end inside their start, against simulations of the whole oscillator and wheel."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from examples import hopper, limit_cycle, rimless_wheel
from nlsid_core.arrays import FloatArray
from nlsid_core.design import (
    ContinuousTracking,
    FunnelDesign,
    closed_cycle,
    design,
    integrate_nominal,
)
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import DataError, Infeasible

TURNS = 3


def decaying(hold: float | None = None, rate: float = -1.0) -> FunnelDesign:
    """A funnel of dx/dt = rate x + u around 0, for one second."""
    field = VectorField.from_function(lambda x, u: [rate * x[0] + u[0]], 1, 1)
    still = integrate_nominal(field, lambda _: np.zeros(1), t=np.linspace(0, 1, 5), start=[0.0])
    return design(ContinuousTracking(field, still, goal=[0.5], hold=hold))


@pytest.mark.slow
def test_every_start_of_the_ring_comes_to_the_published_limit_cycle() -> None:
    found = limit_cycle.designed()
    funnel = found.funnel
    assert limit_cycle.amplitude(funnel) == pytest.approx(limit_cycle.PUBLISHED, abs=2e-6)
    (r,), (start,), (end,) = funnel.nominal(0.0), funnel.widths(0.0), funnel.widths(funnel.tf)
    assert start > 10 * end, "the ring is wide"
    assert "ends in the goal" in str(found.verdict)
    goal = found.claim["goal"]
    assert goal["P"][0][0] ** -0.5 == pytest.approx(start, rel=1e-6), "the goal is the start"
    assert goal["centre"] == [r]

    def oscillator(_: float, z: FloatArray) -> list[float]:
        x, y = z
        return [y - (x**3 / 3 - x), -x]

    def half_turn(_: float, z: FloatArray) -> float:
        return float(z[1])

    half_turn.direction = 1.0  # type: ignore[attr-defined]
    half_turn.terminal = True  # type: ignore[attr-defined]
    for radius in (r - start, r + start):
        z = np.array([radius, -1e-9])
        for _ in range(TURNS):
            solved = solve_ivp(oscillator, (0, 20), z, events=half_turn, rtol=1e-10, atol=1e-12)
            (z,) = solved.y_events[0]
            assert z[0] < 0, "half a turn ends on the other side"
            assert abs(-z[0] - r) <= end
            z = np.array([-z[0], -1e-9])  # the oscillator is odd


def steps(speed: float) -> Iterator[tuple[float, float]]:
    """(speed before, speed after the impact) of steps of the wheel, θ(t) from its own equation."""
    a, slope = rimless_wheel.ALPHA, rimless_wheel.SLOPE

    def struck(_: float, z: FloatArray) -> float:
        return float(z[0] - slope - a)

    struck.terminal = True  # type: ignore[attr-defined]
    while True:
        solved = solve_ivp(
            lambda _, z: [z[1], rimless_wheel.GRAVITY * np.sin(z[0])],
            (0, 20), [slope - a, speed], events=struck, rtol=1e-10, atol=1e-12,
        )  # fmt: skip
        ((_, before),) = solved.y_events[0]
        speed = float(before * np.cos(2 * a))
        yield float(before), speed


@pytest.mark.slow
@pytest.mark.parametrize("side", [-1, 1])
def test_a_wheel_that_starts_in_its_funnel_walks_on_for_ever(side: int) -> None:
    found = rimless_wheel.designed()
    funnel = found.funnel
    (speed,), (start,), (end,) = (
        funnel.nominal(funnel.t0), funnel.widths(funnel.t0), funnel.widths(funnel.tf),
    )  # fmt: skip
    assert np.cos(2 * rimless_wheel.ALPHA) * end < start, "what the impact leaves is inside"
    walked = steps(speed + side * start)
    for _ in range(TURNS):
        before, after = next(walked)
        assert abs(before - funnel.nominal(funnel.tf)[0]) <= end
        assert abs(after - speed) <= start
    assert after == pytest.approx(rimless_wheel.PUBLISHED, abs=0.2 * start)


def hops(found: FunnelDesign, start: FloatArray, gust: float) -> Iterator[tuple[float, float]]:
    """(V on landing, V on leaving the ground again) of hops in time; w has the sign of dx/dt."""
    policy, funnel = found.policy, found.funnel
    e, x, speed = hopper.SPEED + start[0], *start[1:]

    def across(z: FloatArray) -> tuple[float, FloatArray]:
        """The phase and the state across it, from y, dy/dt, x, dx/dt."""
        ground = np.sqrt(z[1] ** 2 + 2 * hopper.GRAVITY * max(z[0], 0.0))
        phase = float(np.clip(-z[1] / ground, -1, 1))
        return phase, np.array([ground - hopper.SPEED, z[2], z[3]])

    def flying(_: float, z: FloatArray) -> list[float]:
        u = float(policy(*across(z))[0])
        return [z[1], -hopper.GRAVITY, z[3], u + gust * np.sign(z[3])]

    def landed(_: float, z: FloatArray) -> float:
        return float(z[0])

    landed.terminal, landed.direction = True, -1.0  # type: ignore[attr-defined]
    while True:
        run = solve_ivp(flying, (0, 9), [1e-9, e, x, speed], events=landed, rtol=1e-8, atol=1e-10)
        z = run.y_events[0][0]
        low = float(funnel.value(funnel.tf, across(z)[1][None])[0])
        e, x, speed = -0.8 * z[1] + 0.2 * hopper.SPEED, z[2], 0.9 * z[3]
        again = np.array([e - hopper.SPEED, x, speed])
        yield low, float(funnel.value(funnel.t0, again[None])[0])


@pytest.mark.slow
def test_a_hopper_that_starts_in_its_funnel_hops_on_for_ever() -> None:
    """Simulated in time, until it touches the ground: how long a hop lasts is not known before."""
    found = hopper.designed()
    funnel, rng = found.funnel, np.random.default_rng(2)
    P = funnel.shape(funnel.t0)
    for start in rng.normal(size=(8, 3)):
        start /= np.sqrt(start @ P @ start)
        hopping = hops(found, 0.9999 * start, hopper.GUST)
        for _ in range(TURNS):
            assert max(next(hopping)) < 1
    assert max(next(hops(found, 0.9999 * start, 30 * hopper.GUST))) > 1, "a storm is seen"


def test_a_cycle_closes_up_to_the_reset_that_the_widths_allow() -> None:
    found = decaying()
    start, end = found.funnel.widths(0.0)[0], found.funnel.widths(1.0)[0]
    closed = closed_cycle(found, reset=[[0.5]])
    assert closed.claim["goal"]["P"][0][0] == pytest.approx(
        0.25 * found.funnel.shape(0.0)[0, 0], rel=1e-6
    )
    with pytest.raises(Infeasible, match="does not end inside its start"):
        closed_cycle(found, reset=[[1.01 * start / end]])
    closed_cycle(found, reset=[[0.99 * start / end]])


@pytest.mark.parametrize("reset", [[[0.0]], [[1.0, 0.0]]])
def test_a_reset_without_an_inverse_is_refused(reset: Any) -> None:
    with pytest.raises(DataError, match="invertible"):
        closed_cycle(decaying(), reset=reset)


def test_a_held_funnel_is_not_closed() -> None:
    with pytest.raises(DataError, match="held into the next cycle"):
        closed_cycle(decaying(hold=0.01))
