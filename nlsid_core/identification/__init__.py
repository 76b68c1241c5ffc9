"""Identification: a dataset in, a stable model with its proof out (thesis Part I)."""

from nlsid_core.identification.fit import FINAL, FIRST, LEAST_SQUARES, SEM, Candidate, Fit, identify
from nlsid_core.identification.simulation_error import simulation_error_percent
from nlsid_core.identification.stability import StabilityProof, prove_stability

__all__ = [
    "FINAL",
    "FIRST",
    "LEAST_SQUARES",
    "SEM",
    "Candidate",
    "Fit",
    "StabilityProof",
    "identify",
    "prove_stability",
    "simulation_error_percent",
]
