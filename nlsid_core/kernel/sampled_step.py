"""One step of an identified model around a motion, in the coordinates that a proof states.

x̄ = T z and, of a trapezoidal model, v̄⁺ = T⁺w: f̄_k, h and the stated bounds of norms and curvature,
which are verified here. What they prove: `sampled_funnel`.
"""

from collections.abc import Sequence
from fractions import Fraction
from math import factorial, prod
from types import SimpleNamespace

from .exact import Matrix, combined, identity, product, scaled, semidefinite, transposed
from .files import Members, Node, Table, Terms, each, itself, refuse_if
from .polynomials import Polynomial, Ring

MAX_CURVED = 64  # degrees with a bound of their curvature


# Of a policy x, u, K at a sample and the next x, of a funnel S at both and A of the response.
Sample = SimpleNamespace


def read_step(node: Node, model: Members, at: Sample, ring: Ring) -> Members:
    """A step's members, its stated bounds verified; with S⁺x̄⁺ (rows), h, and |S T z|² (size)."""
    n, d, where, trapezoidal = len(at.x), len(at.x) // 2, node.where, model["trapezoidal"]
    norms = ["kappa"] + ["kappa_next", "state", "rates", "direct", "through"] * trapezoidal
    curvature = each(nonnegative, 0, MAX_CURVED)
    table: Table = {"T": (n, n), "curvature": curvature, "tube": itself, "inlet": itself}
    table |= dict.fromkeys(["T_next", "inverse"] * trapezoidal, (d, d))
    step = node.read({**table, **dict.fromkeys(norms, nonnegative)})
    T = triangular(step["T"], node)
    ST, unit = product(at.S, T), product(at.S_next, product(at.A, T))
    prove_inverse(ST, step["kappa"], f"{where}: kappa")
    h: list[Polynomial] = []
    if trapezoidal:
        S_rates = product([row[d:] for row in at.S_next[d:]], step["T_next"])
        prove_inverse(S_rates, step["kappa_next"], f"{where}: kappa_next")
        rows, h = implicit_step(model["map"], at, T, step["T_next"], model["period"], ring)
        moved = ring.product(step["inverse"], h)
        (B, C), (L_z, L_w) = linear_part(moved, ring, n), linear_part(rows, ring, n)
        direct = combined(combined(L_z, product(L_w, B), -1), unit, -1)
        norm = {"state": B, "rates": combined(C, identity(d), -1), "through": L_w}
        for name, M in {**norm, "direct": direct}.items():
            _at_most_square(product(M, transposed(M)), step[name], f"{where}: the bound {name}")
    else:
        rows = explicit_step(model["map"], at, T, ring)
        turned = ring.product(unit, ring.variables[:n])
        moved = [p - q for p, q in zip(rows, turned, strict=True)]
    prove_curvature(moved, step["curvature"], ring, least=1 + trapezoidal)
    size = ring.product(ST, ring.variables[:n])
    return {**step, "rows": rows, "h": h, "size": ring.dot(size, size)}


def explicit_step(f: Sequence[Terms], at: Sample, T: Matrix, ring: Ring) -> list[Polynomial]:
    """S⁺(f(x + Tz, u - K T z) - x⁺)."""
    moved = ring.substituted(f, _state_and_input(at, T, ring))
    return ring.product(at.S_next, [p - c for p, c in zip(moved, at.x_next, strict=True)])


def implicit_step(
    a: Sequence[Terms], at: Sample, T: Matrix, T_next: Matrix, period: Fraction, ring: Ring
) -> tuple[list[Polynomial], list[Polynomial]]:
    """S⁺x̄⁺ and h = v⁺ - v - period/2 (a(q, v, u) + a(q⁺, v⁺, u)), in z, then w.

    v⁺ = v_{k+1} + T⁺w and q⁺ = q + period/2 (v + v⁺).
    """
    d, half = len(T_next), period / 2
    here = _state_and_input(at, T, ring)
    q, v, u = here[:d], here[d : 2 * d], here[2 * d :]
    moved = ring.product(T_next, ring.variables[2 * d :])
    rate = [p + c for p, c in zip(moved, at.x_next[d:], strict=True)]
    place = [p + half * (s + r) for p, s, r in zip(q, v, rate, strict=True)]
    pulls = ring.substituted(a, here), ring.substituted(a, [*place, *rate, *u])
    h = [r - s - half * (b + c) for r, s, b, c in zip(rate, v, *pulls, strict=True)]
    after = [p - c for p, c in zip([*place, *rate], at.x_next, strict=True)]
    return ring.product(at.S_next, after), h


def _state_and_input(at: Sample, T: Matrix, ring: Ring) -> list[Polynomial]:
    """x + T z and u - K T z."""
    moved = ring.product([*T, *scaled(product(at.K, T), -1)], ring.variables[: len(T)])
    return [p + c for p, c in zip(moved, [*at.x, *at.u], strict=True)]


def linear_part(p: Sequence[Polynomial], ring: Ring, count: int) -> tuple[Matrix, Matrix]:
    """The coefficients of degree 1, a row each: of the first `count` variables, and others."""
    rows = [[Fraction(q.terms.get(key, 0), q.denominator) for key in ring.keys] for q in p]
    return [row[:count] for row in rows], [row[count:] for row in rows]


def prove_curvature(
    p: Sequence[Polynomial], gammas: Sequence[Fraction], ring: Ring, least: int
) -> None:
    """Raise Rejected unless gammas bound the parts of p of degree least, least + 1, and so on."""
    sizes: dict[int, Matrix] = {}
    for key in set().union(*(q.terms for q in p)):
        e = ring.exponents(key)
        c, m = [Fraction(q.terms.get(key, 0), q.denominator) for q in p], sum(e)
        outer = [[a * b for b in c] for a in c]
        share = Fraction(prod(map(factorial, e)), factorial(m))
        sizes[m] = combined(sizes.get(m, [[Fraction(0)] * len(c)] * len(c)), outer, share)
    missing = max(sizes, default=0) >= least + len(gammas)
    refuse_if(missing, "curvature: a bound for every degree is needed", "not_covered")
    for m, gamma in enumerate(gammas, start=least):
        if m in sizes:
            _at_most_square(sizes[m], gamma, f"curvature bound on degree {m}")


def stretch(gammas: Sequence[Fraction], size: Fraction, step: Fraction, least: int) -> Fraction:
    """μ with |p(z + w) - p(z)| <= μ|w| for |z| <= size, |w| <= step; degrees from `least` on."""
    far = size + step
    return sum(
        (
            gamma * far**i * size ** (m - 1 - i)
            for m, gamma in enumerate(gammas, start=least)
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
