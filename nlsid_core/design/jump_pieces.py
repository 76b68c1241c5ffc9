"""Witnesses for a jump from one funnel into another, found in floating point.

At instants a program finds τ, μ and the most that V of the funnel after leaves on the guard; pieces
of time between them have these multipliers, linear in time. A piece on which no proof is found is
halved. Source: docs/certificate_hybrid_funnel.md.
"""

from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from math import comb

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray, Json
from nlsid_core.design.continuous.closed_loop import linear
from nlsid_core.design.continuous.graded import (
    Graded,
    add,
    multiply,
    negative,
    positions,
    restrict,
    weighted,
)
from nlsid_core.design.continuous.pieces import Part, substitution
from nlsid_core.design.continuous.witnesses import (
    MU_BITS,
    TAU_BITS,
    fitted,
    gram_curves,
    matrices,
    together,
)
from nlsid_core.dynamics import Jump
from nlsid_core.errors import Infeasible, SolverError
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.polynomial import Polynomial
from nlsid_core.polynomial.maps import monomials
from nlsid_core.sos.compiled import solve
from nlsid_core.sos.program import NonNegative, Program, SumOfSquares, template
from nlsid_core.sos.witness import multiplier, witness

MAX_LEVEL = 8  # of halvings of an interval
MOST = 0.5  # of the room: where nothing of the funnel is on the guard, multipliers give any


@dataclass(frozen=True, eq=False)
class Multipliers:
    """At one instant, in x̄: τ (k', k'), μ (M,), the Gram matrix (k, k), and the room that is left.

    room: of the polynomial over its size, what all monomials of the basis in z have to spare.
    """

    tau: FloatArray
    mu: FloatArray
    gram: FloatArray
    room: float


