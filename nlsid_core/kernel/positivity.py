"""The third obligation: `positive(c)`, c(s, x) > 0 for every s in [0, 1] and every x.

The witness states monomials v of x, a power of two `columns[k]` for each, and whole factors R_j:
    c(s, x) = Σ_j B_j(s) |R_j V v|² / 4^unit + r(s, x),
B_j Bernstein polynomials, V = diag 2^columns. r is the difference: each of its Bernstein
coefficients in s has to be diagonally dominant in V v, so c >= Σ_i left[i] v_i² with the least that
is left on the diagonal: c > 0 if something is left for the monomial 1. docs/certificate.md.
"""

from collections.abc import Mapping
from fractions import Fraction
from math import comb
from operator import mul
from types import SimpleNamespace

from .files import MAX_DEGREE, Node, Rejected, Table, itself, limit, no_more, refuse_if, whole
from .polynomials import Polynomial, Ring, packed, unpacked

MAX_BASIS = 200
MAX_FACTORS = 24
MAX_SHIFT = 400  # of a power of two
SPARE = 32  # bits of c below the unit of its squares that are enough for nearly every proof
WITNESS = "basis columns squares"

# Σ_j B_j(s) |R_j V v|² / 4^unit, nowhere negative. keys: the monomials v, of `degree` at most.
# columns: their powers of two. grams: |R_j V v|² by monomial, whole numbers, in units of `weight`.
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
        "factors": itself,
        "scale?": no_more,
        "weights?": no_more,
    }
    stated = parts["squares"].read(table)
    keys, shifts, grams = list(map(ring.key, basis)), [c - min(columns) for c in columns], []
    for factor in stated["factors"].items(1, MAX_FACTORS):
        rows = [row.integers(1, size) for row in factor.items(0, 4 * MAX_BASIS)]
        grams.append(_gram(keys, shifts, rows))
    weight, degree = Fraction(2) ** (2 * min(columns) - 2 * stated["unit"]), max(map(sum, basis))
    return Squares(keys=keys, columns=columns, degree=degree, weight=weight, grams=grams)


def powers_of_two(node: Node, size: int) -> list[int]:
    """So many exponents of two."""
    shifts: list[int] = node.wholes(size)
    small = all(abs(shift) <= MAX_SHIFT for shift in shifts)
    node.require({f"should be exponents of two within {MAX_SHIFT}": small})
    return shifts


def expanded(parts: Mapping[str, Node], ring: Ring) -> Polynomial:
    """Squares that are stated as a polynomial in s and x: a multiplier that is never negative."""
    squares = read_squares(parts, ring)
    summands, J = [], len(squares.grams) - 1
    for j, gram in enumerate(squares.grams):
        constants = Polynomial(ring, gram, 1, 2 * squares.degree, 0, sum(map(abs, gram.values())))
        basis = ring.bernstein([Fraction(i == j) for i in range(J + 1)])
        summands.append((squares.weight, basis * constants))
    return ring.weighted(summands)


def positive(
    c: Polynomial, squares: Squares, ring: Ring, what: str, *, strict: bool = True
) -> None:
    """Raise Rejected unless c > 0 (strict) or c >= 0, for every s in [0, 1] and every x.

    Raises TooNarrow if the ring is.
    """
    try:  # with c rounded down to few bits, which is nearly always enough
        left = _left(c, squares, ring, what, rounded=True)
    except Rejected:
        left = _left(c, squares, ring, what, rounded=False)
    some = min(left.get(0, (0,))) > 0
    refuse_if(strict and not some, f"{what}: not positive, only nonnegative", "not_positive")


