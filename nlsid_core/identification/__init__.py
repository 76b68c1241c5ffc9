"""Identification: a dataset in, a stable model with its proof out (thesis Part I)."""

from nlsid_core.identification.block_cascade import (
    BlockCascadeClass,
    CascadeFit,
    identify_block_cascade,
)
from nlsid_core.identification.cascade_proof import CascadeProof, prove_block_cascade
from nlsid_core.identification.contraction import StateAffineProof, prove_state_affine
from nlsid_core.identification.fit import (
    CERTIFIED,
    CERTIFIED_SEM,
    FINAL,
    FIRST,
    LEAST_SQUARES,
    METHODS,
    RIE,
    SEM,
    UNBIASED_RIE,
    Candidate,
    Fit,
    History,
    Proof,
    Step,
    stated_rate,
)
from nlsid_core.identification.from_repeats import identify_from_repeats
from nlsid_core.identification.identify import identify
from nlsid_core.identification.implicit import ImplicitProof, prove_implicit
from nlsid_core.identification.implicit_class import ImplicitClass
from nlsid_core.identification.linear_states import LinearStateClass
from nlsid_core.identification.model_class import ModelClass, describe
from nlsid_core.identification.moment_rie import MomentFit
from nlsid_core.identification.moments import MonotoneClass
from nlsid_core.identification.monotone_proof import MonotoneProof, prove_monotone_equation
from nlsid_core.identification.prediction import Model, predict, simulate_trial
from nlsid_core.identification.regression import LinearClass
from nlsid_core.identification.repeats import RepeatTest, compare_repeats
from nlsid_core.identification.searches import methods_of
from nlsid_core.identification.selection import Selection, Tried, select
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
    "CERTIFIED",
    "CERTIFIED_SEM",
    "FINAL",
    "FIRST",
    "LEAST_SQUARES",
    "METHODS",
    "RIE",
    "SEM",
    "UNBIASED_RIE",
    "BlockCascadeClass",
    "Candidate",
    "CascadeFit",
    "CascadeProof",
    "Fit",
    "History",
    "ImplicitClass",
    "ImplicitProof",
    "LinearClass",
    "LinearStateClass",
    "Model",
    "ModelClass",
    "MomentFit",
    "MonotoneClass",
    "MonotoneProof",
    "Proof",
    "RepeatTest",
    "Residual",
    "Selection",
    "StabilityProof",
    "StateAffineClass",
    "StateAffineProof",
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
    "prove_block_cascade",
    "prove_implicit",
    "prove_monotone_equation",
    "prove_stability",
    "prove_state_affine",
    "select",
    "simulate_trial",
    "simulation_percent",
    "stated_rate",
    "validate",
    "without_missing",
]
