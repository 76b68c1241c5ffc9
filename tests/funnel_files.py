"""The files of a design, changed as a forger would."""

import json
from pathlib import Path
from typing import Any

from nlsid_core import files as documents
from nlsid_core import proofs
from nlsid_core.arrays import Json
from nlsid_core.designs import AnyDesign
from tests.edits import Edit

Files = dict[str, Any]
MODEL, FIELD, POLICY, FUNNEL, PROOF = (
    "model.json",
    "vector_field.json",
    "policy.json",
    "funnel.json",
    "funnel.proof.json",
)
ROLES = {"vector_field": FIELD, "policy": POLICY, "funnel": FUNNEL}


def files_of(design: AnyDesign) -> Files:
    """The documents of a design by file name, to be changed."""
    return copy_of(design.documents())


def copy_of(files: Files) -> Files:
    """The same documents, to be changed."""
    return dict(json.loads(json.dumps(files)))


def read(folder: Path) -> Files:
    """The documents of a folder by file name."""
    return {path.name: json.loads(path.read_text()) for path in folder.glob("*.json")}


def forged_by(forge: Edit, files: Files) -> Files:
    """The same documents, changed."""
    forged = copy_of(files)
    forge(forged)
    return forged


def bind(files: Files) -> None:
    """Make every digest fit the documents as they are now."""
    bases = {"model": MODEL, "vector_field": FIELD}
    for name, roles in ((POLICY, bases), (FUNNEL, bases | {"policy": POLICY})):
        for role in files.get(name, {}).keys() & roles.keys():
            files[name][role] = documents.digest(files[roles[role]])
    for document in files.values():
        for binding in document.get("claim", {}).get("about", {}).values():
            binding["digest"] = documents.digest(files[binding["file"]])


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
    return next(folder / name for name in files if name.endswith(".proof.json"))
