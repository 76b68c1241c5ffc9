"""One step of an identified model around a motion, in the coordinates that a proof states.

x̄ = T z: f̄_k and the stated bounds of a norm and of curvature, which are verified here. What they
prove: `sampled_funnel`.
"""

from collections.abc import Sequence
from fractions import Fraction
from math import factorial, prod
from types import SimpleNamespace

from .exact import Matrix, combined, identity, product, scaled, semidefinite, transposed
from .files import Members, Node, Terms, each, refuse_if
from .polynomials import Polynomial, Ring

MAX_CURVED = 64  # degrees with a bound of their curvature


# Of a policy x, u, K at a sample and the next x, of a funnel S at both and A of the response.
Sample = SimpleNamespace


def read_step(node: Node, model: Members, at: Sample, ring: Ring) -> Members:
    """A step's members, its stated bounds verified; with S⁺x̄⁺ (rows), and |S T z|² (size)."""
    n = len(at.x)
    step = node.read(
        {
            "T": (n, n),
            "kappa": nonnegative,
            "curvature": each(nonnegative, 0, MAX_CURVED),
            "tube": None,
            "inlet": None,
        }
    )
    T = triangular(step["T"], node)
    ST = product(at.S, T)
    prove_inverse(ST, step["kappa"], f"{node.where}: kappa")
    rows = explicit_step(model["map"], at, T, ring)
    turned = ring.product(product(at.S_next, product(at.A, T)), ring.variables)
    moved = [p - q for p, q in zip(rows, turned, strict=True)]
    prove_curvature(moved, step["curvature"], ring)
    size = ring.product(ST, ring.variables)
    return {**step, "rows": rows, "size": ring.dot(size, size)}


def explicit_step(f: Sequence[Terms], at: Sample, T: Matrix, ring: Ring) -> list[Polynomial]:
    """S⁺(f(x + Tz, u - K T z) - x⁺)."""
    moved = ring.product([*T, *scaled(product(at.K, T), -1)], ring.variables)
    here = [p + c for p, c in zip(moved, [*at.x, *at.u], strict=True)]
    after = ring.substituted(f, here)
    return ring.product(at.S_next, [p - c for p, c in zip(after, at.x_next, strict=True)])


def prove_curvature(p: Sequence[Polynomial], gammas: Sequence[Fraction], ring: Ring) -> None:
    """Raise Rejected unless gammas bound the parts of p of degree 1, 2, and so on."""
    sizes: dict[int, Matrix] = {}
    for key in set().union(*(q.terms for q in p)):
        e = ring.exponents(key)
        c, m = [Fraction(q.terms.get(key, 0), q.denominator) for q in p], sum(e)
        outer = [[a * b for b in c] for a in c]
        share = Fraction(prod(map(factorial, e)), factorial(m))
        sizes[m] = combined(sizes.get(m, [[Fraction(0)] * len(c)] * len(c)), outer, share)
    missing = max(sizes, default=0) > len(gammas)
    refuse_if(missing, "curvature: a bound for every degree is needed", "not_covered")
    for m, gamma in enumerate(gammas, start=1):
        if m in sizes:
            _at_most_square(sizes[m], gamma, f"curvature bound on degree {m}")


def stretch(gammas: Sequence[Fraction], size: Fraction, step: Fraction) -> Fraction:
    """μ with |p(z + w) - p(z)| <= μ|w| for |z| <= size, |w| <= step."""
    far = size + step
    return sum(
        (
            gamma * far**i * size ** (m - 1 - i)
            for m, gamma in enumerate(gammas, start=1)
            for i in range(m)
        ),
        Fraction(0),
    )


def prove_inverse(M: Matrix, bound: Fraction, what: str) -> None:
    """Raise Rejected unless |z| <= bound |M z| for every z."""
    MM = product(transposed(M), M)
    semidefinite(combined(scaled(MM, bound**2), identity(len(MM)), -1), what)


def _at_most_square(MM: Matrix, bound: Fraction, what: str) -> None:
    """Raise Rejected unless |M'v| <= bound |v| for every v."""
    semidefinite(combined(scaled(identity(len(MM)), bound**2), MM, -1), what)


def nonnegative(node: Node) -> Fraction:
    """A number of 0 or more."""
    value = node.number()
    node.require({"should not be negative": value >= 0}, "not_below")
    return value


def triangular(M: Matrix, node: Node) -> Matrix:
    """M, if it is upper triangular with a nonzero diagonal."""
    size = range(len(M))
    upper = all(M[i][i] for i in size) and not any(M[i][j] for i in size for j in range(i))
    node.require({"should be upper triangular with a nonzero diagonal": upper})
    return M
