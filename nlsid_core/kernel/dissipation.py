"""Claim `dissipation`: what two runs of a model with two inputs can differ by, in sums of squares.

V = x̄'Px̄ of the difference x̄ of two runs, the past inputs that the model remembers among the
states, satisfies λ V⁺ - V <= s(w̄, ȳ): with z = (ν, x̄, w̄) and ȳ = H z, at every vertex of the driven
increment form
    diag(0, P, 0) - λ F'PF + s(w̄, H z) + sym(N E) ≻ 0,
    s = γ²|w̄|² - |ȳ|² (gain γ) or 2 w̄'ȳ - 2ι|w̄|² (passivity of index ι),
both in units of stated scales. Summed over samples this bounds the outputs. Source:
docs/certificate_dissipation.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from . import text
from .decision import Decision
from .exact import Matrix, block_diagonal, combined, congruence, definite, scaled, transposed, zero
from .files import Node, Read, Rejected, bound_files
from .increments import MAX_WORK, Model, positive, read_model
from .polynomials import Work
from .signals import Signal, apart, within

MEMBERS = "kind about supply discount scales"


@dataclass(frozen=True)
class Dissipation:
    """A decided claim: γ or ι as `number`, in units of the scales of inputs and outputs.

    everywhere: for every input and output, none refused and no box.
    """

    model: Model
    kind: str
    number: Fraction
    discount: Fraction
    u_scales: list[Fraction]
    y_scales: list[Fraction]
    everywhere: bool


def decide(claim: Node, proof: Node, read: Read) -> Decision:
    """Decide {kind, about: {model}, supply, discount, scales[, box]} by {P, multipliers}."""
    return decide_dissipation(claim, proof, read)[0]


def decide_dissipation(claim: Node, proof: Node, read: Read) -> tuple[Decision, Dissipation]:
    """`decide`; also what was decided."""
    parts = claim.members(MEMBERS, "box")
    documents, digests = bound_files(parts["about"], read, "model")
    model = read_model(documents["model"], parts.get("box"), driven=True)
    found = _read(parts, model)
    given = proof.members("P", "multipliers")
    P = given["P"].array(model.states, model.states)
    definite(P, "P")
    storage = block_diagonal(zero(model.unknowns), P, zero(model.driven))
    gap = combined(storage, congruence(model.F, scaled(P, found.discount)), -1)
    what = "the growth of V = x'Px up to the supply"
    forms = [(what, combined(gap, _supply(found)))]
    positive(model, given.get("multipliers"), forms, Work(MAX_WORK))
    gain = found.kind == "gain"
    assumptions = []
    if "box" in parts:
        shown = ", ".join(
            within(*pair)
            for key, node in parts["box"].members("", "y u").items()
            for signals in (model.y if key == "y" else apart(model.u, model.y),)
            for pair in zip(signals, node.array(len(signals), 2), strict=True)
        )
        assumptions.append(f"from their past on, both runs stay in {shown}")
    decision = Decision(
        statement=_statement(found),
        margin=1 / found.number if gain else found.number,
        assumptions=tuple(assumptions),
        digests=digests,
    )
    return decision, found


def _read(parts: dict[str, Node], model: Model) -> Dissipation:
    supply = parts["supply"].members("kind number")
    kind, number = supply["kind"].text(), supply["number"].number()
    if kind not in ("gain", "passivity"):
        raise Rejected(f"supply {kind!r} is unknown; known: gain, passivity")
    if kind == "gain" and number <= 0:
        raise Rejected("a gain should be positive")
    if kind == "passivity" and len(model.u) != len(model.y):
        raise Rejected("passivity is of a model with as many inputs as outputs")
    if kind == "passivity" and model.limits == "clip":
        raise Rejected("passivity is of a model that does not clip its inputs")
    discount = parts["discount"].number()
    if not 0 < discount <= 1:
        raise Rejected("the discount should satisfy 0 < discount <= 1")
    scales = parts["scales"].members("u y")
    u, y = scales["u"].array(len(model.u)), scales["y"].array(len(model.y))
    if min(u + y) <= 0:
        raise Rejected("scales should be positive")
    everywhere = "box" not in parts and model.limits != "refuse"
    return Dissipation(model, kind, number, discount, u, y, everywhere)


def _supply(claim: Dissipation) -> Matrix:
    """s(w̄, H z) as a matrix of z."""
    model = claim.model
    size = len(model.F[0])
    H = [[e / s for e in row] for row, s in zip(model.H, claim.y_scales, strict=True)]
    W = [[(Fraction(1) / s if j == size - model.driven + i else Fraction(0)) for j in range(size)]
         for i, s in enumerate(claim.u_scales)]  # fmt: skip
    inputs = congruence(W, _identity(len(W)))
    if claim.kind == "gain":
        outputs = congruence(H, _identity(len(H)))
        return combined(scaled(inputs, claim.number**2), outputs, -1)
    cross = [
        [sum((w[i] * h[j] for w, h in zip(W, H, strict=True)), Fraction(0)) for j in range(size)]
        for i in range(size)
    ]
    return combined(combined(cross, transposed(cross)), inputs, -2 * claim.number)


def _identity(size: int) -> Matrix:
    return [[Fraction(int(i == j)) for j in range(size)] for i in range(size)]


def in_units(signals: Sequence[Signal], scales: Sequence[Fraction]) -> str:
    """`NAME in units of SCALE UNIT` for each, joined."""
    pairs = zip(signals, scales, strict=True)
    return " and ".join(f"{s.name} in units of {s.quantity(text.exact(by))}" for s, by in pairs)


def _statement(claim: Dissipation) -> str:
    model = claim.model
    fade = "" if claim.discount == 1 else f"{text.exact(claim.discount)}^k "
    outputs = in_units(model.y, claim.y_scales)
    inputs = in_units(apart(model.u, model.y), claim.u_scales)
    if claim.kind == "gain":
        said = "incremental gain: two runs of the model satisfy "
        bound = f"sum {fade}|dy|^2 <= G^2 sum {fade}|du|^2 + V(0)"
        bound += f" up to every sample t >= 0, G = {text.above(claim.number)}"
    else:
        low = text.below(claim.number)
        said = "incremental passivity: two runs of the model satisfy "
        if claim.number < 0:
            said = "limited shortage of incremental passivity: two runs of the model satisfy "
        excess = f"{low} sum {fade}|du|^2 " if claim.number else ""
        bound = f"sum {fade}du'dy >= {excess}- V(0)/2".replace(">= - ", ">= -")
        bound += " up to every sample t >= 0"
    return (
        f"{said}{bound}, dy the difference of {outputs}, du that of {inputs}, V(0) = x'Px of "
        f"the difference of their states, 0 where both have one past, {model.inputs}"
    )
