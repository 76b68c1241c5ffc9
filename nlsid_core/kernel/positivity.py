"""The third obligation: `positive(c)`, c(s, x) > 0 for every s in [0, 1] and every x.

The witness states monomials v of x, a power of two `columns[k]` for each, and whole factors R_j:
    scale · c(s, x) = Σ_j B_j(s) Σ_i weights[i] (R_j[i] · V v)² / 4^unit + r(s, x),
B_j Bernstein polynomials, V = diag 2^columns. r is the difference: each of its Bernstein
coefficients in s has to be diagonally dominant in V v, so c >= Σ_i left[i] v_i² with the least that
is left on the diagonal: c > 0 if something is left for the monomial 1. docs/certificate.md.
"""

from collections.abc import Mapping
from fractions import Fraction
from math import comb, lcm
from types import SimpleNamespace

from .files import MAX_DEGREE, Node, Rejected, Table, itself, limit, refuse_if, whole
from .polynomials import Polynomial, Ring, packed, unpacked

MAX_BASIS = 200
MAX_FACTORS = 24
MAX_SHIFT = 400  # of a power of two
WITNESS = "basis columns squares"

# Σ_j B_j(s) Σ_i weights[i] (R_j[i] V v)² / (scale 4^unit), nowhere negative. keys: the monomials v,
# of `degree` at most. columns: their powers of two. grams: of each factor the sum over i by
# monomial, whole numbers, in units of `weight`.
Squares = SimpleNamespace


def read_squares(parts: Mapping[str, Node], ring: Ring) -> Squares:
    """`basis` and `columns`; `squares` with `unit`, `factors`, and perhaps `scale` and `weights`.

    A row of a factor may leave out leading zeros: its last entry belongs to the last monomial.
    """
    basis = parts["basis"].monomials(ring.count, MAX_DEGREE // 2)
    size = limit(len(basis), MAX_BASIS, f"{parts['basis'].where}: monomials", least=1)
    columns, node = powers_of_two(parts["columns"], size), parts["squares"]
    table: Table = {"unit": whole(0, MAX_SHIFT), "factors": itself, "scale?": Node.integer}
    stated = node.read({**table, "weights?": lambda entry: entry.integers(0, 4 * MAX_BASIS)})
    scale = 1 if stated["scale"] is None else stated["scale"]
    node.require({"scale should be a positive whole number": scale >= 1})
    keys, shifts, grams = list(map(ring.key, basis)), [c - min(columns) for c in columns], []
    for factor in stated["factors"].items(1, MAX_FACTORS):
        rows = [row.integers(1, size) for row in factor.items(0, 4 * MAX_BASIS)]
        weights = [1] * len(rows) if stated["weights"] is None else stated["weights"]
        fits = len(weights) == len(rows) and min(weights, default=0) >= 0
        factor.require({"one weight of 0 or more a row": fits})
        grams.append(_gram(keys, shifts, weights, rows))
    weight, degree = Fraction(2) ** (2 * min(columns) - 2 * stated["unit"]), max(map(sum, basis))
    weight /= scale
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
) -> Fraction:
    """A number that c is nowhere below; Rejected unless c > 0 (strict) or c >= 0 everywhere."""
    left = remainder(c, squares, ring, what)
    refuse_if(strict and 0 not in left, f"{what}: the basis needs the monomial 1", "not_positive")
    refuse_if(strict and not left[0], f"{what}: not positive, only nonnegative", "not_positive")
    return left.get(0, Fraction(0))


