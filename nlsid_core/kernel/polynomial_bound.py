"""Claim: a polynomial p is at least a bound, or a symmetric matrix M is ⪰ 0, on a domain.

With the domain {x : g_k(x) >= 0, h_j(x) = 0} the obligation is
    φ·(p - bound) - Σ_k σ_k g_k - Σ_j μ_j h_j >= 0 everywhere,
σ_k sums of squares, μ_j any polynomials, φ = 1 or a stated constant > 0 plus a sum of squares.
M(x) ⪰ 0 where y'M(x) y >= 0 for every y: the same in (x, y), with p = y'My and bound 0.
Source: Putinar 1993; Scherer and Hol 2006 for matrices; Reznick 1995 for φ.
"""

from collections.abc import Sequence
from fractions import Fraction

from . import text
from .decision import Decision
from .files import Node, Read, Rejected, bound_files
from .polynomials import FREE_OF_S, MOST_WORK, Polynomial, Ring, Work, at_width
from .positivity import expanded, positive_on, read_witness
from .terms import MAX_VARIABLES, Terms, form, read_names, read_terms, shown, substituted

MAX_ORDER = 20  # of a matrix
MAX_CONDITIONS = 100  # of the domain
BOUND_DIGITS = 12  # of the bound in the sentence


def decide(claim: Node, proof: Node, read: Read) -> Decision:
    """Rebuild the inequality from the claim's numbers, and decide it by the proof's squares."""
    is_matrix = type(claim.value) is dict and "matrix" in claim.value
    what = "matrix" if is_matrix else "polynomial bound"
    parts = claim.members(f"kind about variables {what}", "domain equalities")
    _, digests = bound_files(parts["about"], read, "")
    names = read_names(parts["variables"])
    n = len(names)
    domain, equalities = (
        [read_terms(entry, n) for entry in parts[key].items(0, MAX_CONDITIONS)]
        if key in parts
        else []
        for key in ("domain", "equalities")
    )
    matrix = _read_matrix(parts["matrix"], n) if is_matrix else []
    if n + len(matrix) > MAX_VARIABLES:
        raise Rejected(f"more than {MAX_VARIABLES} variables, those of y'My included")
    p = () if is_matrix else read_terms(parts["polynomial"], n)
    bound = Fraction(0) if is_matrix else parts["bound"].rational()
    margin = Fraction(0)

    def build(ring: Ring) -> None:
        nonlocal margin
        x = [ring.variable(i) for i in range(n)]
        y = [ring.variable(n + i) for i in range(len(matrix))]
        M = [[substituted(entry, x, ring) for entry in row] for row in matrix]
        below = ring.minus(substituted(p, x, ring), ring.constant(bound))
        target = form(M, y, ring) if is_matrix else below
        inside, on = ([substituted(g, x, ring) for g in part] for part in (domain, equalities))
        left = _decided(target, inside, on, proof, ring)
        forms = [ring.key([int(i == n + k) for i in range(ring.count)]) for k in range(len(matrix))]
        margin = min((left.get(key, Fraction(0)) for key in forms or [0]), default=Fraction(0))

    at_width(n + len(matrix), Work(MOST_WORK), build, first=FREE_OF_S)
    where = [f"{shown(g, names)} >= 0" for g in domain]
    where += [f"{shown(h, names)} = 0" for h in equalities]
    condition = f" with {' and '.join(where)}" if where else ""
    inequality = (
        f"the matrix {_shown_matrix(matrix, names)} is positive semidefinite"
        if is_matrix
        else f"{shown(p, names)} >= {text.below(bound, BOUND_DIGITS)}"
    )
    return Decision(f"{inequality} for all real {', '.join(names)}{condition}", margin, (), digests)


def _decided(
    target: Polynomial,
    inside: Sequence[Polynomial],
    on: Sequence[Polynomial],
    proof: Node,
    ring: Ring,
) -> dict[int, Fraction]:
    """φ·target - Σ σ g - Σ μ h >= 0: what is left over by monomial."""
    parts = proof.members("basis columns squares", "multipliers equality_multipliers factor")
    if "factor" in parts:
        target = ring.times(_factor(parts.pop("factor"), ring), target)
    if "equality_multipliers" in parts or on:
        if "equality_multipliers" not in parts:
            raise Rejected("each equation of the domain needs an equality multiplier")
        x = [ring.variable(i) for i in range(ring.count)]
        stated = parts.pop("equality_multipliers").items(len(on), len(on))
        terms = [
            ring.times(substituted(read_terms(entry, ring.count), x, ring), h)
            for entry, h in zip(stated, on, strict=True)
        ]
        target = ring.minus(target, ring.sum(terms))
    rest = Node({key: part.value for key, part in parts.items()}, proof.where)
    return positive_on(target, inside, rest, ring, "the inequality")


def _factor(node: Node, ring: Ring) -> Polynomial:
    """φ: `constant` > 0 plus a sum of squares."""
    parts = node.members("constant basis columns squares")
    constant = parts.pop("constant").rational()
    if constant <= 0:
        raise Rejected(f"{node.where}: its constant should be positive")
    squares = read_witness(Node({key: part.value for key, part in parts.items()}, node.where), ring)
    return ring.sum([ring.constant(constant), expanded(squares, ring)])


def _read_matrix(node: Node, n: int) -> list[list[Terms]]:
    rows = node.items(1, MAX_ORDER)
    M = [[read_terms(entry, n) for entry in row.items(len(rows), len(rows))] for row in rows]
    if any(M[i][j] != M[j][i] for i in range(len(M)) for j in range(i)):
        raise Rejected(f"{node.where} is not symmetric")
    return M


def _shown_matrix(M: Sequence[Sequence[Terms]], names: Sequence[str]) -> str:
    return "[" + "; ".join(", ".join(shown(entry, names) for entry in row) for row in M) + "]"
