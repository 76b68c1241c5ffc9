"""The third obligation: `positive(c)`, c(s, x) > 0 for every s in [0, 1] and every x.

The witness states monomials v of x, a power of two `columns[k]` for each, and whole factors R_j:
    c(s, x) = Σ_j B_j(s) |R_j V v|² / 4^unit + r(s, x),
B_j Bernstein polynomials, V = diag 2^columns. r is the difference: each of its Bernstein
coefficients in s has to be diagonally dominant in V v, so c >= Σ_i left[i] v_i² with the least that
is left on the diagonal: c > 0 if something is left for the monomial 1. docs/certificate.md.
"""

from collections.abc import Mapping
from fractions import Fraction
from math import comb, lcm
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
        norm = sum(map(abs, gram.values()))
        constants = Polynomial(ring, gram, 1, 2 * squares.degree, 0, norm)
        basis = ring.bernstein([Fraction(i == j) for i in range(J + 1)])
        summands.append((squares.weight, basis * constants))
    return ring.weighted(summands)


def positive(
    c: Polynomial, squares: Squares, ring: Ring, what: str, *, strict: bool = True
) -> None:
    """Raise Rejected unless c > 0 (strict) or c >= 0 everywhere."""
    left = remainder(c, squares, ring, what)
    refuse_if(strict and not left.get(0), f"{what}: not positive, only nonnegative", "not_positive")


def remainder(c: Polynomial, squares: Squares, ring: Ring, what: str) -> dict[int, Fraction]:
    """left[i] by monomial, so that c >= Σ_i left[i] v_i² >= 0 for every s in [0, 1] and every x.

    Raises Rejected if r is not diagonally dominant; TooNarrow if the ring is.
    """
    try:  # nearly always enough, and much shorter numbers
        return _left(c, squares, ring, what, spare=SPARE)
    except Rejected:
        return _left(c, squares, ring, what, spare=None)


def _left(
    c: Polynomial, squares: Squares, ring: Ring, what: str, *, spare: int | None
) -> dict[int, Fraction]:
    """The same; of c, at most `spare` bits below the unit of the squares are kept.

    What is cut off a coefficient of c, from 0 to 1 in the last place, only adds to a square; where
    it is one of a product, all of it is charged. So c is as stated where something is left then.
    """
    basis, columns, grams, digits = squares.keys, squares.columns, squares.grams, ring.digits(c)
    highest, size, order, J = max(columns), ring.width // 8, c.order, len(grams) - 1
    D, found = max(order, J), set(digits).union(*grams)
    squared = {2 * key: i for i, key in enumerate(basis) if 2 * key in found}
    paired: dict[int, tuple[int, int]] = {}  # who is charged for a product
    for i, left_key in enumerate(basis):
        for j in range(i + 1, len(basis)):
            key = left_key + basis[j]
            if key in found and key not in squared:
                a, b = paired.setdefault(key, (i, j))
                if columns[i] + columns[j] > columns[a] + columns[b]:
                    paired[key] = i, j
    keys = [*squared, *paired]
    balanced = len(keys) == len(found)
    refuse_if(not balanced, f"{what}: a monomial is no product of the basis", "not_positive")

    # r times c.denominator times below: below * (c's numerators) - above * (those of the squares).
    above, below = (squares.weight * c.denominator).as_integer_ratio()
    cut = 0  # bytes of c's numerators
    if spare is not None:
        cut = min(max(0, (above & -above).bit_length() - 1 - spare) // 8, size - 1)
    above >>= 8 * cut
    # One integer for each power of s and each factor, a lane for each monomial. A lane holds r: the
    # weights below are at most 2^D, and a sum over powers of c at most `order` more than c.norm.
    largest = max((abs(entry) for gram in grams for entry in gram.values()), default=0)
    bits = max(8 * (size - cut) + below.bit_length(), (largest * above).bit_length())
    width = (bits + D + order.bit_length() + 2) // 8 + 1
    pad, zero = bytes(width - size + cut), bytes(size - 1) + b"\x80"
    halves = int.from_bytes((zero[cut:] + pad) * len(keys), "little")
    rows = [digits.get(key, zero * (order + 1)) for key in keys]
    lanes = []
    for i in range(0, size * (order + 1), size):
        lane = pad.join([row[i + cut : i + size] for row in rows])
        lanes.append((int.from_bytes(lane, "little") - halves) * below)
    lanes += [packed([gram.get(key, 0) for key in keys], width) * -above for gram in grams]

    of_squares = [(i, 2 * (highest - columns[i]) + 1) for i in squared.values()]
    of_pairs = [(i, j, 2 * highest - columns[i] - columns[j]) for i, j in paired.values()]
    common = lcm(*(comb(D, k) for k in range(D + 1)))
    least: list[int] = []
    for k in range(D + 1):
        of_c = [comb(D - i, k - i) if i <= k else 0 for i in range(order + 1)]
        of_gram = [comb(J, j) * comb(D - J, k - j) if k >= j else 0 for j in range(J + 1)]
        weights = of_c + of_gram
        line = sum(weight * lane for weight, lane in zip(weights, lanes, strict=True) if weight)
        lost = sum(of_c) * below if cut else 0
        values = unpacked(line, width, len(keys))
        left = [0] * len(basis)
        for value, (i, shift) in zip(values, of_squares, strict=False):
            left[i] = value << shift
        for value, (i, j, shift) in zip(values[len(squared) :], of_pairs, strict=True):
            charge = abs(value) + lost << shift
            left[i] -= charge
            left[j] -= charge
        enough = min(left) > 0 if cut else min(left) >= 0
        refuse_if(
            not enough, f"{what}: not positive (Bernstein coefficient {k} of {D})", "not_positive"
        )
        left = [room * (common // comb(D, k)) for room in left]
        least = list(map(min, least, left)) if k else left
    return {
        key: Fraction(room, 2 * c.denominator * below * common << 2 * (highest - column)) * 256**cut
        for key, column, room in zip(basis, columns, least, strict=True)
    }


def _gram(keys: list[int], shifts: list[int], rows: list[list[int]]) -> dict[int, int]:
    """Σ_i (rows[i]·diag(2^shifts) v)² by monomial.

    Rows are packed into one integer each, so that a row of R'R is a few products.
    """
    size, most = len(keys), max((abs(entry) for row in rows for entry in row), default=0)
    largest = most * most * (len(rows) + 1)
    width = largest.bit_length() // 8 + 1
    lines = [(packed(row, width) << 8 * width * (size - len(row)), row) for row in rows]
    gram: dict[int, int] = {}
    for i, left in enumerate(keys):  # a row's last entry belongs to the last monomial
        line = sum(line * row[i - size] for line, row in lines if len(row) >= size - i)
        entries = unpacked(line, width, size, i)
        for j, entry in enumerate(entries, start=i):
            if entry:
                key = left + keys[j]
                gram[key] = gram.get(key, 0) + (entry << shifts[i] + shifts[j] + (i != j))
    return gram
