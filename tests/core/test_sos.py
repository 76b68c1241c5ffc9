"""Sums of squares: bases, symmetry, multipliers, and exact witnesses."""

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from nlsid_core.errors import DataError, Infeasible
from nlsid_core.kernel import Rejected
from nlsid_core.kernel.files import Node
from nlsid_core.kernel.polynomials import Ring, at_width
from nlsid_core.kernel.positivity import positive, read_squares
from nlsid_core.polynomial import Polynomial, constant, monomials, variables
from nlsid_core.sos import (
    Builder,
    NonNegative,
    NormBound,
    Program,
    SumOfSquares,
    forms_of,
    matrix_sum_of_squares,
    solve,
    symmetric_template,
    template,
)
from nlsid_core.sos.basis import gram_basis, sign_blocks
from nlsid_core.sos.witness import expanded, multiplier, witness

x, y = variables("x y")
(t,) = variables("t")
CAMEL = 4 * x**2 - 2.1 * x**4 + x**6 / 3 + x * y - 4 * y**2 + 4 * y**4


def residual(identity: object) -> float:
    """The largest coefficient of p - v'Qv - Σσg - Σμh left by the solver, without multipliers."""
    from nlsid_core.sos import Identity

    assert isinstance(identity, Identity)
    difference = identity.p - identity.gram.polynomial()
    return float(np.abs(difference.coefficients).max(initial=0.0))


def test_the_basis_of_motzkins_polynomial_is_its_half_newton_polytope() -> None:
    motzkin = x**4 * y**2 + x**2 * y**4 - 3 * x**2 * y**2 + 1
    assert {tuple(b) for b in gram_basis(motzkin.exponents).tolist()} == {
        (0, 0),
        (1, 1),
        (2, 1),
        (1, 2),
    }


def test_the_basis_of_a_form_is_homogeneous() -> None:
    assert gram_basis((x**4 + y**4).exponents).sum(axis=1).tolist() == [2, 2, 2]


def test_even_polynomials_split_by_sign_symmetry() -> None:
    support = (x**4 + y**4 + x**2 * y**2 + 1).exponents
    blocks = sign_blocks(monomials(2, range(3)), support)
    assert sorted(len(block) for block in blocks) == [1, 1, 1, 3]
    together = sign_blocks(monomials(2, range(3)), np.vstack([support, [[1, 1]]]))
    assert sorted(len(block) for block in together) == [2, 4]


def test_the_camel_minimum_is_found_and_the_identity_holds() -> None:
    found = solve(Program(("x", "y"), (SumOfSquares(CAMEL - t, name="p"),), minimise=-t))
    assert -found.objective == pytest.approx(-1.0316284535, abs=1e-6)
    assert residual(found["p"]) < 1e-6


def test_scaling_changes_nothing_but_the_conditioning() -> None:
    in_millimetres = CAMEL.substitute({"x": x / 1000, "y": y / 1000})
    program = Program(
        ("x", "y"),
        (SumOfSquares(in_millimetres - t, name="p"),),
        minimise=-t,
        scale={"x": 1000.0, "y": 1000.0},
    )
    found = solve(program)
    assert -found.objective == pytest.approx(-1.0316284535, abs=1e-6)
    difference = found["p"].p - found["p"].gram.polynomial()
    assert np.abs(difference([[500.0, -700.0], [0.0, 0.0]])).max() < 1e-6


def test_a_disc_domain_uses_a_sum_of_squares_multiplier() -> None:
    program = Program(
        ("x", "y"), (SumOfSquares(x - t, domain=(1 - x**2 - y**2,), name="p"),), minimise=-t
    )
    found = solve(program)
    assert -found.objective == pytest.approx(-1.0, abs=1e-6)
    assert np.linalg.eigvalsh(found["p"].multipliers[0].Q)[0] > -1e-8


def test_an_equation_takes_a_free_multiplier() -> None:
    circle = 1 - x**2 - y**2
    p = x**3 + x * y - y**4
    free = template("f", monomials(2, range(3)), ("x", "y"))
    full = Program(("x", "y"), (SumOfSquares(p - t - free * circle),), minimise=-t)
    angle = np.linspace(0, 2 * np.pi, 100_001)
    least = p(np.c_[np.cos(angle), np.sin(angle)]).min()
    assert -solve(full).objective == pytest.approx(least, abs=1e-6)


def test_a_template_finds_the_lyapunov_function_of_a_linear_system() -> None:
    """P - I ⪰ 0, -(A'P + PA) - I ⪰ 0, minimise tr P, as constant matrix inequalities."""
    A = np.array([[-1.0, 2.0], [0.0, -3.0]])
    P = symmetric_template("P", 2)
    lyapunov_matrix = -(A.T @ P + P @ A)
    one = constant(1.0)
    identity = np.array([[one, 0 * one], [0 * one, one]], dtype=object)
    program = Program(
        forms_of(2),
        (
            matrix_sum_of_squares(P - identity, name="P"),
            matrix_sum_of_squares(lyapunov_matrix - identity, name="decrease"),
        ),
        minimise=P[0, 0] + P[1, 1],
    )
    found = solve(program)
    value = np.array([[float(found.value(P[i, j])) for j in range(2)] for i in range(2)])
    assert np.linalg.eigvalsh(value - np.eye(2))[0] > -1e-6
    assert np.linalg.eigvalsh(-(A.T @ value + value @ A) - np.eye(2))[0] > -1e-6


def test_norms_are_bounded() -> None:
    """The most of a + b on a disc: |(a, b)| ≤ 1."""
    a, b = variables("a b")
    program = Program(
        ("x", "y"),
        (
            NormBound((a, b), constant(1.0)),
            NonNegative(a),
        ),
        minimise=-a - b,
    )
    assert -solve(program).objective == pytest.approx(2**0.5, abs=1e-6)


