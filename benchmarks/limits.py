"""Work that is stopped when it has used its processor time."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager


class OutOfTimeError(BaseException):
    """Work took more than its processor time; no `except Exception` on the way is for it."""


@contextmanager
def stopped_after(seconds: float) -> Iterator[None]:
    """Raise OutOfTimeError in what runs inside once it has used this much processor time."""

    def stop(*_: object) -> None:
        raise OutOfTimeError(f"stopped: not ended after {seconds:.3g} s of processor time")

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
