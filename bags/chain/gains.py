"""`gain_of`: a model file in, a proof of its gain beside it, and two runs that come near it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from bags.chain.training import load_training
from bags.designs import documents
from nlsid_core import files, proofs
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError
from nlsid_core.identification import DissipationProof, prove_gain, prove_passivity
from nlsid_core.identification.two_runs import TwoRuns, two_runs
from nlsid_core.kernel import Verdict
from nlsid_core.models import ImplicitModel, Signal, StableModel, StateAffineModel

BOX_ROOM = 0.1  # of what the training trials reach, on which a gain holds where it needs a box


@dataclass(frozen=True, eq=False)
class Gain:
    """What was proved, two runs that come near it if the inputs' ranges are known, and the file."""

    model: StableModel
    proof: DissipationProof
    verdict: Verdict
    reached: TwoRuns | None
    file: Path

    @property
    def unit(self) -> str:
        """Of the number: the output's per the input's, empty where scales take both away."""
        y, u = signals(self.model)
        if len(y) != 1 or len(u) != 1 or self.proof.y_scales[0] != 1 or self.proof.u_scales[0] != 1:
            return ""
        return f"{y[0].unit or '1'} per {u[0].unit or '1'}" if y[0].unit or u[0].unit else ""


def gain_of(
    model_path: Path,
    *,
    kind: Literal["gain", "passivity"] = "gain",
    discount: float = 1.0,
    scales: Mapping[str, float] | None = None,
) -> Gain | None:
    """Write MODEL.gain.proof.json, or MODEL.passivity.proof.json, beside MODEL.json.

    scales: units of signals by name, 1 where none is given. A model that needs a box is proved on a
    tenth more than the trials in training.npz reach. None if nothing was proved. Raises DataError.
    """
    model = documents.load_stable_model(model_path)
    y, u = signals(model)
    names = [signal.name for signal in (*y, *u)]
    unknown = set(scales or ()) - set(names)
    if unknown:
        raise DataError(
            f"no signal is called {', '.join(sorted(unknown))}; the model has {', '.join(names)}"
        )
    y_scales, u_scales = (
        np.array([(scales or {}).get(signal.name, 1.0) for signal in part]) for part in (y, u)
    )
    train = _trials(model_path, model)
    prove: Any = prove_gain if kind == "gain" else prove_passivity
    options: dict[str, Any] = {"discount": discount, "u_scales": u_scales, "y_scales": y_scales}
    try:
        proof = prove(model, **options)
    except DataError as refusal:
        box = _box(model, train)
        if "box" not in str(refusal) or (train is not None and box is None):
            raise
        if box is None:
            raise DataError(
                f"{refusal}. It is taken from the trials in {documents.TRAINING}, and these are "
                "not beside the model"
            ) from refusal
        proof = prove(model, box=box, **options)
    if proof is None:
        return None
    document = proof.document(model, model_path.name)
    content = model_path.read_bytes()
    document["claim"]["about"]["model"]["digest"] = files.digest(content)
    verdict = proofs.decide(document, {model_path.name: content})
    file = model_path.with_name(f"{model_path.stem}.{kind}.proof.json")
    files.write_document(file, document)
    reach, reached = _reach(model, train), None
    if reach is not None and discount == 1.0:
        reached = two_runs(
            model,
            kind,
            reach,
            u_scales=u_scales,
            y_scales=y_scales,
            y_box=None if proof.box is None else proof.box["y"],
        )
    return Gain(model, proof, verdict, reached, file)


def signals(model: StableModel) -> tuple[tuple[Signal, ...], tuple[Signal, ...]]:
    """Outputs and inputs."""
    return tuple(
        (part,) if isinstance(part, Signal) else tuple(part) for part in (model.y, model.u)
    )  # type: ignore[return-value]


def _trials(model_path: Path, model: StableModel) -> Dataset | None:
    """Those the model was fitted to, if they are beside it."""
    path = model_path.with_name(documents.TRAINING)
    training = getattr(model, "training", "")
    return load_training(path, digest=training) if training and path.is_file() else None


def _reach(model: StableModel, train: Dataset | None) -> FloatArray | None:
    """(n_u, 2): what the inputs of the trials reach, or else the model's own range."""
    if train is not None:
        return _ranges([trial.u for trial in train])
    own = getattr(model, "u_range", None)
    return None if own is None else np.atleast_2d(np.asarray(own, dtype=np.float64))


def _ranges(parts: list[FloatArray], room: float = 0.0) -> FloatArray:
    low, high = (
        np.array([getattr(np, f"nan{end}")(part, axis=0) for part in parts])
        for end in ("min", "max")
    )
    low, high = low.min(axis=0), high.max(axis=0)
    return np.stack([low - room * (high - low), high + room * (high - low)], axis=1)


def _box(model: StableModel, train: Dataset | None) -> Json | None:
    if train is None or not isinstance(model, ImplicitModel | StateAffineModel):
        return None
    box: Json = {"y": _ranges([trial.y for trial in train], BOX_ROOM).tolist()}
    if isinstance(model, ImplicitModel):
        box["u"] = _ranges([trial.u for trial in train], BOX_ROOM).tolist()
    return box
