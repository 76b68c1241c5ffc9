"""The third obligation: `positive(c)`, c(s, x) > 0 for every s in [0, 1] and every x.

The witness states monomials v of x, a power of two `columns[k]` for each, and whole factors R_j:
    c(s, x) = Σ_j B_j(s) |R_j V v|² / 4^unit + r(s, x),
B_j Bernstein polynomials, V = diag 2^columns. r is the difference: each of its Bernstein
coefficients in s has to be diagonally dominant in V v, so c >= Σ_i left[i] v_i² with the least that
is left on the diagonal: c > 0 if something is left for the monomial 1. docs/certificate.md.
"""

from collections.abc import Mapping
from fractions import Fraction
from functools import reduce
from itertools import combinations_with_replacement
from operator import lshift, mul, or_
from types import SimpleNamespace

from .exact import identity
from .files import MAX_DEGREE, Node, Table, limit, no_more, refuse_if, whole
from .polynomials import Polynomial, Ring

MAX_BASIS = 200
MAX_FACTORS = 24
MAX_SHIFT = 400  # of a power of two
WITNESS = "basis columns squares"

# Σ_j B_j(s) |R_j V v|² / 4^unit, nowhere negative: a `form` in s and x. keys: of the monomials v.
# columns: their powers of two. paired: who is charged for a product, the pair with the largest
# columns, the first such.
Squares = SimpleNamespace


def read_squares(parts: Mapping[str, Node], ring: Ring) -> Squares:
    """`basis` and `columns`; `squares` with `unit` and `factors`.

    A row of a factor may leave out leading zeros: its last entry belongs to the last monomial.
    """
    basis = parts["basis"].monomials(ring.count, MAX_DEGREE // 2)
    size = limit(len(basis), MAX_BASIS, f"{parts['basis'].where}: monomials", least=1)
    columns = powers_of_two(parts["columns"], size)
    table: Table = {
        "unit": whole(0, MAX_SHIFT),
        "factors": None,
        "scale?": no_more,
        "weights?": no_more,
    }
    stated = parts["squares"].read(table)
    keys, shifts, grams = list(map(ring.key, basis)), [c - min(columns) for c in columns], []
    products, paired = [], dict[int, tuple[int, int]]()
    for i, j in combinations_with_replacement(range(size), 2):
        key, shift = keys[i] + keys[j], shifts[i] + shifts[j]
        products.append((key, shift + (i != j)))
        a, b = paired.setdefault(key, (i, j))
        if shift > shifts[a] + shifts[b]:
            paired[key] = i, j
    for factor in stated["factors"].items(1, MAX_FACTORS):
        rows = [row.integers(1, size) for row in factor.items(0, 4 * MAX_BASIS)]
        gram: dict[int, int] = {}
        for (key, shift), entry in zip(products, _upper(rows, size), strict=True):
            gram[key] = gram.get(key, 0) + (entry << shift)
        norm = sum(map(abs, gram.values()))
        grams.append(Polynomial(ring, gram, 1, 2 * max(map(sum, basis)), 0, norm))
    weight = Fraction(2) ** (2 * min(columns) - 2 * stated["unit"])
    shares = [weight * ring.bernstein(row) for row in identity(len(grams))]
    return Squares(keys=keys, columns=columns, paired=paired, form=ring.dot(shares, grams))


def powers_of_two(node: Node, size: int) -> list[int]:
    """So many exponents of two."""
    shifts: list[int] = node.wholes(size)
    small = all(abs(shift) <= MAX_SHIFT for shift in shifts)
    node.require({f"should be exponents of two within {MAX_SHIFT}": small})
    return shifts


def positive(
    c: Polynomial, squares: Squares, ring: Ring, what: str, *, strict: bool = True
) -> None:
    """Raise Rejected unless c > 0 (strict) or c >= 0, for every s in [0, 1] and every x.

    All Bernstein coefficients of r are compared at once: coefficient k, times C(D, k) and a
    positive number, is lane k of an integer, at the bit k * width.
    Raises TooNarrow if the ring is.
    """
    r: Polynomial = c - squares.form
    columns: list[int] = squares.columns
    keys, room, D = squares.keys, [max(columns) - column for column in columns], r.order
    # All that is added to a diagonal, or taken off it, is less than half of a lane together.
    width = r.norm.bit_length() + D + max(room) + 2
    ones = sum(1 << width * k for k in range(D + 1))
    halves = ones << width - 1

    def negative(lanes: int) -> int:
        """The highest bit of every lane that is negative."""
        return ((lanes + halves) & halves) ^ halves

    def absolute(lanes: int) -> int:
        """The absolute value of every lane: of a negative one the complement, and 1."""
        some = negative(lanes) >> width - 1
        return ((lanes + halves) ^ halves ^ ((some << width) - some)) + some

    squared, paired = {2 * key: i for i, key in enumerate(keys)}, squares.paired
    left = [0] * len(keys)  # of row i in some unit times 2^-room[i]
    for key, lanes in ring.bernstein_coefficients(r, width):
        if key in squared:
            i = squared[key]
            left[i] += lanes << room[i] + 1
        elif key in paired:
            i, j = paired[key]
            charge = absolute(lanes)
            left[i] -= charge << room[j]
            left[j] -= charge << room[i]
        else:
            refuse_if(lanes, f"{what}: a monomial is no product of the basis", "not_positive")

    failing = reduce(or_, map(negative, left))
    first = f"Bernstein coefficient {(failing & -failing).bit_length() // width - 1} of {D}"
    refuse_if(failing, f"{what}: not positive ({first})", "not_positive")
    some = 0 in keys and not negative(left[keys.index(0)] - ones)
    refuse_if(strict and not some, f"{what}: not positive, only nonnegative", "not_positive")


def _upper(rows: list[list[int]], size: int) -> list[int]:
    """R'R on and above its diagonal, row by row: a row of R, packed into one integer, times R'."""
    most = max((max(max(row), -min(row)) for row in rows), default=0)
    width = (most * most * len(rows)).bit_length() + 1
    lanes, rows = range(0, width * size, width), [[], *rows]  # one at least, for zip
    lines = [sum(map(lshift, row, lanes[size - len(row) :])) for row in rows]
    columns = zip(*([0] * (size - len(row)) + row for row in rows), strict=True)
    half, found = 1 << width - 1, []
    halves = sum(half << lane for lane in lanes)
    for i, column in enumerate(columns):
        line = sum(map(mul, lines, column)) + halves
        found += [(line >> lane & 2 * half - 1) - half for lane in lanes[i:]]
    return found
