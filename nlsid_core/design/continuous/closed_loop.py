"""The polynomial c(s, z) of a funnel's claim for the search: many pieces at once.

In floating point; the kernel expands the same polynomial exactly, and says what it claims.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.design.continuous.graded import (
    Graded,
    add,
    monomials_of,
    multiply,
    negative,
    positions,
    restrict,
    weighted,
)
from nlsid_core.dynamics.vector_field import VectorField
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.polynomial.maps import monomials

OWN = ("T", "mu", "gram", "tau", "stated")  # of each piece
CELLS = 6_000_000  # Gram entries held at once


@dataclass(frozen=True, eq=False)
class Cases:
    """What each piece is of: interval, vertex of w, part index/2^level of the interval.

    mode: (B, L) of the policy's modes. off: (B, m + n_w) δ, that the input is off, and w.
    """

    interval: IntArray
    vertex: IntArray
    level: IntArray
    index: IntArray
    mode: IntArray
    off: FloatArray

    def select(self, chosen: slice | IntArray) -> "Cases":
        """Some of them."""
        return Cases(**{f.name: getattr(self, f.name)[chosen] for f in fields(self)})


@dataclass(frozen=True, eq=False)
class Pieces:
    """basis: (k, n) exponents of v.

    T: (B, n, n), x̄ = Tz. mu: (B, 2, M) multiplier at both ends, in the monomials of degree 0 up to
    2 less than twice the basis'. gram: (B, 2, k, k) Gram matrices in v there, as first found.
    tau: (B, 2, L, n+1, n+1) S ⪰ 0 at both ends, y'Sy with y = (1, z) the multiplier of what holds
    in the mode. stated: (B,) how a proof writes mu and tau, see `witnesses.rounded`.
    kappa: (intervals, n_w); then what w adds to ẋ is bounded with them and `vertex` is 0.
    """

    basis: IntArray
    cases: Cases
    T: FloatArray
    mu: FloatArray
    gram: FloatArray
    tau: FloatArray
    stated: NDArray[np.object_]
    kappa: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.T)

    @staticmethod
    def multiplier_size(basis: IntArray) -> int:
        """M for this basis."""
        return len(monomials(basis.shape[1], Pieces.multiplier_degrees(basis)))

    @staticmethod
    def multiplier_degrees(basis: IntArray) -> range:
        """The degrees of the multiplier's monomials."""
        return range(max(2 * int(np.max(basis.sum(axis=1))) - 1, 1))

    def select(self, chosen: slice | IntArray) -> "Pieces":
        """Some of the pieces."""
        kept = {name: getattr(self, name)[chosen] for name in OWN}
        return replace(self, cases=self.cases.select(chosen), **kept)


@dataclass(frozen=True, eq=False)
class InputRates:
    """How fast the policy changes input entry (B,), with a sign (B,), on pieces.

    Pieces that differ in entry and sign only follow each other, in the same frame T.

    taken: (B,) what entries of w that only push add to the rate, in input units per s; shoved:
    (B, m) what a unit of every δ that only pushes adds.
    """

    pieces: Pieces
    entry: IntArray
    sign: IntArray
    taken: FloatArray
    shoved: FloatArray

    def room(self, rates: FloatArray, widths: FloatArray) -> FloatArray:
        """(B,) what R and W (intervals, m) leave to the rest, in input units per s."""
        k = self.pieces.cases.interval
        pushed = self.taken + (self.shoved * widths[k]).sum(axis=1)
        return np.asarray(rates[k, self.entry] - pushed)


