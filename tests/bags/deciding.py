"""What a receiver of a bundle is told."""

from bags.designs.bundle import Bundle
from nlsid_core.arrays import Json
from nlsid_core.errors import NlsidError


def decide(text: str) -> Json:
    """What a receiver is told."""
    try:
        bundle = Bundle.parse(text)
        deciding = bundle.deciding()
        verdict = deciding.wait()
        bundle.refuse_others(verdict)
    except NlsidError as refusal:
        return {"refused": str(refusal)}
    return {"proved": str(verdict), "digest": bundle.digest, "before": deciding.before}
