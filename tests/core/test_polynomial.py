"""Polynomials against sums of powers in fractions, and the messages users see."""

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nlsid_core.errors import DataError, NotPolynomial, ShapeError
from nlsid_core.polynomial import (
    Gram,
    Polynomial,
    jacobian,
    monomials,
    trace,
    variables,
)

NAMES = ("x", "y", "z")
COEFFICIENTS = st.fractions(min_value=-20, max_value=20, max_denominator=16)
EXPONENTS = st.tuples(*[st.integers(0, 3)] * 3)


@st.composite
def polynomials(draw: st.DrawFn) -> Polynomial:
    terms = draw(st.dictionaries(EXPONENTS, COEFFICIENTS, max_size=6))
    coefficients = np.empty(len(terms), dtype=object)
    coefficients[:] = list(terms.values())
    return Polynomial(np.array(list(terms), dtype=np.int64), coefficients, NAMES)


POINT = (Fraction(3, 7), Fraction(-5, 3), Fraction(11, 2))


def at(p: Polynomial, point: tuple[Fraction, ...] = POINT) -> Fraction:
    """Its value, term by term."""
    total = Fraction(0)
    for exponents, coefficient in p.exact().terms():
        for x, power in zip(point, exponents, strict=True):
            coefficient *= x**power
        total += coefficient
    return total


@settings(max_examples=30, deadline=None)
@given(polynomials(), polynomials(), st.integers(0, 3))
def test_arithmetic_is_that_of_values(p: Polynomial, q: Polynomial, power: int) -> None:
    a, b = at(p), at(q)
    found = [at(each) for each in (p + q, p - q, p * q, p**power, -p / 3)]
    assert found == [a + b, a - b, a * b, a**power, -a / 3]


@settings(max_examples=30, deadline=None)
@given(polynomials(), polynomials())
def test_derivatives_are_linear_and_obey_the_product_rule(p: Polynomial, q: Polynomial) -> None:
    y = variables(NAMES)[1].exact()
    assert (y**3).derivative("y") == 3 * y**2
    assert (p * q).derivative("y") == p.derivative("y") * q + p * q.derivative("y")
    assert (p + q).derivative("y") == p.derivative("y") + q.derivative("y")


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(polynomials(), polynomials())
def test_composition_is_that_of_values(p: Polynomial, q: Polynomial) -> None:
    composed = p.substitute({"x": q, "z": Fraction(1, 3)}).over(NAMES)
    assert at(composed) == at(p, (at(q), POINT[1], Fraction(1, 3)))


@settings(max_examples=40, deadline=None)
@given(polynomials(), st.integers(0, 2**32 - 1))
def test_values_agree_with_exact_substitution(p: Polynomial, seed: int) -> None:
    points = np.random.default_rng(seed).integers(-8, 8, size=(5, 3)) / 4
    for point, value in zip(points, p(points), strict=True):
        exact = p.substitute(dict(zip(NAMES, map(Fraction, point.tolist()), strict=True)))
        assert value == pytest.approx(float(exact), rel=1e-12, abs=1e-9)


@settings(max_examples=40, deadline=None)
@given(polynomials())
def test_floats_convert_to_rationals_and_back_without_loss(p: Polynomial) -> None:
    rounded = p.rounded()
    assert rounded.exact().rounded() == rounded
    assert np.array_equal(rounded.exact().rounded().coefficients, rounded.coefficients)


def test_a_python_function_becomes_the_polynomial_it_computes() -> None:
    A = np.array([[0.1, 2.0], [3.0, -1.0]])

    def field(x: Any, u: Any) -> Any:
        return A @ x + np.outer(x, x) @ x * u[0] + np.array([u[0] ** 2, 1.0])

    traced = trace(field, {"x": 2, "u": 1})
    x0, x1, u0 = (v.exact() for v in variables("x0 x1 u0"))
    tenth = Fraction(0.1)
    assert traced[0] == tenth * x0 + 2 * x1 + (x0**3 + x0 * x1**2) * u0 + u0**2
    assert all(p.is_exact and p.names == ("x0", "x1", "u0") for p in traced)
    point = np.array([0.3, -0.7, 1.1])
    values = [p(point) for p in traced]
    assert values == pytest.approx(field(point[:2], point[2:]), rel=1e-14)


def test_cross_products_and_matrices_can_be_traced() -> None:
    traced = trace(lambda w: np.cross(w, np.diag([5.0, 3.0, 2.0]) @ w), {"w": 3})
    w = [v.exact() for v in variables("w0 w1 w2")]
    assert traced.tolist() == [-w[1] * w[2], 3 * w[0] * w[2], -2 * w[0] * w[1]]