def remainder(c: Polynomial, squares: Squares, ring: Ring, what: str) -> dict[int, Fraction]:
    """left[i] by monomial, so that c >= Σ_i left[i] v_i² >= 0 for every s in [0, 1] and every x.

    Raises Rejected if r is not diagonally dominant; TooNarrow if the ring is.
    """
    basis, columns, grams, digits = squares.keys, squares.columns, squares.grams, ring.digits(c)
    highest = max(columns)
    square = {2 * key: i for i, key in enumerate(basis)}
    pair: dict[int, tuple[int, int]] = {}  # who is charged for a product
    for i, left_key in enumerate(basis):
        for j in range(i + 1, len(basis)):
            a, b = pair.setdefault(left_key + basis[j], (i, j))
            if columns[i] + columns[j] > columns[a] + columns[b]:
                pair[left_key + basis[j]] = (i, j)
    keys = list(set(digits).union(*grams))
    balanced = all(key in square or key in pair for key in keys)
    refuse_if(not balanced, f"{what}: a monomial is no product of the basis", "not_positive")
    J, order = len(grams) - 1, c.order
    D = max(order, J)
    # r times c.denominator times below: below * (c's numerators) - above * (those of the squares).
    above, below = (squares.weight * c.denominator).as_integer_ratio()
    # One integer for each power of s and each factor, a lane for each monomial, wide enough for r.
    largest = max((abs(entry) for gram in grams for entry in gram.values()), default=0)
    bits = max(ring.width + below.bit_length(), (largest * above).bit_length())
    width = (bits + D + 2) // 8 + 1
    size = ring.width // 8
    pad, zero = bytes(width - size), bytes(size - 1) + b"\x80"
    halves = int.from_bytes((zero + pad) * len(keys), "little")
    rows = [digits.get(key, zero * (order + 1)) for key in keys]
    lanes = []
    for i in range(0, size * (order + 1), size):
        lane = pad.join([row[i : i + size] for row in rows])
        lanes.append((int.from_bytes(lane, "little") - halves) * below)
    lanes += [packed([-gram.get(key, 0) * above for key in keys], width) for gram in grams]
    squared = [(place, square[key]) for place, key in enumerate(keys) if key in square]
    paired = [(place, *pair[key]) for place, key in enumerate(keys) if key not in square]
    common = lcm(*(comb(D, k) for k in range(D + 1)))
    least: list[int] = []
    for k in range(D + 1):
        weights = [comb(D - i, k - i) if i <= k else 0 for i in range(order + 1)]
        weights += [comb(J, j) * comb(D - J, k - j) if k >= j else 0 for j in range(J + 1)]
        line = sum(weight * lane for weight, lane in zip(weights, lanes, strict=True) if weight)
        values = unpacked(line, width, len(keys))
        left = [0] * len(basis)
        for place, i in squared:
            left[i] = values[place] << 2 * (highest - columns[i]) + 1
        for place, i, j in paired:
            charge = abs(values[place]) << 2 * highest - columns[i] - columns[j]
            left[i] -= charge
            left[j] -= charge
        if min(left) < 0:
            raise Rejected(
                f"{what}: not positive (Bernstein coefficient {k} of {D})", "not_positive"
            )
        left = [room * (common // comb(D, k)) for room in left]
        least = list(map(min, least, left)) if k else left
    return {
        key: Fraction(room, 2 * c.denominator * below * common << 2 * (highest - column))
        for key, column, room in zip(basis, columns, least, strict=True)
    }


def _gram(
    keys: list[int], shifts: list[int], weights: list[int], rows: list[list[int]]
) -> dict[int, int]:
    """Σ_i weights[i] (rows[i]·diag(2^shifts) v)² by monomial.

    Rows are packed into one integer each, so that a row of R'R is a few products.
    """
    size, most = len(keys), max((abs(entry) for row in rows for entry in row), default=0)
    largest = most * most * max([1, *weights]) * (len(rows) + 1)
    width = largest.bit_length() // 8 + 1
    lines = [
        (weight * packed(row, width) << 8 * width * (size - len(row)), row)
        for weight, row in zip(weights, rows, strict=True)
    ]
    gram: dict[int, int] = {}
    for i, left in enumerate(keys):  # a row's last entry belongs to the last monomial
        line = sum(line * row[i - size] for line, row in lines if len(row) >= size - i)
        entries = unpacked(line, width, size, i)
        for j, entry in enumerate(entries, start=i):
            if entry:
                key = left + keys[j]
                gram[key] = gram.get(key, 0) + (entry << shifts[i] + shifts[j] + (i != j))
    return gram
