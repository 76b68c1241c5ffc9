"""Convex conditions for stable, well-posed models, as polynomial inequalities on a domain.

A model is e(x⁺) = f(x, w), or 0 = h(v, x, w) with x⁺ = [v; ã(x, w)]. The second of two solutions is
written with gaps: x̂ = x - x~, so that every term vanishes with the gap and Gram matrices can be
definite. Polynomials may be exact (then so is the condition) or hold unknowns linearly (then it
is a convex set). The conditions do not change when e, f, h and the storage are scaled together.
Source: thesis Chapter 2; the lemma is named at each function.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

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

    vanishing: the gaps, if the matrix's first row vanishes where they are zero; for the search.
    kept: once made relevant, which of the domain's polynomials are still there.
    """

    matrix: Polynomials
    domain: Domain = ()
    vanishing: tuple[str, ...] = ()
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
    matrix, domain, gaps = inequality.matrix, inequality.domain, inequality.vanishing
    if len(matrix) == 1:
        return SumOfSquares(matrix[0, 0], domain=domain, vanishing=gaps, name=name)
    found = matrix_sum_of_squares(matrix, domain=domain, name=name)
    return replace(found, vanishing=(*gaps, *found.forms[1:])) if gaps else found


def linear(E: Polynomials, F: Polynomials, delta: Number = 1, *, rate: Number = 1) -> Inequality:
    """[ρ²E - δI, F'; F, E] ⪰ 0: E x⁺ = F x + …, stable; with E = E' it contains every stable A.

    rate: ρ, by which V shrinks beside δ. Source: (2.19).
    """
    corner = rate**2 * E - delta * _identity(len(E))
    return Inequality(filled(np.block([[corner, F.T], [F, E]])))


def increments(
    e: Polynomials,
    f: Polynomials,
    P: Polynomials,
    states: Sequence[str],
    *,
    delta: Number = 1,
    rate: Number = 1,
    domain: Domain = (),
) -> Inequality:
    """[ρ²(2Δ'(e - ê) - |Δ|²_P) - δ|Δ|², (f - f̂)'; f - f̂, P] ⪰ 0, Δ = x - x̂, ρ = rate.

    V = |e - ê|²_{P⁻¹} ≥ 2Δ'(e - ê) - |Δ|²_P shrinks by ρ² or more. Source: Lemma 2.12.
    """
    hat, gap = _second(states)
    moved, image = e - _substituted(e, hat), f - _substituted(f, hat)
    matrix = np.empty((len(e) + 1,) * 2, dtype=object)
    matrix[0, 0] = rate**2 * (2 * (gap @ moved) - gap @ P @ gap) - delta * (gap @ gap)
    matrix[0, 1:] = matrix[1:, 0] = image
    matrix[1:, 1:] = P
    return Inequality(filled(matrix), _both(domain, hat), _gaps(states))


def derivatives(
    e: Polynomials,
    f: Polynomials,
    P: Polynomials,
    states: Sequence[str],
    *,
    delta: Number = 1,
    rate: Number = 1,
    domain: Domain = (),
) -> Inequality:
    """[ρ²(He(E(x)) - P) - δI, F(x, w)'; F(x, w), P] ⪰ 0 with E = ∂e/∂x, F = ∂f/∂x, ρ = rate.

    Global only if deg E ≥ 2 deg F; otherwise give a domain. Source: Lemma 2.13.
    """
    E, F = _slopes(e, states), _slopes(f, states)
    corner = rate**2 * (E + E.T - P) - delta * _identity(len(e))
    return Inequality(filled(np.block([[corner, F.T], [F, P]])), domain)


def implicit_increments(
    h: Polynomials,
    shift: Polynomials,
    V: Polynomial,
    v: Sequence[str],
    x: Sequence[str],
    *,
    delta: Number = 1,
    rate: Number = 1,
    domain: Domain = (),
) -> Inequality:
    """2(v - v̂)'(h - ĥ) + ρ²V(x, x̂) - V(x⁺, x̂⁺) - δ|x - x̂|² ≥ 0, x⁺ = [v; ã(x, w)], ρ = rate.

    V: in x and its gap, zero without gap; `storage` asks V ≥ 0. Source: Lemma 2.10.
    """
    if len(h) != len(v) or len(shift) != len(x) - len(v):
        raise ShapeError(f"{len(h)} equations for {len(v)} unknowns, {len(shift)} shifted states")
    hat, gap = _second([*v, *x])
    unknown, gap_v, gap_x = np.array(variables(list(v))), gap[: len(v)], gap[len(v) :]
    after = [*unknown, *shift]
    gap_after = [*gap_v, *(shift - _substituted(shift, hat))]
    names = [*x, *(name + GAP for name in x)]
    wide = V.over(tuple(dict.fromkeys([*names, *V.names])))
    next_V = wide.substitute(dict(zip(names, [*after, *gap_after], strict=True)))
    moved = h - _substituted(h, hat)
    p = 2 * (gap_v @ moved) + rate**2 * V - next_V - delta * (gap_x @ gap_x)
    return Inequality(filled(np.array([[p]], dtype=object)), _both(domain, hat), _gaps([*v, *x]))


def storage(V: Polynomial, x: Sequence[str], *, domain: Domain = ()) -> Inequality:
    """V(x, x̂) ≥ 0 for both states in the domain. Source: Lemma 2.10."""
    return Inequality(np.array([[V]], dtype=object), _both(domain, _second(x)[0]), _gaps(x))


