"""Convex conditions for stable, well-posed models, as polynomial inequalities on a domain.

A model is e(x⁺) = f(x, w), or 0 = h(v, x, w) with x⁺ = [v; ã(x, w)]. Polynomials may be exact (then
so is the condition) or hold unknowns linearly (then it is a convex set). The conditions do not
change when e, f, h and the storage are scaled together.
Source: thesis Chapter 2; the lemma is named at each function.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlsid_core.arrays import objects_at
from nlsid_core.errors import ShapeError
from nlsid_core.polynomial import Polynomial, constant, jacobian, variables
from nlsid_core.polynomial.algebra import as_polynomial
from nlsid_core.sos import SumOfSquares, matrix_sum_of_squares

Polynomials = NDArray[Any]  # object array of `Polynomial`, or numbers
Domain = tuple[Polynomial, ...]
GAP = "~"  # appended to a variable's name: its difference between two solutions
Number = float | Fraction


@dataclass(frozen=True, eq=False)
class Inequality:
    """matrix ⪰ 0 where every polynomial of the domain is ≥ 0.

    kept: once made relevant, which of the domain's polynomials are still there.
    """

    matrix: Polynomials
    domain: Domain = ()
    kept: tuple[int, ...] = ()

    def relevant(self) -> "Inequality":
        """The same without the part of the domain that no variable of the matrix is tied to."""
        used, kept = set().union(*(_used(entry) for entry in self.matrix.ravel())), -1
        while kept < len(used):
            kept = len(used)
            used |= set().union(*(_used(g) for g in self.domain if _used(g) & used))
        which = tuple(k for k, g in enumerate(self.domain) if _used(g) & used)
        return replace(self, domain=tuple(self.domain[k] for k in which), kept=which)

    def variables(self, names: Sequence[str]) -> tuple[str, ...]:
        """Those of `names` that occur; the first if none does."""
        everything = (*self.matrix.ravel(), *self.domain)
        used = set().union(*(_used(entry) for entry in everything))
        return tuple(name for name in names if name in used) or tuple(names[:1])


def constraint(inequality: Inequality, *, name: str) -> SumOfSquares:
    """The inequality as a sum of squares on its domain, for a `sos.Program`; name: for messages."""
    matrix, domain = inequality.matrix, inequality.domain
    if len(matrix) == 1:
        return SumOfSquares(matrix[0, 0], domain=domain, name=name)
    return matrix_sum_of_squares(matrix, domain=domain, name=name)


def linear(E: Polynomials, F: Polynomials, delta: Number = 1, *, rate: Number = 1) -> Inequality:
    """[ρ²E - δI, F'; F, E] ⪰ 0: E x⁺ = F x + …, stable; with E = E' it contains every stable A.

    rate: ρ, by which V shrinks beside δ. Source: (2.19).
    """
    corner = rate**2 * E - delta * _identity(len(E))
    return Inequality(filled(np.block([[corner, F.T], [F, E]])))


def derivatives(
    E: Polynomials,
    F: Polynomials,
    P: Polynomials,
    *,
    delta: Number = 1,
    rate: Number = 1,
    domain: Domain = (),
) -> Inequality:
    """[ρ²(He(E(x)) - P) - δI, F(x, w)'; F(x, w), P] ⪰ 0 with E = ∂e/∂x, F = ∂f/∂x, ρ = rate.

    Global only if deg E ≥ 2 deg F; otherwise give a domain. Source: Lemma 2.13.
    """
    corner = rate**2 * (E + E.T - P) - delta * _identity(len(E))
    return Inequality(filled(np.block([[corner, F.T], [F, P]])), domain)


def implicit_derivatives(
    h: Polynomials,
    shift: Polynomials,
    M: Polynomials,
    names: tuple[Sequence[str], Sequence[str]],
    *,
    delta: Number = 1,
    rate: Number = 1,
) -> Inequality:
    """2ν'(H₁ν + H₂Δ) + |Δ|²_{ρ²M - δI} - |[ν; ÃΔ]|²_M ≥ 0 for every ν, Δ, as a matrix.

    names: of v and x. ρ = rate, H₁ = ∂h/∂v, H₂ = ∂h/∂x, Ã = ∂ã/∂x; M: (n_x, n_x), M ⪰ 0 to be
    asked for beside it. Source: Lemma 2.11 with a constant metric.
    """
    (v, x), n_v = names, len(names[0])
    H1, H2 = slopes(h, v), slopes(h, x)
    A = slopes(shift, x) if len(shift) else np.zeros((0, len(x)), dtype=object)
    top = H1 + H1.T - M[:n_v, :n_v]
    side = H2 - _product(M[:n_v, n_v:], A)
    kept = _product(A.T, _product(M[n_v:, n_v:], A))
    corner = rate**2 * M - delta * _identity(len(x)) - kept
    return Inequality(filled(np.block([[top, side], [side.T, corner]])))


def monotone(h: Polynomials, v: Sequence[str], m: Number, *, domain: Domain = ()) -> Inequality:
    """H₁ + H₁' - 2mI ⪰ 0, H₁ = ∂h/∂v: h is m-monotone in v. Source: (2.12)."""
    H1 = slopes(h, v)
    return Inequality(filled(H1 + H1.T - 2 * m * _identity(len(v))), domain)


def box(names: Sequence[str], ends: Sequence[Sequence[Number] | tuple[Number, Number]]) -> Domain:
    """low ≤ x ≤ high of states and inputs: (x - low)(high - x) ≥ 0; ends (low, high) each."""
    if len(names) != len(ends):
        raise ShapeError(f"{len(names)} names and the ends of {len(ends)} intervals")
    return tuple(
        (x - low) * (high - x) for x, (low, high) in zip(variables(list(names)), ends, strict=True)
    )


def constants(rows: Sequence[Sequence[float]]) -> Polynomials:
    """A matrix of numbers as exact constant polynomials."""
    return objects_at((len(rows),) * 2, lambda at: constant(Fraction(rows[at[0]][at[1]])))


def _used(p: Polynomial) -> set[str]:
    return {n for n, column in zip(p.names, p.exponents.T, strict=True) if column.any()}


def slopes(polynomials: Polynomials, names: Sequence[str]) -> Polynomials:
    """(m, n) derivatives; a variable that does not occur has derivative zero."""
    result = np.empty((len(polynomials), len(names)), dtype=object)
    for i, entry in enumerate(polynomials):
        p = as_polynomial(entry)
        result[i] = jacobian([p.over(tuple(dict.fromkeys([*p.names, *names])))], names)[0]
    return result


def _product(left: Polynomials, right: Polynomials) -> Polynomials:
    """left @ right; where a factor is zero, as most slopes of a shift are, nothing is added."""
    result = np.empty((len(left), right.shape[1]), dtype=object)
    there = [np.array([len(as_polynomial(p)) > 0 for p in column]) for column in right.T]
    for i, row in enumerate(left):
        known = np.array([len(as_polynomial(p)) > 0 for p in row], dtype=bool)
        for j, column in enumerate(right.T):
            both = known & there[j].astype(bool)
            result[i, j] = row[both] @ column[both] if both.any() else constant(0)
    return result


def _identity(n: int) -> Polynomials:
    return np.eye(n, dtype=np.int64).astype(object)


def filled(matrix: Polynomials) -> Polynomials:
    """Every entry a polynomial."""
    return objects_at(matrix.shape, lambda at: as_polynomial(matrix[at]))
