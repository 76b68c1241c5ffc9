"""State-affine models: documents, simulation, several outputs, proofs, certified iterates."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from nlsid_core.arrays import FloatArray, Json
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.identification import Degrees, Polynomial, identify, prove_stability
from nlsid_core.identification.methods.rse import robust_simulation_error
from nlsid_core.identification.methods.simulation_error import SimulationError
from nlsid_core.identification.polynomial import certified
from nlsid_core.identification.polynomial.certified import (
    certified_simulation_error,
    descend_certified,
)
from nlsid_core.identification.polynomial.matrix_set import MatrixSet, slowest_rate
from nlsid_core.identification.polynomial.rows import StateAffineRows, build_state_affine_rows
from nlsid_core.models import Polynomials, Signal, StateAffineModel
from tests.decided import checked
from tests.state_affine_rows import problem


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
def documents(model: StateAffineModel) -> tuple[Json, Json]:
    """Model and proof of the last certified iterate."""
    proof = prove_stability(model)
    assert proof is not None
    return model.document(), proof.document(model, "model.json")


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


# -- State-affine models of several outputs: their matrix, their proof, and identification

LEAD = np.array([[1.0, 0.3], [-0.2, 0.9]])
LAGGED = (np.array([[-1.0, 0.1], [0.2, -0.7]]), np.array([[0.3, 0.0], [0.0, 0.2]]))


def constants(values: FloatArray) -> Polynomials:
    return Polynomials(np.zeros((1, 1), dtype=np.int64), values[None])


def coupled(lead: FloatArray = LEAD, *lagged: FloatArray) -> StateAffineModel:
    return StateAffineModel(
        G=(constants(lead), *map(constants, lagged or LAGGED)),
        p=Polynomials(np.array([[1], [2]]), np.array([[-0.5, 0.2], [0.1, -0.3]])),
        window=((0, 1),),
        y_offset=np.array([0.5, -1.0]),
        y_scale=np.array([2.0, 0.1]),
        u_offset=np.zeros(1),
        u_scale=np.ones(1),
        u_range=np.array([[-2.0, 2.0]]),
        period=0.01,
        y=(Signal("angle", "rad"), Signal("rate", "rad/s")),
        u=(Signal("torque", "N m"),),
    )


def block_matrix(model: StateAffineModel) -> FloatArray:
    """A of x = [ȳ(t-1); ȳ(t-2)]."""
    gains, _ = model.explicit(np.zeros(1))
    return np.vstack([gains, np.eye(2, 4)])


def test_the_stated_rate_is_near_the_slowest_pole() -> None:
    proof = prove_stability(coupled())
    assert proof is not None
    A = block_matrix(coupled())
    radius = float(np.max(np.abs(np.linalg.eigvals(A))))
    assert radius < proof.rate < radius + 0.1 * (1.0 - radius)


def test_what_is_not_stable_or_not_solvable_has_no_proof() -> None:
    assert prove_stability(coupled(LEAD, 1.9 * LAGGED[0], LAGGED[1])) is None
    assert prove_stability(coupled(np.ones((2, 2)), *LAGGED)) is None


def test_two_coupled_outputs_are_identified_to_the_truth_and_proved() -> None:
    model, trials = coupled(), []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        u = rng.uniform(-2.0, 2.0, (200 + 30 * seed, 1))
        y = model.simulate(u) + 1e-3 * model.y_scale * rng.standard_normal((len(u), 2))
        trials.append(Trajectory(t=0.01 * np.arange(len(u)), y=y, u=u, name=f"run {seed}"))
    found = identify(Dataset(tuple(trials)), Polynomial(2, (1,), Degrees(inputs=2)))
    assert found.errors["train"][found.method.name] < 1.0
    own, truth = found.model.document(), block_matrix(model)
    assert own["on_out_of_range"] == "clip"
    poles = [
        np.sort_complex(np.linalg.eigvals(matrix)) for matrix in (block_matrix(found.model), truth)
    ]
    np.testing.assert_allclose(poles[0], poles[1], atol=0.02)
    assert found.proof.rate < 1.0


# -- Certified iterates of several outputs, and of lagged coefficients that depend on the input

# (outputs, degree of G_0, degree of G_1 …), and inputs in [-range, range] beside data in [-1, 1]
CASES = [(2, 0, 0, 1.0), (2, 1, 0, 6.0), (2, 1, 1, 2.0), (1, 1, 1, 3.0), (1, 2, 0, 2.0)]
MARKED = [CASES[0], *(pytest.param(case, marks=pytest.mark.slow) for case in CASES[1:])]


def rows(outputs: int, leading: int, lagged: int, most: float) -> StateAffineRows:
    return problem(
        outputs=outputs,
        trials=1,
        samples=200,
        noise=0.2,
        model_class=Polynomial(
            2, (0, 1), Degrees(leading=leading, lagged=lagged), ((-most, most),)
        ),
    )


def left(model: StateAffineModel) -> np.ndarray:
    return np.concatenate([g.coefficients.ravel() for g in model.G])


def smallest(inside: MatrixSet, theta: np.ndarray, extra: np.ndarray) -> float:
    z = np.concatenate([theta, extra])
    return min(float(np.linalg.eigvalsh(part.at(z)).min()) for part in inside.inequalities())


@pytest.mark.parametrize("case", MARKED)
def test_iterates_never_go_up_and_the_last_one_is_proved(
    case: tuple[int, int, int, float], tmp_path: Path
) -> None:
    stacked = rows(*case)
    found = list(certified_simulation_error(stacked, iterations=5))
    *_, free = robust_simulation_error(stacked.rows, iterations=5)
    assert all(b.J <= a.J * (1 + 1e-5) for a, b in pairwise(found))
    assert free.J * (1 - 1e-5) <= found[-1].J <= 1.02 * free.J
    point = found[-1].point
    assert "every input" in checked(stacked.model(point.theta, point.p), tmp_path)


@pytest.mark.slow
def test_few_steps_a_bound_stay_inside_the_set_and_end_as_low(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stacked = rows(2, 1, 0, 6.0)
    *_, whole = certified_simulation_error(stacked, iterations=12)
    monkeypatch.setattr(certified, "affordable_steps", lambda _: 36)
    few = list(certified_simulation_error(stacked, iterations=40))
    assert len(few) == certified.FEWEST_BOUNDS
    assert few[-1].J <= 1.02 * whole.J
    for iterate in few:
        assert prove_stability(stacked.model(iterate.point.theta, iterate.point.p)) is not None


def test_the_set_gives_a_proof_where_the_free_iterates_have_none() -> None:
    stacked = rows(2, 1, 0, 6.0)
    *_, free = robust_simulation_error(stacked.rows, iterations=5)
    model = stacked.model(free.theta, free.p)
    box = model.window_range()
    w = np.random.default_rng(0).uniform(box[:, 0], box[:, 1], (200, len(box)))
    assert np.max(np.abs(np.linalg.eigvals(states(model, w)))) > 1.1
    assert prove_stability(model) is None


@pytest.mark.parametrize("case", MARKED)
def test_the_last_step_keeps_the_proof_and_lowers_the_error(
    case: tuple[int, int, int, float], tmp_path: Path
) -> None:
    stacked = rows(*case)
    point = next(certified_simulation_error(stacked)).point
    model = stacked.model(point.theta, point.p)
    proof = prove_stability(model)
    assert proof is not None
    start = MatrixSet.of_proof(stacked, model, proof)
    assert smallest(start, left(model), start.extra) > 0
    found = descend_certified(stacked, model, proof)
    assert "every input" in checked(found, tmp_path)
    objective = SimulationError(stacked.rows)
    assert objective.at(left(found)).J < 0.999 * objective.at(left(model)).J
    proof = prove_stability(found)
    assert proof is not None
    again = descend_certified(stacked, found, proof)
    assert objective.at(left(again)).J <= objective.at(left(found)).J


@pytest.mark.parametrize("case", CASES)
def test_models_in_the_set_contract_and_unstable_ones_are_outside(
    case: tuple[int, int, int, float],
) -> None:
    stacked = rows(*case)
    iterate = next(certified_simulation_error(stacked))
    inside, theta = iterate.inside, iterate.point.theta
    assert isinstance(inside, MatrixSet)
    assert smallest(inside, theta, inside.extra) > 0
    rng, box = np.random.default_rng(0), stacked.window_range()
    w = rng.uniform(box[:, 0], box[:, 1], (50, len(box)))
    found = 0
    for size in np.geomspace(1e-3, 1.0, 40):
        moved = theta + size * rng.standard_normal(len(theta))
        A = states(stacked.model(moved, iterate.point.p), w)
        if smallest(inside, moved, inside.extra) > 0:
            found += 1
            decrease = slowest_rate(stacked) ** 2 * inside.P - A.transpose(0, 2, 1) @ inside.P @ A
            assert np.linalg.eigvalsh(decrease).min() > 0
    assert 5 < found < 40
    unstable = theta.copy()
    n_0 = len(stacked.left[0]) * len(inside.M) ** 2
    unstable[n_0:] *= 20.0
    A = states(stacked.model(unstable, iterate.point.p), w)
    assert np.max(np.abs(np.linalg.eigvals(A))) > 1
    assert smallest(inside, unstable, inside.extra) < 0


def states(model: StateAffineModel, w: np.ndarray) -> np.ndarray:
    """(T, n n_y, n n_y): A(w) of x⁺ = A(w)x."""
    gains, _ = model.explicit(w)
    n_y, size = gains.shape[1:]
    A = np.zeros((len(w), size, size))
    A[:, :n_y] = gains
    A[:, n_y:, : size - n_y] = np.eye(size - n_y)
    return A
