"""The polynomial c(s, z) of a funnel's claim, expanded in the closed loop's own coordinates."""

from typing import TYPE_CHECKING

import numpy as np

from nlsid_core._types import FloatArray
from nlsid_core.certificate import saturation
from nlsid_core.certificate.arithmetic import Arithmetic, Ball, Exact, Number
from nlsid_core.certificate.graded import (
    Graded,
    add,
    monomials_of,
    multiply,
    negative,
    restrict,
    weighted,
)
from nlsid_core.continuous.funnel import Funnel
from nlsid_core.continuous.policy import Policy
from nlsid_core.continuous.vector_field import VectorField, odd_denominator
from nlsid_core.errors import CertificateRejected

if TYPE_CHECKING:
    from nlsid_core.certificate.funnel_pieces import Pieces


def closed_loop_polynomial(
    field: VectorField, policy: Policy, funnel: Funnel, pieces: "Pieces", arithmetic: Arithmetic
) -> tuple[Graded, int]:
    """unit·c(s, z) for every piece, and unit, a positive integer (1 in floating point).

    c = dρ/ds - 2x̄'P(hf - dx₀/ds) - x̄'(dP/ds)x̄ + μ(ρ - x̄'Px̄), x̄ = Tz, s in [0, 1] on the piece;
    derivatives are with respect to s on the whole interval, of length h. Where inputs are limited,
    f is that of the piece's mode, and what holds in the mode is taken off with its multipliers.
    """
    n, k = field.n, pieces.interval
    loop = _Loop(field, policy, funnel, pieces, arithmetic)
    P = _linear(funnel.P)[k]
    rho = _linear(funnel.rho)[k]
    T = arithmetic.of(pieces.T)
    x_bar = [{1: T[:, i][:, None]} for i in range(n)]
    PT = loop.product(loop.restricted(P), T)  # (B, 2, n, n): row i is (Px̄)_i
    rates = loop.field_times_h()
    x_rate = loop.nominal_rate()
    unit = arithmetic.of(np.array(float(loop.unit)))
    growth: Graded = {}
    for i in range(n):
        error = add(rates[i], {0: -(unit * x_rate[:, :, i])[:, :, None]})
        twice = {1: arithmetic.of(np.array(2.0)) * PT[:, :, i]}
        growth = add(growth, multiply(twice, error, n))
    for term in loop.bounded_pushes(PT):
        growth = add(growth, {q: unit * part for q, part in term.items()})
    W: Graded = {}
    bend: Graded = {}
    start, end = (arithmetic.of(part) for part in (P[:, 0], P[:, 1]))
    PdotT = loop.product((end - start)[:, None], T)
    for i in range(n):
        W = add(W, multiply({1: PT[:, :, i]}, x_bar[i], n))
        bend = add(bend, multiply({1: PdotT[:, :, i]}, x_bar[i], n))
    rho_rate = arithmetic.of(rho[:, 1]) - arithmetic.of(rho[:, 0])
    level = {0: loop.restricted(rho)[:, :, None]}
    mu = _multiplier(pieces, arithmetic)
    rest = add(multiply(mu, add(level, negative(W)), n), negative(bend))
    rest = add(rest, {0: rho_rate[:, None, None]})
    for term in saturation.in_mode(loop.demands, policy, pieces, arithmetic):
        rest = add(rest, negative(term))
    return add({q: unit * part for q, part in rest.items()}, negative(growth)), loop.unit


def _multiplier(pieces: "Pieces", arithmetic: Arithmetic) -> Graded:
    n, start, result = pieces.basis.shape[1], 0, {}
    for q in pieces.multiplier_degrees(pieces.basis):
        size = len(monomials_of(n, q))
        result[q] = arithmetic.of(pieces.mu[:, :, start : start + size])
        start += size
    return result


