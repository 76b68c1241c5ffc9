"""Implicit models of mechanisms: physical coefficients come back, spurious roots do not."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from nlsid_core import documents, files
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.design.sampled import closed_loop
from nlsid_core.design.sampled.implicit_step import ImplicitStep
from nlsid_core.errors import SolverError
from nlsid_core.identification.states import identify_states
from nlsid_core.kernel.sampled_step import Sample, implicit_step
from nlsid_core.models.trapezoidal import TrapezoidalModel
from tests.implicit_pendulum import EXPONENTS, PERIOD, PHYSICS, truth


def recorded(repeats: int = 4) -> Dataset:
    """Two excitations, repeated with new noise."""
    runs = []
    for group in range(2):
        u = np.repeat(np.random.default_rng(group).uniform(-3.0, 3.0, 60), 20)[:, None]
        x = truth().simulate([0.0, 0.0], u)[:-1]
        for repeat in range(repeats):
            noise = np.random.default_rng([group, repeat]).standard_normal(x.shape)
            runs.append(
                Trajectory(
                    t=np.arange(len(u)) * PERIOD,
                    y=x + np.array([1e-3, 1e-2]) * noise,
                    u=u,
                    name=f"run_{group}_{repeat}",
                    group=f"excitation_{group}",
                )
            )
    return Dataset(tuple(runs))


def identified(data: Dataset) -> TrapezoidalModel:
    """Fitted to data, the first trajectory validating."""
    fit = identify_states(data, Dataset(data.trajectories[:1]), degrees=[(3, 1, 1)], implicit=True)
    assert isinstance(fit.model, TrapezoidalModel)
    return fit.model


def coefficient(model: TrapezoidalModel, exponent: list[int]) -> float:
    row = np.flatnonzero((model.exponents == exponent).all(axis=1))[0]
    return float(model.coefficients[row, 0])


def test_the_accelerations_coefficients_are_the_physical_ones() -> None:
    model = identified(recorded())
    for exponent, value in zip(EXPONENTS.tolist(), PHYSICS[:, 0], strict=True):
        assert coefficient(model, exponent) == pytest.approx(value, rel=0.05, abs=0.02)


def test_a_step_satisfies_the_equations_it_states() -> None:
    model, x, u = truth(), np.array([0.7, -1.0]), np.array([0.4])
    following = model(x, u)
    residual = model.equations()[0](np.concatenate([x, u, following[1:]]))
    assert abs(float(residual)) < 1e-12
    assert following[0] == pytest.approx(x[0] + PERIOD / 2 * (x[1] + following[1]))


def test_a_step_that_has_no_root_is_an_error() -> None:
    cubic = replace(truth(), exponents=np.array([[0, 2, 0]]), coefficients=np.array([[1e3]]))
    with pytest.raises(SolverError, match="no next rate"):  # w - 10 w² = 11 at v = 1
        cubic([0.0, 1.0], [0.0])


def test_steps_of_many_states_are_those_of_each() -> None:
    model, rng = truth(), np.random.default_rng(3)
    x, u = rng.uniform(-1, 1, (5, 2)), rng.uniform(-3, 3, (5, 1))
    each = [model(a, b) for a, b in zip(x, u, strict=True)]
    np.testing.assert_allclose(model(x, u), each, rtol=0, atol=1e-15)


def test_the_linearised_step_is_the_slope_of_steps() -> None:
    model, x, u, step = truth(), np.array([0.6, -1.2]), np.array([0.8]), 1e-6
    slopes = [
        (model(x + step * e[:2], u + step * e[2:]) - model(x - step * e[:2], u - step * e[2:]))
        / (2 * step)
        for e in np.eye(3)
    ]
    np.testing.assert_allclose(np.hstack(model.linearised(x, u)), np.array(slopes).T, atol=1e-8)


def test_a_trapezoidal_model_reads_back_from_its_document_bit_for_bit() -> None:
    text = files.encode(truth().document())
    again = documents.read(files.parse_document(text), source="model")
    assert isinstance(again, TrapezoidalModel)
    assert files.encode(again.document()) == text


def test_the_proved_reach_of_an_implicit_step_bounds_the_models_own_steps() -> None:
    """Around the origin, x = size z, u = -2 z0 - z1, the next rate 3 w."""
    model, size = truth(), np.array([0.5, 2.0])
    unit = closed_loop.exact(np.diag(1 / size))
    at = Sample(
        x=[Fraction(0)] * 2,
        u=[Fraction(0)],
        K=closed_loop.exact([[2.0 / size[0], 1.0 / size[1]]]),
        x_next=[Fraction(0)] * 2,
        S=unit,
        S_next=unit,
        A=unit,
    )
    ring, T = closed_loop.ring_of(3), closed_loop.exact(np.diag(size))
    rows, h = implicit_step(
        closed_loop.map_of(model), at, T, [[Fraction(3)]], Fraction(PERIOD), ring
    )
    z0, z1, _ = ring.variables
    ball = z0 * z0 + z1 * z1
    step = ImplicitStep(ring, rows, h, ball, 1.0, 1.0)
    reach = step.reach()
    rng = np.random.default_rng(0)
    farthest = 0.0
    for _ in range(500):
        z = rng.standard_normal(2)
        z /= np.linalg.norm(z)
        following = model(size * z, np.array([-2.0 * z[0] - z[1]]))
        farthest = max(farthest, float(np.linalg.norm(following / size)))
    assert 0.98 * reach < farthest <= reach
