"""What the kernel says of files, decided in this process: `check` starts another for each proof."""

from pathlib import Path

from nlsid_core.proofs import Verdict, decide


def decided(proof: Path) -> Verdict:
    """`check` of a proof about the files beside it, without limits and without what was known.

    For tests that ask of many files; those of `check` itself are in tests/bags and tests/core.
    """
    beside = {path.name: path.read_bytes() for path in proof.parent.iterdir() if path.is_file()}
    return decide(proof.read_bytes(), beside)
