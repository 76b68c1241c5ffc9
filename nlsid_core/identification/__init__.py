"""Identification: a dataset in, a stable model with its proof out (thesis Part I)."""

from nlsid_core.identification.choosing import Attempt, Choice, Promise, Row
from nlsid_core.identification.families import ModelClass, describe, methods_of
from nlsid_core.identification.fit import Candidate, Fit, History, Proof, Step, stated_rate
from nlsid_core.identification.identify import Search, identify
from nlsid_core.identification.methods.options import (
    METHODS,
    LeastSquares,
    Method,
    Rie,
    Rse,
    Sem,
)
from nlsid_core.identification.network.options import (
    CellRow,
    Feedback,
    FilterMapFilter,
    Follower,
    Network,
)
from nlsid_core.identification.polynomial.options import Degrees, Polynomial
from nlsid_core.identification.prediction import Model, simulate_trial
from nlsid_core.identification.proofs.stability import StabilityProof, prove_stability
from nlsid_core.identification.proofs.stable_sets import ImplicitProof, prove_implicit
from nlsid_core.identification.repeats import compare_repeats
from nlsid_core.identification.uncertainty import standard_errors
from nlsid_core.identification.validation import (
    Residual,
    Validation,
    compare,
    simulation_percent,
    validate,
)

__all__ = [
    "METHODS",
    "Attempt",
    "Candidate",
    "CellRow",
    "Choice",
    "Degrees",
    "Feedback",
    "FilterMapFilter",
    "Fit",
    "Follower",
    "History",
    "ImplicitProof",
    "LeastSquares",
    "Method",
    "Model",
    "ModelClass",
    "Network",
    "Polynomial",
    "Promise",
    "Proof",
    "Residual",
    "Rie",
    "Row",
    "Rse",
    "Search",
    "Sem",
    "StabilityProof",
    "Step",
    "Validation",
    "compare",
    "compare_repeats",
    "describe",
    "identify",
    "methods_of",
    "prove_implicit",
    "prove_stability",
    "simulate_trial",
    "simulation_percent",
    "standard_errors",
    "stated_rate",
    "validate",
]
