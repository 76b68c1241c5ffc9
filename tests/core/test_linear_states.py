"""Models of measured states: linear ones with exact proofs, polynomial maps from repeats."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nlsid import Dataset, Fit, Polynomial, Trajectory, check, identify
from nlsid_core import files
from nlsid_core.errors import CertificateRejected, DataError, DocumentError
from nlsid_core.identification.states import identify_states
from nlsid_core.models import ImplicitModel, StateModel
from tests.tracked import PERIOD, pendulum

A = np.array([[0.9, 0.2], [-0.2, 0.7]])
B = np.array([[1.0], [0.5]])
OFFSET = np.array([3.0, -40.0])
SIZE = np.array([1.0, 20.0])


def identified(data: Dataset) -> Fit[ImplicitModel]:
    """The stable linear model of measured states."""
    return identify(data, Polynomial(1, (1,), set="2.19"))


def A_of(fit: Fit[ImplicitModel]) -> np.ndarray:
    """(n, n): ∂x⁺/∂x."""
    n = len(fit.model)
    zero = np.zeros((1, n + len(fit.model.inputs)))
    return fit.model.jacobian(zero[:, :n], zero[:, :n], zero[:, n:])[0, :, :n]


def states(A: np.ndarray, *, samples: int = 400, noise: float = 0.0, seed: int = 0) -> Dataset:
    """x⁺ = A x + B u in units of very different size, and off zero."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((samples, 1))
    x = np.zeros((samples, 2))
    for t in range(samples - 1):
        x[t + 1] = A @ x[t] + B @ u[t]
    y = OFFSET + SIZE * (x + noise * rng.standard_normal(x.shape))
    return Dataset((Trajectory(t=0.1 * np.arange(samples), y=y, u=u, name="run"),))


def stored(fit: Fit[ImplicitModel], folder: Path) -> Path:

    files.write_document(folder / "model.json", fit.model.document())
    path = folder / "model.proof.json"
    files.write_document(path, fit.proof.document(fit.model, "model.json"))
    return path


def test_noise_free_states_give_the_truth_back_with_a_proof(tmp_path: Path) -> None:
    data = states(A)
    fit = identified(data)
    found = A_of(fit) * SIZE / SIZE[:, None]
    np.testing.assert_allclose(found, A, atol=1e-4)
    assert "(set 2.19: " in check(stored(fit, tmp_path)).statement
    trial = data.trajectories[0]
    simulated = fit.model.simulate(trial.y[:1], trial.u[None, :-1])[0]
    np.testing.assert_allclose(simulated, trial.y, atol=2e-3 * float(np.max(np.abs(trial.y))))


@pytest.mark.parametrize("seed", range(3))
def test_data_of_an_unstable_system_give_a_stable_model_with_a_proof(
    seed: int, tmp_path: Path
) -> None:
    unstable = np.array([[1.02, 0.1], [0.0, 0.8]])
    data = states(unstable, samples=120, seed=seed)
    trial = data.trajectories[0]
    regressors = np.hstack([trial.y[:-1], trial.u[:-1], np.ones((len(trial) - 1, 1))])
    plain = np.linalg.lstsq(regressors, trial.y[1:], rcond=None)[0][:2].T
    assert max(abs(np.linalg.eigvals(plain))) > 1.0
    fit = identified(data)
    assert max(abs(np.linalg.eigvals(A_of(fit)))) < 1.0
    path = stored(fit, tmp_path)
    assert check(path).margin > 0.0
    other = fit.model.document()
    other["h"]["coefficients"] = [
        [1.1 * v for v in row] if k > 1 else row for k, row in enumerate(other["h"]["coefficients"])
    ]
    files.write_document(tmp_path / "model.json", other)
    with pytest.raises(CertificateRejected):
        check(path)


def test_data_that_cannot_tell_are_refused() -> None:
    with pytest.raises(DataError, match="4 regressors"):
        identified(states(A, samples=4))
    data = states(A)
    trial = data.trajectories[0]
    twice = np.column_stack([trial.y[:, 0], 2.0 * trial.y[:, 0]])
    with pytest.raises(DataError, match="not independent"):
        identified(Dataset((Trajectory(t=trial.t, y=twice, u=trial.u, name="r"),)))
    flat = Trajectory(t=trial.t, y=trial.y, u=np.ones_like(trial.u), name="r")
    with pytest.raises(DataError, match="u0 is constant"):
        identified(Dataset((flat,)))


# -- Polynomial maps of measured states from repeats: known truths come back, the rest is refused

NOISE = np.array([2e-3, 2e-2])


