"""A model file in increment form: which family its kind belongs to."""

from collections.abc import Callable

from .equations import read_affine, read_implicit, read_linear, read_monotone
from .files import Node, Rejected, refuse_if
from .increments import Model
from .networks import read_cascade, read_cells

READERS: dict[str, Callable[[Node], Model]] = {
    "difference_equation": read_linear,
    "state_affine": read_affine,
    "monotone_equation": read_monotone,
    "block_cascade": read_cascade,
    "cell_network": read_cells,
}


def read_model(node: Node, bounds: Node | None = None) -> Model:
    """The increment form of a model file's content.

    bounds: {y, u}, of the outputs and inputs of an implicit model that has no global form.
    """
    kind = node.kind()
    if kind == "implicit":
        return read_implicit(node, bounds)
    if kind not in READERS:
        known = ", ".join([*READERS, "implicit"])
        raise Rejected(f"{node.where}: kind is {kind!r}; known: {known}")
    refuse_if(
        bounds is not None,
        f"a model of kind {kind} needs no box: its increments are known everywhere",
    )
    return READERS[kind](node)
