"""Claim: a polynomial p is at least a bound, or a symmetric matrix M is ⪰ 0, on a domain.

With the domain {x : g_k(x) >= 0, h_j(x) = 0} the obligation is
    φ·(p - bound) - Σ_k σ_k g_k - Σ_j μ_j h_j >= 0 everywhere,
σ_k sums of squares, μ_j any polynomials, φ = 1 or a stated constant > 0 plus a sum of squares.
M(x) ⪰ 0 where y'M(x) y >= 0 for every y: the same in (x, y), with p = y'My and bound 0.
Source: Putinar 1993; Scherer and Hol 2006 for matrices; Reznick 1995 for φ.
"""

from fractions import Fraction

from . import text
from .decision import Decision
from .files import Node, Read, Rejected, bound_files
from .polynomials import FREE_OF_S, MOST_WORK, Polynomial, Ring, Work, at_width
from .positivity import WITNESS, expanded, positive_on, read_squares
from .terms import MAX_VARIABLES, read_names, read_symmetric, shown

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
        [entry.polynomial(n) for entry in parts[key].items(0, MAX_CONDITIONS)]
        if key in parts
        else []
        for key in ("domain", "equalities")
    )
    M = read_symmetric(parts["matrix"], n, MAX_ORDER) if is_matrix else []
    if n + len(M) > MAX_VARIABLES:
        raise Rejected(f"more than {MAX_VARIABLES} variables, those of y'My included")
    p = [] if is_matrix else parts["polynomial"].polynomial(n)
    bound = Fraction(0) if is_matrix else parts["bound"].rational()

    def build(ring: Ring) -> Fraction:
        x, y = ring.variables[:n], ring.variables[n:]
        entries = ring.substituted([entry for row in M for entry in row] + [p], x)
        rows = [entries[i : i + len(M)] for i in range(0, len(M) ** 2, max(1, len(M)))]
        target = ring.form(rows, y) if is_matrix else entries[-1] - bound
        inside, on = ring.substituted(domain, x), ring.substituted(equalities, x)
        left = _decided(target, inside, on, proof, ring)
        forms = [ring.key([int(i == n + k) for i in range(ring.count)]) for k in range(len(M))]
        return min((left.get(key, Fraction(0)) for key in forms or [0]), default=Fraction(0))

    margin = at_width(n + len(M), Work(MOST_WORK, FREE_OF_S), build)
    where = [f"{shown(g, names, f'domain[{i}]')} >= 0" for i, g in enumerate(domain)]
    where += [f"{shown(h, names, f'equalities[{i}]')} = 0" for i, h in enumerate(equalities)]
    condition = f" with {' and '.join(where)}" if where else ""
    inequality = f"{shown(p, names, 'polynomial')} >= {text.below(bound, BOUND_DIGITS)}"
    if is_matrix:
        rows = "; ".join(
            ", ".join(shown(entry, names, f"matrix[{i}][{j}]") for j, entry in enumerate(row))
            for i, row in enumerate(M)
        )
        inequality = f"the matrix [{rows}] is positive semidefinite"
    return Decision(f"{inequality} for all real {', '.join(names)}{condition}", margin, (), digests)


def _decided(
    target: Polynomial, inside: list[Polynomial], on: list[Polynomial], proof: Node, ring: Ring
) -> dict[int, Fraction]:
    """φ·target - Σ σ g - Σ μ h >= 0: what is left over by monomial."""
    parts = proof.members(WITNESS, "multipliers equality_multipliers factor")
    if "factor" in parts:
        factor = parts["factor"].members(f"constant {WITNESS}")
        constant = factor["constant"].rational()
        if constant <= 0:
            raise Rejected(f"{parts['factor'].where}: its constant should be positive")
        target *= expanded(read_squares(factor, ring), ring) + constant
    if ("equality_multipliers" in parts) < bool(on):
        raise Rejected("each equation of the domain needs an equality multiplier")
    if "equality_multipliers" in parts:
        stated = parts["equality_multipliers"].items(len(on), len(on))
        mu = ring.substituted([entry.polynomial(ring.count) for entry in stated], ring.variables)
        target -= ring.dot(mu, on)
    return positive_on(target, inside, parts, ring, "the inequality")