def batches(pieces: Pieces) -> Iterator[IntArray]:
    """Indices of pieces, as many as fit at once."""
    size = max(1, CELLS // (len(pieces.basis) ** 2 * 16))
    for start in range(0, len(pieces), size):
        yield np.arange(start, min(start + size, len(pieces)))


def closed_loop_polynomial(
    field: VectorField,
    policy: ContinuousPolicy,
    funnel: ContinuousFunnel,
    pieces: Pieces,
    end: int | None = None,
) -> Graded:
    """c(s, z) of every piece, in Bernstein form times the binomials.

    end: 0 or 1 for the value at that end alone, of degree 0 in s.

    c = dρ/ds - 2x̄'P(hf - dx₀/ds) - x̄'(dP/ds)x̄ + μ(ρ - x̄'Px̄) - Στq, x̄ = Tz, s in [0, 1] on the
    piece; derivatives are with respect to s on the whole interval, of length h. Where inputs are
    limited, f is that of the piece's mode, and what holds in the mode is taken off.
    """
    n, k = field.n, pieces.cases.interval
    loop = _Loop(field, policy, funnel, pieces, end)
    P = linear(funnel.P)[k]
    rho = linear(funnel.rho)[k]
    x_bar: list[Graded] = [{1: pieces.T[:, i][:, None]} for i in range(n)]
    PT = _product(loop.restricted(P), pieces.T)  # (B, 2, n, n): row i is (Px̄)_i
    rates = loop.field_times_h()
    x_rate = loop.nominal_rate()
    c: Graded = {}  # -dW/ds
    for i in range(n):
        error = add(rates[i], {0: -x_rate[:, :, i][:, :, None]})
        c = add(c, multiply({1: -2 * PT[:, :, i]}, error, n))
    for term in loop.bounded_pushes(PT):
        c = add(c, negative(term))
    PdotT = _product((P[:, 1] - P[:, 0])[:, None], pieces.T)
    for i in range(n):
        c = add(c, multiply({1: -PdotT[:, :, i]}, x_bar[i], n))
    gap, rise = loop.gap(), {0: (rho[:, 1] - rho[:, 0])[:, None, None]}
    c = add(add(c, rise), multiply(loop.multiplier(), gap, n))
    for term in loop.held():
        c = add(c, negative(term))
    return c


def rate_polynomial(
    field: VectorField,
    policy: ContinuousPolicy,
    funnel: ContinuousFunnel,
    of: InputRates,
    room: FloatArray,
    end: int | None = None,
) -> Graded:
    """h room - sign dũ_i/ds - τ(ρ - x̄'Px̄) of every piece, as `closed_loop_polynomial` writes c.

    room: (B,) in input units per s. τ: the first of the piece's. end: only its value at 0 or at 1.
    """
    pieces, entry = of.pieces, of.entry
    n, k = field.n, pieces.cases.interval
    loop = _Loop(field, policy, funnel, pieces, end)
    case = np.column_stack(
        [k, pieces.cases.level, pieces.cases.index, pieces.cases.vertex, pieces.cases.mode]
    )
    new = np.r_[True, (case[1:] != case[:-1]).any(axis=1)]
    first = np.flatnonzero(new)
    rates = _Loop(field, policy, funnel, pieces.select(first), end).field_times_h()
    shared = np.cumsum(new) - 1
    every = np.arange(len(k))
    gains = policy.K.control[k][every, :, entry]
    turned = _product(loop.restricted(_slope(gains))[:, :, None], pieces.T)[:, :, 0]
    steered = loop.restricted(_slope(policy.u.control[k][every, :, entry]))
    change: Graded = {0: steered[:, :, None], 1: -turned}
    along, x_rate = loop.restricted(gains), loop.nominal_rate()
    for j, rate in enumerate(rates):
        here = {q: part[shared] for q, part in rate.items()}
        error = add(here, {0: -x_rate[:, :, j][:, :, None]})
        change = add(change, multiply({0: -along[:, :, j][:, :, None]}, error, n))
    c: Graded = {q: -of.sign[:, None, None] * part for q, part in change.items()}
    c = add(c, {0: (np.diff(funnel.t)[k] * room)[:, None, None]})
    return add(c, negative(multiply(loop.squares(0), loop.gap(), n)))


class _Loop:
    """The variables t, x, u, w of the field in z and s, one batch entry per piece.

    end: 0 or 1 if only what they are at that end of the pieces is asked for.
    """

    def __init__(
        self,
        field: VectorField,
        policy: ContinuousPolicy,
        funnel: ContinuousFunnel,
        pieces: Pieces,
        end: int | None = None,
    ) -> None:
        self.field, self.pieces, self.end = field, pieces, end
        self.policy, self.funnel = policy, funnel
        spans = np.searchsorted(field.breaks, funnel.t[:-1], side="right")
        self.span = spans[pieces.cases.interval]
        self._variables = self._affine_forms()
        self._known: dict[tuple[int, ...], Graded] = {}

    def restricted(self, control: FloatArray) -> FloatArray:
        """Bernstein control points (B, d+1, ...) as polynomials in s on each piece."""
        return self._at_end(
            restrict(weighted(control), self.pieces.cases.level, self.pieces.cases.index)
        )

    def multiplier(self) -> Graded:
        """μ."""
        n, start, result = self.field.n, 0, {}
        mu = self._at_end(self.pieces.mu)
        for q in self.pieces.multiplier_degrees(self.pieces.basis):
            size = len(monomials_of(n, q))
            result[q] = mu[:, :, start : start + size]
            start += size
        return result

    def squares(self, place: int) -> Graded:
        """τ of this place."""
        return _squares(self._at_end(self.pieces.tau[:, :, place]))

    def nominal_rate(self) -> FloatArray:
        """dx₀/ds (B, d, n)."""
        return self.restricted(_slope(self.funnel.x.control[self.pieces.cases.interval]))

    def gap(self) -> Graded:
        """ρ - x̄'Px̄."""
        k, n = self.pieces.cases.interval, self.field.n
        PT = _product(self.restricted(linear(self.funnel.P)[k]), self.pieces.T)
        W: Graded = {}
        for i in range(n):
            W = add(W, multiply({1: PT[:, :, i]}, {1: self.pieces.T[:, i][:, None]}, n))
        return add({0: self.restricted(linear(self.funnel.rho)[k])[:, :, None]}, negative(W))

    def field_times_h(self) -> list[Graded]:
        """h·f_i along the closed loop."""
        h = np.diff(self.funnel.t)[self.pieces.cases.interval][:, None, None]
        rates: list[Graded] = [{} for _ in range(self.field.n)]
        exponents, table = self.field.coefficients
        numbers = table[self.span]
        for i, j in np.argwhere(numbers.any(axis=0)).tolist():
            scale = numbers[:, i, j][:, None, None] * h
            value = self._monomial(tuple(exponents[j].tolist())).items()
            rates[i] = add(rates[i], {q: scale * part for q, part in value})
        return rates

    def bounded_pushes(self, PT: FloatArray) -> list[Graded]:
        """h·r(κ(x̄'Pg)² + 1/κ) for each w, r half its range: at least 2|x̄'Pg|·h·|w - centre|."""
        kappa = self.pieces.kappa
        if kappa is None:
            return []
        pushes = np.array([self.field.pushes(span) for span in range(len(self.field.pieces))])
        h = np.diff(self.funnel.t)[self.pieces.cases.interval][:, None, None]
        terms = []
        scales = kappa[self.pieces.cases.interval][:, :, None, None]
        for j, radius in enumerate((np.ptp(self.field.uncertain, axis=1) / 2).tolist()):
            scale = scales[:, j]
            along: Graded = {1: np.einsum("bkij,bi->bkj", PT, pushes[self.span, :, j])}
            square = multiply(along, along, self.field.n)
            total = add({q: scale * part for q, part in square.items()}, {0: 1 / scale})
            terms.append({q: radius * h * part for q, part in total.items()})
        return terms

    def held(self) -> list[Graded]:
        """τ_l q_l for every limited input: what is nonnegative in the piece's mode."""
        n, terms = self.field.n, []
        for place, (i, low, high) in enumerate(self.policy.limits.tolist()):
            mode = self.pieces.cases.mode[:, place][:, None, None]
            demand = self.demands[int(i)]
            above = add(demand, {0: np.full((1, 1, 1), -low)})
            below = add(negative(demand), {0: np.full((1, 1, 1), high)})
            q: Graded = {}
            for part, chosen in (
                (multiply(above, below, n), mode == 0),
                (negative(above), mode < 0),
                (negative(below), mode > 0),
            ):
                q = add(q, {degree: chosen * factor for degree, factor in part.items()})
            terms.append(multiply(self.squares(place - len(self.policy.limits)), q, n))
        return terms

    def _at_end(self, part: FloatArray) -> FloatArray:
        """(B, S+1, ...) on each piece; (B, 1, ...) at the end, where only that is asked for."""
        return part if self.end is None else part[:, [-self.end]]

    def _monomial(self, exponent: tuple[int, ...]) -> Graded:
        if exponent not in self._known:
            last = max((j for j, e in enumerate(exponent) if e), default=-1)
            if last < 0:
                return {0: np.ones((len(self.pieces), 1, 1))}
            lower = list(exponent)
            lower[last] -= 1
            self._known[exponent] = multiply(
                self._monomial(tuple(lower)), self._variables[last], self.field.n
            )
        return self._known[exponent]

    def _affine_forms(self) -> list[Graded]:
        k, T = self.pieces.cases.interval, self.pieces.T
        x = self.restricted(self.policy.x.control[k])
        u = self.restricted(self.policy.u.control[k])
        KT = _product(self.restricted(self.policy.K.control[k]), T)
        time = self.restricted(linear(self.funnel.t)[k])
        forms: list[Graded] = [{0: time[:, :, None]}]
        forms += [{0: x[:, :, i][:, :, None], 1: T[:, None, i]} for i in range(self.field.n)]
        self.demands: list[Graded] = [
            {0: u[:, :, i][:, :, None], 1: -KT[:, :, i]} for i in range(self.field.m)
        ]
        for i, applied in enumerate(self._clipped()):
            forms.append(add(applied, {0: self.pieces.cases.off[:, i][:, None, None]}))
        forms += [{0: part[:, None, None]} for part in self.pieces.cases.off[:, self.field.m :].T]
        return forms

    def _clipped(self) -> list[Graded]:
        """The inputs in each piece's mode: ũ, or a limit."""
        inputs = list(self.demands)
        for place, (i, low, high) in enumerate(self.policy.limits.tolist()):
            mode = self.pieces.cases.mode[:, place][:, None, None]
            limit = np.where(mode < 0, low, np.where(mode > 0, high, 0.0))
            free = {q: (mode == 0) * part for q, part in self.demands[int(i)].items()}
            inputs[int(i)] = add(free, {0: limit})
        return inputs


def _squares(S: FloatArray) -> Graded:
    """y'Sy with y = (1, z), S (B, J, n+1, n+1) in Bernstein form times the binomials."""
    n = S.shape[-1] - 1
    y = np.vstack([np.zeros((1, n), dtype=np.int64), monomials(n, [1])])
    products: IntArray = (y[:, None] + y[None]).reshape(-1, n)
    entries = S.reshape(*S.shape[:2], -1)
    result: Graded = {}
    for degree in range(3):
        chosen = np.flatnonzero(products.sum(axis=1) == degree)
        rows = monomials(n, [degree])
        part = np.zeros((*S.shape[:2], len(rows)))
        homes = positions(products[chosen], rows)
        for home, entry in zip(homes.tolist(), chosen.tolist(), strict=True):
            part[:, :, home] += entries[:, :, entry]
        result[degree] = part
    return result


def _slope(control: FloatArray) -> FloatArray:
    """Control points (B, d, ...) of the derivative in s of curves with (B, d+1, ...)."""
    degree = control.shape[1] - 1
    return degree * np.diff(control, axis=1) if degree else 0.0 * control


def _product(A: FloatArray, T: FloatArray) -> FloatArray:
    """A(s) T for A (B, S+1, r, n) and T (B, n, n)."""
    return np.asarray(np.einsum("bsij,bjk->bsik", A, T))


def linear(values: FloatArray) -> FloatArray:
    """(K-1, 2, ...) control points of the piecewise linear function through (K, ...)."""
    return np.stack([values[:-1], values[1:]], axis=1)
