"""The third obligation: `positive(c)`, c(s, x) > 0 for every s in [0, 1] and every x.

The witness states monomials v of x, a power of two `columns[k]` for each, and whole factors R_j:
    scale · c(s, x) = Σ_j B_j(s) Σ_i weights[i] (R_j[i] · V v)² / 4^unit + r(s, x),
B_j the Bernstein polynomials of degree (number of factors - 1), V = diag 2^columns. r is not
stated: it is the difference. In Bernstein form of degree D, r = Σ_k b_k(x) s^k (1-s)^(D-k), and
each b_k has to be diagonally dominant in V v: a square of a monomial of v counts on the diagonal;
any other monomial is charged, by halves of its size, to a pair of v whose product it is, the first
of those with the largest powers of two.
So c >= Σ_i left[i] v_i², left[i] >= 0 being the least that any b_k leaves on the diagonal: c > 0
if something is left for the monomial 1.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from math import comb, lcm

from .files import MAX_DEGREE, Node, Rejected, Table, itself, limit, refuse_if, whole
from .polynomials import Polynomial, Ring, packed, unpacked

MAX_BASIS = 200
MAX_FACTORS = 24
MAX_SHIFT = 400  # of a power of two
WITNESS = "basis columns squares"
Rows = list[tuple[int, list[int]]]  # of a factor, each with its weight


@dataclass(frozen=True)
class Squares:
    """Σ_j B_j(s) Σ_i weight_i (R_j[i] V v)² / (scale 4^unit): nowhere negative.

    keys: the monomials v, of `degree` at most; columns: their powers of two.
    """

    keys: list[int]
    columns: list[int]
    degree: int
    scale: Fraction
    unit: int
    factors: list[Rows]


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
    factors = []
    for factor in stated["factors"].items(1, MAX_FACTORS):
        rows = [row.integers(1, size) for row in factor.items(0, 4 * MAX_BASIS)]
        weights = [1] * len(rows) if stated["weights"] is None else stated["weights"]
        fits = len(weights) == len(rows) and min(weights, default=0) >= 0
        factor.require({"one weight of 0 or more a row": fits})
        factors.append(list(zip(weights, rows, strict=True)))
    keys, degree = list(map(ring.key, basis)), max(map(sum, basis))
    return Squares(keys, columns, degree, Fraction(scale), stated["unit"], factors)


def powers_of_two(node: Node, size: int) -> list[int]:
    """So many exponents of two."""
    shifts: list[int] = node.wholes(size)
    small = all(abs(shift) <= MAX_SHIFT for shift in shifts)
    node.require({f"should be exponents of two within {MAX_SHIFT}": small})
    return shifts


def expanded(squares: Squares, ring: Ring) -> Polynomial:
    """The squares as a polynomial in s and x: a multiplier that is never negative."""
    lowest, J = min(squares.columns), len(squares.factors) - 1
    weight = Fraction(2) ** (2 * lowest - 2 * squares.unit) / squares.scale
    parts = []
    for j, gram in enumerate(_grams(squares, lowest)):
        norm = sum(map(abs, gram.values()))
        constants = Polynomial(ring, gram, 1, 2 * squares.degree, 0, norm)
        parts.append((weight, ring.bernstein([Fraction(i == j) for i in range(J + 1)]) * constants))
    return ring.weighted(parts)


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
    basis, columns = squares.keys, squares.columns
    lowest, highest = min(columns), max(columns)
    square = {2 * key: i for i, key in enumerate(basis)}
    pair: dict[int, tuple[int, int]] = {}  # who is charged for a product
    for i, left_key in enumerate(basis):
        for j in range(i + 1, len(basis)):
            a, b = pair.setdefault(left_key + basis[j], (i, j))
            if columns[i] + columns[j] > columns[a] + columns[b]:
                pair[left_key + basis[j]] = (i, j)
    grams, digits = _grams(squares, lowest), ring.digits(c)
    keys = list(set(digits).union(*grams))
    balanced = all(key in square or key in pair for key in keys)
    refuse_if(not balanced, f"{what}: a monomial is no product of the basis", "not_positive")
    J, order = len(grams) - 1, c.order
    D = max(order, J)
    # r times c.denominator times below: below * (c's numerators) - above * (those of the squares).
    ratio = Fraction(2) ** (2 * lowest - 2 * squares.unit) / squares.scale * c.denominator
    above, below = ratio.numerator, ratio.denominator
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


def _grams(squares: Squares, lowest: int) -> list[dict[int, int]]:
    """Σ_i weight_i (R_j[i] V v)² / 4^lowest by monomial, whole numbers, for each factor R_j.

    Rows are packed into one integer each, so that a row of R'R is a few products.
    """
    keys, size = squares.keys, len(squares.keys)
    columns = [shift - lowest for shift in squares.columns]
    result = []
    for factor in squares.factors:
        most = max((abs(entry) for _, row in factor for entry in row), default=0)
        heaviest = max((weight for weight, _ in factor), default=1)
        width = (most * most * max(1, heaviest) * (len(factor) + 1)).bit_length() // 8 + 1
        lines = [
            (weight * packed(row, width) << 8 * width * (size - len(row)), row)
            for weight, row in factor
        ]
        gram: dict[int, int] = {}
        for i, left in enumerate(keys):  # a row's last entry belongs to the last monomial
            line = sum(line * row[i - size] for line, row in lines if len(row) >= size - i)
            entries = unpacked(line, width, size, i)
            for j, entry in enumerate(entries, start=i):
                if entry:
                    key = left + keys[j]
                    gram[key] = gram.get(key, 0) + (entry << columns[i] + columns[j] + (i != j))
        result.append(gram)
    return result
