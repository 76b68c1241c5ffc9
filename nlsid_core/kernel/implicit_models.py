"""Implicit models as files state them: 0 = h(v, x, w), x⁺ = [v; ã(x, w)]."""

from dataclasses import dataclass
from fractions import Fraction

from .files import Node, Rejected, Terms

EQUATION = "0 = h(v, x, w), x+ = [v; shift(x, w)]"
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
    h: list[Terms]
    shift: list[Terms]
    centre: list[Terms]
    monotonicity: Fraction
    period: Fraction

    def separated(self) -> tuple[list[Terms], list[Terms]]:
        """(e in x, f in (x, w)) of a model e(x⁺) = f(x, w); Rejected if it is not of that form."""
        n = self.states
        if self.unknowns < n or any(any(e[:n]) and any(e[n:]) for p in self.h for e, _ in p):
            raise Rejected("the model is not e(x+) = f(x, w); this set is for such models")
        left = [[(e[:n], c) for e, c in p if any(e[:n])] for p in self.h]
        right = [[(e[n:], -c) for e, c in p if not any(e[:n])] for p in self.h]
        return left, right


def read_implicit_model(node: Node) -> ImplicitModel:
    """The model of a file."""
    names = "equation period states inputs monotonicity h"
    parts = node.document("model", names, "implicit", optional=f"shift centre {RECORDED}")
    if parts["equation"].text() != EQUATION:
        raise Rejected(f"{parts['equation'].where} should be {EQUATION!r}")
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
    return ImplicitModel(k, n, m, h, shift, centre, monotonicity, period)


def read_stack(node: Node, count: int, size: int) -> list[Terms]:
    """`size` polynomials with the same distinct `exponents`, `coefficients` a row for each."""
    parts = node.members("exponents coefficients")
    rows = parts["exponents"].monomials(count)
    values = parts["coefficients"].array(len(rows), size)
    return [
        [(e, row[i]) for e, row in zip(rows, values, strict=True) if row[i]] for i in range(size)
    ]
