"""Implicit models as files state them: 0 = h(v, x, w), x⁺ = [v; ã(x, w)]."""

from dataclasses import dataclass
from fractions import Fraction

from .files import Node, Table, Terms, each, itself, one_of, refuse_if

EQUATION = "0 = h(v, x, w), x+ = [v; shift(x, w)]"
MAX_IMPLICIT, MAX_WINDOW = 30, 60  # states, and entries of w
EQUATIONS = "format version kind equation period states inputs monotonicity h"
IMPLICIT: Table = {  # the members of a file; those of recorded signals are not read
    "equation": one_of(EQUATION),
    "period": (),
    "states": each(Node.text, 1, MAX_IMPLICIT),
    "inputs": each(Node.text, 0, MAX_WINDOW),
    "monotonicity": (),
    "h": itself,
    "shift?": itself,
    "centre?": itself,
    "y?": itself,
    "u?": itself,
    "window?": itself,
    "training?": itself,
    "bags?": itself,
}


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
        mixed = any(any(e[:n]) and any(e[n:]) for p in self.h for e, _ in p)
        refuse_if(mixed or self.unknowns < n, "the set is for models e(x+) = f(x, w)")
        left = [[(e[:n], c) for e, c in p if any(e[:n])] for p in self.h]
        right = [[(e[n:], -c) for e, c in p if not any(e[:n])] for p in self.h]
        return left, right


def read_implicit_model(node: Node) -> ImplicitModel:
    """The equations of an `implicit` model's file."""
    given = node.document("model", IMPLICIT, "implicit")
    n, m = len(given["states"]), len(given["inputs"])
    rows = given["h"].members("exponents coefficients")["coefficients"].array(None, None)
    k = len(rows[0]) if rows else 0
    positive = given["monotonicity"] > 0 and given["period"] > 0
    node.require(
        {
            "monotonicity and period should be positive": positive,
            "there should be an equation, and no more than states": 0 < k <= n,
            "a shift gives the states without an equation": bool(given["shift"]) == (k < n),
        }
    )
    h = _read_stack(given["h"], k + n + m, k)
    shift = _read_stack(given["shift"], n + m, n - k) if given["shift"] else []
    centre = _read_stack(given["centre"], k, k) if given["centre"] else []
    return ImplicitModel(k, n, m, h, shift, centre, given["monotonicity"], given["period"])


def derivative(p: Terms, j: int) -> Terms:
    """∂p/∂(variable j)."""
    return [(bytes([*e[:j], e[j] - 1, *e[j + 1 :]]), c * e[j]) for e, c in p if e[j]]


def _read_stack(node: Node, count: int, size: int) -> list[Terms]:
    """`size` polynomials with the same distinct `exponents`, `coefficients` a row for each."""
    parts = node.members("exponents coefficients")
    rows = parts["exponents"].monomials(count)
    values = parts["coefficients"].array(len(rows), size)
    return [
        [(e, row[i]) for e, row in zip(rows, values, strict=True) if row[i]] for i in range(size)
    ]
