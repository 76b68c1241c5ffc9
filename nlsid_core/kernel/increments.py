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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import chain, product
from math import comb, prod
from types import SimpleNamespace

from .exact import Matrix, Rows, combined, definite, scaled, transposed
from .exact import product as times
from .files import Node, Terms, limit, no_more, refuse_if
from .signals import Signal

MAX_POWER = 20  # of a variable in a monomial of E
MAX_SPLITS = 40  # of one box, one inside the other
MAX_VERTICES = 10**5  # of a box

Box = list[tuple[Fraction, Fraction]]
Entries = list[list[Terms]]  # a matrix of polynomials in θ
Linear = SimpleNamespace  # B, D, input_range of x⁺ = A x + B u + f, y = x_1 + D u + c


@dataclass(frozen=True)
class Hull:
    """E(θ), each (m, m + n), for θ in a box.

    ray: E(θ) may have any multiple of [1, 0] added. whole: so many entries of the box, the first,
    cannot be split.
    """

    E: Entries
    box: Box = field(default_factory=list)
    ray: bool = False
    whole: int = 0

    def vertices(self, box: Box) -> list[Matrix]:
        """The Bernstein coefficients of E(θ) on a part of the box: their hull holds its values.

        On [lo, hi], at index k of degree d, θ^e has the coefficient
        Σ_j C(e, j) lo^(e-j) (hi - lo)^j C(k, j)/C(d, j).
        Where they differ in one entry only, the two extreme ones have the same hull.
        """
        powers = {e for row in self.E for entry in row for e, _ in entry}
        highest = [max(e[i] for e in powers) for i in range(len(box))]
        limit(max(highest, default=0), MAX_POWER, "the power of a variable")
        degrees = [
            most if low < high else 0 for most, (low, high) in zip(highest, box, strict=True)
        ]
        limit(prod(d + 1 for d in degrees), MAX_VERTICES, "vertices of a box")
        tables = [
            [[_weight(e, k, d, *ends) for k in range(d + 1)] for e in range(most + 1)]
            for most, d, ends in zip(highest, degrees, box, strict=True)
        ]
        found: list[Matrix] = []
        for k in product(*(range(d + 1) for d in degrees)):
            weights = {e: prod(t[e[i]][k[i]] for i, t in enumerate(tables)) for e in powers}
            found.append(
                [[Fraction(sum(c * weights[e] for e, c in p)) for p in row] for row in self.E]
            )
        columns = zip(*(chain.from_iterable(matrix) for matrix in found), strict=True)
        varying = sum(any(entry != column[0] for entry in column) for column in columns)
        return found if varying > 1 else [min(found), max(found)][: 1 + varying]


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
    where: str = "for every input"
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
    M = scaled(times(transposed(G), times(Q, G)), -1)
    for start, block in ((model.unknowns, scaled(P, rho)), (len(model.F[0]), R)):
        for i, row in enumerate(block, start):
            for j, entry in enumerate(row, start):
                M[i][j] += entry
    return M


def positive(model: Model, multipliers: Node | None, gaps: Sequence[tuple[str, Matrix]]) -> None:
    """Raise Rejected unless M + sym(N [E 0]) ≻ 0 for each gap (what, M), at every vertex E.

    `multipliers` is a leaf {N}, N of M's order × m, a list of one for each gap if there are
    several; or {split, parts}: the entry of the box that is halved, and the multipliers of the
    lower and of the upper half.
    """
    m, size = model.unknowns, len(gaps[0][1])
    refuse_if((multipliers is None) != (m == 0), "multipliers are for models with ν, and needed")
    if multipliers is None:
        for what, M in gaps:
            definite(M, what)
        return
    for box, given in _leaves(multipliers, model.E, model.E.box):
        Ns = given.array(len(gaps), size, m) if len(gaps) > 1 else [given.array(size, m)]
        pointed = all(N[0][0] >= 0 and not any(row[0] for row in N[1:]) for N in Ns)
        shape = {"with a ray N should be (T >= 0, 0, ..., 0)": pointed or not model.E.ray}
        given.require(shape, "not_below")
        for E in model.E.vertices(box):
            wide = [row + [Fraction(0)] * (size - len(row)) for row in E]
            for (what, M), N in zip(gaps, Ns, strict=True):
                cross = times(N, wide)
                definite(combined(M, combined(cross, transposed(cross))), what)


def _leaves(node: Node, E: Hull, box: Box, depth: int = 0) -> Iterator[tuple[Box, Node]]:
    """The N of every leaf of the tree, and its part of the box."""
    parts = node.members("N? ends? split? parts?")
    if "ends" in parts:
        no_more(parts["ends"])
    if set(parts) == {"N"}:
        yield box, parts["N"]
        return
    splits = set(parts) == {"split", "parts"} and box
    node.require({"should be a multiplier N, or split and parts of a box": splits})
    limit(depth + 1, MAX_SPLITS, f"{node.where}: splits, one inside the other")
    i = parts["split"].whole(E.whole, len(box) - 1)
    low, high = box[i]
    halves = ((low, (low + high) / 2), ((low + high) / 2, high))
    for half, part in zip(halves, parts["parts"].items(2, 2), strict=True):
        yield from _leaves(part, E, [*box[:i], half, *box[i + 1 :]], depth + 1)


def _weight(e: int, k: int, d: int, low: Fraction, high: Fraction) -> Fraction:
    parts = (
        comb(e, j) * low ** (e - j) * (high - low) ** j * Fraction(comb(k, j), comb(d, j))
        for j in range(min(e, k) + 1)
    )
    return sum(parts, Fraction(0))