def _left(
    c: Polynomial, squares: Squares, ring: Ring, what: str, *, rounded: bool
) -> dict[int, tuple[int, ...]]:
    """What r leaves on the diagonal by monomial, for each Bernstein coefficient, in some unit.

    What is cut off a coefficient of c, from 0 to 1 in the last place, only adds to a square; where
    it is one of a product, all of it is charged. So c is as stated where something is left then.
    """
    basis, columns, grams = squares.keys, squares.columns, squares.grams
    # r times c.denominator times below: below * (c's numerators) - above * (those of the squares).
    above, below = (squares.weight * c.denominator).as_integer_ratio()
    spare = (above & -above).bit_length() - 1 - SPARE if rounded else 0
    cut = min(max(0, spare // 8), ring.width // 8 - 1)  # bytes of c's numerators
    of_c, above = ring.coefficients(c, cut), above >> 8 * cut
    found = set(of_c).union(*grams)
    squared = {2 * key: i for i, key in enumerate(basis) if 2 * key in found}
    paired: dict[int, tuple[int, int]] = {}  # who is charged for a product
    for i, left_key in enumerate(basis):
        for j in range(i + 1, len(basis)):
            key = left_key + basis[j]
            if key in found and key not in squared:
                a, b = paired.setdefault(key, (i, j))
                if columns[i] + columns[j] > columns[a] + columns[b]:
                    paired[key] = i, j
    balanced = len(squared) + len(paired) == len(found)
    refuse_if(not balanced, f"{what}: a monomial is no product of the basis", "not_positive")

    J, order = len(grams) - 1, c.order
    D = max(order, J)
    # Each times C(D, k): Bernstein coefficient k of s^i, of B_j, and of what is cut off.
    of_powers = [[below * comb(D - i, D - k) for k in range(D + 1)] for i in range(order + 1)]
    of_squares = [
        [-above * comb(J, j) * comb(D - J, k - j) if k >= j else 0 for k in range(D + 1)]
        for j in range(J + 1)
    ]
    lost = [sum(column) if cut else 0 for column in zip(*of_powers, strict=True)]
    # A lane of `width` bytes for each k: below * Σ|c's numerators| + above * |that of the squares|,
    # times 2^D, is less than half of it.
    largest = max((abs(entry) for gram in grams for entry in gram.values()), default=0)
    most = below * ((c.norm >> 8 * cut) + order + 2) + above * largest
    width = (most.bit_length() + D + 1) // 8 + 1
    lines, zeros = [packed(row, width) for row in of_powers + of_squares], [0] * (order + 1)

    def coefficients(key: int) -> list[int]:
        values = of_c.get(key, zeros) + [gram.get(key, 0) for gram in grams]
        return unpacked(sum(map(mul, lines, values)), width, D + 1)

    left, highest = [[0] * len(basis) for _ in range(D + 1)], max(columns)
    for key, i in squared.items():
        shift = 2 * (highest - columns[i]) + 1
        for row, value in zip(left, coefficients(key), strict=True):
            row[i] = value << shift
    for key, (i, j) in paired.items():
        shift = 2 * highest - columns[i] - columns[j]
        for row, value, more in zip(left, coefficients(key), lost, strict=True):
            charge = abs(value) + more << shift
            row[i] -= charge
            row[j] -= charge
    for k, row in enumerate(left):
        enough = min(row) > 0 if cut else min(row) >= 0
        failed = f"{what}: not positive (Bernstein coefficient {k} of {D})"
        refuse_if(not enough, failed, "not_positive")
    return dict(zip(basis, zip(*left, strict=True), strict=True))


def _gram(keys: list[int], shifts: list[int], rows: list[list[int]]) -> dict[int, int]:
    """Σ_i (rows[i]·diag(2^shifts) v)² by monomial.

    Rows are packed into one integer each, so that a row of R'R is a few products.
    """
    size, most = len(keys), max((abs(entry) for row in rows for entry in row), default=0)
    width = (most * most * (len(rows) + 1)).bit_length() // 8 + 1
    lines = [(packed(row, width) << 8 * width * (size - len(row)), row) for row in rows]
    gram: dict[int, int] = {}
    for i, left in enumerate(keys):  # a row's last entry belongs to the last monomial
        line = sum(line * row[i - size] for line, row in lines if len(row) >= size - i)
        for j, entry in enumerate(unpacked(line, width, size, i), start=i):
            if entry:
                key = left + keys[j]
                gram[key] = gram.get(key, 0) + (entry << shifts[i] + shifts[j] + (i != j))
    return gram
