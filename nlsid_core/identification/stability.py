"""Search for the Lyapunov matrix that proves a difference equation incrementally stable."""

import warnings
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, solve_discrete_lyapunov

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import proof_document
from nlsid_core.certificate.stability import contracts
from nlsid_core.models import DifferenceEquation

RATE_ROOM = 0.05  # the certified rate gives up this fraction of 1 - |slowest pole|, for a well
# conditioned P


@dataclass(frozen=True, eq=False)
class StabilityProof:
    """P (n, n) and rate r with P ≻ 0, r²P - A'PA ≻ 0, decided exactly by the checker's code."""

    P: FloatArray
    rate: float

    def document(self, model: DifferenceEquation, file: str) -> Json:
        """The proof file's content for the model stored in `file` beside it."""
        about = {"model": {"file": file, "digest": _json.digest(model.document())}}
        claim = {"kind": "incremental_stability", "rate": self.rate, "about": about}
        return proof_document(claim, {"P": self.P.tolist()})


def prove_stability(model: DifferenceEquation) -> StabilityProof | None:
    """A proof of incremental stability, or None if the model has none (it is not stable).

    P solves (A/r)'P(A/r) - P + I = 0 with r between the slowest pole's radius and 1.
    Source: thesis (2.19), Definition 2.3.
    """
    radius = float(np.abs(model.poles).max())
    rate = radius + RATE_ROOM * (1.0 - radius)
    if not 0.0 < rate < 1.0:
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of bad conditioning: the checker judges the result
            P = solve_discrete_lyapunov(model.A.T / rate, np.eye(len(model)))
    except LinAlgError:
        return None
    P = (P + P.T) / (2.0 * np.abs(P).max())
    proof = StabilityProof(P=P, rate=rate)
    return proof if contracts(model, proof.P, proof.rate) is None else None
