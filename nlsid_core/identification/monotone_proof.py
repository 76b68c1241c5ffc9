"""Search for the storage function and rate that prove a monotone equation stable."""

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from scipy.linalg import LinAlgError, eigh

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import exact, proof_document
from nlsid_core.certificate.monotone_equation import contracts, dissipation
from nlsid_core.models import MonotoneEquation

ROOM = 0.5  # of the largest provable 1 - r²: rounding has to have room


@dataclass(frozen=True, eq=False)
class MonotoneProof:
    """P (n, n) and rate of a `monotone_equation_stability` proof, decided by the checker's code."""

    P: FloatArray
    rate: float

    def document(self, model: MonotoneEquation, file: str) -> Json:
        """The proof file's content for the model stored in `file` beside it."""
        about = {"model": {"file": file, "digest": _json.digest(model.document())}}
        claim = {"kind": "monotone_equation_stability", "rate": self.rate, "about": about}
        return proof_document(claim, {"P": self.P.tolist()})


def prove_monotone_equation(model: MonotoneEquation, P: FloatArray) -> MonotoneProof | None:
    """A proof with V = x'Px, P (n, n) symmetric, at half the best 1 - rate²; None if there is none.

    The matrix G of the claim is affine in r²: G(r²) = G(1) - (1 - r²) diag(P, 0).
    """
    P = (P + P.T) / 2.0
    G = np.array(dissipation(model, exact.rational(P.tolist()), Fraction(1)), dtype=np.float64)
    storage = np.zeros_like(G)
    storage[: len(P), : len(P)] = P
    try:
        most = float(eigh(storage, G, eigvals_only=True)[-1])
    except LinAlgError:
        return None
    if not most > 0:
        return None
    rate = float(np.sqrt(max(1.0 - ROOM / most, 0.0)))
    return MonotoneProof(P, rate) if contracts(model, P, rate) is None else None
