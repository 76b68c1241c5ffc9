"""The trusted part: it rebuilds a claim exactly and decides it, with no solver."""

from nlsid_core.certificate.attraction import prove_attraction
from nlsid_core.certificate.check import check, proof_document
from nlsid_core.certificate.identity import Mode, Product, decide_gram, decide_identity
from nlsid_core.certificate.nonnegative import prove_lower_bound
from nlsid_core.certificate.verdict import Decision, Verdict

__all__ = [
    "Decision",
    "Mode",
    "Product",
    "Verdict",
    "check",
    "decide_gram",
    "decide_identity",
    "proof_document",
    "prove_attraction",
    "prove_lower_bound",
]
