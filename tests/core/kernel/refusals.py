"""`refused`: the kernel says no, with the code of the reason that the fault has."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from nlsid_core.errors import CertificateRejected
from nlsid_core.kernel import REASONS, Rejected


@contextmanager
def refused(reason: str) -> Iterator[None]:
    """Fails unless what is inside is refused for this reason, one of kernel.REASONS."""
    assert reason in REASONS
    with pytest.raises((Rejected, CertificateRejected)) as found:
        yield
    refusal: Any = found.value
    assert refusal.reason == reason, str(refusal)
