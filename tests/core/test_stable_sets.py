"""The convex sets of stable models: what they contain, what they exclude, exact proofs."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from examples import not_a_contraction
from nlsid_core import files
from nlsid_core.errors import CertificateRejected, Infeasible, ShapeError, SolverError
from nlsid_core.identification.proofs import conditions
from nlsid_core.identification.proofs.conditions import Inequality, constraint
from nlsid_core.polynomial import variables
from nlsid_core.proofs import check, proof_document
from nlsid_core.sos import Program, SumOfSquares, forms_of, solve, symmetric_template

FORMS = 4


def feasible(*parts: SumOfSquares | Inequality, names: tuple[str, ...]) -> bool:
    """Whether a solver finds the decisions; the sizes here leave no doubt either way."""
    constraints = tuple(
        constraint(part, name="a set") if isinstance(part, Inequality) else part for part in parts
    )
    try:
        solve(Program((*names, *forms_of(FORMS)), constraints))
    except (Infeasible, SolverError):
        return False
    return True


def linear_map(A: np.ndarray, names: list[str]) -> np.ndarray:
    x = np.array(variables(names))
    return np.array([sum(float(a) * v for a, v in zip(row, x, strict=True)) for row in A])


def random_matrix(seed: int, radius: float) -> np.ndarray:
    A = np.random.default_rng(seed).standard_normal((2, 2))
    return np.asarray(A * radius / max(abs(np.linalg.eigvals(A))))


def test_example_2_3_1_gives_the_published_slope_and_an_exact_proof(tmp_path: Path) -> None:
    computed, published = not_a_contraction.example()
    assert computed == pytest.approx(published, abs=5e-4)
    model, proof = not_a_contraction.model, not_a_contraction.proof()
    path = tmp_path / "example.proof.json"
    files.write_document(tmp_path / "model.json", model.document())
    files.write_document(path, proof.document(model, "model.json"))
    assert "for every state and input" in check(path).statement
    steeper = model.document()
    steeper["h"]["coefficients"][-1] = [-0.6]
    files.write_document(tmp_path / "model.json", steeper)
    document = proof.document(model, "model.json")
    document["claim"]["about"]["model"]["digest"] = files.digest(steeper)
    files.write_document(path, proof_document(document["claim"], document["proof"]))
    with pytest.raises(CertificateRejected):
        check(path)


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 10_000), st.floats(0.05, 0.97))
def test_the_linear_set_contains_every_stable_matrix(seed: int, radius: float) -> None:
    """With E = sX, F = sXA for a Lyapunov matrix X of A; here the solver finds E itself."""
    A = random_matrix(seed, radius)
    E = symmetric_template("E", 2)
    assert feasible(conditions.linear(E, E @ A), names=())


@pytest.mark.parametrize("radius", [1.05, 1.5])
def test_the_linear_set_contains_no_unstable_matrix(radius: float) -> None:
    for seed in range(3):
        E = symmetric_template("E", 2)
        A = random_matrix(seed, radius)
        assert not feasible(conditions.linear(E, E @ A), names=())


@settings(deadline=None, max_examples=8)
@given(st.integers(0, 10_000), st.floats(0.05, 0.95))
def test_proposition_2_14_stable_matrices_satisfy_lemma_2_13(seed: int, radius: float) -> None:
    """E = 2P/2, f = PAx + Pb(w) for P - A'PA ≻ 0 satisfies the inequality for a small δ."""
    A = random_matrix(seed, radius)
    P = np.eye(2)
    for _ in range(600):
        P = np.eye(2) + A.T @ P @ A
    names = ["x0", "x1"]
    E, F = (conditions.slopes(linear_map(part, names), names) for part in (P, P @ A))
    assert feasible(conditions.derivatives(E, F, P, delta=0.5), names=("x0", "x1"))


def test_a_cubic_map_needs_a_domain_and_gets_one() -> None:
    """f = 0.5 x + x³/4 with linear e is not contracting globally, but for |x| ≤ 0.7 it is."""
    (x,) = variables("x")
    e, f = np.array([1.0 * x]), np.array([0.5 * x + 0.25 * x**3])
    P, parts = np.eye(1), (conditions.slopes(e, ["x"]), conditions.slopes(f, ["x"]))
    domain = conditions.box(["x"], [(-0.7, 0.7)])
    assert not feasible(conditions.derivatives(*parts, P, delta=0.01), names=("x",))
    inside = conditions.derivatives(*parts, P, delta=0.01, domain=domain)
    assert feasible(inside, names=("x",))
    wide = conditions.box(["x"], [(-2.0, 2.0)])
    outside = conditions.derivatives(*parts, P, delta=0.01, domain=wide)
    assert not feasible(outside, names=("x",))


def delayed(a1: float, a2: float) -> tuple[np.ndarray, np.ndarray]:
    """h = 3v + v³ - 3(a1 x0 + a2 x1), x⁺ = [v; x0]."""
    v, x0, x1 = variables("v x0 x1")
    return np.array([3.0 * v + v**3 - 3.0 * (a1 * x0 + a2 * x1)]), np.array([x0])


@pytest.mark.parametrize(("a1", "a2", "stable"), [(0.5, -0.3, True), (1.0, 0.3, False)])
def test_lemma_2_11_tells_stable_delay_models_from_unstable_ones(
    a1: float, a2: float, stable: bool
) -> None:
    h, shift = delayed(a1, a2)
    M, names = symmetric_template("M", 2), ("x0", "x1")
    slopes = conditions.implicit_derivatives(h, shift, M, (("v",), names), delta=0.01)
    assert feasible(slopes, Inequality(M), names=("v", *names)) == stable


def test_sizes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ShapeError, match="2 names and the ends of 1"):
        conditions.box(["x", "u"], [(0.0, 1.0)])
