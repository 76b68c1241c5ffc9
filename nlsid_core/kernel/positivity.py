"""The third obligation: `positive(c)`, c(s, x) > 0 for every s in [0, 1] and every x.

The witness states monomials v of x, a power of two `columns[k]` for each, and whole factors R_j:
    scale · c(s, x) = Σ_j B_j(s) Σ_i weights[i] (R_j[i] · V v)² / 4^unit + r(s, x),
B_j the Bernstein polynomials of degree (number of factors - 1), V = diag 2^columns. r is not
stated: it is the difference. In Bernstein form of degree D, r = Σ_k b_k(x) s^k (1-s)^(D-k), and
each b_k has to be diagonally dominant in V v: a square of a monomial of v counts on the diagonal;
any other monomial is charged, by halves of its size, to a pair of v whose product it is, the first
of those with the largest powers of two.
So c >= Σ_i left[i] v_i², left[i] >= 0 being the least that any b_k leaves on the diagonal: c > 0
if something is left for the monomial 1, and c > 0 except at the origin if 1 is not in v and
something is left for a pure power of every variable.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import comb, lcm

from .files import Node, Rejected
from .polynomials import LONG, MAX_DEGREE, Polynomial, Ring, packed, unpacked

MAX_BASIS = 200
MAX_FACTORS = 24
MAX_SHIFT = 400  # of a power of two


@dataclass(frozen=True)
class Basis:
    """Monomials v with their powers of two, and the pair that is charged for each product."""

    keys: tuple[int, ...]
    columns: tuple[int, ...]
    degree: int
    square: dict[int, int]
    pair: dict[int, tuple[int, int]]


@dataclass(frozen=True)
class Squares:
    """Σ_j B_j(s) Σ_i weights[i] (R_j[i] V v)² / (scale 4^unit): nowhere negative."""

    basis: Basis
    scale: int
    unit: int
    weights: tuple[int, ...] | None
    factors: tuple[tuple[tuple[int, ...], ...], ...]


def read_basis(node: Node, columns: Node, ring: Ring) -> Basis:
    """Distinct monomials, and as many exponents of two."""
    rows = node.wholes(None, ring.count)
    keys = tuple(ring.key(row) for row in rows)
    if not 0 < len(keys) <= MAX_BASIS or len(set(keys)) != len(keys):
        raise Rejected(f"{node.where} should hold 1 to {MAX_BASIS} distinct monomials")
    degree = max(sum(row) for row in rows)
    if 2 * degree > MAX_DEGREE:
        raise Rejected(
            f"{node.where}: degree {degree}; products of its monomials exceed {MAX_DEGREE}"
        )
    shifts = tuple(columns.wholes(len(keys)))
    if any(abs(shift) > MAX_SHIFT for shift in shifts):
        raise Rejected(f"{columns.where}: powers of two beyond 2^{MAX_SHIFT}")
    pair: dict[int, tuple[int, int]] = {}
    for i, left in enumerate(keys):
        for j in range(i + 1, len(keys)):
            a, b = pair.setdefault(left + keys[j], (i, j))
            if shifts[i] + shifts[j] > shifts[a] + shifts[b]:
                pair[left + keys[j]] = (i, j)
    return Basis(keys, shifts, degree, {2 * key: i for i, key in enumerate(keys)}, pair)


def read_squares(node: Node, basis: Basis) -> Squares:
    """`unit`, `factors`, and optionally `scale` and `weights`.

    A row of a factor may leave out leading zeros: its last entry belongs to the last monomial.
    """
    parts = node.members("unit factors", "scale weights")
    size = len(basis.keys)
    unit = parts["unit"].whole(0, MAX_SHIFT)
    scale = int(parts["scale"].rational()) if "scale" in parts else 1
    if scale < 1 or ("scale" in parts and parts["scale"].rational() != scale):
        raise Rejected(f"{node.where}: scale should be a positive whole number")
    factors = []
    for factor in parts["factors"].items(1, MAX_FACTORS):
        rows = factor.items(0, 4 * MAX_BASIS)
        factors.append(tuple(row.integers(1, size) for row in rows))
    weights = None
    if "weights" in parts:
        weights = parts["weights"].integers(0, 4 * MAX_BASIS)
        if any(w < 0 for w in weights) or any(len(f) != len(weights) for f in factors):
            raise Rejected(f"{node.where}: one weight of 0 or more for each row of each factor")
    return Squares(basis, scale, unit, weights, tuple(factors))


def expanded(squares: Squares, ring: Ring) -> Polynomial:
    """The squares as a polynomial in s and x: a multiplier that is never negative."""
    J = len(squares.factors) - 1
    lowest = min(squares.basis.columns)
    parts = []
    for j, gram in enumerate(_grams(squares, ring, lowest)):
        bernstein = [Fraction(0)] * (J + 1)
        for i in range(J - j + 1):
            bernstein[j + i] = Fraction((-1) ** i * comb(J, j) * comb(J - j, i))
        constants = Polynomial(gram, 1, 2 * squares.basis.degree, 0, sum(map(abs, gram.values())))
        parts.append(ring.times(ring.in_s(bernstein), constants))
    shift = 2 * lowest - 2 * squares.unit
    return ring.scaled(ring.sum(parts), Fraction(2) ** shift / squares.scale)


def positive(
    c: Polynomial, squares: Squares, ring: Ring, what: str, *, strict: bool = True
) -> Fraction:
    """A number that c is nowhere below; Rejected unless c > 0 (strict) or c >= 0 everywhere."""
    left = remainder(c, squares, ring, what)
    if strict and 0 not in left:
        raise Rejected(f"{what}: the basis needs the monomial 1")
    if strict and not left[0]:
        raise Rejected(f"{what}: not positive, only nonnegative")
    return left.get(0, Fraction(0))


def positive_except_origin(c: Polynomial, squares: Squares, ring: Ring, what: str) -> Fraction:
    """Raise Rejected unless c = 0 at the origin, and c > 0 elsewhere and unbounded with |x|.

    Returns the largest number with c >= number * Σ_i (a pure power of x_i)², as far as is known.
    """
    left = remainder(c, squares, ring, what)
    if 0 in left:
        raise Rejected(f"{what}: the basis should not hold the monomial 1")
    best = [Fraction(0)] * ring.count
    for key, room in left.items():
        exponents = ring.exponents(key)
        if sum(1 for e in exponents if e) == 1:
            i = next(i for i, e in enumerate(exponents) if e)
            best[i] = max(best[i], room)
    if not all(best):
        i = next(i for i, room in enumerate(best) if not room)
        raise Rejected(f"{what}: nothing is left for a pure power of variable {i}")
    return min(best)


def positive_on(
    c: Polynomial, domain: Sequence[Polynomial], witness: Node, ring: Ring, what: str
) -> dict[int, Fraction]:
    """`remainder` of c - Σ_k σ_k domain[k], σ_k sums of squares: then c >= 0 where domain >= 0.

    witness: `basis`, `columns`, `squares`, and optionally `multipliers`, each with `of`, the index
    k of its part of the domain, increasing, and the same three members; a part without one has 0.
    """
    parts = witness.members("basis columns squares", "multipliers")
    terms, last = [c], -1
    for entry in parts["multipliers"].items(0, len(domain)) if "multipliers" in parts else []:
        members = entry.members("of basis columns squares")
        last = members["of"].whole(last + 1, len(domain) - 1)
        sigma = expanded(_squares(members, ring), ring)
        terms.append(ring.scaled(ring.times(sigma, domain[last]), -1))
    return remainder(ring.sum(terms), _squares(parts, ring), ring, what)


def read_witness(node: Node, ring: Ring) -> Squares:
    """`basis`, `columns` and `squares`."""
    return _squares(node.members("basis columns squares"), ring)


def remainder(c: Polynomial, squares: Squares, ring: Ring, what: str) -> dict[int, Fraction]:
    """left[i] by monomial, so that c >= Σ_i left[i] v_i² >= 0 for every s in [0, 1] and every x.

    Raises Rejected if r is not diagonally dominant; TooNarrow if the ring is.
    """
    basis = squares.basis
    lowest, highest = min(basis.columns), max(basis.columns)
    grams, digits = _grams(squares, ring, lowest), ring.digits(c)
    keys = list(set(digits).union(*grams))
    if any(key not in basis.square and key not in basis.pair for key in keys):
        raise Rejected(f"{what}: a monomial that no product of the basis could balance")
    J, order = len(squares.factors) - 1, c.order
    D = max(order, J)
    # r times c.denominator times below: below * (c's numerators) - above * (those of the squares).
    ratio = Fraction(2) ** (2 * lowest - 2 * squares.unit) / squares.scale * c.denominator
    above, below = ratio.numerator, ratio.denominator
    # One integer for each power of s and each factor, a lane for each monomial, wide enough for r.
    largest = max((abs(entry) for gram in grams for entry in gram.values()), default=0)
    bits = max(ring.width + below.bit_length(), (largest * above).bit_length())
    width = (bits + D + 2) // 8 + 1
    ring.work.spend(len(keys) * (D + 1) * (1 + (width * (J + order + 2) >> 5)))
    size = ring.width // 8
    pad, zero = bytes(width - size), bytes(size - 1) + b"\x80"
    halves = int.from_bytes((zero + pad) * len(keys), "little")
    nothing = zero * (order + 1)
    rows = [digits.get(key, nothing) for key in keys]
    lanes = []
    for i in range(0, size * (order + 1), size):
        lane = pad.join([row[i : i + size] for row in rows])
        lanes.append((int.from_bytes(lane, "little") - halves) * below)
    lanes += [packed([-gram.get(key, 0) * above for key in keys], width) for gram in grams]
    squared = [(place, basis.square[key]) for place, key in enumerate(keys) if key in basis.square]
    paired = [
        (place, i, j, 2 * highest - basis.columns[i] - basis.columns[j])
        for place, key in enumerate(keys)
        if key not in basis.square
        for i, j in [basis.pair[key]]
    ]
    common = lcm(*(comb(D, k) for k in range(D + 1)))
    least: list[int] = []
    for k in range(D + 1):
        weights = [comb(D - i, k - i) if i <= k else 0 for i in range(order + 1)]
        weights += [comb(J, j) * comb(D - J, k - j) if k >= j else 0 for j in range(J + 1)]
        line = sum(weight * lane for weight, lane in zip(weights, lanes, strict=True) if weight)
        values = unpacked(line, width, len(keys))
        left = [0] * len(basis.keys)
        for place, i in squared:
            left[i] = values[place] << 2 * (highest - basis.columns[i]) + 1
        for place, i, j, shift in paired:
            charge = abs(values[place]) << shift
            left[i] -= charge
            left[j] -= charge
        if min(left) < 0:
            i = next(i for i, room in enumerate(left) if room < 0)
            raise Rejected(f"{what}: not positive (Bernstein coefficient {k} of {D}, monomial {i})")
        left = [room * (common // comb(D, k)) for room in left]
        least = list(map(min, least, left)) if k else left
    return {
        key: Fraction(room, 2 * c.denominator * below * common << 2 * (highest - column))
        for key, column, room in zip(basis.keys, basis.columns, least, strict=True)
    }


def _squares(parts: Mapping[str, Node], ring: Ring) -> Squares:
    return read_squares(parts["squares"], read_basis(parts["basis"], parts["columns"], ring))


def _grams(squares: Squares, ring: Ring, lowest: int) -> list[dict[int, int]]:
    """Σ_i weights[i] (R_j[i] V v)² / 4^lowest by monomial, whole numbers, for each factor R_j.

    Rows are packed into one integer each, so that a row of R'R is a few products.
    """
    keys, size = squares.basis.keys, len(squares.basis.keys)
    columns = [shift - lowest for shift in squares.basis.columns]
    result = []
    for factor in squares.factors:
        most = max((abs(entry) for row in factor for entry in row), default=0)
        heaviest = max((1, *(squares.weights or ())))
        width = (most * most * heaviest * (len(factor) + 1)).bit_length() // 8 + 1
        long = 1 + (size * 8 * width * most.bit_length() >> LONG)
        ring.work.spend(size * (len(factor) + size) * long)
        weights = squares.weights or (1,) * len(factor)
        lines = [
            (weight * packed(row, width) << 8 * width * (size - len(row)), row)
            for weight, row in zip(weights, factor, strict=True)
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