def implicit_derivatives(
    h: Polynomials,
    shift: Polynomials,
    M: Polynomials,
    v: Sequence[str],
    x: Sequence[str],
    *,
    delta: Number = 1,
    rate: Number = 1,
    domain: Domain = (),
) -> Inequality:
    """2ν'(H₁ν + H₂Δ) + |Δ|²_{ρ²M(x)-δI} - |[ν; ÃΔ]|²_{M(x⁺)} ≥ 0 for every ν, Δ, as a matrix.

    ρ = rate, H₁ = ∂h/∂v, H₂ = ∂h/∂x, Ã = ∂ã/∂x; M: (n_x, n_x) in x, M ⪰ 0 to be asked for beside
    it. Source: Lemma 2.11.
    """
    n_v, n_x = len(v), len(x)
    H1, H2 = _slopes(h, v), _slopes(h, x)
    A = _slopes(shift, x) if len(shift) else np.zeros((0, n_x), dtype=object)
    next_M = _substituted(M, dict(zip(x, [*variables(list(v)), *shift], strict=True)))
    top = H1 + H1.T - next_M[:n_v, :n_v]
    side = H2 - _product(next_M[:n_v, n_v:], A)
    kept = _product(A.T, _product(next_M[n_v:, n_v:], A))
    corner = rate**2 * M - delta * _identity(n_x) - kept
    return Inequality(filled(np.block([[top, side], [side.T, corner]])), domain)


def monotone(h: Polynomials, v: Sequence[str], m: Number, *, domain: Domain = ()) -> Inequality:
    """H₁ + H₁' - 2mI ⪰ 0, H₁ = ∂h/∂v: h is m-monotone in v. Source: (2.12)."""
    H1 = _slopes(h, v)
    return Inequality(filled(H1 + H1.T - 2 * m * _identity(len(v))), domain)


def regular(centre: Polynomials, v: Sequence[str], m: Number) -> Inequality:
    """E₀'E₀ - m²I ⪰ 0: a linear e₀ is a bijection, |e₀ - ê₀| ≥ m|v - v̂|."""
    E0 = _slopes(centre, v)
    return Inequality(filled(E0.T @ E0 - Fraction(m) ** 2 * _identity(len(v))))


def centred(
    h: Polynomials, centre: Polynomials, v: Sequence[str], *, domain: Domain = ()
) -> Inequality:
    """E₀'H₁ + H₁'E₀ - E₀'E₀ ⪰ 0: h is a bijection in v if e₀ is, with invertible Jacobian E₀.

    Source: Proposition 2.7, (2.15).
    """
    H1, E0 = _slopes(h, v), _slopes(centre, v)
    return Inequality(filled(E0.T @ H1 + H1.T @ E0 - E0.T @ E0), domain)


def box(names: Sequence[str], ends: Sequence[Sequence[Number] | tuple[Number, Number]]) -> Domain:
    """low ≤ x ≤ high of states and inputs: (x - low)(high - x) ≥ 0; ends (low, high) each."""
    if len(names) != len(ends):
        raise ShapeError(f"{len(names)} names and the ends of {len(ends)} intervals")
    return tuple(
        (x - low) * (high - x) for x, (low, high) in zip(variables(list(names)), ends, strict=True)
    )


def constants(rows: Sequence[Sequence[float]]) -> Polynomials:
    """A matrix of numbers as exact constant polynomials."""
    result = np.empty((len(rows), len(rows)), dtype=object)
    for i, row in enumerate(rows):
        result[i] = [constant(Fraction(value)) for value in row]
    return result


def _second(names: Sequence[str]) -> tuple[dict[str, Polynomial], Polynomials]:
    """The second solution x - x~ of each variable, and the gaps x~."""
    gaps = variables([name + GAP for name in names])
    first = variables(list(names))
    return {n: x - d for n, x, d in zip(names, first, gaps, strict=True)}, np.array(gaps)


def _gaps(names: Sequence[str]) -> tuple[str, ...]:
    return tuple(name + GAP for name in names)


def _both(domain: Domain, hat: dict[str, Polynomial]) -> Domain:
    """The domain for both solutions; once where only inputs occur."""
    second = [g.substitute(_occurring(g, hat)) for g in domain if _occurring(g, hat)]
    return (*domain, *second)


def _occurring(p: Polynomial, values: dict[str, Polynomial]) -> dict[str, Polynomial]:
    used = _used(p)
    return {name: value for name, value in values.items() if name in used}


def _used(p: Polynomial) -> set[str]:
    return {n for n, column in zip(p.names, p.exponents.T, strict=True) if column.any()}


def _substituted(polynomials: Polynomials, values: dict[str, Polynomial]) -> Polynomials:
    result = np.empty(polynomials.shape, dtype=object)
    for index in np.ndindex(polynomials.shape):
        entry = as_polynomial(polynomials[index])
        result[index] = entry.substitute(_occurring(entry, values))
    return result


def _slopes(polynomials: Polynomials, names: Sequence[str]) -> Polynomials:
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
    result = np.empty(matrix.shape, dtype=object)
    for index in np.ndindex(matrix.shape):
        result[index] = as_polynomial(matrix[index])
    return result
