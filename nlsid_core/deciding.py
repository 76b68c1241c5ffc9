"""`Deciding`: the kernel at work on a proof, in a process of its own with limits; and what it knew.

Whoever uses a proof has it decided here: `nlsid check`, publisher, monitor and controller alike.
The process is `python -I <kernel folder>`, which limits its own processor time and address space by
the operating system, and it starts in a tenth of a second.

A proof that this machine has decided is remembered, by the digest of its bytes and of the kernel's
own sources, with the digests of all files that were read for it: what is remembered is what would
be decided again. Nothing is remembered where the sources change meanwhile. The folder is the user's
own, of mode 0700; what another user could have written is ignored.
"""

import contextlib
import hashlib
import json
import os
import signal
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

from nlsid_core import kernel
from nlsid_core.errors import CertificateMismatch, CertificateRejected
from nlsid_core.kernel import Verdict
from nlsid_core.kernel.checking import read_regular
from nlsid_core.kernel.files import digest

PATIENCE: Final = 30  # times the seconds on the wall, on a machine that has other work
KERNEL: Final = Path(kernel.__file__).parent
LARGEST: Final = 2**20  # bytes of an entry
LOOK: Final = 0.01  # s between two looks at the process


@dataclass(frozen=True)
class Limits:
    """What a proof may take: s of processor time (a large one takes 3), MB of address space."""

    seconds: int = 15
    memory: int = 4096


USUAL: Final = Limits()


class Deciding:
    """A proof that the kernel is at work on; `poll` until it returns a verdict, or `wait` for it.

    before: whether this machine had decided it, so that nothing is done.
    """

    def __init__(self, proof: Path, limits: Limits = USUAL, *, remembered: bool = True) -> None:
        """Begin. OSError if the proof cannot be read, CertificateRejected if it is too large."""
        self._seconds, self._begun = limits.seconds, time.monotonic()
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        with _own_errors():
            self._proof = read_regular(proof)
        self._key = _entry(self._proof)
        self._found = _recalled(self._proof, proof.parent) if remembered else None
        self.before = self._found is not None
        self._answer = tempfile.TemporaryFile()  # noqa: SIM115 - until close
        options = "--json", f"--seconds={limits.seconds}", f"--memory={limits.memory}"
        self._process: subprocess.Popen[bytes] | None = None
        if not self.before:
            self._process = subprocess.Popen(
                [sys.executable, "-I", str(KERNEL), *options, str(proof.absolute())],
                stdin=subprocess.DEVNULL,
                stdout=self._answer,
                stderr=subprocess.DEVNULL,
            )

    @classmethod
    def of(cls, proof: bytes, files: Mapping[str, bytes], limits: Limits = USUAL) -> "Deciding":
        """The same for a proof in memory; `files` by the names that it calls them."""
        folder = tempfile.TemporaryDirectory(prefix="nlsid-proof-")
        path = Path(folder.name) / f"{digest(proof)[7:]}.json"
        path.write_bytes(proof)
        for name, content in files.items():
            if name not in ("", ".", "..") and not set(name) & set("/\\:\0"):
                with contextlib.suppress(OSError):  # too long a name: the kernel misses the file
                    path.with_name(name).write_bytes(content)
        made = cls(path, limits)
        made._folder = folder
        return made

    @property
    def seconds(self) -> float:
        """s since it began."""
        return time.monotonic() - self._begun

    def poll(self) -> Verdict | None:
        """None while the kernel works; then its verdict.

        Raises CertificateRejected with the reason, CertificateMismatch if a file is another.
        """
        if self._found is not None or self._process is None:
            return self._found
        status = self._process.poll()
        if status is None and self.seconds < PATIENCE * self._seconds:
            return None
        self._answer.seek(0)
        content = self._answer.read()
        if status is None or not content:
            raise CertificateRejected(self._why(status))
        self._found = _verdict(json.loads(content))
        if _entry(self._proof) == self._key:  # else another kernel may have answered
            _remember(self._key, self._found)
        return self._found

    def wait(self) -> Verdict:
        """`poll` until there is a verdict; then let go of the process."""
        try:
            while (found := self.poll()) is None:
                time.sleep(LOOK)
        finally:
            self.close()
        return found

    def close(self) -> None:
        """Stop it if it runs, and release its process and files."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._answer.close()
        if self._folder is not None:
            self._folder.cleanup()

    def _why(self, status: int | None) -> str:
        """Why there is no answer."""
        if status is None:
            return f"not decided within {PATIENCE * self._seconds} s"
        if -status in (signal.SIGXCPU, signal.SIGKILL):
            return f"it takes more than {self._seconds} s of processor time, or too much memory"
        return f"the kernel ended with status {status}"


def as_ours(message: str, reason: str) -> CertificateRejected:
    """The kernel's refusal as this project's error."""
    made = CertificateMismatch if reason == "mismatch" else CertificateRejected
    refusal = made(message)
    refusal.reason = reason
    return refusal


def _verdict(answer: dict[str, Any]) -> Verdict:
    """What the kernel's process has written."""
    if "unread" in answer:
        raise OSError(0, answer["unread"])
    if "rejected" in answer:
        raise as_ours(answer["rejected"], answer["reason"])
    return Verdict(
        answer["statement"],
        Fraction(answer["margin"]),
        tuple(answer["assumptions"]),
        answer["digests"],
        answer["kind"],
        answer["files"],
    )


