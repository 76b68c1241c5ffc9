"""Forecasts from a tube's present estimate: no output that keeps the assumption leaves them."""

from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from operator import mul
from typing import Any

import numpy as np
import pytest

from nlsid import Monitor, Status
from nlsid_core.arrays import FloatArray
from nlsid_core.design import OutputTubeDesign
from nlsid_core.errors import DataError
from nlsid_core.funnels.level import LevelMeter
from nlsid_core.funnels.tube import TubeFunnel
from nlsid_core.running.comparison import Centre
from nlsid_core.running.forecast import Forecast, linear_form, reach
from nlsid_core.running.stage import Stage
from nlsid_core.running.stepping import Stepper
from tests.core.kernel.tube_claims import HIGH, LONG, LOW, MODELS, design
from tests.marks import slow_among

AHEAD = 12
EVERY = pytest.mark.parametrize("name", slow_among(MODELS, LONG))


def alone(name: str, i: int = 0, *, peak: bool = True) -> tuple[Any, TubeFunnel]:
    """A model and a funnel of its tube i only, with or without what is assumed of its peak."""
    made = design(name)
    tube = made.funnel.tubes[i]
    kept = tube
    if not peak and tube.peak is not None:  # the energy alone bounds what is direct too
        direct = (1.0 - (1.0 - tube.peak.direct) ** 2) * np.diag(np.linalg.inv(tube.R))
        kept = replace(
            tube,
            peak=replace(tube.peak, at_most=np.full_like(tube.peak.at_most, 1e9)),
            half_widths=(1.0 + 1e-7) * np.sqrt(tube.level * (1.0 / tube.tau + direct)),
        )
    return made.model, replace(made.funnel, tubes=(kept,))


