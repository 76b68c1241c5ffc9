"""Implicit models of mechanisms: physical coefficients come back, spurious roots do not."""

import numpy as np
import pytest

from nlsid_core.errors import DataError, SolverError
from nlsid_core.funnels.implicit import ImplicitStep
from nlsid_core.identification.trapezoidal import identify_trapezoidal
from nlsid_core.models.trapezoidal import TrapezoidalModel
from nlsid_core.polynomial import compose_affine, variables
from nlsid_core.trajectory import Dataset, Trajectory

PERIOD = 0.02
EXPONENTS = np.array([[1, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 1]])
PHYSICS = np.array([[-9.8], [9.8 / 6], [-0.5], [1.0]])


def truth() -> TrapezoidalModel:
    """A pendulum with a cubic in the place of the sine."""
    return TrapezoidalModel(EXPONENTS, PHYSICS, PERIOD, np.array([[-9.0, 9.0]]))


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


def coefficient(model: TrapezoidalModel, exponent: list[int]) -> float:
    row = np.flatnonzero((model.exponents == exponent).all(axis=1))[0]
    return float(model.coefficients[row, 0])


def test_the_accelerations_coefficients_are_the_physical_ones() -> None:
    model = identify_trapezoidal(recorded(), degrees=[3, 1, 1])
    for exponent, value in zip(EXPONENTS.tolist(), PHYSICS[:, 0], strict=True):
        assert coefficient(model, exponent) == pytest.approx(value, rel=0.05, abs=0.02)


def test_free_run_of_the_identified_model_follows_the_truth() -> None:
    data = recorded()
    model = identify_trapezoidal(data, degrees=[3, 1, 1])
    u = data.trajectories[0].u
    true, free = truth().simulate([0.0, 0.0], u), model.simulate([0.0, 0.0], u)
    assert np.linalg.norm(free - true) < 0.01 * np.linalg.norm(true)


def test_a_step_satisfies_the_equations_it_states() -> None:
    model, x, u = truth(), np.array([0.7, -1.0]), np.array([0.4])
    following = model.step(x, u)
    residual = model.equations()[0](np.concatenate([x, u, following[1:]]))
    assert abs(float(residual)) < 1e-12
    assert following[0] == pytest.approx(x[0] + PERIOD / 2 * (x[1] + following[1]))


def test_a_root_outside_the_data_is_refused() -> None:
    with pytest.raises(SolverError, match=r"outside the box|no next rate"):
        truth().step([0.0, 8.9], [500.0])


def test_without_repeats_nothing_is_identified() -> None:
    with pytest.raises(DataError, match="repeated"):
        identify_trapezoidal(recorded(1), degrees=[3, 1, 1])


def test_the_proved_reach_of_an_implicit_step_bounds_the_models_own_steps() -> None:
    """Around the origin, u = -2 z0 - z1, the next rate 3 w."""
    model, size = truth(), np.array([0.5, 2.0])
    (h,) = compose_affine(
        model.equations(),
        np.array([[size[0], 0, 0], [0, size[1], 0], [-2.0, -1.0, 0], [0, 0, 3.0]]),
        np.zeros(4),
        names=("z0", "z1", "w"),
    )
    z0, z1, w = variables("z0 z1 w")
    half = PERIOD / 2
    position = (size[0] * z0 + half * (size[1] * z1 + 3.0 * w)) / size[0]
    step = ImplicitStep((position, 3.0 * w / size[1]), (h,), ("z0", "z1"), ("w",), bound=1.0)
    reach = step.reach()
    rng = np.random.default_rng(0)
    farthest = 0.0
    for _ in range(500):
        z = rng.standard_normal(2)
        z /= np.linalg.norm(z)
        following = model.step(size * z, np.array([-2.0 * z[0] - z[1]]))
        farthest = max(farthest, float(np.linalg.norm(following / size)))
    assert 0.98 * reach < farthest <= reach
