"""Identification: a dataset in, a stable model with its proof out (thesis Part I)."""

from nlsid_core.identification.contraction import StateAffineProof, prove_state_affine
from nlsid_core.identification.fit import (
    CERTIFIED,
    FINAL,
    FIRST,
    LEAST_SQUARES,
    RIE,
    SEM,
    AnyCandidate,
    AnyFit,
    Candidate,
    Fit,
)
from nlsid_core.identification.identify import METHODS, ModelClass, Selection, identify, select
from nlsid_core.identification.prediction import Model, predict, simulate_trial
from nlsid_core.identification.regression import LinearClass
from nlsid_core.identification.stability import StabilityProof, prove_stability
from nlsid_core.identification.state_affine import StateAffineClass
from nlsid_core.identification.validation import (
    Validation,
    simulation_percent,
    validate,
    without_missing,
)

__all__ = [
    "CERTIFIED",
    "FINAL",
    "FIRST",
    "LEAST_SQUARES",
    "METHODS",
    "RIE",
    "SEM",
    "AnyCandidate",
    "AnyFit",
    "Candidate",
    "Fit",
    "LinearClass",
    "Model",
    "ModelClass",
    "Selection",
    "StabilityProof",
    "StateAffineClass",
    "StateAffineProof",
    "Validation",
    "identify",
    "predict",
    "prove_stability",
    "prove_state_affine",
    "select",
    "simulate_trial",
    "simulation_percent",
    "validate",
    "without_missing",
]
