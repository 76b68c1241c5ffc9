"""Search for the proof that an implicit model is well posed and incrementally stable."""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import exact, proof_document
from nlsid_core.certificate.implicit import (
    box,
    monotonicity_matrix,
    polynomials,
    stability_matrix,
    variable_names,
)
from nlsid_core.certificate.nonnegative import prove_lower_bound, quadratic_form
from nlsid_core.certificate.polynomial_data import write_gram
from nlsid_core.errors import CertificateRejected, Infeasible, SolverError, Undecided
from nlsid_core.identification.stable_sets import derivatives
from nlsid_core.models import ImplicitModel
from nlsid_core.polynomial import Gram, Polynomial
from nlsid_core.sos import (
    Identity,
    Program,
    forms_of,
    matrix_sum_of_squares,
    solve,
    symmetric_template,
)
from nlsid_core.sos.search import positive_semidefinite


@dataclass(frozen=True, eq=False)
class ImplicitProof:
    """P, δ, and the Gram matrices of both inequalities, decided exactly by the checker's code."""

    P: FloatArray
    delta: float
    box: tuple[tuple[float, float], ...]
    stable: tuple[Gram, tuple[Gram, ...]]
    monotone: Gram

    def document(self, model: ImplicitModel, file: str) -> Json:
        """The proof file's content for the model stored in `file` beside it."""
        claim = {
            "kind": "implicit_stability",
            "delta": self.delta,
            "box": [list(ends) for ends in self.box],
            "about": {"model": {"file": file, "digest": _json.digest(model.document())}},
        }
        gram, multipliers = self.stable
        proof = {
            "P": self.P.tolist(),
            "stable": {"gram": write_gram(gram), "multipliers": list(map(write_gram, multipliers))},
            "monotone": {"gram": write_gram(self.monotone), "multipliers": []},
        }
        return proof_document(claim, proof)


def prove_implicit(
    model: ImplicitModel, *, delta: float, ends: Sequence[tuple[float, float]] = ()
) -> ImplicitProof | None:
    """A proof at the stated δ, or None if the search finds none (Lemma 2.13 with a constant P).

    ends: (low, high) of every state and input for a claim on that box; none is global.
    """
    n, names = len(model), variable_names(model)
    local = tuple(box(names, [list(pair) for pair in ends])) if ends else ()
    e, f = (
        np.array([p.rounded().over(names) for p in polynomials(part, names[:size])])
        for part, size in ((model.e, n), (model.f, len(names)))
    )
    unknown = symmetric_template("P", n)
    condition = derivatives(
        e, f, unknown, list(names[:n]), delta=delta, domain=tuple(g.rounded() for g in local)
    )
    try:
        found = solve(Program((*names, *forms_of(2 * n)), (condition,)))
        P = np.array([[float(found.value(entry)) for entry in row] for row in unknown])
        fixed = stability_matrix(model, exact.rational(P.tolist()), Fraction(delta))
        stable = _identity(fixed, names, local)
        monotone = _identity(monotonicity_matrix(model), names[:n], ())
        multipliers = tuple(positive_semidefinite(gram) for gram in stable.multipliers)
        for matrix, identity, domain, grams in (
            (fixed, stable, local, multipliers),
            (monotonicity_matrix(model), monotone, (), ()),
        ):
            p = quadratic_form(matrix)
            wide = [g.over(p.names) for g in domain]
            prove_lower_bound(p, 0, identity.gram, domain=wide, multipliers=grams)
    except (Infeasible, SolverError, CertificateRejected, Undecided):
        return None
    return ImplicitProof(P, delta, tuple(ends), (stable.gram, multipliers), monotone.gram)


def _identity(
    matrix: NDArray[np.object_], names: Sequence[str], domain: Sequence[Polynomial]
) -> Identity:
    rounded = np.array([[entry.rounded() for entry in row] for row in matrix], dtype=object)
    local = tuple(g.rounded() for g in domain)
    constraint = matrix_sum_of_squares(rounded, domain=local, name="identity")
    return solve(Program((*names, *forms_of(len(matrix))), (constraint,)))["identity"]