def test_free_polynomials_and_sum_of_squares_multipliers_can_be_written_out() -> None:
    sigma = template("s", monomials(2, [0, 2]), ("x", "y"))
    program = Program(
        ("x", "y"),
        (SumOfSquares(sigma), SumOfSquares(x**4 + 1 - t - sigma * (x**2 - 1))),
        minimise=-t,
    )
    assert -solve(program).objective == pytest.approx(2.0, abs=1e-5)


def test_products_of_unknowns_are_refused() -> None:
    a, b = variables("a b")
    with pytest.raises(DataError, match="linearly"):
        Builder(Program(("x", "y"), (SumOfSquares(a * b * x**2),)))


def test_a_polynomial_that_is_negative_somewhere_is_infeasible() -> None:
    with pytest.raises(Infeasible):
        solve(Program(("x", "y"), (SumOfSquares(x**2 - 0.1 * y**2 * x**2 - 1),)))


def test_univariate_minima_are_exact() -> None:
    (z,) = variables("z")
    rng = np.random.default_rng(5)
    for _ in range(5):
        p: Polynomial = z**6 + sum(float(c) * z**k for k, c in enumerate(rng.normal(size=6)))
        roots = np.roots([float(p.derivative("z").coefficient([k])) for k in range(5, -1, -1)])
        least = np.min(p(roots[np.abs(roots.imag) < 1e-9].real[:, None]))
        found = solve(Program(("z",), (SumOfSquares(p - t),), minimise=-t))
        assert -found.objective == pytest.approx(least, abs=1e-6)


# -- Float Gram matrices become whole numbers that the kernel accepts, and rebuilds exactly

Coefficients = dict[tuple[int, ...], list[Fraction]]


def decide(c: Coefficients, squares: Any, *, strict: bool = True) -> None:
    """`positive` of Σ_j B_j(s) c_j(x), given by Bernstein control points."""
    count = len(squares["basis"][0])

    def build(ring: Ring, _: None) -> None:
        parts = [ring.bernstein(control) * ring.monomial(e) for e, control in c.items()]
        members = Node(squares, "c").members("basis columns squares")
        positive(ring.sum(parts), read_squares(members, ring), ring, "c", strict=strict)

    at_width(count, [None], build)


def of_grams(basis: Any, grams: Any) -> Coefficients:
    result: Coefficients = {}
    for j, Q in enumerate(grams):
        for a, row in zip(basis.tolist(), Q.tolist(), strict=True):
            for b, entry in zip(basis.tolist(), row, strict=True):
                key = tuple(i + k for i, k in zip(a, b, strict=True))
                result.setdefault(key, [Fraction(0)] * len(grams))[j] += Fraction(entry)
    return result


@pytest.mark.parametrize("seed", range(6))
def test_a_definite_gram_matrix_becomes_a_witness_whatever_its_units(seed: int) -> None:
    rng = np.random.default_rng(seed)
    basis = monomials(2, range(seed % 3 + 2))
    units = 10.0 ** rng.uniform(-8, 8) * np.prod(10.0 ** (rng.uniform(-4, 4, 2) * basis), axis=1)
    grams = []
    for _ in range(seed % 4 + 1):
        L = rng.normal(size=(len(basis), len(basis))) * 10.0 ** -rng.uniform(0, 2)
        grams.append((L @ L.T + 1e-4 * np.eye(len(basis))) * units[:, None] * units)
    c = of_grams(basis, grams)
    found = witness(basis, grams)
    decide(c, found)
    entries = [abs(int(e)) for f in found["squares"]["factors"] for row in f for e in row]
    assert max(entries) < 2 ** (found["squares"]["unit"] + 1)
    lower = {key: list(value) for key, value in c.items()}
    first = [Fraction(float(g[0, 0])) for g in grams]
    lower[0, 0] = [v - 4 * g for v, g in zip(lower[0, 0], first, strict=True)]
    with pytest.raises(Rejected):
        decide(lower, found)


def test_a_residual_is_shared_out_among_the_products_of_the_basis() -> None:
    basis = monomials(2, range(3))
    Q = np.eye(len(basis))
    extra: dict[tuple[int, ...], list[float]] = {(2, 2): [0.3], (1, 1): [-0.2], (0, 0): [0.1]}
    c = of_grams(basis, [Q])
    for key, value in extra.items():
        c[key] = [c.get(key, [Fraction(0)])[0] + Fraction(value[0])]
    decide(c, witness(basis, Q, residual=extra))
    with pytest.raises(Infeasible, match="no product"):
        witness(basis, Q, residual={(5, 0): [1.0]})


def test_what_is_not_definite_is_refused_with_its_eigenvalue() -> None:
    with pytest.raises(Infeasible, match="not positive definite"):
        witness([[0], [1]], np.array([[1.0, 1.0], [1.0, 1.0]]))
    with pytest.raises(Infeasible, match="not positive definite"):
        witness([[0], [1]], np.array([[1.0, 2.0], [2.0, 1.0]]))


def test_a_multiplier_is_the_gram_matrix_to_its_bits_and_what_expanded_says_exactly() -> None:
    rng = np.random.default_rng(0)
    basis = monomials(2, range(3))
    L = rng.normal(size=(len(basis), 2))
    Q = L @ L.T
    found = multiplier(basis, Q, bits=40)
    assert np.linalg.matrix_rank(Q) == 2
    for key, (value,) in expanded(found).items():
        assert abs(float(value) - float(of_grams(basis, [Q])[key][0])) < 1e-9
    decide(expanded(found), found, strict=False)
