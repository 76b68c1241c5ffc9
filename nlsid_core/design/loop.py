"""`compose_loop`: two proved gains in files, and the proof that a loop of both models is bounded.

Source: docs/certificate_small_gain.md.
"""

from collections.abc import Sequence
from pathlib import Path

from nlsid_core import files, proofs
from nlsid_core.arrays import Json
from nlsid_core.design.compose import write_beside
from nlsid_core.errors import CertificateMismatch, CertificateRejected, DataError, Infeasible
from nlsid_core.kernel import Verdict

LOOP = "small_gain.proof.json"
KIND = "dissipation"
TOO_LARGE = "the product of the gains is not below 1"  # the kernel's last reason to refuse


def is_gain(path: Path | str) -> bool:
    """Whether a file is a proof of a gain or of passivity."""
    claim = files.load_document(Path(path)).get("claim")
    return isinstance(claim, dict) and claim.get("kind") == KIND


def compose_loop(paths: Sequence[Path | str], folder: Path | str) -> tuple[Path, Verdict]:
    """Bind two proofs of gains, and their models, into one claim that `check` decides.

    Copies each proof and its model to `folder`, as first.proof.json, first.model.json and so on,
    and writes small_gain.proof.json, whose path is returned.

    Raises DataError if there are not two proofs, CertificateRejected or CertificateMismatch if one
    is none of a gain or the models do not fit, Infeasible if the gains' product is 1 or more.
    """
    if len(paths) != 2:
        raise DataError(f"a loop is of two proved gains, got {len(paths)}")
    contents: dict[str, bytes] = {}
    about: Json = {}
    numbers = []
    for role, path in zip(("first", "second"), map(Path, paths), strict=True):
        if not is_gain(path):
            raise CertificateRejected(f"{path} is no proof of a gain")
        document = files.load_document(path)
        claim = document["claim"]
        supply = claim.get("supply")
        kind = supply.get("kind") if isinstance(supply, dict) else None
        if kind != "gain":
            raise CertificateRejected(
                f"{path} proves {kind or 'something else'}, not a gain: a loop is proved by two "
                "gains, which `nlsid gain` finds without --passivity"
            )
        given = files.member(claim, "about", dict, source=str(path))
        binding = files.member(given, "model", dict, source=str(path))
        name = files.member(binding, "file", str, source=str(path))
        beside = path.parent / name
        if beside.name != name or not beside.is_file():
            raise CertificateMismatch(f"{path}: the model file {name!r} is not beside it")
        own = {"model": binding | {"file": f"{role}.model.json"}}
        document = document | {"claim": claim | {"about": own}}
        proof = files.encode(document)
        contents |= {f"{role}.model.json": beside.read_bytes(), f"{role}.proof.json": proof}
        about[role] = {"file": f"{role}.proof.json", "digest": files.digest(proof)}
        numbers.append(files.number(supply, "number", source=f"{path} supply"))
    loop = proofs.proof_document({"kind": "small_gain", "about": about}, {})
    try:
        verdict = proofs.decide(loop, contents)
    except CertificateRejected as refusal:
        if str(refusal) != TOO_LARGE:
            raise
        one, two = numbers
        raise Infeasible(
            f"the gains {one:.4g} and {two:.4g} have the product {one * two:.4g}; only a product "
            "below 1 proves the loop"
        ) from refusal
    write_beside(Path(folder), contents, [Path(path) for path in paths])
    files.write_document(Path(folder) / LOOP, loop)
    return Path(folder) / LOOP, verdict
