"""`refused`: the kernel says no, with the code of the reason that the fault has."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from nlsid_core.errors import CertificateRejected
from nlsid_core.kernel import REASONS, Rejected
from nlsid_core.proofs import decide
from tests.funnel_files import PROOF, Files, bind


@contextmanager
def refused(reason: str) -> Iterator[None]:
    """Fails unless what is inside is refused for this reason, one of kernel.REASONS."""
    assert reason in REASONS
    with pytest.raises((Rejected, CertificateRejected)) as found:
        yield
    refusal: Any = found.value
    assert refusal.reason == reason, str(refusal)


def refused_with_fresh_digests(files: Files, reason: str) -> None:
    """The kernel refuses the documents of a funnel, all digests fresh, with this reason."""
    bind(files)
    with refused(reason):
        decide(files[PROOF], files)
