"""State-affine models of several outputs: their matrix, their proof, and identification."""

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.identification import Degrees, Polynomial, identify, prove_stability
from nlsid_core.models import Signal, StateAffineModel
from nlsid_core.models.polynomials import Polynomials

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
