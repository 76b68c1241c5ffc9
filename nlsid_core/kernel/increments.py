"""How two solutions of an identified model under one input differ, and the one inequality of it.

With ζ = (ν, x̄), x̄ the difference of the states and ν those of quantities that the model defines
by an equation,
    E(θ) ζ = 0,    x̄⁺ = F ζ,    o = H ζ,    E(θ) in the convex hull of finitely many matrices,
plus multiples of [1, 0] where the form has a ray. θ is what is not known: the input where the
model is affine in its outputs, the slope of a nonlinearity elsewhere. With an innovation e beside
ζ, every claim asks at each of these matrices, with multipliers N of its own,
    diag(0, ρP, R) - G'QG + sym(N [E 0]) ≻ 0.
It is affine in E, so it holds at E(θ), where (ζ, e)'N E ζ = 0; a ray adds 2 T s ν² >= 0.
docs/certificate_stability.md has the forms and why.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

from .exact import Matrix, Rows, combined, definite, product, scaled, transposed
from .files import Node, Table, itself, limit, refuse_if
from .signals import Signal

MAX_STATES = 120
MAX_SPLITS = 40  # of one box, one inside the other

Box = list[tuple[Fraction, Fraction]]


@dataclass(frozen=True)
class Linear:
    """x⁺ = A x + B u + f, y = x_1 + D u + c, in the increment form's own state."""

    B: list[Fraction]
    D: Fraction
    input_range: tuple[Fraction, Fraction]


@dataclass(frozen=True)
class Hull:
    """E(θ), each (m, m + n), for θ in a box: in the hull of the vertices of a part that θ is in.

    vertices: of a part of the box, perhaps by stated ends. ray: E(θ) may have any multiple of
    [1, 0] added. whole: so many entries of the box, the first, cannot be split.
    """

    vertices: Callable[[Box, Node | None], list[Matrix]]
    box: Box = field(default_factory=list)
    ray: bool = False
    whole: int = 0


@dataclass(frozen=True)
class Model:
    """A model file in increment form: F (n, m + n), H (p, m + n) for m quantities ν.

    where: for which inputs this is so, in words.
    """

    period: Fraction
    y: tuple[Signal, ...]
    u: tuple[Signal, ...]
    F: Matrix
    H: Matrix
    E: Hull
    where: str
    linear: Linear | None = None

    @property
    def states(self) -> int:
        """n."""
        return len(self.F)

    @property
    def unknowns(self) -> int:
        """m."""
        return len(self.F[0]) - len(self.F)


def gap(model: Model, rho: Fraction, P: Rows, R: Rows, G: Rows, Q: Rows) -> Matrix:
    """diag(0, ρP, R) - G'QG, without the multipliers."""
    M = scaled(product(transposed(G), product(Q, G)), -1)
    for start, block in ((model.unknowns, scaled(P, rho)), (len(model.F[0]), R)):
        for i, row in enumerate(block, start):
            for j, entry in enumerate(row, start):
                M[i][j] += entry
    return M


def positive(model: Model, multipliers: Node | None, gaps: Sequence[tuple[str, Matrix]]) -> None:
    """Raise Rejected unless M + sym(N [E 0]) ≻ 0 for each gap (what, M), at every vertex E.

    `multipliers` is a leaf {N}, N of M's order × m, a list of one for each gap if there are
    several; or {split, parts}: the variable of the box that is halved, and the multipliers of the
    lower and of the upper half. A leaf may state `ends` beside N: bounds of the one entry of E that
    varies, in the place of the vertices.
    """
    m, size = model.unknowns, len(gaps[0][1])
    refuse_if((multipliers is None) != (m == 0), "multipliers are for models with ν, and needed")
    if multipliers is None:
        for what, M in gaps:
            definite(M, what)
        return
    for box, leaf in _leaves(multipliers, model.E, model.E.box):
        given = leaf["N"]
        Ns = given.array(len(gaps), size, m) if len(gaps) > 1 else [given.array(size, m)]
        pointed = all(N[0][0] >= 0 and not any(row[0] for row in N[1:]) for N in Ns)
        shape = {"with a ray N should be (T >= 0, 0, ..., 0)": pointed or not model.E.ray}
        leaf["N"].require(shape, "not_below")
        for E in model.E.vertices(box, leaf.get("ends")):
            wide = [row + [Fraction(0)] * (size - len(row)) for row in E]
            for (what, M), N in zip(gaps, Ns, strict=True):
                cross = product(N, wide)
                definite(combined(M, combined(cross, transposed(cross))), what)


def _leaves(node: Node, E: Hull, box: Box, depth: int = 0) -> Iterator[tuple[Box, dict[str, Node]]]:
    """Every leaf of the tree, and its part of the box."""
    parts = node.members("", "N ends split parts")
    if set(parts) == {"N"} or (set(parts) == {"N", "ends"} and box):
        yield box, parts
        return
    splits = set(parts) == {"split", "parts"} and box
    node.require({"should be a multiplier N, or split and parts of a box": splits})
    limit(depth + 1, MAX_SPLITS, f"{node.where}: splits, one inside the other")
    i = parts["split"].whole(E.whole, len(box) - 1)
    low, high = box[i]
    halves = ((low, (low + high) / 2), ((low + high) / 2, high))
    for half, part in zip(halves, parts["parts"].items(2, 2), strict=True):
        yield from _leaves(part, E, [*box[:i], half, *box[i + 1 :]], depth + 1)


def read_recorded(node: Node, kind: str, table: Table) -> dict[str, Any]:
    """The members of a model of recorded signals; what made it is not read."""
    heads: Table = {"period": (), "training": itself, "bags": itself, "equation?": itself}
    given = node.document("model", {**heads, **table}, kind)
    node.require({"the period should be positive": given["period"] > 0})
    return given


def sized(n: int, node: Node) -> int:
    """So many states."""
    return limit(n, MAX_STATES, f"{node.where}: states", least=1)
