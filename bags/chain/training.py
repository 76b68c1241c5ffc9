"""The trials kept beside a model: those it was fitted to, and those held back from it."""

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


def save_trials(path: Path | str, parts: Mapping[str, Dataset]) -> str:
    """Write trials by what they are for as an .npz file and return its `sha256:` digest."""
    content = encoded(parts)
    write_atomically(path, content)
    return _digest(content)


def load_trials(path: Path | str, *, digest: str) -> dict[str, Dataset]:
    """Read what `save_trials` wrote; nothing is unpickled.

    Raises DataError if the content is not what `digest` says; OS errors pass through.
    """
    content = Path(path).read_bytes()
    if _digest(content) != digest:
        raise DataError(f"{path}: not the trials of this model; run `nlsid identify` again")
    return decoded(content, source=f"{path}: not a file of trials")


def encoded(parts: Mapping[str, Dataset], *, compressed: bool = True) -> bytes:
    """The .npz content of trials by their use.

    Compressing some kilobytes takes three times as long as all the rest.
    """
    arrays: dict[str, np.ndarray] = {}
    labels: list[dict[str, Any]] = []
    for use, dataset in parts.items():
        for trial in dataset:
            index = len(labels)
            arrays |= {f"t{index}": trial.t, f"y{index}": trial.y, f"u{index}": trial.u}
            labels.append({key: getattr(trial, key) for key in (*NAMES, *LABELS)} | {"use": use})
    arrays["labels"] = np.frombuffer(json.dumps(labels).encode(), dtype=np.uint8)
    stream = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def decoded(content: bytes, *, source: str) -> dict[str, Dataset]:
    """What `encoded` made; nothing is unpickled. DataError, which `source` begins, if it is not."""
    parts: dict[str, list[Trajectory]] = {}
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            for index, entry in enumerate(json.loads(arrays["labels"].tobytes())):
                signals = {letter: arrays[f"{letter}{index}"] for letter in "tyu"}
                labels: dict[str, Any] = {key: str(entry[key]) for key in NAMES}
                labels |= {key: tuple(map(str, entry[key])) for key in LABELS}
                trial = Trajectory(**signals, **labels)
                parts.setdefault(str(entry["use"]), []).append(trial)
    except (KeyError, ValueError, TypeError, zipfile.BadZipFile) as error:
        raise DataError(f"{source}: {error}") from error
    return {use: Dataset(tuple(trials)) for use, trials in parts.items()}


def _digest(content: bytes) -> str:
    return "sha256:" + hashlib.sha256(content).hexdigest()