@dataclass(frozen=True, eq=False)
class Crossing:
    """A jump out of the funnel `before` into the start of `after`."""

    jump: Jump
    before: ContinuousFunnel
    after: ContinuousFunnel
    known: dict[tuple[int, int, float], Multipliers] = field(default_factory=dict)

    @cached_property
    def half(self) -> int:
        """Half the degree of what is proved to be a sum of squares."""
        highest = max(int(p.exponents[:, : self.jump.n].sum(axis=1).max()) for p in self.jump.reset)
        return max(highest, (self.jump.guard.degree + 1) // 2, 1)

    @cached_property
    def basis(self) -> IntArray:
        """(k, n) of v."""
        return monomials(self.jump.n, range(self.half + 1))

    @cached_property
    def sides(self) -> IntArray:
        """(k', n) of the monomials of τ."""
        return monomials(self.jump.n, range(self.half))

    @cached_property
    def rows(self) -> IntArray:
        """(M, n) of the monomials of μ."""
        return monomials(self.jump.n, range(2 * self.half - self.jump.guard.degree + 1))

    @cached_property
    def resets(self) -> list[list[Polynomial]]:
        """The reset at each vertex of w, in x."""
        names = [f"w{j}" for j in range(len(self.jump.uncertain))]
        return [
            [p.substitute(dict(zip(names, w, strict=True))).rounded() for p in self.jump.reset]
            for w in self.jump.vertices().tolist()
        ]

    def first(self) -> int:
        """The knot from which the guard is watched on."""
        return int(np.flatnonzero(self.before.t == self.jump.start)[0])

    def proof(self) -> Json:
        """The members of the jump's proof; Infeasible with where there is none."""
        last = len(self.before.t) - 1
        waiting = [Part(k, 0, 0) for k in range(self.first(), last)]
        found = {"start": self._side(self.first(), 1), "end": self._side(last, -1)}
        pieces = []
        while waiting:
            part = waiting.pop()
            try:
                rows = [self._piece(part, vertex) for vertex in range(len(self.resets))]
            except Infeasible:
                if part.level == MAX_LEVEL:
                    raise
                waiting += part.halves()
            else:
                pieces += rows
        pieces.sort(key=lambda p: (p["interval"], p["index"] / 2 ** p["level"], p["vertex"]))
        return found | {
            "basis": self.basis.tolist(),
            "sides": self.sides.tolist(),
            "multiplier": self.rows.tolist(),
            "pieces": pieces,
        }

    def _piece(self, part: Part, vertex: int) -> Json:
        """The piece as the kernel reads it; Infeasible if it is not shown to be positive.

        What w does is often little: multipliers of the first vertex are tried first.
        """
        for of in (0, vertex) if vertex else (0,):
            start, end = (self._instant(part.interval, of, s) for s in part.ends())
            if of == vertex and min(start.room, end.room) <= 0:
                raise Infeasible(
                    "the reset is not shown to lead into the start of the next stage "
                    f"{self._said(part)}: design the stage before for a narrower goal"
                )
            for pair in ([start, end], [start, start], [end, end]):  # near an instant its own serve
                with suppress(Infeasible):
                    return self._written(part, vertex, pair)
        raise Infeasible(f"no multipliers are found for all times {self._said(part)}")

    def _written(self, part: Part, vertex: int, ends: list[Multipliers]) -> Json:
        """The piece with multipliers between these two; Infeasible if it is not positive."""
        mu, stated = self._rounded(np.array([end.mu for end in ends]), part)
        squares = multiplier(self.sides, [end.tau for end in ends], bits=TAU_BITS)
        tau = matrices(squares["columns"], squares["squares"])
        gap, guard, room = self._polynomials(vertex, part)
        c = add(room, negative(multiply(_squares(self.sides, tau), gap, self.jump.n)))
        c = add(c, negative(multiply(_graded(self.rows, mu), guard, self.jump.n)))
        found = _witness(self.basis, c, np.array([end.gram for end in ends]))
        return {
            "interval": part.interval,
            "vertex": vertex,
            "level": part.level,
            "index": part.index,
            "tau": {key: squares[key] for key in ("columns", "squares")},
            "mu": stated,
        } | {key: found[key] for key in ("columns", "squares")}

    def _elsewhere(self) -> str:
        """To first order: another knot where it is above 0, or how narrow the funnel has to be."""
        funnel = self.before
        shares = []
        for points, P, rho in zip(funnel.x.control, funnel.P, funnel.rho, strict=False):
            slope = self.jump.slopes(points[0])[0]
            reach = np.sqrt(rho * (slope @ np.linalg.solve(P, slope)))
            shares.append(float(self.jump.height(points[:1])[0]) / max(float(reach), 1e-300))
        shares[self.first()] = -1.0  # it was tried
        above = np.flatnonzero(np.array(shares) > 1)
        if len(above):
            return f"; to first order it is at {float(funnel.t[above[-1]])!r} s"
        best = int(np.argmax(shares))
        if shares[best] <= 0:
            return "; nor is it on the motion at any other knot"
        return (
            f"; to first order a funnel {shares[best]:.2g} times as wide would do at "
            f"{float(funnel.t[best])!r} s: take a goal so much narrower"
        )

    def _said(self, part: Part) -> str:
        k, (a, b) = part.interval, part.ends()
        first, h = self.before.t[k], self.before.t[k + 1] - self.before.t[k]
        return f"between {first + a * h:.6g} and {first + b * h:.6g} s"

    def _instant(self, k: int, vertex: int, s: float) -> Multipliers:
        """What a program finds at s along interval k."""
        key = k, vertex, s
        if key not in self.known:
            self.known[key] = self._solved(*key)
        return self.known[key]

    def _solved(self, k: int, vertex: int, s: float) -> Multipliers:
        T = self._frame(k, s)
        gap, guard, room = self._polynomials(vertex, Part(k, 0, 0), s, T)
        try:
            return _multipliers(room, gap, guard, self.basis, T)
        except (Infeasible, SolverError) as error:
            t = self.before.t
            raise Infeasible(f"no multipliers at {t[k] + s * (t[k + 1] - t[k]):.6g} s") from error

    def _frame(self, k: int, s: float) -> FloatArray:
        """T (n, n) with W = ρ|z|² where x̄ = Tz, at s along interval k."""
        funnel = self.before
        P = (1 - s) * funnel.P[k] + s * funnel.P[k + 1]
        rho = float((1 - s) * funnel.rho[k] + s * funnel.rho[k + 1])
        return np.asarray(np.sqrt(rho) * np.linalg.inv(np.linalg.cholesky(P).T))

    def _polynomials(
        self, vertex: int, part: Part, end: float | None = None, T: FloatArray | None = None
    ) -> tuple[Graded, Graded, Graded]:
        """ρ - W, g and ρ_b - |R - b|² on a part of time, or at one instant, in z with x̄ = Tz."""
        n, k = self.jump.n, part.interval
        T = np.eye(n) if T is None else T
        level, index = np.array([part.level]), np.array([part.index])

        def curve(control: FloatArray) -> FloatArray:
            if end is None:
                return restrict(weighted(control[None]), level, index)
            degree = len(control) - 1
            shares = [
                comb(degree, i) * end**i * (1 - end) ** (degree - i) for i in range(degree + 1)
            ]
            return np.tensordot(shares, control, 1)[None, None]

        funnel, after = self.before, self.after
        x, rho = curve(funnel.x.control[k]), curve(linear(funnel.rho)[k])
        P = curve(linear(funnel.P)[k])
        states = [{0: x[:, :, i][:, :, None], 1: T[None, None, i]} for i in range(n)]
        bars: list[Graded] = [{1: T[None, None, i]} for i in range(n)]
        gap: Graded = {0: rho[:, :, None]}
        for i in range(n):
            row: Graded = {1: np.einsum("bsj,jk->bsk", P[:, :, i], T)}
            gap = add(gap, negative(multiply(row, bars[i], n)))
        known: dict[tuple[int, ...], Graded] = {(0,) * n: {0: np.ones((1, 1, 1))}}
        guard, *reached = (
            _composed(p, states, known) for p in (self.jump.guard.rounded(), *self.resets[vertex])
        )
        centre, away = after.x.control[0, 0], []
        for r, b in zip(reached, centre.tolist(), strict=True):
            away.append(add(r, {0: np.full((1, 1, 1), -b)}))
        room: Graded = {0: np.full((1, 1, 1), float(after.rho[0]))}
        for i, left in enumerate(away):
            weighed: Graded = {}
            for entry, right in zip(after.P[0, i].tolist(), away, strict=True):
                weighed = add(weighed, _scaled(entry, right))
            room = add(room, negative(multiply(left, weighed, n)))
        return gap, guard, room

    def _rounded(self, mu: FloatArray, part: Part) -> tuple[FloatArray, Json]:
        """(2, M) of few bits, and how a proof states it."""
        k = part.interval
        reach = np.sqrt(
            max(self.before.rho[k : k + 2])
            * np.diag(np.linalg.inv(self.before.P[k : k + 2]).max(axis=0))
        )
        sizes = np.exp(self.rows @ np.log(reach))
        largest = max(float((np.abs(mu).max(axis=0) * sizes).max()), 1e-300)
        shifts = np.round(np.log2(largest / sizes)).astype(np.int64) - MU_BITS
        whole = np.round(mu * np.exp2(-shifts.astype(np.float64)))
        stated = {
            "shifts": shifts.tolist(),
            "start": whole[0].astype(np.int64).tolist(),
            "end": whole[1].astype(np.int64).tolist(),
        }
        return whole * np.exp2(shifts.astype(np.float64)), stated

    def _side(self, knot: int, sign: int) -> Json:
        """The witness that sign g > 0 in the funnel before at a knot."""
        funnel, n = self.before, self.jump.n
        k, s = (knot, 0.0) if knot < len(funnel.t) - 1 else (knot - 1, 1.0)
        basis = monomials(n, range(max((self.jump.guard.degree + 1) // 2, 1) + 1))
        T = self._frame(k, s)
        gap, guard, _ = self._polynomials(0, Part(k, 0, 0), s, T)
        found = _multipliers(_scaled(sign, guard), gap, None, basis, T)
        if found.room <= 0:
            raise Infeasible(
                f"the guard is not {'above' if sign > 0 else 'below'} 0 on all of the funnel at "
                f"{funnel.t[knot]:.6g} s, where it "
                f"{f'is watched from{self._elsewhere()}' if sign > 0 else 'ends'}"
            )
        sides = basis[basis.sum(axis=1) < basis.sum(axis=1).max()]
        squares = multiplier(sides, found.tau)
        stated = _squares(sides, matrices(squares["columns"], squares["squares"]))
        gap, guard, _ = self._polynomials(0, Part(k, 0, 0), s)
        c = add(_scaled(sign, guard), negative(multiply(stated, gap, n)))
        return _witness(basis, c, np.array([found.gram, found.gram])) | {"tau": squares}


def _multipliers(
    room: Graded, gap: Graded, guard: Graded | None, basis: IntArray, T: FloatArray
) -> Multipliers:
    """The most that room / size keeps above 0 where gap >= 0 and guard = 0, all in z of x̄ = Tz.

    size: of the constant or the largest coefficient of `room`. τ has the monomials of the basis but
    those of its highest degree. Raises Infeasible or SolverError if the program is not solved.
    """
    n, half = basis.shape[1], int(basis.sum(axis=1).max())
    p, inside = _at(room, n), _at(gap, n)
    level, rho = float(np.abs(p.coefficients).max()), inside.coefficient((0,) * n)
    zero = () if guard is None else (_at(guard, n),)
    size = [float(np.abs(g.coefficients).max()) for g in zero]
    m = template("m", np.zeros((1, n), dtype=np.int64), p.names)
    spread = Polynomial(2 * basis, np.ones(len(basis)), p.names)
    equalities = tuple(g / by for g, by in zip(zero, size, strict=True))
    squares = SumOfSquares(
        p / level - m * spread, (inside / rho,), equalities, 2 * half, basis=basis, name="squares"
    )
    found = solve(Program(p.names, (squares, NonNegative(MOST - m)), maximise=m))
    identity, left = found["squares"], found.values["m[0]"]
    sides, A = basis[basis.sum(axis=1) < half], np.linalg.inv(T)
    gram = _placed(identity.gram.basis, identity.gram.Q, basis) + left * np.eye(len(basis))
    tau = _placed(identity.multipliers[0].basis, identity.multipliers[0].Q, sides)
    of_v, of_side = substitution(basis, A), substitution(sides, A)
    mu = np.zeros(0)
    for g, by, found_mu in zip(zero, size, identity.equality_multipliers, strict=True):
        rows = monomials(n, range(2 * half - g.degree + 1))
        mu = level / by * substitution(rows, A).T @ _coefficients(found_mu, rows)
    return Multipliers(
        level / rho * of_side.T @ tau @ of_side, mu, level * of_v.T @ gram @ of_v, left
    )


def _witness(basis: IntArray, c: Graded, ends: FloatArray) -> Json:
    """`basis`, `columns` and `squares` that show c > 0, near to v'Qv of Q between two ends."""
    control, rows = together(c, basis.shape[1])
    N = control.shape[1] - 1
    control = control / np.array([comb(N, j) for j in range(N + 1)])[:, None]
    grams = gram_curves(basis, control, rows, ends[None])[0]
    root = np.sqrt(np.maximum(np.diagonal(grams, axis1=1, axis2=2), 1e-300))
    if not np.linalg.eigvalsh(grams / root[:, :, None] / root[:, None]).min() > 0:
        raise Infeasible("a Gram matrix is not positive definite between the ends of a piece")
    return witness(basis, fitted(basis, grams))


def _composed(p: Polynomial, values: list[Graded], known: dict[tuple[int, ...], Graded]) -> Graded:
    """p with `values` in the place of its variables."""
    n = len(values)

    def power(exponent: tuple[int, ...]) -> Graded:
        if exponent not in known:
            last = max(j for j, e in enumerate(exponent) if e)
            lower = tuple(e - (j == last) for j, e in enumerate(exponent))
            known[exponent] = multiply(power(lower), values[last], n)
        return known[exponent]

    result: Graded = {}
    for exponent, c in p.terms():
        result = add(result, _scaled(float(c), power(tuple(exponent[:n]))))
    return result


def _scaled(factor: float, p: Graded) -> Graded:
    return {q: factor * part for q, part in p.items()}


def _graded(rows: IntArray, ends: FloatArray) -> Graded:
    """Coefficients (J+1, M) of monomials, control points in s, by degree."""
    degree = rows.sum(axis=1)
    points = weighted(ends[None])
    return {int(q): points[:, :, degree == q] for q in np.unique(degree)}


def _squares(sides: IntArray, S: FloatArray) -> Graded:
    """y'S_jy for S (J+1, k, k), y the monomials `sides`, by degree."""
    n = sides.shape[1]
    rows = monomials(n, range(2 * int(sides.sum(axis=1).max()) + 1))
    homes = positions((sides[:, None] + sides[None]).reshape(-1, n), rows)
    ends = np.array([np.bincount(homes, part.ravel(), len(rows)) for part in S])
    return _graded(rows, ends)


def _at(part: Graded, n: int) -> Polynomial:
    """A polynomial in z of degree 0 in s."""
    values, rows = together(part, n)
    return Polynomial(rows, values[0, 0], tuple(f"z{i}" for i in range(n)))


def _placed(basis: IntArray, Q: FloatArray, among: IntArray) -> FloatArray:
    """Q in the order of all monomials `among`."""
    home = positions(basis, among)
    result = np.zeros((len(among), len(among)))
    result[np.ix_(home, home)] = Q
    return result


def _coefficients(p: Polynomial, rows: IntArray) -> FloatArray:
    """Of the monomials `rows`."""
    result = np.zeros(len(rows))
    result[positions(p.exponents, rows)] = p.coefficients.astype(np.float64)
    return result
