"""Sum-of-squares programs as data: what is unknown, what has to be a sum of squares.

Unknowns are ordinary variables of ordinary polynomials: every variable that is not
an indeterminate of the program is a decision, and may occur linearly.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nlsid_core.arrays import FloatArray
from nlsid_core.conic import ConeSolution
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.polynomial import Gram, Polynomial
from nlsid_core.polynomial.maps import added


@dataclass(frozen=True)
class SumOfSquares:
    """p = v'Qv + Σ σ_i g_i with Q ⪰ 0 and σ_i sums of squares: p ≥ 0 on a domain.

    Each summand has the least even degree in the indeterminates that fits p and the domain.

    p: polynomial, affine in the decisions. domain: the g_i ≥ 0. forms: indeterminates in which p is
    a quadratic form, as `matrix_sum_of_squares` makes it.
    """

    p: Polynomial
    domain: tuple[Polynomial, ...] = ()
    forms: tuple[str, ...] = ()
    name: str = ""


@dataclass(frozen=True)
class NonNegative:
    """An affine expression in the decisions, without indeterminates, is ≥ 0."""

    p: Polynomial


@dataclass(frozen=True)
class NormBound:
    """|(p_1, …, p_k)| ≤ bound, all affine in the decisions, without indeterminates."""

    entries: tuple[Polynomial, ...]
    bound: Polynomial


Constraint: TypeAlias = SumOfSquares | NonNegative | NormBound


@dataclass(frozen=True)
class Program:
    """Find decisions that satisfy the constraints and minimise an affine objective.

    indeterminates: the variables the inequalities hold for. scale: the size of an indeterminate in
    its unit (default 1); the program is solved in variables of size 1. Powers of two are used, so
    that scaling rounds nothing.
    """

    indeterminates: tuple[str, ...]
    constraints: tuple[Constraint, ...]
    minimise: Polynomial | None = None
    scale: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, size in self.scale.items():
            if name not in self.indeterminates or not (np.isfinite(size) and size > 0):
                raise DataError(
                    f"scale {name}: {size}; expected a positive size of an indeterminate"
                )


@dataclass(frozen=True, eq=False)
class Identity:
    """What a solved `SumOfSquares` says: p = gram + Σ multipliers·domain.

    Up to solver tolerance: the kernel decides whether it proves anything.
    """

    p: Polynomial
    gram: Gram
    multipliers: tuple[Gram, ...]
    name: str


@dataclass(frozen=True, eq=False)
class Solution:
    """Values of the decisions, the identities found, and how the solver got there."""

    values: dict[str, float]
    identities: tuple[Identity, ...]
    objective: float
    cone: ConeSolution

    def value(self, p: Polynomial) -> Polynomial:
        """`p` with the decisions replaced by their values."""
        known = {name: self.values[name] for name in p.names if name in self.values}
        return p.substitute(known)

    def __getitem__(self, name: str) -> Identity:
        found = [identity for identity in self.identities if identity.name == name]
        if not found:
            raise KeyError(f"no identity '{name}'; named: {[i.name for i in self.identities]}")
        return found[0]

    def __str__(self) -> str:
        return str(self.cone)


def template(name: str, basis: ArrayLike, names: Sequence[str]) -> Polynomial:
    """Σ_k name[k]·monomial_k: a polynomial with one free decision per monomial of basis (m, n)."""
    basis = np.asarray(basis, dtype=np.int64)
    if basis.ndim != 2 or basis.shape[1] != len(names):
        raise ShapeError(f"the basis should have shape (m, {len(names)}), has {basis.shape}")
    m = len(basis)
    unknowns = tuple(f"{name}[{k}]" for k in range(m))
    exponents = np.hstack([basis, np.eye(m, dtype=np.int64)])
    return Polynomial(exponents, np.ones(m), tuple(names) + unknowns)


def symmetric_template(name: str, size: int) -> NDArray[Any]:
    """A symmetric matrix of decisions name[i,j], i ≤ j, as an object array."""
    index = [(i, j) for i in range(size) for j in range(i, size)]
    names = tuple(f"{name}[{i},{j}]" for i, j in index)
    unit = np.eye(len(index), dtype=np.int64)
    matrix = np.empty((size, size), dtype=object)
    for k, (i, j) in enumerate(index):
        matrix[i, j] = matrix[j, i] = Polynomial(unit[[k]], np.ones(1), names)
    return matrix


def matrix_sum_of_squares(
    M: ArrayLike, *, domain: tuple[Polynomial, ...] = (), name: str = ""
) -> SumOfSquares:
    """M(x) ⪰ 0 on the domain, for a symmetric matrix of polynomials: y'M(x)y is a sum of squares.

    Constant in x, this is a linear matrix inequality. The program's indeterminates have to
    include `forms_of(size)`, the y.
    """
    M = np.asarray(M, dtype=object)
    if M.ndim != 2 or M.shape[0] != M.shape[1]:
        raise ShapeError(f"a square matrix of polynomials is needed, shape {M.shape} was given")
    names = forms_of(len(M))
    unit = np.eye(len(M), dtype=np.int64)
    parts = [
        Polynomial(unit[[i]] + unit[[j]], np.array([1.0 if i == j else 2.0]), names) * M[i, j]
        for i in range(len(M))
        for j in range(i, len(M))
    ]
    return SumOfSquares(added(parts), domain=domain, forms=names, name=name)


def forms_of(size: int) -> tuple[str, ...]:
    """The auxiliary indeterminates y of a matrix constraint of this size."""
    return tuple(f"y[{i}]" for i in range(size))


def round_to_power_of_two(size: float) -> float:
    """The power of two nearest to `size` on a logarithmic scale."""
    return float(2.0 ** np.round(np.log2(size)))


def scaling(program: Program) -> FloatArray:
    """(n,) sizes of the indeterminates, as powers of two."""
    sizes = [program.scale.get(name, 1.0) for name in program.indeterminates]
    return np.array([round_to_power_of_two(size) for size in sizes])
