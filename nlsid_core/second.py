"""The second kernel's opinion of a proof file: the checker that `verified/` proves right in Coq.

It decides nothing that `nlsid_core.kernel` has not proved, and nothing needs it. `make -C verified
second` builds it: the program `nlsid-second`, looked for in the checkout and then on the PATH.
"""

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

BUILT = Path(__file__).resolve().parents[1] / "verified" / "build" / "nlsid-second"
PATIENCE = 600.0  # s
_VERDICTS: dict[int, Literal["accepted", "refused", "not covered"]] = {
    0: "accepted",
    1: "refused",
    3: "not covered",
}


@dataclass(frozen=True)
class Opinion:
    """verdict: `absent` if the program is not built here. reason: of `not covered`, `failed`."""

    verdict: Literal["accepted", "refused", "not covered", "absent", "failed"]
    reason: str = ""

    def __str__(self) -> str:
        """One line, for below the first kernel's verdict."""
        told = {
            "accepted": "accepted by the checker that Coq proves right (extracted)",
            "refused": "REFUSED: the two kernels disagree, one of them is wrong; please report it",
            "not covered": f"no theorem ({self.reason}); the first kernel alone decided",
            "absent": "not built here (make -C verified second); the first kernel alone decided",
            "failed": f"failed ({self.reason}); the first kernel alone decided",
        }
        return f"second kernel: {told[self.verdict]}"


def opinion(path: Path, program: Path | None = None) -> Opinion:
    """What the second kernel says of a proof file; program: in the place of the one found."""
    found = program or (BUILT if BUILT.is_file() else shutil.which("nlsid-second"))
    if found is None:
        return Opinion("absent")
    try:
        done = subprocess.run(
            [found, path], capture_output=True, text=True, check=False, timeout=PATIENCE
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return Opinion("failed", type(error).__name__)
    reason = done.stderr.strip().splitlines()[-1:] or [f"status {done.returncode}"]
    return Opinion(_VERDICTS.get(done.returncode, "failed"), reason[0].partition(": ")[2])
