"""The convex sets of stable models: what they contain, what they exclude, exact proofs."""

from pathlib import Path

import numpy as np
import pytest

from examples import not_a_contraction
from nlsid_core import files
from nlsid_core.errors import CertificateRejected, Infeasible, ShapeError, SolverError
from nlsid_core.identification.proofs import conditions
from nlsid_core.identification.proofs.conditions import Inequality, constraint
from nlsid_core.polynomial import variables
from nlsid_core.proofs import check, proof_document
from nlsid_core.sos import Program, SumOfSquares, forms_of, solve

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


def test_sizes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ShapeError, match="2 names and the ends of 1"):
        conditions.box(["x", "u"], [(0.0, 1.0)])
