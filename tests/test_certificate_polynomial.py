"""The checker's core: definiteness, both modes, and what it may import."""

import subprocess
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nlsid_core import _json
from nlsid_core.certificate import (
    Product,
    check,
    decide_gram,
    decide_identity,
    prove_attraction,
    prove_lower_bound,
)
from nlsid_core.certificate.documents import bound_document
from nlsid_core.certificate.dyadic import is_positive_definite, is_positive_semidefinite
from nlsid_core.certificate.rigorous import is_positive_definite as rigorously_definite
from nlsid_core.errors import CertificateRejected, Undecided
from nlsid_core.polynomial import Gram, Polynomial, variables

x, y = variables("x y")
NAMES = ("x", "y")
LINEAR = np.array([[0, 0], [1, 0], [0, 1]])


def gram(Q: Any, basis: Any = LINEAR) -> Gram:
    return Gram(np.asarray(basis), np.asarray(Q), NAMES)


def test_the_checker_imports_no_solver() -> None:
    """In a fresh interpreter: NumPy and the standard library, nothing else."""
    program = (
        "import sys; import nlsid_core.certificate, nlsid_core.certificate.documents;"
        "print(sorted({name.split('.')[0] for name in sys.modules}))"
    )
    root = Path(__file__).parent.parent
    shown = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=root
    )
    loaded = set(eval(shown.stdout)) - set(sys.stdlib_module_names)
    outside = {name for name in loaded if not name.startswith(("_", "numpy", "nlsid_core"))}
    assert not outside & {"scipy", "clarabel", "cvxpy", "scs", "sympy"}
    for source in (root / "nlsid_core" / "certificate").glob("*.py"):
        for line in source.read_text().splitlines():
            if line.startswith(("import ", "from ")):
                top = line.split()[1].split(".")[0]
                assert top in {"numpy", "nlsid_core"} | sys.stdlib_module_names, f"{source}: {line}"


@settings(max_examples=150, deadline=None)
@given(st.integers(1, 6), st.integers(0, 2**32 - 1), st.integers(-2, 2))
def test_integer_definiteness_agrees_with_exact_eigenvalue_signs(
    n: int, seed: int, shift: int
) -> None:
    """LL' + shift·I of small integers: minors by Fraction elimination decide."""
    rng = np.random.default_rng(seed)
    L = rng.integers(-3, 4, size=(n, int(rng.integers(1, n + 1))))
    M = (L @ L.T + shift * np.eye(n, dtype=int)).tolist()
    eigenvalues = np.linalg.eigvalsh(np.array(M, dtype=float))
    lowest = round(float(eigenvalues[0]), 9)  # integers: zero exactly, or far from it
    assert is_positive_definite(M) == (lowest > 0)
    assert is_positive_semidefinite(M) == (lowest >= 0)


def test_definiteness_is_decided_where_floats_cannot_tell() -> None:
    big = 10**40
    assert is_positive_definite([[big, big - 1], [big - 1, big - 1]])
    assert not is_positive_definite([[big, big], [big, big]])
    assert is_positive_semidefinite([[big, big], [big, big]])
    assert not is_positive_semidefinite([[big, big + 1], [big + 1, big]])
    assert not is_positive_semidefinite([[0, 1], [1, 10]])
    assert is_positive_definite([])
    assert is_positive_semidefinite([[0]])


@settings(max_examples=100, deadline=None)
@given(st.integers(1, 8), st.integers(0, 2**32 - 1), st.floats(-12, -1))
def test_rigorous_definiteness_never_proves_what_is_false(n: int, seed: int, gap: float) -> None:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    A = A @ A.T
    A = (A + A.T) / 2 - (np.linalg.eigvalsh(A)[0] + 10**gap * rng.choice([-1, 1])) * np.eye(n)
    D = 2**100
    whole = [[int(Fraction(entry) * D) for entry in row] for row in A.tolist()]
    if rigorously_definite(A):
        assert is_positive_definite(whole)


def test_rigorous_definiteness_proves_well_conditioned_and_badly_scaled_matrices() -> None:
    A = np.array([[2.0, 1.0], [1.0, 2.0]])
    assert rigorously_definite(A)
    assert rigorously_definite(A, 0.999)
    assert not rigorously_definite(A, 1.001)
    S = np.diag([1e-100, 1e100])
    assert rigorously_definite(S @ A @ S)
    assert not rigorously_definite(np.array([[1.0, 2.0], [2.0, 1.0]]))
    assert not rigorously_definite(np.array([[np.nan]]))


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-17, -2), st.booleans())
def test_rigorous_mode_proves_nothing_that_exact_mode_does_not(
    seed: int, room: float, above: bool
) -> None:
    """Identities whose truth hangs on a margin down to rounding size, on either side of it."""
    rng = np.random.default_rng(seed)
    L = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-3, 3, size=(3, 1))
    Q = L @ L.T
    Q = (Q + Q.T) / 2
    p = gram(Q).polynomial()
    lowest = float(np.linalg.eigvalsh(Q)[0])
    shift = lowest * (1 - 10.0**room if above else 1 + 10.0**room)
    shifted = gram(Q - shift * np.eye(3))
    target = p - shift * (x**2 + y**2 + 1)
    answers = []
    for mode in ("exact", "rigorous"):
        try:
            prove_lower_bound(target, 0.0, shifted, mode=mode)
            answers.append(True)
        except CertificateRejected:
            answers.append(False)
    assert answers[0] or not answers[1]


