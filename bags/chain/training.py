"""The training data kept beside a model, so that later steps measure on what it was fitted to."""

import hashlib
import io
import json
import zipfile
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
    arrays: dict[str, np.ndarray] = {}
    labels = []
    for index, trial in enumerate(dataset):
        arrays |= {f"t{index}": trial.t, f"y{index}": trial.y, f"u{index}": trial.u}
        labels.append({key: getattr(trial, key) for key in (*NAMES, *LABELS)})
    arrays["labels"] = np.frombuffer(json.dumps(labels).encode(), dtype=np.uint8)
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    write_atomically(path, stream.getvalue())
    return _digest(stream.getvalue())


def load_training(path: Path | str, *, digest: str) -> Dataset:
    """Read what `save_training` wrote; nothing is unpickled.

    Raises DataError if the content is not what `digest` says; OS errors pass through.
    """
    content = Path(path).read_bytes()
    if _digest(content) != digest:
        raise DataError(f"{path}: not the data the model was fitted to; run `nlsid identify` again")
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            labels = json.loads(arrays["labels"].tobytes())
            return Dataset(
                tuple(
                    Trajectory(
                        t=arrays[f"t{index}"],
                        y=arrays[f"y{index}"],
                        u=arrays[f"u{index}"],
                        **_labels(entry),
                    )
                    for index, entry in enumerate(labels)
                )
            )
    except (KeyError, ValueError, TypeError, zipfile.BadZipFile) as error:
        raise DataError(f"{path}: not a training file: {error}") from error


def _labels(entry: dict[str, Any]) -> dict[str, Any]:
    texts = {key: str(entry[key]) for key in NAMES}
    return texts | {key: tuple(map(str, entry[key])) for key in LABELS}


def _digest(content: bytes) -> str:
    return "sha256:" + hashlib.sha256(content).hexdigest()
