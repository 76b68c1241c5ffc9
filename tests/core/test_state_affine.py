"""State-affine models: documents, simulation and certified iterates."""

import json

import numpy as np
import pytest

from nlsid_core.arrays import Json
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.identification import Degrees, Polynomial, prove_stability
from nlsid_core.identification.polynomial.certified import certified_simulation_error
from nlsid_core.identification.polynomial.rows import StateAffineRows, build_state_affine_rows
from nlsid_core.models import StateAffineModel


def recording(samples: int = 300, noise: float = 0.02, seed: int = 0) -> Trajectory:
    """A valve whose time constant depends on its input."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(0.0, 2.0, samples)
    y = np.zeros(len(u))
    for t in range(2, len(u)):
        y[t] = (1.1 * y[t - 1] - 0.3 * y[t - 2] + u[t - 1] ** 2) / (1.0 + 0.3 * u[t])
    y += noise * rng.standard_normal(len(u))
    return Trajectory(t=np.linspace(0.0, 0.1 * (len(u) - 1), len(u)), y=y, u=u, name=f"run {seed}")


@pytest.fixture(scope="module")
def stacked() -> StateAffineRows:
    model_class = Polynomial(2, degrees=Degrees(inputs=2, leading=2), input_range=((0.0, 2.0),))
    dataset = Dataset((recording(), recording(seed=1)))
    return build_state_affine_rows(dataset, model_class)


@pytest.fixture(scope="module")
def model(stacked: StateAffineRows) -> StateAffineModel:
    *_, last = certified_simulation_error(stacked, iterations=4)
    made: StateAffineModel = stacked.model(last.point.theta, last.point.p)
    return made


@pytest.fixture(scope="module")
def documents(stacked: StateAffineRows) -> tuple[Json, Json]:
    """Model and proof of the last certified iterate."""
    *_, last = certified_simulation_error(stacked, iterations=4)
    model = stacked.model(last.point.theta, last.point.p)
    proof = prove_stability(model)
    assert proof is not None
    return model.document(), proof.document(model, "model.json")


def copied(document: Json) -> Json:
    return json.loads(json.dumps(document))  # type: ignore[no-any-return]


def test_the_proof_holds_on_simulations_from_two_initial_conditions(
    model: StateAffineModel, documents: tuple[Json, Json]
) -> None:
    rng = np.random.default_rng(5)
    P, rate = np.array(documents[1]["proof"]["P"]), documents[1]["claim"]["rate"]
    u = rng.uniform(-3.0, 5.0, (200, 40, 1))  # beyond the range too: inputs are clipped
    starts = rng.normal(size=(2, 200, 2, 1))
    first, second = (model.simulate(u, start) for start in starts)
    gap = (first - second)[:, :, 0] / model.y_scale[0]
    states = np.stack([gap[:, 1:], gap[:, :-1]], axis=-1)
    V = np.einsum("bti,ij,btj->bt", states, P, states)
    assert (V[:, 1:] <= rate**2 * V[:, :-1] + 1e-12).all()


def test_a_model_document_round_trips_exactly(model: StateAffineModel) -> None:
    again = StateAffineModel.from_document(copied(model.document()))
    assert again.document() == model.document()
    u = recording(seed=9).u
    np.testing.assert_array_equal(again.simulate(u), model.simulate(u))


def test_several_trajectories_simulate_as_each_alone(model: StateAffineModel) -> None:
    trials = [recording(seed=seed) for seed in range(3)]
    together = model.simulate(np.stack([t.u for t in trials]))
    for index, trial in enumerate(trials):
        np.testing.assert_allclose(together[index], model.simulate(trial.u), rtol=1e-12)


def test_explicit_gains_are_the_jacobian_of_a_step(model: StateAffineModel) -> None:
    u = recording(seed=4, samples=9).u[:3]
    start = np.array([[0.3], [0.8]])
    gains, _ = model.explicit(model.windows(u))
    step = 1e-6
    for lag in (1, 2):
        moved = start.copy()
        moved[2 - lag] += step
        slope = (model.simulate(u, moved) - model.simulate(u, start))[2, 0] / step
        assert gains[0, 0, lag - 1] == pytest.approx(slope, rel=1e-6)


def test_a_rank_deficient_basis_is_refused() -> None:
    u = np.tile([0.0, 1.0], 150)
    y = np.random.default_rng(0).standard_normal(300)
    dataset = Dataset((Trajectory(t=np.arange(300.0), y=y, u=u),))
    with pytest.raises(DataError, match="does not excite"):
        build_state_affine_rows(dataset, Polynomial(1, degrees=Degrees(inputs=2)))


def test_certified_iterates_refuse_degrees_they_have_no_set_for() -> None:
    for leading, lagged in ((3, 0), (0, 2), (2, 1)):
        model_class = Polynomial(1, (0,), Degrees(leading=leading, lagged=lagged))
        stacked = build_state_affine_rows(Dataset((recording(),)), model_class)
        with pytest.raises(ShapeError, match="at most"):
            next(certified_simulation_error(stacked))
    many = build_state_affine_rows(
        Dataset((recording(),)), Polynomial(12, degrees=Degrees(lagged=1))
    )
    with pytest.raises(ShapeError, match=r"8192 vertices .* fewer delays"):
        next(certified_simulation_error(many))
