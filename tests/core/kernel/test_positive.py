"""`positive` in s and x: random true and false claims against an oracle, and exact refutation."""

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nlsid_core.kernel.files import Node, Rejected
from nlsid_core.kernel.polynomials import Polynomial, Ring, at_width
from nlsid_core.kernel.positivity import WITNESS, positive, read_squares
from tests.core.kernel import oracle_polynomial as oracle
from tests.core.kernel.refusals import refused

Claim = list[oracle.P]  # coefficients of s^0, s^1, …


def decide(c: Claim, witness: Any, *, strict: bool = True) -> None:
    """Rejected if the kernel does not prove c with this witness."""

    def build(ring: Ring, nothing: None) -> None:  # noqa: ARG001 - one case
        parts: list[Polynomial] = []
        power = ring.made(1)
        for p in c:
            for exponents, value in p.terms.items():
                term = value * power
                for variable, e in zip(ring.variables, exponents, strict=True):
                    for _ in range(e):
                        term = term * variable
                parts.append(term)
            power = power * ring.bernstein([Fraction(0), Fraction(1)])
        squares = read_squares(Node(witness, "witness").members(WITNESS), ring)
        positive(ring.sum(parts), squares, ring, "c", strict=strict)

    at_width(c[0].n, [None], build)


def random_claim(seed: int) -> tuple[Claim, Any]:
    """Squares as a witness states them, plus slack that is tiny, or a little too small."""
    rng = np.random.default_rng(seed)
    n, J, order = int(rng.integers(1, 4)), int(rng.integers(0, 3)), int(rng.integers(0, 4))
    degree = int(rng.integers(1, 3))
    every = [k for k in np.ndindex(*(degree + 1,) * n) if sum(k) <= degree]
    basis = [list(every[i]) for i in rng.permutation(len(every))[: rng.integers(1, 7)]]
    if [0] * n not in basis:
        basis.append([0] * n)
    k = len(basis)
    columns = rng.integers(-6, 6, size=k).tolist()
    squares: dict[str, Any] = {"unit": int(rng.integers(0, 20)), "factors": []}
    rows = int(rng.integers(1, k + 1))
    for _ in range(J + 1):
        factor = [
            rng.integers(-1000, 1000, size=int(rng.integers(1, k + 1))).tolist()
            for _ in range(rows)
        ]
        squares["factors"].append(factor)
    witness = {"basis": basis, "columns": columns, "squares": squares}
    points = oracle.raised(oracle.squares(witness, n), J + order)
    slack = Fraction(1, 2 ** int(rng.integers(1, 90)))
    for point in points:
        for row, column in zip(basis, columns, strict=True):
            share = slack * int(rng.integers(-1 if rng.random() < 0.2 else 1, 4))
            square = {tuple(2 * e for e in row): share * Fraction(4) ** column}
            point.terms = (point + oracle.P(n, square)).terms
        i, j = rng.integers(k, size=2)
        cross = {
            tuple(a + b for a, b in zip(basis[i], basis[j], strict=True)): (
                slack * int(rng.integers(-2, 3)) * Fraction(2) ** (columns[i] + columns[j]) / 3
            )
        }
        point.terms = (point + oracle.P(n, cross)).terms
    return powers(points), witness


def powers(points: list[oracle.P]) -> Claim:
    """Bernstein control points as coefficients of s^0, s^1, …."""
    from math import comb

    d = len(points) - 1
    return [
        sum(
            (points[j] * Fraction((-1) ** (k - j) * comb(d, k) * comb(k, j)) for j in range(k + 1)),
            oracle.P(points[0].n),
        )
        for k in range(d + 1)
    ]


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_kernel_decides_as_the_oracle_decides(seed: int) -> None:
    """In both directions, with slack down to 2^-90."""
    c, witness = random_claim(seed)
    expected = oracle.left_over(c, witness)
    if expected is None:
        with pytest.raises(Rejected):
            decide(c, witness, strict=False)
        return
    decide(c, witness, strict=False)
    if expected[(0,) * c[0].n] > 0:
        decide(c, witness)
    else:
        with pytest.raises(Rejected):
            decide(c, witness)


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_what_is_negative_somewhere_is_never_proved(seed: int) -> None:
    """A true claim is lowered to below 0 at one rational point (s, x)."""
    rng = np.random.default_rng(seed)
    c, witness = random_claim(seed)
    n = c[0].n
    s = Fraction(int(rng.integers(0, 9)), 8)
    point = [Fraction(int(a), int(b)) for a, b in rng.integers(-9, 10, size=(n, 2)) if b] or None
    if point is None or len(point) != n:
        return
    value = sum((p(point) * s**k for k, p in enumerate(c)), Fraction(0))
    drop = value + Fraction(1, 2 ** int(rng.integers(0, 80)))
    basis = [tuple(row) for row in witness["basis"]]
    chosen = basis[rng.integers(len(basis))]
    square = oracle.P(n, {tuple(2 * e for e in chosen): 1})
    if not square(point):
        square = oracle.P.constant(n, 1)
    c[0] = c[0] - square * (drop / square(point))
    assert sum((p(point) * s**k for k, p in enumerate(c)), Fraction(0)) < 0
    for strict in (True, False):
        with pytest.raises(Rejected):
            decide(c, witness, strict=strict)


def test_a_zero_at_one_end_of_s_is_nonnegative_and_not_positive() -> None:
    """c = s(1 + x²) and (1 - s)(1 + x²): 0 at an end; s(1 - s)(1 + x²): 0 at both."""
    one = oracle.P(1, {(0,): 1, (2,): 1})
    nothing = oracle.P(1)
    witness = {"basis": [[0], [1]], "columns": [0, 0], "squares": {"unit": 0, "factors": [[]]}}
    for c in ([nothing, one], [one, one * -1], [nothing, one, one * -1]):
        decide(c, witness, strict=False)
        with refused("not_positive"):
            decide(c, witness)
    for tiny in (Fraction(1, 2**1074), -Fraction(1, 10**30)):  # of no product: no lane is so small
        with refused("not_positive"):
            decide([one + oracle.P(1, {(3,): tiny})], witness)
    below = [nothing - oracle.P.constant(1, Fraction(1, 10**30)), one]
    with pytest.raises(Rejected):
        decide(below, witness, strict=False)


def test_the_same_square_does_not_balance_two_cross_terms() -> None:
    """x²y² is the square of xy and the product of x² and y²: it counts once."""
    witness = {
        "basis": [[2, 0], [0, 2], [1, 1]],
        "columns": [0, 0, 0],
        "squares": {"unit": 0, "factors": [[]]},
    }
    c = oracle.P(2, {(4, 0): 1, (0, 4): 1, (2, 2): -2})  # (x² - y²)²: true, with zeros
    with pytest.raises(Rejected):
        decide([c], witness, strict=False)
    decide([oracle.P(2, {(4, 0): 1, (0, 4): 1})], witness, strict=False)


@pytest.mark.parametrize("entry", [-0.0, 2.0, "4/2", "+2", True])
def test_a_whole_number_is_one_without_a_fraction_or_a_text_of_digits(entry: Any) -> None:
    """As in a file: parsed, a float64 is a Fraction."""
    given = Fraction(entry) if type(entry) is float else entry
    assert Node([1, "2", "-3"], "columns").integers(3, 3) == [1, 2, -3]
    with pytest.raises(Rejected):
        Node([1, given, -3], "columns").integers(3, 3)
