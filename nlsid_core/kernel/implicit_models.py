"""Implicit models as files state them: 0 = h(v, x, w), x⁺ = [v; ã(x, w)]."""

from typing import Any

from .files import Node, Table, Terms, each, no_more, one_of

MAX_STATES, MAX_WINDOW = 30, 60  # of x, and of w

Implicit = dict[str, Any]  # the members of an implicit model's file, its equations as Terms
IMPLICIT: Table = {
    "equation": one_of("0 = h(v, x, w), x+ = [v; shift(x, w)]"),
    "period": (),
    "states": each(Node.text, 1, MAX_STATES),
    "inputs": each(Node.text, 0, MAX_WINDOW),
    "monotonicity": (),
    "h": None,
    **dict.fromkeys(("shift?", "y?", "u?", "window?", "training?", "bags?")),
    "centre?": no_more,
}


def read_implicit(node: Node) -> Implicit:
    """The members of an `implicit` model's file: 0 = h(v, x, w), x⁺ = [v; ã(x, w)]."""
    given = node.document("model", IMPLICIT, "implicit")
    n, m = len(given["states"]), len(given["inputs"])
    rows = given["h"].members("exponents coefficients")["coefficients"].array(None, None)
    k = len(rows[0]) if rows else 0
    positive = given["monotonicity"] > 0 and given["period"] > 0
    node.require(
        {
            "monotonicity and period should be positive": positive,
            "there should be an equation, and no more than states": 0 < k <= n,
            "two states have the same name": len(set(given["states"])) == n,
            "two inputs have the same name": len(set(given["inputs"])) == m,
            "a shift gives the states without an equation": bool(given["shift"]) == (k < n),
        }
    )
    given["h"] = _read_stack(given["h"], k + n + m, k)
    given["shift"] = _read_stack(given["shift"], n + m, n - k) if k < n else []
    return given


def _read_stack(node: Node, count: int, size: int) -> list[Terms]:
    """`size` polynomials with the same distinct `exponents`, `coefficients` a row for each."""
    parts = node.members("exponents coefficients")
    rows = parts["exponents"].monomials(count)
    values = parts["coefficients"].array(len(rows), size)
    return [
        [(e, row[i]) for e, row in zip(rows, values, strict=True) if row[i]] for i in range(size)
    ]


def derivative(p: Terms, j: int) -> Terms:
    """∂p/∂(variable j)."""
    return [(bytes([*e[:j], e[j] - 1, *e[j + 1 :]]), c * e[j]) for e, c in p if e[j]]
