"""What a native library writes to standard error by itself, past Python."""

import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Lock
from typing import IO, Final

STDERR: Final = 2  # the file descriptor, which Python's sys.stderr writes to as well
_PANIC: Final = re.compile(rb"\n?thread '[^\n]*' panicked at .*?(?:\nnote: [^\n]*\n|\Z)", re.DOTALL)


class NativeStderr:
    """Standard error of this process, which its threads share.

    A Rust library that panics prints a backtrace there before Python sees the exception.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._inside = 0
        self._kept: IO[bytes] | None = None
        self._saved = -1

    @contextmanager
    def without_panics(self) -> Iterator[None]:
        """Leave the backtraces of Rust's panics out; everything else is written when this ends."""
        self._enter()
        try:
            yield
        finally:
            self._leave()

    def _enter(self) -> None:
        with self._lock:
            self._inside += 1
            if self._inside > 1:
                return

            self._kept = self._kept or tempfile.TemporaryFile()  # noqa: SIM115 - open to the end
            with suppress(OSError):  # it is closed: nothing can be written there
                self._saved = os.dup(STDERR)
                os.dup2(self._kept.fileno(), STDERR)

    def _leave(self) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside or self._saved < 0 or self._kept is None:
                return

            os.dup2(self._saved, STDERR)
            os.close(self._saved)
            self._saved = -1
            if not os.lseek(self._kept.fileno(), 0, os.SEEK_CUR):
                return

            self._kept.seek(0)
            said = _PANIC.sub(b"", self._kept.read())
            self._kept.seek(0)
            self._kept.truncate()
            with suppress(OSError):
                os.write(STDERR, said)
