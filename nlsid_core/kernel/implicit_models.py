"""Implicit models as files state them: 0 = h(v, x, w), x⁺ = [v; ã(x, w)]."""

from dataclasses import dataclass
from fractions import Fraction

from .files import Node, Terms, refuse_if

EQUATION = "0 = h(v, x, w), x+ = [v; shift(x, w)]"
MAX_IMPLICIT, MAX_WINDOW = 30, 60  # states, and entries of w, of an implicit model
IMPLICIT = "equation period states inputs monotonicity h"
RECORDED = "y u window training bags"  # of an implicit model of recorded signals


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
        refuse_if(
            self.unknowns < n or any(any(e[:n]) and any(e[n:]) for p in self.h for e, _ in p),
            "the model is not e(x+) = f(x, w); this set is for such models",
        )
        left = [[(e[:n], c) for e, c in p if any(e[:n])] for p in self.h]
        right = [[(e[n:], -c) for e, c in p if not any(e[:n])] for p in self.h]
        return left, right


def read_implicit_model(node: Node) -> ImplicitModel:
    """The equations of an `implicit` model's file."""
    parts = node.document("model", IMPLICIT, "implicit", optional=f"shift centre {RECORDED}")
    refuse_if(
        parts["equation"].text() != EQUATION, f"{parts['equation'].where} should be {EQUATION!r}"
    )
    n = len([entry.text() for entry in parts["states"].items(1, MAX_IMPLICIT)])
    m = len([entry.text() for entry in parts["inputs"].items(0, MAX_WINDOW)])
    monotonicity, period = parts["monotonicity"].number(), parts["period"].number()
    refuse_if(monotonicity <= 0 or period <= 0, "monotonicity and period should be positive")
    rows = parts["h"].members("exponents coefficients")["coefficients"].array(None, None)
    k = len(rows[0]) if rows else 0
    refuse_if(
        not 0 < k <= n or ("shift" in parts) != (k < n),
        f"{k} equations for {n} states; a shift gives the others",
    )
    h = _read_stack(parts["h"], k + n + m, k)
    shift = _read_stack(parts["shift"], n + m, n - k) if "shift" in parts else []
    centre = _read_stack(parts["centre"], k, k) if "centre" in parts else []
    return ImplicitModel(k, n, m, h, shift, centre, monotonicity, period)


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
