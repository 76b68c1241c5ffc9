"""`load`: whichever noun a file holds, by the format and kind that it declares."""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TypeAlias

from nlsid_core import _json
from nlsid_core.continuous import Funnel, Policy, VectorField
from nlsid_core.discrete_funnel import DiscreteFunnel
from nlsid_core.errors import DocumentError
from nlsid_core.funnel import Funnel as EnergyTube
from nlsid_core.models import (
    BlockCascade,
    DifferenceEquation,
    ImplicitModel,
    MonotoneEquation,
    StateAffineModel,
    StateModel,
)
from nlsid_core.policy import Policy as TubePolicy
from nlsid_core.tracking_policy import TrackingPolicy

Noun: TypeAlias = (
    Funnel | DiscreteFunnel | EnergyTube | Policy | TrackingPolicy | TubePolicy | VectorField
    | BlockCascade | DifferenceEquation | ImplicitModel | MonotoneEquation | StateAffineModel
    | StateModel
)  # fmt: skip

# By format, and by kind where the format has kinds.
READERS: Mapping[tuple[str, str | None], Callable[..., Noun]] = MappingProxyType(
    {
        ("nlsid/trajectory_funnel", None): Funnel.from_document,
        ("nlsid/trajectory_policy", None): Policy.from_document,
        ("nlsid/vector_field", None): VectorField.from_document,
        ("nlsid/funnel", None): EnergyTube.from_document,
        ("nlsid/funnel", "discrete"): DiscreteFunnel.from_document,
        ("nlsid/policy", None): TubePolicy.from_document,
        ("nlsid/policy", "time_varying"): TrackingPolicy.from_document,
        ("nlsid/model", "block_cascade"): BlockCascade.from_document,
        ("nlsid/model", "difference_equation"): DifferenceEquation.from_document,
        ("nlsid/model", "implicit"): ImplicitModel.from_document,
        ("nlsid/model", "monotone_equation"): MonotoneEquation.from_document,
        ("nlsid/model", "state_affine"): StateAffineModel.from_document,
        ("nlsid/model", "state_map"): StateModel.from_document,
    }
)


def load(path: Path | str) -> Noun:
    """Read a funnel, policy, vector field or model of any kind; DocumentError says what is wrong.

    For one kind only, ask its class: `Funnel.load(path)`, `Policy.load(path)`.
    """
    document = _json.load_document(path)
    name = _json.member(document, "format", str, source=str(path))
    kind = document.get("kind")
    reader = READERS.get((name, kind if isinstance(kind, str) else None))
    if reader is None:
        known = ", ".join(sorted({f"{f} {k or ''}".strip() for f, k in READERS}))
        raise DocumentError(f"{path}: no '{name}' of kind {kind!r} is known; known: {known}")
    return reader(document, source=str(path))
