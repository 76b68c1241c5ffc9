"""Stable linear state-space models: exact proofs, and what data they come from."""

from pathlib import Path

import numpy as np
import pytest

from nlsid import Dataset, Fit, Polynomial, Trajectory, check, identify
from nlsid_core import files
from nlsid_core.errors import CertificateRejected, DataError
from nlsid_core.models import ImplicitModel

A = np.array([[0.9, 0.2], [-0.2, 0.7]])
B = np.array([[1.0], [0.5]])
OFFSET = np.array([3.0, -40.0])
SIZE = np.array([1.0, 20.0])


def identified(data: Dataset) -> Fit[ImplicitModel]:
    """The stable linear model of measured states."""
    return identify(data, Polynomial(1, (1,), set="2.19"), comparators=())


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
