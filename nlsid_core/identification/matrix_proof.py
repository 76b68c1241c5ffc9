"""Search for the proof of a state-affine model of several outputs, or input-dependent lags."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import proof_document
from nlsid_core.certificate.conditions import Inequality
from nlsid_core.certificate.polynomial_data import write_gram
from nlsid_core.certificate.state_affine_matrix import constants, inequality, prove, window_names
from nlsid_core.errors import CertificateRejected, Infeasible, SolverError, Undecided
from nlsid_core.identification.stable_sets import constraint
from nlsid_core.models import StateAffineModel
from nlsid_core.polynomial import Gram
from nlsid_core.polynomial.algebra import as_polynomial
from nlsid_core.sos import Program, Solution, forms_of, solve, symmetric_template, template
from nlsid_core.sos.search import positive_semidefinite

SAMPLES = 200  # windows at which the spectral radius bounds the rate from below
ROOM_FALL = 2.0  # of 1 - rate from one attempt to the next
ATTEMPTS = 8


@dataclass(frozen=True, eq=False)
class MatrixProof:
    """P (n n_y, n n_y), the multiplier T (n_y, n_y), rate, and the Gram matrices."""

    P: FloatArray
    T: FloatArray
    rate: float
    gram: Gram
    multipliers: tuple[Gram, ...]

    def document(self, model: StateAffineModel, file: str) -> Json:
        """The proof file's content for the model stored in `file` beside it."""
        about = {"model": {"file": file, "digest": _json.digest(model.document())}}
        claim = {"kind": "state_affine_stability", "rate": self.rate, "about": about}
        proof = {
            "P": self.P.tolist(),
            "T": self.T.tolist(),
            "gram": write_gram(self.gram),
            "multipliers": [write_gram(multiplier) for multiplier in self.multipliers],
        }
        return proof_document(claim, proof)


def prove_by_matrix(model: StateAffineModel) -> MatrixProof | None:
    """An exact proof, or None if the search finds none."""
    room = 1.0 - sampled_radius(model)
    if not room > 0.0:
        return None
    for _ in range(ATTEMPTS):
        room /= ROOM_FALL
        found = _at_rate(model, 1.0 - room)
        if found is not None:
            return found
    return None


def sampled_radius(model: StateAffineModel) -> float:
    """The largest spectral radius of x⁺ = A(w)x over windows of the box and its corners."""
    rng, box = np.random.default_rng(0), model.window_range()
    part = rng.uniform(size=(SAMPLES, len(box)))
    part[: SAMPLES // 2] = np.round(part[: SAMPLES // 2])
    gains, _ = model.explicit(box[:, 0] + part * (box[:, 1] - box[:, 0]))
    n_y, size = gains.shape[1:]
    A = np.zeros((SAMPLES, size, size))
    A[:, :n_y] = gains
    A[:, n_y:, : size - n_y] = np.eye(size - n_y)
    if not np.isfinite(A).all():
        return np.inf
    return float(np.max(abs(np.linalg.eigvals(A))))


def _at_rate(model: StateAffineModel, rate: float) -> MatrixProof | None:
    n_y, size = len(model.y), len(model) * len(model.y)
    P, T = symmetric_template("P", size), _square("T", n_y)
    above = Inequality(P - constants(np.eye(size)))
    try:
        found = _solved(model, inequality(model, rate, P=P, T=T), above)
        P_found, T_found = _values(found, P), _values(found, T)
        fixed = inequality(model, rate, P=constants(P_found), T=constants(T_found))
        identity = _solved(model, fixed)["stable"]
        multipliers = [positive_semidefinite(gram) for gram in identity.multipliers]
        prove(
            model, rate, P=P_found, T=T_found, gram=identity.gram, multipliers=multipliers
        )  # fmt: skip
    except (Infeasible, SolverError, CertificateRejected, Undecided):
        return None
    return MatrixProof(P_found, T_found, rate, identity.gram, tuple(multipliers))


def _solved(model: StateAffineModel, part: Inequality, above: Inequality | None = None) -> Solution:
    constraints = [constraint(part, name="stable")]
    if above is not None:
        constraints.append(constraint(above, name="P"))
    names = part.variables(window_names(model))
    return solve(Program((*names, *forms_of(len(part.matrix))), tuple(constraints)))


def _square(name: str, size: int) -> NDArray[np.object_]:
    """A matrix of unknowns, not symmetric."""
    T = np.empty((size, size), dtype=object)
    for i in range(size):
        for j in range(size):
            T[i, j] = template(f"{name}[{i},{j}]", np.zeros((1, 0), dtype=np.int64), ())
    return T


def _values(solution: Solution, matrix: NDArray[np.object_]) -> FloatArray:
    rows = [[float(solution.value(as_polynomial(e))) for e in row] for row in matrix]
    return np.array(rows)