class _Loop:
    """The variables t, x, u, w of the field in z and s, one batch entry per piece."""

    def __init__(
        self,
        field: VectorField,
        policy: Policy,
        funnel: Funnel,
        pieces: "Pieces",
        arithmetic: Arithmetic,
    ) -> None:
        self.field, self.pieces, self.arithmetic = field, pieces, arithmetic
        self.policy, self.funnel = policy, funnel
        spans = np.searchsorted(field.breaks, funnel.t[:-1], side="right")[pieces.interval]
        self.span = int(spans[0])
        if (spans != self.span).any():
            raise CertificateRejected("pieces of one batch should obey the same equations")
        self.equations = field.pieces[self.span]
        self.unit = odd_denominator(self.equations) if arithmetic is Exact else 1
        self._variables = self._affine_forms()
        self._known: dict[tuple[int, ...], Graded] = {}

    def restricted(self, control: FloatArray) -> Number:
        """Bernstein control points (B, d+1, ...) as polynomials in s on each piece."""
        part = weighted(self.arithmetic.of(control))
        return restrict(part, self.pieces.level, self.pieces.index)

    def product(self, A: Number, T: Number) -> Number:
        """A(s) T for A (B, S+1, r, n) and T (B, n, n)."""
        total = A[..., 0][..., None] * T[:, None, None, 0]
        for j in range(1, T.shape[1]):
            total = total + A[..., j][..., None] * T[:, None, None, j]
        return total

    def nominal_rate(self) -> Number:
        """dx₀/ds (B, d, n)."""
        control = self.funnel.x.control[self.pieces.interval]
        degree = control.shape[1] - 1
        if degree == 0:
            return self.arithmetic.zeros((len(control), 1, control.shape[2]))
        points = self.arithmetic.of(control)
        steps = points[:, 1:] - points[:, :-1]
        factor = self.arithmetic.of(np.array(float(degree)))
        return restrict(weighted(factor * steps), self.pieces.level, self.pieces.index)

    def field_times_h(self) -> list[Graded]:
        """unit·h·f_i along the closed loop."""
        t = self.funnel.t
        k = self.pieces.interval
        h = self.arithmetic.of(t[k + 1]) - self.arithmetic.of(t[k])
        rates: list[Graded] = [{} for _ in self.equations]
        for i, p in enumerate(self.equations):
            numbers = self.arithmetic.rationals(p.coefficients.tolist(), self.unit)
            for j, exponent in enumerate(p.exponents.tolist()):
                factor = (numbers[j] * h)[:, None, None]
                term = {q: factor * part for q, part in self._monomial(tuple(exponent)).items()}
                rates[i] = add(rates[i], term)
        return rates

    def bounded_pushes(self, PT: Number) -> list[Graded]:
        """h·r(κ(x̄'Pg)² + 1/κ) for each w, r half its range: at least 2|x̄'Pg|·h·|w - centre|."""
        kappa, pushes = self.pieces.kappa, self.field.pushes(self.span)
        if kappa is None or pushes is None:
            return []
        t, k = self.funnel.t, self.pieces.interval
        h = self.arithmetic.of(t[k + 1]) - self.arithmetic.of(t[k])
        radius = self._half_sum(-1.0)
        terms = []
        for j, scale in enumerate(kappa.tolist()):
            along: Graded = {}
            for i in np.flatnonzero(pushes[:, j]).tolist():
                weight = self.arithmetic.of(np.array(pushes[i, j]))
                along = add(along, {1: weight * PT[:, :, i]})
            factor = (h * radius[:, j])[:, None, None]
            square = multiply(along, along, self.field.n)
            scaled = {q: self.arithmetic.of(np.array(scale)) * part for q, part in square.items()}
            inverse = self.arithmetic.of(np.full((1, 1, 1), 1 / scale))
            total = add(scaled, {0: inverse})
            terms.append({q: factor * part for q, part in total.items()})
        return terms

    def _half_sum(self, sign: float) -> Number:
        """(B, n_w): half of high + sign·low, for every piece."""
        low, high = (self.arithmetic.of(part) for part in self.field.uncertain.T)
        half = (high + self.arithmetic.of(np.array(sign)) * low) * self.arithmetic.of(np.array(0.5))
        zeros = self.arithmetic.zeros((len(self.pieces), len(self.field.uncertain)))
        return zeros + half

    def _monomial(self, exponent: tuple[int, ...]) -> Graded:
        if exponent not in self._known:
            last = max((j for j, e in enumerate(exponent) if e), default=-1)
            if last < 0:
                one = self.arithmetic.of(np.ones((len(self.pieces), 1, 1)))
                return {0: one}
            lower = list(exponent)
            lower[last] -= 1
            self._known[exponent] = multiply(
                self._monomial(tuple(lower)), self._variables[last], self.field.n
            )
        return self._known[exponent]

    def _affine_forms(self) -> list[Graded]:
        k = self.pieces.interval
        T = self.arithmetic.of(self.pieces.T)
        x = self.restricted(self.policy.x.control[k])
        u = self.restricted(self.policy.u.control[k])
        K = self.restricted(self.policy.K.control[k])
        time = self.restricted(_linear(self.funnel.t)[k])
        KT = self.product(K, T)
        w = self.arithmetic.of(self.field.vertices()[self.pieces.vertex])
        if self.pieces.kappa is not None:
            w = self._half_sum(1.0)
        forms: list[Graded] = [{0: time[:, :, None]}]
        forms += [{0: x[:, :, i][:, :, None], 1: T[:, None, i]} for i in range(self.field.n)]
        self.demands: list[Graded] = [
            {0: u[:, :, i][:, :, None], 1: -KT[:, :, i]} for i in range(self.field.m)
        ]
        forms += saturation.clipped(self.demands, self.policy, self.pieces, self.arithmetic)
        forms += [{0: w[:, None, i][:, :, None]} for i in range(w.shape[1])]
        return forms


def _linear(values: FloatArray) -> FloatArray:
    """(K-1, 2, ...) control points of the piecewise linear function through (K, ...)."""
    return np.stack([values[:-1], values[1:]], axis=1)


def error_at_end(
    field: VectorField, policy: Policy, funnel: Funnel, pieces: "Pieces", end: int
) -> FloatArray:
    """(B, n, M) coefficients of f(x₀ + Tz, u) - ẋ₀ at one end of each piece, in floating point.

    M: monomials in z of degree 0 up to the largest that occurs. For the search, not for proofs.
    """
    loop = _Loop(field, policy, funnel, pieces, Ball)
    x_rate = loop.nominal_rate()
    h = np.diff(funnel.t)[pieces.interval]
    rows = []
    for i, rate in enumerate(loop.field_times_h()):
        error = add(rate, {0: -x_rate[:, :, i][:, :, None]})
        parts = [
            error[q].approximate()[:, -end]
            if q in error
            else np.zeros((len(h), len(monomials_of(field.n, q))))
            for q in range(field.degree + 1)
        ]
        rows.append(np.concatenate(parts, axis=1) / h[:, None])
    return np.stack(rows, axis=1)
