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
from operator import lshift, mul
from types import SimpleNamespace

from .exact import unit
from .files import MAX_DEGREE, Node, Rejected, Table, itself, limit, no_more, refuse_if, whole
from .polynomials import Polynomial, Ring

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
    pairs = [(i, j) for i in range(size) for j in range(i, size)]
    products = [(keys[i] + keys[j], shifts[i] + shifts[j] + (i != j)) for i, j in pairs]
    for factor in stated["factors"].items(1, MAX_FACTORS):
        rows = [row.integers(1, size) for row in factor.items(0, 4 * MAX_BASIS)]
        gram: dict[int, int] = {}
        for (key, shift), entry in zip(products, _upper(rows, size), strict=True):
            gram[key] = gram.get(key, 0) + (entry << shift)
        grams.append(gram)
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
    J, degree = len(squares.grams) - 1, 2 * squares.degree
    shares = [squares.weight * ring.bernstein(unit(j, J + 1)) for j in range(J + 1)]
    constants = [
        Polynomial(ring, gram, 1, degree, 0, sum(map(abs, gram.values()))) for gram in squares.grams
    ]
    return ring.dot(shares, constants)


def positive(
    c: Polynomial, squares: Squares, ring: Ring, what: str, *, strict: bool = True
) -> None:
    """Raise Rejected unless c > 0 (strict) or c >= 0, for every s in [0, 1] and every x.

    Raises TooNarrow if the ring is.
    """
    try:  # with c rounded down to few bits, which is nearly always enough
        some = _dominant(c, squares, ring, what, rounded=True)
    except Rejected:
        some = _dominant(c, squares, ring, what, rounded=False)
    refuse_if(strict and not some, f"{what}: not positive, only nonnegative", "not_positive")


def _dominant(c: Polynomial, squares: Squares, ring: Ring, what: str, *, rounded: bool) -> bool:
    """Whether r leaves something for the monomial 1; Rejected unless it leaves 0 or more for all.

    All Bernstein coefficients of r are compared at once: coefficient k, times C(D, k) and a
    positive number, is lane k of an integer, at the bit k * width.
    What is cut off a coefficient of c, from 0 to 1 in the last place, only adds to a square; where
    it is one of a product, all of it is charged. So c is as stated where something is left then.
    """
    keys, grams, highest = squares.keys, squares.grams, max(squares.columns)
    room: list[int] = [highest - column for column in squares.columns]
    # r times c.denominator times below: below * (c's numerators) - above * (those of the squares).
    scale: Fraction = squares.weight * c.denominator
    above, below = scale.as_integer_ratio()
    cut = max(0, (above & -above).bit_length() - 1 - SPARE) if rounded else 0
    above, of_c = above >> cut, ring.coefficients(c, cut)

    J, order = len(grams) - 1, c.order
    D = max(order, J)
    # 2^(D + largest room + 1) times this bounds what is added to one diagonal, or taken off it.
    most = below * ((c.norm >> cut) + 1 + (order + 1) * len(of_c) + 2 * len(keys))
    most += above * sum(sum(map(abs, gram.values())) for gram in grams)
    width = most.bit_length() + D + max(room) + 3
    s = 1 << width
    powers = [below * s**i * (1 + s) ** (D - i) for i in range(order + 1)]
    lost = sum(powers) if cut else 0
    powers = [-above * comb(J, j) * s**j * (1 + s) ** (D - J) for j in range(J + 1)] + powers
    ones = sum(1 << width * k for k in range(D + 1))
    halves = ones << width - 1

    def negative(lanes: int) -> int:
        """The highest bit of every lane that is negative."""
        return ((lanes + halves) & halves) ^ halves

    def absolute(lanes: int) -> int:
        """The absolute value of every lane: of a negative one the complement, and 1."""
        some = negative(lanes) >> width - 1
        return ((lanes + halves) ^ halves ^ ((some << width) - some)) + some

    squared, paired = {2 * key: i for i, key in enumerate(keys)}, _pairs(keys, room)
    left = [0] * len(keys)  # of row i in some unit times 2^-room[i]
    for key in of_c.keys() | set().union(*grams):
        values = [gram.get(key, 0) for gram in grams] + of_c.get(key, [])
        lanes = sum(map(mul, powers, values))
        if key in squared:
            i = squared[key]
            left[i] += lanes << room[i] + 1
        elif key in paired:
            i, j = paired[key]
            charge = absolute(lanes) + lost
            left[i] -= charge << room[j]
            left[j] -= charge << room[i]
        else:
            refuse_if(lanes, f"{what}: a monomial is no product of the basis", "not_positive")

    failing = 0
    for lanes in left:
        failing |= negative(lanes - ones if cut else lanes)
    first = f"Bernstein coefficient {(failing & -failing).bit_length() // width - 1} of {D}"
    refuse_if(failing, f"{what}: not positive ({first})", "not_positive")
    return 0 in keys and not negative(left[keys.index(0)] - ones)


def _pairs(keys: list[int], room: list[int]) -> dict[int, tuple[int, int]]:
    """Who is charged for a product: the pair with the largest columns, the first such."""
    paired: dict[int, tuple[int, int]] = {}
    for i, left in enumerate(keys):
        for j in range(i + 1, len(keys)):
            a, b = paired.setdefault(left + keys[j], (i, j))
            if room[i] + room[j] < room[a] + room[b]:
                paired[left + keys[j]] = i, j
    return paired


def _upper(rows: list[list[int]], size: int) -> list[int]:
    """R'R on and above its diagonal, row by row: a row of R, packed into one integer, times R'."""
    rows = [[0] * (size - len(row)) + row for row in [[], *rows]]
    most = max(max(max(row), -min(row)) for row in rows)
    width = (most * most * len(rows)).bit_length() + 1
    lanes = range(0, width * size, width)
    lines = [sum(map(lshift, row, lanes)) for row in rows]
    half, found = 1 << width - 1, []
    halves = sum(half << lane for lane in lanes)
    for i, column in enumerate(zip(*rows, strict=True)):
        line = sum(map(mul, lines, column)) + halves
        found += [(line >> lane & 2 * half - 1) - half for lane in lanes[i:]]
    return found
