"""The trials kept beside a model: those it was fitted to, and those that were held back from it."""

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError
from nlsid_core.files import write_atomically

LABELS = ("y_names", "u_names", "y_units", "u_units", "y_paths", "u_paths")
NAMES = ("name", "group", "digest", "provenance")


def save_training(path: Path | str, dataset: Dataset) -> str:
    """Write `dataset` as an .npz file and return its `sha256:` digest."""
    content = encoded({"training": dataset})
    write_atomically(path, content)
    return _digest(content)


def load_training(path: Path | str, *, digest: str) -> Dataset:
    """Read what `save_training` wrote; nothing is unpickled.

    Raises DataError if the content is not what `digest` says; OS errors pass through.
    """
    content = Path(path).read_bytes()
    if _digest(content) != digest:
        raise DataError(f"{path}: not the data the model was fitted to; run `nlsid identify` again")
    return decoded(content, source=f"{path}: not a training file")["training"]


def save_held_back(path: Path | str, parts: Mapping[str, Dataset], *, model: str) -> None:
    """Write trials that the model with this digest was not fitted to, by what they are for."""
    write_atomically(path, encoded(parts, model=model))


def load_held_back(path: Path | str, *, model: str) -> dict[str, Dataset]:
    """Read what `save_held_back` wrote, nothing if there is no such file.

    Raises DataError if the trials were held back from another model.
    """
    path = Path(path)
    if not path.exists():
        return {}
    return decoded(path.read_bytes(), model=model, source=f"{path}: not trials held back")


def encoded(parts: Mapping[str, Dataset], *, model: str = "", compressed: bool = True) -> bytes:
    """The .npz content of trials by their use; model: the digest of the model that they made.

    Compressing some kilobytes takes three times as long as all the rest.
    """
    arrays: dict[str, np.ndarray] = {}
    labels: list[dict[str, Any]] = []
    for use, dataset in parts.items():
        for trial in dataset:
            index = len(labels)
            arrays |= {f"t{index}": trial.t, f"y{index}": trial.y, f"u{index}": trial.u}
            labels.append({key: getattr(trial, key) for key in (*NAMES, *LABELS)} | {"use": use})
    document = json.dumps({"model": model, "trials": labels})
    arrays["labels"] = np.frombuffer(document.encode(), dtype=np.uint8)
    stream = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def decoded(content: bytes, *, model: str = "", source: str) -> dict[str, Dataset]:
    """What `encoded` made; nothing is unpickled. DataError, which `source` begins, if it is not."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            document = json.loads(arrays["labels"].tobytes())
            if document["model"] != model:
                raise DataError(f"{source} from this model; run `nlsid identify` again")
            parts: dict[str, list[Trajectory]] = {}
            for index, entry in enumerate(document["trials"]):
                trial = Trajectory(
                    t=arrays[f"t{index}"],
                    y=arrays[f"y{index}"],
                    u=arrays[f"u{index}"],
                    **_labels(entry),
                )
                parts.setdefault(str(entry["use"]), []).append(trial)
    except (KeyError, ValueError, TypeError, zipfile.BadZipFile) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{source}: {error}") from error
    return {use: Dataset(tuple(trials)) for use, trials in parts.items()}


def _labels(entry: dict[str, Any]) -> dict[str, Any]:
    texts = {key: str(entry[key]) for key in NAMES}
    return texts | {key: tuple(map(str, entry[key])) for key in LABELS}


def _digest(content: bytes) -> str:
    return "sha256:" + hashlib.sha256(content).hexdigest()
