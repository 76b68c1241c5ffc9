"""Identification: a dataset in, a stable model with its proof out (thesis Part I)."""

from nlsid_core.identification.fit import Candidate, Fit, History, Proof, Step, stated_rate
from nlsid_core.identification.identify import Selection, Tried, identify, select
from nlsid_core.identification.methods.options import (
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
from nlsid_core.identification.network.cascade import (
    BlockCascadeClass,
    CascadeFit,
    identify_block_cascade,
)
from nlsid_core.identification.network.cells import CellClass
from nlsid_core.identification.network.feedback import FeedbackClass
from nlsid_core.identification.polynomial.implicit_rows import ImplicitClass
from nlsid_core.identification.polynomial.linear import LinearClass
from nlsid_core.identification.polynomial.linear_states import LinearStateClass
from nlsid_core.identification.polynomial.moment_rie import MomentFit
from nlsid_core.identification.polynomial.moments import MonotoneClass
from nlsid_core.identification.polynomial.monotone import identify_from_repeats
from nlsid_core.identification.polynomial.rows import StateAffineClass
from nlsid_core.identification.prediction import Model, predict, simulate_trial
from nlsid_core.identification.proofs.stability import StabilityProof, prove_stability
from nlsid_core.identification.proofs.stable_sets import ImplicitProof, prove_implicit
from nlsid_core.identification.repeats import RepeatTest, compare_repeats
from nlsid_core.identification.searches import methods_of
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
