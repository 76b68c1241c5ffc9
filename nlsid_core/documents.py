"""`load`: whichever noun a file holds, by the format and kind that it declares."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final, TypeAlias

from nlsid_core import files
from nlsid_core.arrays import Json
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import DocumentError
from nlsid_core.funnels import AnyFunnel, ContinuousFunnel, SampledFunnel, TubeFunnel
from nlsid_core.models import (
    BlockCascade,
    CellNetwork,
    DifferenceEquation,
    ImplicitModel,
    MonotoneEquation,
    StableModel,
    StateAffineModel,
    StateModel,
)
from nlsid_core.policies import AnyPolicy, ContinuousPolicy, SampledPolicy, TubePolicy

Noun: TypeAlias = AnyFunnel | AnyPolicy | VectorField | StableModel | StateModel

# By format, and by kind where the format has kinds.
READERS: Final[Mapping[tuple[str, str | None], Callable[..., Noun]]] = {
    ("nlsid/funnel", "continuous"): ContinuousFunnel.from_document,
    ("nlsid/policy", "continuous"): ContinuousPolicy.from_document,
    ("nlsid/vector_field", None): VectorField.from_document,
    ("nlsid/funnel", "sampled"): SampledFunnel.from_document,
    ("nlsid/funnel", "tube"): TubeFunnel.from_document,
    ("nlsid/policy", "tube"): TubePolicy.from_document,
    ("nlsid/policy", "sampled"): SampledPolicy.from_document,
    ("nlsid/model", "block_cascade"): BlockCascade.from_document,
    ("nlsid/model", "cell_network"): CellNetwork.from_document,
    ("nlsid/model", "difference_equation"): DifferenceEquation.from_document,
    ("nlsid/model", "implicit"): ImplicitModel.from_document,
    ("nlsid/model", "monotone_equation"): MonotoneEquation.from_document,
    ("nlsid/model", "state_affine"): StateAffineModel.from_document,
    ("nlsid/model", "state_map"): StateModel.from_document,
}


def load(path: Path | str) -> Noun:
    """Read a funnel, policy, vector field or model; DocumentError says what is wrong."""
    return read(files.load_document(path), source=str(path))


def read(document: Json, *, source: str) -> Noun:
    """`load` for a document in memory."""
    name = files.member(document, "format", str, source=source)
    kind = document.get("kind")
    reader = READERS.get((name, kind if isinstance(kind, str) else None))
    if reader is None and name == "nlsid/proof":
        raise DocumentError(f"{source} is a proof: give one of the files that its claim is about")
    if reader is None:
        known = ", ".join(sorted({f"{f} {k or ''}".strip() for f, k in READERS}))
        raise DocumentError(f"{source}: no '{name}' of kind {kind!r} is known; known: {known}")
    return reader(document, source=source)