def attack(
    model: Any, funnel: TubeFunnel, kind: str, samples: int, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Outputs (samples, p) and inputs (samples, n_u) of a robot that keeps the tube's assumption.

    It is what innovations make of the observer: `spent`, all that is left from time to time and
    nothing between; `random`, any part in any direction; `sign`, away from the simulation.
    """
    tube, rng, stepper = funnel.tubes[0], np.random.default_rng(seed), Stepper(model)
    p, n_u, lags = len(stepper.y), len(stepper.u), funnel.settling
    u, y = np.zeros((samples, n_u)), np.zeros((samples, p))
    x = np.tile(stepper.begin(y[:lags], u[:lags]), (2, 1))
    meter = None if tube.follows is None else LevelMeter(tube.follows)
    if meter is not None:
        for now in u[:lags]:
            meter.update(now.tolist())
    spent = 0.0
    for k in range(lags, samples):
        u[k] = rng.uniform(LOW, HIGH, n_u) if rng.random() < 0.2 else u[k - 1]
        outputs, x = stepper.advance(x, u[k])
        level = tube.level * (1.0 if meter is None else meter.update(u[k].tolist()))
        left = max(level - tube.rho * spent, 0.0) * (1.0 - 1e-9)
        away = np.sign(outputs[0] - outputs[1] + 1e-12 * rng.normal(size=p)) * rng.random(p)
        direction = away if kind == "sign" else rng.normal(size=p)
        part = {"spent": float(rng.random() < 0.1), "random": rng.random(), "sign": 1.0}[kind]
        e = direction * np.sqrt(part * left / (direction @ tube.R @ direction))
        if tube.peak is not None:
            most = tube.peak.at_most * np.sqrt(max(1.0, level / tube.level))
            e /= max(1.0, float((np.abs(e) / most).max()) * (1.0 + 1e-9))
        spent = tube.rho * spent + float(e @ tube.R @ e)
        y[k], x[0] = outputs[0] + e, x[0] + tube.L @ e
    return y, u


def forecasts(
    model: Any, funnel: TubeFunnel, y: FloatArray, u: FloatArray
) -> Iterator[tuple[int, Forecast]]:
    """That of every third judged sample k, for the AHEAD after it."""
    monitor = Monitor([Stage(model, None, funnel)])
    for k in range(len(y) - AHEAD):
        reading = monitor.update(k * model.period, y[k], u[k])
        if reading.status is not Status.UNKNOWN and k % 3 == 0:
            yield k, monitor.forecast(u[k + 1 : k + 1 + AHEAD])


def used(forecast: Forecast, y: FloatArray) -> FloatArray:
    """How far from its middle the outputs (AHEAD, p) are, 1 at its ends; as many as it has."""
    middle, half = (forecast.low + forecast.high) / 2, (forecast.high - forecast.low) / 2
    return np.asarray(np.abs(y[: len(middle)] - middle) / half)


@EVERY
def test_no_output_that_keeps_the_assumption_leaves_its_forecast(name: str) -> None:
    for i, tube in enumerate(design(name).funnel.tubes):
        model, funnel = alone(name, i)
        samples = 80 if tube.samples is None else funnel.settling + tube.samples
        most, count = 0.0, 0
        for kind in ("spent", "random", "sign"):
            y, u = attack(model, funnel, kind, samples, seed=1)
            for k, forecast in forecasts(model, funnel, y, u):
                times = model.period * np.arange(1, len(forecast.t) + 1)
                assert forecast.t == pytest.approx(times)
                assert (len(forecast.t) == AHEAD) == (forecast.reason == "")
                part = used(forecast, y[k + 1 :])
                most, count = max(most, float(part.max(initial=0.0))), count + len(part)
        assert count > 0.2 * AHEAD * (samples - AHEAD)
        assert 0.7 < most <= 1.0


@pytest.mark.slow
@EVERY
@pytest.mark.parametrize("peak", [True, False])
def test_no_output_of_thousands_leaves_its_forecast(name: str, peak: bool) -> None:
    model, funnel = alone(name, peak=peak)
    for kind in ("spent", "random", "sign"):
        y, u = attack(model, funnel, kind, 1500, seed=2)
        for k, forecast in forecasts(model, funnel, y, u):
            assert used(forecast, y[k + 1 :]).max(initial=0.0) <= 1.0


def test_a_linear_forecast_is_reached_at_every_sample() -> None:
    """The worst innovations by Cauchy and Schwarz: e_q = B ρ^-(h-1-q) R⁻¹ c_q' / reach."""
    model, funnel = alone("linear", peak=False)
    tube, linear = funnel.tubes[0], linear_form(model)
    assert linear is not None
    A, C = linear.A, linear.C[0]
    lags, zero = funnel.settling, np.zeros((AHEAD, 1))
    for h in range(1, AHEAD + 1):
        monitor, stepper = Monitor([Stage(model, None, funnel)]), Stepper(model)
        x = stepper.begin(np.zeros((lags, 1)), np.zeros((lags, 1)))[None]
        u = np.zeros(1)
        for k in range(lags + 1):
            y = np.zeros(1)
            if k == lags:  # nothing is spent before
                predicted, x = stepper.advance(x, u)
                y = predicted[0]
            monitor.update(k * model.period, y, u)
        forecast = monitor.forecast(zero)
        powers = [np.linalg.matrix_power(A, h - 2 - q) for q in range(h - 1)]
        gains = [*(float(C @ power @ tube.L[:, 0]) for power in powers), 1.0]
        weights = np.array([tube.rho ** (h - 1 - q) for q in range(h)])
        e = np.array(gains) / weights
        e *= np.sqrt(tube.level / (weights @ e**2))
        for q in range(h):
            predicted, x = stepper.advance(x, u)
            y = predicted[0] + e[q]
            x = x + tube.L[:, 0] * e[q]
        assert 0.0 <= forecast.high[h - 1, 0] - y[0] < 1e-6 * tube.half_widths[0]


@EVERY
def test_a_peak_bounds_the_next_output_and_is_reached_where_there_is_one(name: str) -> None:
    model, funnel = alone(name)
    tube = funnel.tubes[0]
    assert tube.peak is not None
    p, lags = len(tube.R), funnel.settling
    u = np.zeros((lags + 3, len(Stepper(model).u)))
    monitors = [Monitor([Stage(model, None, f)]) for f in (funnel, alone(name, peak=False)[1])]
    stepper = Stepper(model)
    x = stepper.begin(np.zeros((lags, p)), u[:lags])[None]
    for k in range(lags + 1):
        y = np.zeros(p)
        if k == lags:
            predicted, x = stepper.advance(x, u[k])
            y = predicted[0]
        for monitor in monitors:
            monitor.update(k * model.period, y, u[k])
    (with_peak, without) = (monitor.forecast(u[lags + 1 :]) for monitor in monitors)
    assert (with_peak.low >= without.low).all()
    assert (with_peak.high <= without.high).all()
    (predicted,), _ = stepper.advance(x, u[lags + 1])
    g = 1.0 if tube.follows is None else float(tube.follows.along(u)[lags + 1])
    single = max(g, 1.0) * tube.peak.at_most @ np.abs(tube.R) @ tube.peak.at_most
    most = np.sqrt(min(single, g * tube.level) * np.diag(np.linalg.inv(tube.R)))
    least = np.minimum(most, np.sqrt(g) * tube.half_widths)
    assert (with_peak.high[0] >= predicted + (1.0 - 1e-7) * least).all()
    assert (with_peak.high[0] <= predicted + (1.0 + 1e-7) * most).all()


@pytest.mark.parametrize(
    "name", ["linear", pytest.param("implicit_linear", marks=pytest.mark.slow)]
)
def test_the_reach_of_a_linear_model_is_above_the_exact_one_and_close(name: str) -> None:
    model, funnel = alone(name, peak=False)
    linear, tube = linear_form(model), funnel.tubes[0]
    assert linear is not None
    exact, bound = exact_reach(tube, linear), reach(tube, linear, AHEAD)
    assert tube.peak is not None
    direct = 1.0 - (1.0 - tube.peak.direct) ** 2
    ever = 1.0 / tube.tau + direct * np.diag(np.linalg.inv(tube.R))
    for h in range(AHEAD):
        for j, value in enumerate(exact[h]):
            least = min(value, Fraction(float(ever[j])))
            assert least <= Fraction(float(bound[h, j])) <= least * (1 + Fraction(3, 10**8))


def exact_reach(tube: Any, linear: Any) -> list[list[Fraction]]:
    """Σ ρ^-(q+1) C_j A^q L R⁻¹ L'A^q' C_j' + R⁻¹_jj of these float64, in fractions."""

    def of(M: FloatArray) -> list[list[Fraction]]:
        return [[Fraction(v) for v in row] for row in np.atleast_2d(M).tolist()]

    def times(X: Any, Y: Any) -> list[list[Fraction]]:
        columns = list(zip(*Y, strict=True))
        return [[sum(map(mul, row, column)) for column in columns] for row in X]

    A, C, G, (p, R) = of(linear.A), of(linear.C), of(tube.L), (len(tube.R), of(tube.R))
    if p == 1:
        inverse = [[1 / R[0][0]]]
    else:
        d = R[0][0] * R[1][1] - R[0][1] * R[1][0]
        inverse = [[R[1][1] / d, -R[0][1] / d], [-R[1][0] / d, R[0][0] / d]]
    totals, found = [inverse[j][j] for j in range(p)], []
    weight = 1 / Fraction(tube.rho)
    for _ in range(AHEAD):
        found.append(list(totals))
        rows = times(C, G)
        spread = times(times(rows, inverse), list(zip(*rows, strict=True)))
        totals = [total + weight * spread[j][j] for j, total in enumerate(totals)]
        weight /= Fraction(tube.rho)
        G = times(A, G)
    return found


@pytest.mark.parametrize("name", slow_among(("cascade", "two_following", "implicit_ray"), LONG))
def test_forecasting_leaves_the_run_where_it_is(name: str) -> None:
    model, funnel = alone(name)
    y, u = attack(model, funnel, "random", 60, seed=3)
    looking, plain = Monitor([Stage(model, None, funnel)]), Monitor([Stage(model, None, funnel)])
    for k in range(len(y)):
        expected = plain.update(k * model.period, y[k], u[k])
        assert str(looking.update(k * model.period, y[k], u[k])) == str(expected)
        looking.forecast(u[k : k + 5])


def test_where_nothing_is_known_nothing_is_forecast_and_it_says_why() -> None:
    model, funnel = alone("linear")
    monitor = Monitor([Stage(model, None, funnel)])
    waiting = monitor.forecast(np.zeros((3, 1)))
    assert (len(waiting.t), waiting.reason) == (0, "no run has begun")
    for k in range(20):
        monitor.update(k * model.period, [100.0 * (k == 19)], np.zeros(1))
    assert monitor.forecast(np.zeros((3, 1))).reason == "what the tube assumes is broken, or over"
    model, funnel = alone("implicit_box")
    monitor = Monitor([Stage(model, None, funnel)])
    for k in range(20):
        monitor.update(k * model.period, np.zeros(1), np.zeros(1))
    assert "outside the box" in monitor.forecast(np.full((3, 1), 50.0)).reason


def test_around_a_plan_there_is_no_forecast(tube: OutputTubeDesign) -> None:
    monitor = tube.monitor(centre=Centre.PROFILE)
    with pytest.raises(DataError, match="around the model's simulation"):
        monitor.forecast(np.zeros((1, 1)))