@contextlib.contextmanager
def _own_errors() -> Iterator[None]:
    """The kernel's refusals as this project's."""
    try:
        yield
    except kernel.Rejected as refusal:
        raise as_ours(str(refusal), refusal.reason) from refusal


def _sources() -> bytes:
    """The kernel's own sources, by which its decisions are known."""
    found = hashlib.sha256()
    for path in sorted(KERNEL.glob("*.py")):
        found.update(hashlib.sha256(path.read_bytes()).digest())
    return found.digest()


def _entry(proof: bytes) -> str:
    return hashlib.sha256(_sources() + hashlib.sha256(proof).digest()).hexdigest()


def _is_ours(status: os.stat_result, mode: int) -> bool:
    """Whether it is this user's, and of this mode: nobody else can have written it."""
    return status.st_uid == os.getuid() and stat.S_IMODE(status.st_mode) == mode


def _cache() -> Path | None:
    """The folder that keeps earlier decisions; None where the user has none of their own."""
    try:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(base) / "nlsid" / "decided"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.lstat()
        ours = stat.S_ISDIR(status.st_mode) and _is_ours(status, 0o700)
    except (OSError, RuntimeError, AttributeError):  # no home, or no users
        return None
    return folder if ours else None


def _recalled(proof: bytes, folder: Path) -> Verdict | None:
    """The verdict of a proof that was decided before, about files that are still the same."""
    known = _cache()
    if known is None:
        return None
    try:
        handle = os.open(known / _entry(proof), os.O_RDONLY | os.O_NOFOLLOW)
        with os.fdopen(handle, "rb") as stream:
            status = os.fstat(handle)
            if not (stat.S_ISREG(status.st_mode) and _is_ours(status, 0o600)):
                return None
            verdict = _verdict(json.loads(stream.read(LARGEST)))
        same = all(digest(read_regular(folder / n)) == d for n, d in verdict.files.items())
    except (OSError, ValueError, LookupError, TypeError, kernel.Rejected):
        return None
    return verdict if same and verdict.digests.get("proof") == digest(proof) else None


def _remember(key: str, verdict: Verdict) -> None:
    known = _cache()
    if known is None:
        return
    content = json.dumps({**asdict(verdict), "margin": str(verdict.margin)}).encode()
    with contextlib.suppress(OSError):
        handle, name = tempfile.mkstemp(dir=known)  # of mode 0600
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
        Path(name).replace(known / key)