@pytest.mark.parametrize(
    ("function", "named"),
    [
        (lambda x: np.sin(x), "sin of x0"),
        (lambda x: np.exp(x[0]), "exp of x0"),
        (lambda x: 1 / x[0], "division by x0"),
        (lambda x: x[0] ** 0.5, "power 0.5 of x0"),
        (lambda x: x[0] ** -1, "power -1 of x0"),
        (lambda x: 2 ** x[0], "exponent of x0"),
        (lambda x: abs(x[0]), "abs of x0"),
        (lambda x: x[0] if x[0] > 0 else x[1], "comparison > of x0"),
        (lambda x: np.maximum(x, 0), "comparison"),
        (lambda x: np.sqrt(x @ x), r"sqrt of x0\*\*2 \+ x1\*\*2"),
        (lambda x: np.linalg.norm(x), "sqrt"),
        (lambda x: x[0] % 2, "remainder of x0"),
        (lambda x: x[0] // 2, "floor division of x0"),
        (lambda x: float(x[0]), "float"),
        (lambda x: 1j * x[0], "complex"),
        (lambda x: repr(x[0]), "'x0'"),
        (lambda x: x[1] + (6.0 if x[0] == 0 else 0.0), "comparison == of x0"),
        (lambda x: x[1] + (6.0 if x[0] != x[1] else 0.0), "comparison == of x0"),
        (lambda x: x[1] + (6.0 if x[0] in (0.1, 0.2) else 0.0), "comparison == of x0"),
        (lambda x: x[1] + (6.0 if x[0] in {0.1, 0.2} else 0.0), "a set or dictionary of x0"),
        (lambda x: np.where(x == 0, x, 1.0), "comparison == of x0"),
    ],
)
def test_a_function_that_is_not_polynomial_says_which_operation_was_not(
    function: Any, named: str
) -> None:
    with pytest.raises(NotPolynomial, match=named):
        trace(function, {"x": 2})


def test_the_jacobian_is_the_matrix_of_derivatives() -> None:
    x, y = variables("x y")
    J = jacobian([x**2 * y, x - 3 * y], ["x", "y"])
    assert J.tolist() == [[2 * x * y, x**2], [1 + 0 * x, -3 + 0 * x]]


def test_the_repr_names_the_variables() -> None:
    x, y = variables("x y")
    assert repr(x**2 * y - 1.5 * y + 2) == "x**2*y - 1.5*y + 2"
    assert repr(0 * x) == "0"
    assert repr((x / 3).exact()).startswith("6004799503160661/18014398509481984*x")


def test_different_variables_combine_in_their_union() -> None:
    (x,), (y,) = variables("x"), variables("y")
    assert (x * y).names == ("x", "y")
    assert x * y == y * x


def test_large_integers_stay_exact() -> None:
    (x,) = variables("x")
    assert (x + (2**60 + 1)).coefficient([0]) == Fraction(2**60 + 1)


def test_bad_polynomials_are_refused_with_a_reason() -> None:
    with pytest.raises(DataError, match="nonnegative"):
        Polynomial(np.array([[-1]]), np.ones(1), ("x",))
    with pytest.raises(DataError, match="finite"):
        Polynomial(np.array([[1]]), np.array([np.nan]), ("x",))
    with pytest.raises(ShapeError, match="exponents of"):
        Polynomial(np.array([[1, 2]]), np.ones(1), ("x",))
    with pytest.raises(DataError, match="no variable z"):
        variables("x y")[0].substitute({"z": 1})


def test_a_gram_matrix_multiplies_out_and_refuses_asymmetry() -> None:
    x, y = variables("x y")
    basis = np.array([[1, 0], [0, 1]])
    assert Gram(basis, np.array([[1.0, 2.0], [2.0, 3.0]]), ("x", "y")).polynomial() == (
        x**2 + 4 * x * y + 3 * y**2
    )
    with pytest.raises(DataError, match="differs"):
        Gram(basis, np.array([[1.0, 2.0], [2.1, 3.0]]), ("x", "y"))
    with pytest.raises(DataError, match="distinct"):
        Gram(basis[[0, 0]], np.eye(2), ("x", "y"))


def test_monomials_are_counted_by_the_binomial_coefficient() -> None:
    assert len(monomials(6, range(5))) == 210
    assert len(monomials(6, [1, 2])) == 27
