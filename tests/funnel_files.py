"""The four files of a continuous funnel, changed as a forger would."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nlsid_core import files as documents
from nlsid_core import proofs
from nlsid_core.arrays import Json
from nlsid_core.design import FunnelDesign

Files = dict[str, Any]
FIELD, POLICY, FUNNEL, PROOF = (
    "vector_field.json",
    "policy.json",
    "funnel.json",
    "funnel.proof.json",
)
ROLES = {"vector_field": FIELD, "policy": POLICY, "funnel": FUNNEL}


def saved(design: FunnelDesign, folder: Path) -> Files:
    """The documents of a design, by file name."""
    return {path.name: json.loads(path.read_text()) for path in design.save(folder)}


def copy_of(files: Files) -> Files:
    """The same documents, to be changed."""
    return dict(json.loads(json.dumps(files)))


def forged_by(forge: Callable[[Files], None], files: Files) -> Files:
    """The same documents, changed."""
    forged = copy_of(files)
    forge(forged)
    return forged


def bind(files: Files) -> None:
    """Make every digest fit the documents as they are now."""
    field = documents.digest(files[FIELD])
    files[POLICY]["vector_field"] = files[FUNNEL]["vector_field"] = field
    files[FUNNEL]["policy"] = documents.digest(files[POLICY])
    for role, name in ROLES.items():
        files[PROOF]["claim"]["about"][role]["digest"] = documents.digest(files[name])


def stated(field: Json, policy: Json, funnel: Json, proof: Json, **claim: Any) -> Files:
    """The files of a claim with these members, `hold`, `error` or `goal`, and all digests right."""
    about = {role: {"file": name, "digest": ""} for role, name in ROLES.items()}
    claimed = {"kind": "continuous_funnel", "about": about, **claim}
    document = proofs.proof_document(claimed, proof)
    files = {FIELD: field, POLICY: policy, FUNNEL: funnel, PROOF: document}
    bind(files)
    return files


def write(files: Files, folder: Path, *, rebind: bool = True) -> Path:
    """The files as they are, or with every digest made to fit again; returns the proof's path."""
    files = copy_of(files)
    if rebind:
        bind(files)
    for name, document in files.items():
        (folder / name).write_bytes(documents.encode(document))
    return folder / PROOF
