"""The file a recording grows in: written whole or not at all, with room kept for its end."""

import errno
import fcntl
import os
from pathlib import Path
from typing import Final

RESERVE_BYTES: Final = 8 * 2**20  # a chunk, the summary of hours, and metadata.yaml
FULL: Final = (errno.ENOSPC, errno.EDQUOT)


class Reserve:
    """Disk space held by a file, so that a bag can still be closed once the disk is full.

    Raises OSError if there is not even that much.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.spent = ""
        with path.open("xb") as stream:
            try:
                os.posix_fallocate(stream.fileno(), 0, RESERVE_BYTES)
            except OSError as error:
                path.unlink()
                raise OSError(error.errno, error.strerror, str(path)) from error

    def spend(self, why: str) -> None:
        """Give the space back because of `why`."""
        self.spent = why
        self.release()

    def release(self) -> None:
        """Give the space back."""
        self.path.unlink(missing_ok=True)


class Output:
    """A new file that other processes see locked while it is open. `size`: bytes written.

    A write that fails leaves nothing of itself behind. On a full disk it spends the reserve and is
    tried again; whoever writes should then look at `reserve.spent` and come to an end.
    """

    def __init__(self, path: Path, reserve: Reserve | None = None) -> None:
        self.size = 0
        self._path, self._reserve = path, reserve
        self._stream = path.open("xb", buffering=0)
        fcntl.flock(self._stream, fcntl.LOCK_EX)  # whoever repairs bags leaves this one alone

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return self._stream.closed

    def write(self, data: bytes) -> int:
        """Append `data`; OSError if there is no room and no reserve."""
        try:
            self._append(data)
        except OSError as error:
            if self._reserve is None or self._reserve.spent or error.errno not in FULL:
                raise
            self._reserve.spend(str(error))
            self._append(data)
        return len(data)

    def _append(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._stream.write(rest) :]
        except OSError:
            self._stream.truncate(self.size)
            self._stream.seek(self.size)
            raise
        self.size += len(data)

    def refuse_loss(self) -> None:
        """OSError unless the file is still there under its name, with all that was written."""
        ours, there = os.fstat(self._stream.fileno()), self._path.stat()
        if not os.path.samestat(ours, there) or there.st_size != self.size:
            raise OSError(f"{self._path} was replaced or cut by another program")

    def sync(self) -> None:
        """Wait until the bytes are on the disk; OSError as `refuse_loss`."""
        self.refuse_loss()
        os.fsync(self._stream.fileno())

    def close(self) -> None:
        """Close and unlock the file."""
        self._stream.close()
