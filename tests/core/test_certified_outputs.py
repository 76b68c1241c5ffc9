"""Certified iterates of several outputs, and of lagged coefficients that depend on the input."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from nlsid_core import files
from nlsid_core.identification import Degrees, Polynomial, prove_stability
from nlsid_core.identification.methods.rse import robust_simulation_error
from nlsid_core.identification.methods.simulation_error import SimulationError
from nlsid_core.identification.polynomial import certified
from nlsid_core.identification.polynomial.certified import (
    certified_simulation_error,
    descend_certified,
)
from nlsid_core.identification.polynomial.matrix_set import MatrixSet, slowest_rate
from nlsid_core.identification.polynomial.rows import StateAffineRows
from nlsid_core.models import StateAffineModel
from nlsid_core.proofs import check
from tests.state_affine_rows import problem

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


def checked(model: StateAffineModel, folder: Path) -> str:
    proof = prove_stability(model)
    assert proof is not None
    files.write_document(folder / "model.json", model.document())
    files.write_document(folder / "model.proof.json", proof.document(model, "model.json"))
    return check(folder / "model.proof.json").statement


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
