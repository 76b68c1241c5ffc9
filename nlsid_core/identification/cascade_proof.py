"""Search for the storage function that proves a block cascade incrementally stable."""

import warnings
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from scipy.linalg import LinAlgError, solve_discrete_lyapunov

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import proof_document
from nlsid_core.certificate.block_cascade import contracts, slope_range, state_matrix, states
from nlsid_core.models import BlockCascade

RATE_ROOM = 0.02  # the certified rate gives up this fraction of 1 - |slowest pole|
WEIGHT_STEPS = 200  # halvings of the weight: 2^-200 is beyond any coupling worth a model


@dataclass(frozen=True, eq=False)
class CascadeProof:
    """The numbers of a `block_cascade_stability` proof, decided exactly by the checker's code."""

    P1: FloatArray
    P2: FloatArray
    weight: float
    slopes: tuple[float, float]
    rate: float

    def document(self, model: BlockCascade, file: str) -> Json:
        """The proof file's content for the model stored in `file` beside it."""
        about = {"model": {"file": file, "digest": _json.digest(model.document())}}
        claim = {"kind": "block_cascade_stability", "rate": self.rate, "about": about}
        proof = {
            "P1": self.P1.tolist(),
            "P2": self.P2.tolist(),
            "weight": self.weight,
            "slopes": list(self.slopes),
        }
        return proof_document(claim, proof)


def prove_block_cascade(model: BlockCascade) -> CascadeProof | None:
    """A proof of incremental stability, or None if a filter is not stable.

    Each P solves (A/r)'P(A/r) - P + I = 0; the second filter's weight is halved until the coupling
    through the largest slopes no longer matters (it always ends: the first filter contracts).
    """
    radius = max(float(np.abs(poles).max(initial=0.0)) for poles in model.poles)
    rate = radius + RATE_ROOM * (1.0 - radius)
    if not rate < 1.0:
        return None
    least, most = slope_range(model.f)
    slopes = (_down(least), _up(most))
    n1, _ = states(model)
    corner = max(slopes, key=abs)
    A = np.array(state_matrix(model, (Fraction(corner),) * model.phases), dtype=np.float64)
    try:
        P1, P2 = (_storage(block / rate) for block in (A[:n1, :n1], A[n1:, n1:]))
    except LinAlgError:
        return None
    weight = 1.0
    for _ in range(WEIGHT_STEPS):
        P = np.zeros_like(A)
        P[:n1, :n1], P[n1:, n1:] = P1, weight * P2
        if _is_likely(rate**2 * P - A.T @ P @ A):
            refusal = contracts(model, rate, P=(P1, P2), weight=weight, slopes=slopes)
            if refusal is None:
                return CascadeProof(P1, P2, weight, slopes, rate)
        weight /= 2.0
    return None


def _storage(A: FloatArray) -> FloatArray:
    if not len(A):
        return A
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of bad conditioning: the checker judges the result
        P = solve_discrete_lyapunov(A.T, np.eye(len(A)))
    return np.asarray((P + P.T) / (2.0 * np.abs(P).max()))


def _is_likely(M: FloatArray) -> bool:
    """Worth asking the exact checker."""
    return bool(np.linalg.eigvalsh(M)[0] > 0)


def _down(value: Fraction) -> float:
    """A float64 that is not above `value`."""
    rounded = float(value)
    return rounded if Fraction(rounded) <= value else float(np.nextafter(rounded, -np.inf))


def _up(value: Fraction) -> float:
    """A float64 that is not below `value`."""
    return -_down(-value)
