"""The trusted part: it rebuilds a claim exactly and decides it, with no solver."""

from nlsid_core.certificate.check import check, proof_document
from nlsid_core.certificate.verdict import Decision, Verdict

__all__ = ["Decision", "Verdict", "check", "proof_document"]