@pytest.mark.parametrize("mode", ["exact", "rigorous"])
def test_a_small_residual_is_absorbed_and_a_large_one_refused(mode: Any) -> None:
    p = x**2 + y**2 + 1
    Q = np.eye(3)
    assert prove_lower_bound(p, 0.5, gram(np.diag([0.5, 1, 1])), mode=mode) > 0
    Q[1, 1] += 1e-9
    assert prove_lower_bound(p, 0.0, gram(Q), mode=mode) > 0
    Q[1, 1] += 1e-3
    with pytest.raises(CertificateRejected, match="residual"):
        prove_lower_bound(p, 0.0, gram(Q), mode=mode)


@pytest.mark.parametrize("mode", ["exact", "rigorous"])
def test_a_monomial_outside_the_basis_is_named(mode: Any) -> None:
    with pytest.raises(CertificateRejected, match=r"x\*\*3"):
        prove_lower_bound(x**2 + y**2 + 1 + 1e-300 * x**3, 0.0, gram(np.eye(3)), mode=mode)


def test_semidefinite_is_proved_exactly_and_undecided_rigorously() -> None:
    square = gram(np.array([[1.0, 1.0], [1.0, 1.0]]), [[1, 0], [0, 1]])
    assert prove_lower_bound((x + y) ** 2, 0.0, square) == 0.0
    with pytest.raises(Undecided):
        prove_lower_bound((x + y) ** 2, 0.0, square, mode="rigorous")
    with pytest.raises(CertificateRejected):
        decide_gram(square, strict=True)


def test_a_margin_is_a_proved_eigenvalue() -> None:
    margin = prove_lower_bound(x**2 + y**2 + 4, 0.0, gram(np.diag([4.0, 1.0, 1.0])))
    assert 0.1 < margin <= 0.25  # least eigenvalue 1 over largest diagonal entry 4


def test_rationals_are_exact() -> None:
    third = Fraction(1, 3)
    Q = np.array([[third, 0], [0, third]], dtype=object)
    p = Polynomial(np.array([[2, 0], [0, 2]]), np.array([third, third], dtype=object), NAMES)
    assert prove_lower_bound(p, 0, gram(Q, [[1, 0], [0, 1]])) > 0
    with pytest.raises(Undecided, match="exact mode"):
        prove_lower_bound(p, 0, gram(Q, [[1, 0], [0, 1]]), mode="rigorous")


def test_derivatives_in_an_identity_are_exact() -> None:
    """∂(x²y)/∂x·y = 2xy² has weight 2; as a target it needs a Gram matrix of y and xy."""
    target = [Product(x**4 / 4 + y**2, 0 * y + x, derivative=0)]
    assert decide_identity(target, Gram(np.array([[2, 0]]), np.eye(1), NAMES), strict=True) > 0


def test_attraction_needs_an_equilibrium_a_level_and_a_definite_basis() -> None:
    V, I2 = x**2 + y**2, gram(2 * np.eye(2), [[1, 0], [0, 1]])
    one = gram(np.eye(2), [[1, 0], [0, 1]])
    assert prove_attraction((-x, -y), V, None, positive=one, decrease=I2) > 0
    with pytest.raises(CertificateRejected, match="equilibrium"):
        prove_attraction((-x + 1, -y), V, None, positive=one, decrease=I2)
    with pytest.raises(CertificateRejected, match="multiplier"):
        prove_attraction((-x, -y), V, 1.0, positive=one, decrease=I2)
    with pytest.raises(CertificateRejected, match="origin only"):
        prove_attraction((-x, -y), V, None, positive=gram(np.eye(3)), decrease=I2)
    with pytest.raises(CertificateRejected):
        prove_attraction((x, -y), V, None, positive=one, decrease=I2)


def test_the_statement_is_made_from_the_numbers_that_were_verified(tmp_path: Path) -> None:
    path = tmp_path / "p.json"
    _json.write_document(
        path, bound_document(x**2 + 1, 0.5, gram([[0.5, 0], [0, 1.0]], LINEAR[:2]))
    )
    verdict = check(path, mode="rigorous")
    assert verdict.statement.startswith("polynomial bound: x**2 + 1 >= 0.5 for all real x, y")
    assert verdict.mode == "rigorous"
    with pytest.raises(ValueError, match="mode is 'quick'"):
        check(path, mode="quick")  # type: ignore[arg-type]
