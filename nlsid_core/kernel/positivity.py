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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import comb, lcm

from .files import MAX_DEGREE, Node, Rejected, refuse_if
from .polynomials import Polynomial, Ring, packed, unpacked

MAX_BASIS = 200
MAX_FACTORS = 24
MAX_SHIFT = 400  # of a power of two
WITNESS = "basis columns squares"
Rows = list[tuple[int, tuple[int, ...]]]  # of a factor, each with its weight


@dataclass(frozen=True)
class Squares:
    """Σ_j B_j(s) Σ_i weight_i (R_j[i] V v)² / (scale 4^unit): nowhere negative.

    keys: the monomials v, of `degree` at most; columns: their powers of two.
    """

    keys: tuple[int, ...]
    columns: list[int]
    degree: int
    scale: Fraction
    unit: int
    factors: list[Rows]


def read_squares(parts: Mapping[str, Node], ring: Ring) -> Squares:
    """`basis` and `columns`; `squares` with `unit`, `factors`, and perhaps `scale` and `weights`.

    A row of a factor may leave out leading zeros: its last entry belongs to the last monomial.
    """
    where = parts["squares"].where
    rows = parts["basis"].monomials(ring.count, MAX_DEGREE // 2)
    size = len(rows)
    refuse_if(
        not 0 < size <= MAX_BASIS,
        f"{parts['basis'].where} should hold 1 to {MAX_BASIS} monomials",
        "too_large",
    )
    columns = powers_of_two(parts["columns"], size)
    stated = parts["squares"].members("unit factors", "scale weights")
    scale = stated["scale"].integer() if "scale" in stated else 1
    refuse_if(scale < 1, f"{where}: scale should be a positive whole number")
    weights = stated["weights"].integers(0, 4 * MAX_BASIS) if "weights" in stated else None
    factors = []
    for factor in stated["factors"].items(1, MAX_FACTORS):
        entries = [row.integers(1, size) for row in factor.items(0, 4 * MAX_BASIS)]
        heights = (1,) * len(entries) if weights is None else weights
        refuse_if(
            len(heights) != len(entries) or min(heights, default=0) < 0,
            f"{where}: one weight of 0 or more for each row of each factor",
        )
        factors.append(list(zip(heights, entries, strict=True)))
    degree, unit = max(map(sum, rows)), stated["unit"].whole(0, MAX_SHIFT)
    return Squares(tuple(map(ring.key, rows)), columns, degree, Fraction(scale), unit, factors)


def read_witness(node: Node, ring: Ring) -> Squares:
    """`read_squares` of an object with `basis`, `columns` and `squares`."""
    return read_squares(node.members(WITNESS), ring)


def powers_of_two(node: Node, size: int) -> list[int]:
    """So many exponents of two."""
    shifts: list[int] = node.wholes(size)
    refuse_if(
        any(abs(shift) > MAX_SHIFT for shift in shifts),
        f"{node.where}: powers of two beyond 2^{MAX_SHIFT}",
    )
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


def positive_on(
    c: Polynomial, domain: Sequence[Polynomial], parts: Mapping[str, Node], ring: Ring, what: str
) -> dict[int, Fraction]:
    """`remainder` of c - Σ_k σ_k domain[k], σ_k sums of squares: then c >= 0 where domain >= 0.

    parts: `basis`, `columns`, `squares`, and perhaps `multipliers`, each with `of`, the index
    k of its part of the domain, increasing, and the same three members; a part without one has 0.
    """
    terms, last = [c], -1
    for entry in parts["multipliers"].items(0, len(domain)) if "multipliers" in parts else []:
        members = entry.members(f"of {WITNESS}")
        last = members["of"].whole(last + 1, len(domain) - 1)
        terms.append(-1 * (expanded(read_squares(members, ring), ring) * domain[last]))
    return remainder(ring.sum(terms), read_squares(parts, ring), ring, what)


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
    refuse_if(
        any(key not in square and key not in pair for key in keys),
        f"{what}: a monomial that no product of the basis could balance",
        "not_positive",
    )
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
            i = next(i for i, room in enumerate(left) if room < 0)
            at = f"Bernstein coefficient {k} of {D}, monomial {i}"
            raise Rejected(f"{what}: not positive ({at})", "not_positive")
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
