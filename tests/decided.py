"""What the kernel says of files, decided in this process: `check` starts another for each proof."""

from pathlib import Path

from nlsid_core import files
from nlsid_core.identification import prove_stability
from nlsid_core.models import StableModel
from nlsid_core.proofs import Verdict, check, decide


def decided(proof: Path) -> Verdict:
    """`check` of a proof about the files beside it, without limits and without what was known.

    For tests that ask of many files; those of `check` itself are in tests/bags and tests/core.
    """
    beside = {path.name: path.read_bytes() for path in proof.parent.iterdir() if path.is_file()}
    return decide(proof.read_bytes(), beside)


def checked(model: StableModel, folder: Path) -> str:
    """The sentence of a model's stability, from its files."""
    proof = prove_stability(model)
    assert proof is not None
    files.write_document(folder / "model.json", model.document())
    files.write_document(folder / "model.proof.json", proof.document(model, "model.json"))
    return check(folder / "model.proof.json").statement
