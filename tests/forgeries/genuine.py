"""Genuine proofs to forge from: one of every kind and shape, small enough to check in a ms."""

from functools import cache

import numpy as np

from examples import matrix_positivstellensatz, motzkin, six_hump_camel, too_large_a_level
from nlsid_core._types import Json
from nlsid_core.certificate.documents import bound_document
from nlsid_core.polynomial import Polynomial, monomials, variables
from nlsid_core.sos import SphereProgram, sphere_proof
from nlsid_core.sos.search import lower_bound


@cache
def genuine() -> dict[str, Json]:
    """Name to proof document; every one of them is PROVED."""
    return {
        "bound": six_hump_camel.document(),
        "factor": motzkin.document(),
        "domain": _on_a_disc(),
        "sphere": _on_a_sphere(),
        "matrix": matrix_positivstellensatz.document(),
        "attraction": too_large_a_level.document(0.0499),
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