def record(groups: int, repeats: int, *, seed: int = 0, samples: int = 1200) -> Dataset:
    """The known pendulum under random torques, measured with noise."""
    model, runs = pendulum(), []
    for group in range(groups):
        rng = np.random.default_rng([seed, group])
        u = np.repeat(rng.uniform(-3.0, 3.0, samples // 20), 20)[:, None]
        x = model.simulate([0.0, 0.0], u)[:-1]
        for repeat in range(repeats):
            noise = np.random.default_rng([seed, group, repeat]).standard_normal(x.shape)
            runs.append(
                Trajectory(
                    t=np.arange(samples) * PERIOD,
                    y=x + NOISE * noise,
                    u=u,
                    y_names=("angle", "rate"),
                    u_names=("torque",),
                    name=f"run_{seed}_{group}_{repeat}",
                    group=f"excitation_{group}",
                    digest=f"sha256:{seed}{group}{repeat}",
                )
            )
    return Dataset(tuple(runs))


def coefficient(model: StateModel, exponent: list[int], state: int) -> float:
    row = np.flatnonzero((model.exponents == exponent).all(axis=1))
    return float(model.coefficients[row[0], state])


def test_repeats_remove_the_bias_that_noise_gives_to_least_squares() -> None:
    train, validation = record(3, 4), record(1, 1, seed=9)
    fit = identify_states(train, validation, degrees=[(3, 1, 1)])
    truth = pendulum()
    damping = coefficient(truth, [0, 1, 0], 1)
    assert abs(coefficient(fit.model, [0, 1, 0], 1) - damping) < 5e-4
    assert abs(coefficient(fit.model, [3, 0, 0], 1) - coefficient(truth, [3, 0, 0], 1)) < 5e-3
    points = np.concatenate([np.hstack([t.y[:-1], t.u[:-1]]) for t in train])
    features = np.prod(points[:, None] ** fit.model.exponents, axis=2)
    following = np.concatenate([t.y[1:] for t in train])
    biased = np.linalg.lstsq(features, following, rcond=None)[0]
    row = np.flatnonzero((fit.model.exponents == [0, 1, 0]).all(axis=1))[0]
    assert abs(biased[row, 1] - damping) > 4 * abs(coefficient(fit.model, [0, 1, 0], 1) - damping)


def test_validation_chooses_the_degree_that_the_truth_has() -> None:
    fit = identify_states(
        record(3, 3), record(1, 1, seed=9), degrees=[(1, 1, 1), (3, 1, 1), (5, 1, 1)]
    )
    assert int(np.max(fit.model.exponents[:, 0])) == 3
    assert [degrees for degrees, _ in fit.errors] == [(1, 1, 1), (3, 1, 1), (5, 1, 1)]


def test_noise_and_the_box_of_the_data_go_with_the_model() -> None:
    train = record(2, 4)
    model = identify_states(train, record(1, 1, seed=9), degrees=[(3, 1, 1)]).model
    np.testing.assert_allclose(model.noise, NOISE, rtol=0.1)
    everything = np.concatenate([t.y for t in train])
    np.testing.assert_array_equal(model.x_range[:, 0], everything.min(axis=0))
    assert model.bags[0] == ("run_0_0_0", "sha256:000")


@pytest.mark.parametrize("key", ["x_range", "u_range", "noise", "exponents"])
def test_a_model_document_with_a_part_missing_is_refused(key: str) -> None:
    document = pendulum().document()
    del document[key]
    with pytest.raises(DocumentError, match=key):
        StateModel.from_document(document)


def test_dry_friction_that_sticks_is_refused_and_the_reason_says_where() -> None:
    """A mass with Coulomb friction, pushed at its breakaway force: it sticks most of the time."""
    rng = np.random.default_rng(1)
    runs = []
    for group in range(3):
        u = np.repeat(rng.uniform(-1.5, 1.5, 60), 20)
        x, states = np.zeros(2), []
        for force in u:
            states.append(x)
            for _ in range(10):
                drive = force - np.sign(x[1]) if x[1] else np.sign(force) * max(abs(force) - 1, 0)
                rate = x[1] + PERIOD * drive
                stopped = x[1] * rate < 0
                x = np.array([x[0] + PERIOD / 10 * rate, 0.0 if stopped else rate])
        for repeat in range(2):
            noise = np.random.default_rng([group, repeat]).standard_normal((len(u), 2))
            runs.append(
                Trajectory(
                    t=np.arange(len(u)) * PERIOD,
                    y=np.array(states) + 1e-3 * noise,
                    u=u,
                    y_names=("position", "rate"),
                    u_names=("force",),
                    name=f"run_{group}_{repeat}",
                    group=f"excitation_{group}",
                    digest=f"sha256:{group}{repeat}",
                )
            )
    data = Dataset(tuple(runs))
    train, validation = data.without(["run_2_0", "run_2_1"]), data.select(["run_2_0"])
    with pytest.raises(DataError, match=r"no polynomial map.*worst where"):
        identify_states(train, validation)


def test_data_without_repeats_is_refused() -> None:
    with pytest.raises(DataError, match="repeated"):
        identify_states(record(3, 1), record(1, 1, seed=9))


def test_a_repeat_with_other_inputs_is_refused() -> None:
    runs = record(1, 2).trajectories
    other = replace(runs[1], u=1.1 * runs[1].u)
    with pytest.raises(DataError, match="no repeat"):
        identify_states(Dataset((runs[0], other)), record(1, 1, seed=9))


def test_an_excitation_that_stands_still_is_refused() -> None:
    runs = [replace(t, u=np.zeros_like(t.u)) for t in record(1, 2)]
    with pytest.raises(DataError, match="torque is always zero"):
        identify_states(Dataset(tuple(runs)), record(1, 1, seed=9))
