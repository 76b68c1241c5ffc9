"""Genuine proofs of the polynomial claims: one of every shape, small enough to decide in 10 ms."""

from collections.abc import Mapping
from functools import cache

import numpy as np

from examples import matrix_positivstellensatz, moore_greitzer, motzkin, six_hump_camel
from examples import too_large_a_level as level
from nlsid_core.arrays import Json
from nlsid_core.identification.proofs.stable_sets import prove_implicit, prove_well_posed
from nlsid_core.models import ImplicitModel
from nlsid_core.polynomial import Polynomial, monomials, variables
from nlsid_core.sos import SphereProgram, sphere_proof
from nlsid_core.sos.proofs import bound_document
from nlsid_core.sos.search import lower_bound
from tests.implicit_models import coupled, cubic_spring, lagged, linear, quintic, rotated

Genuine = tuple[Json, Mapping[str, Json]]  # a proof document, and the files it is about
BOX = ((-1.0, 1.0), (-1.0, 1.0))
# model, set, box, degree of the storage
STABLE: dict[str, tuple[ImplicitModel, str, tuple[tuple[float, float], ...], int]] = {
    "increments": (lagged(), "2.10", (), 0),
    "increments_of_degree_4": (quintic(), "2.10", (), 4),
    "increments_on_a_box": (cubic_spring(), "2.10", BOX, 0),
    "slopes": (lagged(), "2.11", (), 0),
    "slopes_of_degree_4": (quintic(), "2.11", (), 4),
    "slopes_on_a_box": (cubic_spring(), "2.11", BOX, 0),
    "separable_increments": (quintic(), "2.12", (), 0),
    "separable_slopes": (quintic(), "2.13", (), 0),
    "separable_slopes_on_a_box": (coupled(), "2.13", (*BOX, (-5.0, 5.0)), 0),
    "linear": (linear(np.array([[0.5, 0.4], [-0.4, 0.6]])), "2.19", (), 0),
}


@cache
def genuine() -> dict[str, dict[str, Genuine]]:
    """By kind and name; every one of them is PROVED."""
    return {
        "polynomial_bound": {
            "bound": (six_hump_camel.document(), {}),
            "factor": (motzkin.document(), {}),
            "domain": (_on_a_disc(), {}),
            "sphere": (_on_a_sphere(), {}),
            "matrix": (matrix_positivstellensatz.document(), {}),
        },
        "region_of_attraction": {
            "level": (level.document(0.0499), {}),
            "everywhere": (moore_greitzer.document(), {}),
        },
        "stable_set": {
            **{name: _stable(name) for name in STABLE},
            "well_posed": _well_posed(rotated()),
        },
    }


def _on_a_disc() -> Json:
    x, y = variables("x y")
    return lower_bound(x * y + x, domain=[1 - x**2 - y**2]).document


def _on_a_sphere() -> Json:
    program, rng = SphereProgram(3), np.random.default_rng(3)
    rows = monomials(3, range(5))
    g = Polynomial(rows, rng.normal(size=len(rows)), ("x", "y", "z"))
    proof = sphere_proof(program, program.solve(g(program.points)), g)
    return bound_document(
        g,
        proof.bound,
        proof.gram,
        equalities=[proof.sphere],
        equality_multipliers=[proof.multiplier],
    )


def _stable(name: str) -> Genuine:
    model, kind, ends, degree = STABLE[name]
    proof = prove_implicit(model, delta=0.1, set=kind, ends=ends, storage_degree=degree)
    assert proof is not None, name
    return proof.document(model, "model.json"), {"model.json": model.document()}


def _well_posed(model: ImplicitModel) -> Genuine:
    proof = prove_well_posed(model)
    assert proof is not None
    return proof.document(model, "model.json"), {"model.json": model.document()}
