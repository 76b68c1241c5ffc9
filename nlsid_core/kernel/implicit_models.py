"""Implicit models as files state them: 0 = h(v, x, w), x⁺ = [v; ã(x, w)]; and their well-posedness.

Well posed means that h has exactly one zero v for every state x and input w:
    h is strongly monotone in v,   2y'(∂h/∂v y) - 2m|y|² >= 0 with m > 0            (Theorem 2.5)
or it follows a centre e₀ that is a bijection,
    2(E₀y)'(∂h/∂v y) - |E₀y|² >= 0,   E₀ = ∂e₀/∂v                              (Proposition 2.7)
e₀ being linear with |E₀y|² - m²|y|² >= 0, or strongly monotone itself; each for every v and y.
Source: thesis (2.4), (2.7), (2.11)-(2.15).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from .files import Node, Rejected
from .polynomials import Polynomial, Ring
from .terms import Terms, along, dot, read_stack

EXPECTED = {
    "format": "nlsid/model",
    "kind": "implicit",
    "equation": "0 = h(v, x, w), x+ = [v; shift(x, w)]",
}
VERSION = 2
MAX_STATES = 30
MAX_INPUTS = 60  # entries of w: inputs and their delays
MEMBERS = "format version kind equation period states inputs monotonicity h shift centre"
RECORDED = "y u window training bags"  # of a model of recorded signals; no part of any claim


@dataclass(frozen=True)
class ImplicitModel:
    """h in (v, x, w), ã in (x, w), and perhaps a centre in v; n states, m entries of w."""

    unknowns: int
    states: int
    inputs: int
    h: tuple[Terms, ...]
    shift: tuple[Terms, ...]
    centre: tuple[Terms, ...]
    monotonicity: Fraction
    period: Fraction

    def separated(self) -> tuple[tuple[Terms, ...], tuple[Terms, ...]]:
        """(e in x, f in (x, w)) of a model e(x⁺) = f(x, w); Rejected if it is not of that form."""
        n = self.states
        if self.unknowns < n or any(any(e[:n]) and any(e[n:]) for p in self.h for e, _ in p):
            raise Rejected("the model is not e(x+) = f(x, w); this set is for such models")
        left = tuple(tuple((e[:n], c) for e, c in p if any(e[:n])) for p in self.h)
        right = tuple(tuple((e[n:], -c) for e, c in p if not any(e[:n])) for p in self.h)
        return left, right


def read_implicit_model(node: Node) -> ImplicitModel:
    """The model of a file."""
    parts = node.members(
        "format version kind equation period states inputs monotonicity h",
        f"shift centre {RECORDED}",
    )
    for name, expected in EXPECTED.items():
        if parts[name].text() != expected:
            raise Rejected(f"{parts[name].where} should be {expected!r}")
    if parts["version"].whole(0) != VERSION:
        raise Rejected(f"the model's version should be {VERSION}")
    n = len([entry.text() for entry in parts["states"].items(1, MAX_STATES)])
    m = len([entry.text() for entry in parts["inputs"].items(0, MAX_INPUTS)])
    monotonicity, period = parts["monotonicity"].number(), parts["period"].number()
    if monotonicity <= 0 or period <= 0:
        raise Rejected("monotonicity and period should be positive")
    rows = parts["h"].members("exponents coefficients")["coefficients"].array(None, None)
    k = len(rows[0]) if rows else 0
    if not 0 < k <= n or ("shift" in parts) != (k < n):
        raise Rejected(f"{k} equations for {n} states; a shift gives the others")
    h = read_stack(parts["h"], k + n + m, k)
    shift = read_stack(parts["shift"], n + m, n - k) if "shift" in parts else []
    centre = read_stack(parts["centre"], k, k) if "centre" in parts else []
    return ImplicitModel(k, n, m, tuple(h), tuple(shift), tuple(centre), monotonicity, period)


def well_posed(
    model: ImplicitModel,
    v: Sequence[Polynomial],
    known: Sequence[Polynomial],
    y: Sequence[Polynomial],
    ring: Ring,
) -> dict[str, Polynomial]:
    """What has to be >= 0: `monotone`, or `centre` (everywhere) and `centred`; known = [x, w]."""
    slope = [along(p, [*v, *known], y, ring) for p in model.h]
    size = dot(y, y, ring)
    if not model.centre:
        return {"monotone": _monotone(slope, y, model, ring)}
    inner = [along(p, v, y, ring) for p in model.centre]
    square = dot(inner, inner, ring)
    centred = ring.minus(ring.scaled(dot(inner, slope, ring), 2), square)
    if all(sum(e) <= 1 for p in model.centre for e, _ in p):
        regular = ring.minus(square, ring.scaled(size, model.monotonicity**2))
        return {"centre": regular, "centred": centred}
    return {"centre": _monotone(inner, y, model, ring), "centred": centred}


def _monotone(
    slope: Sequence[Polynomial], y: Sequence[Polynomial], model: ImplicitModel, ring: Ring
) -> Polynomial:
    difference = ring.minus(dot(y, slope, ring), ring.scaled(dot(y, y, ring), model.monotonicity))
    return ring.scaled(difference, 2)
