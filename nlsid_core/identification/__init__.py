"""Identification: a dataset in, a stable model with its proof out (thesis Part I)."""

from nlsid_core.identification.block_cascade import (
    BlockCascadeClass,
    CascadeFit,
    identify_block_cascade,
)
from nlsid_core.identification.cells import CellClass
from nlsid_core.identification.feedback import FeedbackClass
from nlsid_core.identification.fit import Candidate, Fit, History, Proof, Step, stated_rate
from nlsid_core.identification.identify import Selection, Tried, identify, select
from nlsid_core.identification.implicit_class import ImplicitClass
from nlsid_core.identification.implicit_proof import ImplicitProof, prove_implicit
from nlsid_core.identification.linear import LinearClass
from nlsid_core.identification.linear_states import LinearStateClass
from nlsid_core.identification.methods import (
    METHODS,
    CertifiedRse,
    CertifiedSem,
    FirstRse,
    LeastSquares,
    Method,
    ModelClass,
    MomentRie,
    Rie,
    Rse,
    Sem,
    describe,
)
from nlsid_core.identification.moment_rie import MomentFit
from nlsid_core.identification.moments import MonotoneClass
from nlsid_core.identification.monotone import identify_from_repeats
from nlsid_core.identification.prediction import Model, predict, simulate_trial
from nlsid_core.identification.repeats import RepeatTest, compare_repeats
from nlsid_core.identification.searches import methods_of
from nlsid_core.identification.stability import StabilityProof, prove_stability
from nlsid_core.identification.state_affine import StateAffineClass
from nlsid_core.identification.validation import (
    Residual,
    Validation,
    simulation_percent,
    validate,
    without_missing,
)

__all__ = [
    "METHODS",
    "BlockCascadeClass",
    "Candidate",
    "CascadeFit",
    "CellClass",
    "CertifiedRse",
    "CertifiedSem",
    "FeedbackClass",
    "FirstRse",
    "Fit",
    "History",
    "ImplicitClass",
    "ImplicitProof",
    "LeastSquares",
    "LinearClass",
    "LinearStateClass",
    "Method",
    "Model",
    "ModelClass",
    "MomentFit",
    "MomentRie",
    "MonotoneClass",
    "Proof",
    "RepeatTest",
    "Residual",
    "Rie",
    "Rse",
    "Selection",
    "Sem",
    "StabilityProof",
    "StateAffineClass",
    "Step",
    "Tried",
    "Validation",
    "compare_repeats",
    "describe",
    "identify",
    "identify_block_cascade",
    "identify_from_repeats",
    "methods_of",
    "predict",
    "prove_implicit",
    "prove_stability",
    "select",
    "simulate_trial",
    "simulation_percent",
    "stated_rate",
    "validate",
    "without_missing",
]
