"""`python -I <this folder> FILE.proof.json ...`: PROVED or REJECTED for each; status 0, 1 or 2."""

import argparse
import importlib.util
import json
import signal
import sys
import time
from pathlib import Path
from types import FrameType
from typing import Any

if not __package__:  # run as a folder, by a Python that has no nlsid: be the package `kernel`
    _here = Path(__file__).resolve().parent
    _spec = importlib.util.spec_from_file_location(
        "kernel", _here / "__init__.py", submodule_search_locations=[str(_here)]
    )
    assert _spec is not None
    assert _spec.loader is not None
    _kernel = importlib.util.module_from_spec(_spec)
    sys.modules["kernel"] = _kernel
    _spec.loader.exec_module(_kernel)
else:
    from . import checking as _kernel

SECONDS = 15  # of processor time for a proof; a large one takes 3
MEMORY = 4096  # MB of address space
AFTER = 5  # s that a proof has to end in when its time is up, before the system ends it


def limited(seconds: int, memory: int) -> None:
    """Let the next proof take so much, from now on; says so where the system has no limits."""
    try:
        import resource
    except ImportError:
        print("no limits of time and memory on this system", file=sys.stderr)
        return
    until = int(time.process_time()) + max(1, seconds)

    def allow(what: int, most: int) -> None:
        hard = resource.getrlimit(what)[1]  # stays: it cannot be raised for the next proof
        soft = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(what, (soft, hard))

    def too_long(_: int, __: FrameType | None) -> None:
        signal.signal(signal.SIGXCPU, signal.SIG_DFL)
        allow(resource.RLIMIT_CPU, until + AFTER)
        raise _kernel.Rejected(f"it takes more than {seconds} s of processor time", "too_long")

    signal.signal(signal.SIGXCPU, too_long)
    allow(resource.RLIMIT_AS, memory * 2**20)
    allow(resource.RLIMIT_CPU, until)


def answer(path: str) -> dict[str, Any]:
    """The verdict as JSON has it; `rejected` and its `reason`; or `unread`, why it was not read.

    said: the same for a person.
    """
    try:
        verdict = _kernel.check(path)
        return {**vars(verdict), "margin": verdict.short_margin, "said": str(verdict)}
    except OSError as error:
        return {"unread": error.strerror, "said": f"cannot be read: {error.strerror}"}
    except _kernel.Rejected as refusal:
        said = f"REJECTED {refusal} [{refusal.reason}]"
        return {"rejected": str(refusal), "reason": refusal.reason, "said": said}
    except MemoryError:
        much = "reading it takes too much memory"
        return {"rejected": much, "reason": "too_large", "said": f"REJECTED {much} [too_large]"}


def main(given: list[str]) -> int:
    """0 if every file is proved, 1 if one is rejected, 2 if one cannot be read."""
    parser = argparse.ArgumentParser(prog="python -I <kernel folder>", description=__doc__)
    parser.add_argument("files", nargs="+", metavar="FILE.proof.json")
    parser.add_argument("--seconds", type=int, default=SECONDS, help="of processor time, each")
    parser.add_argument("--memory", type=int, default=MEMORY, help="MB, of address space")
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    options = parser.parse_args(given)
    status = 0
    for path in options.files:
        limited(options.seconds, options.memory)
        found = answer(path)
        status = max(status, 2 if "unread" in found else 1 if "rejected" in found else 0)
        name = "".join(sign if sign.isprintable() and sign.isascii() else "?" for sign in path)
        print(json.dumps(found) if options.json else f"{name}: {found['said']}")
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
