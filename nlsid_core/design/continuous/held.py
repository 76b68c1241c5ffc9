"""The hold between samples: how fast the policy's input changes in a funnel, bounded and proved.

The applied input differs from the policy's by δ, |δ_i| ≤ W_i: the hold times the fastest change
R_i of the intervals before, and what measurement errors do. R holds in a funnel, and the funnel is
searched for W; so R is bounded in a larger one first. Nothing here is trusted.
Source: docs/theory-funnels.md, "The hold between samples".
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from nlsid_core.arrays import ArrayLike, FloatArray, IntArray, Json
from nlsid_core.design.continuous.closed_loop import (
    CELLS,
    Cases,
    InputRates,
    Pieces,
    rate_polynomial,
)
from nlsid_core.design.continuous.graded import monomials_of
from nlsid_core.design.continuous.lstep import LSteps, at_corners, corners_of
from nlsid_core.design.continuous.pieces import (
    MAX_LEVEL,
    Part,
    substitution,
    unsolved,
)
from nlsid_core.design.continuous.rates import frames_of, least_rates
from nlsid_core.design.continuous.witnesses import rate_documents, stated_multipliers
from nlsid_core.dynamics.vector_field import VectorField
from nlsid_core.errors import DataError, Infeasible, OptionError
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.options import is_number
from nlsid_core.policies.continuous import ContinuousPolicy

ROOM = 1.04  # of a rate over its bound at the ends of intervals: what it may be more in between
LONGEST, SHORTEST = 0.064, 0.00025  # s, of a search for the longest hold
MAX_ROUNDS = 6  # of rates for widths for rates: the change is a few percent of the last each time
LARGEST_RATIO = 0.5  # of a change to the last, whose geometric series is taken in one step
SETTLED = 1.005  # of the rates before: ROOM holds what is left


@dataclass(frozen=True, eq=False)
class Hold:
    """period: how old the applied input is at most, s. error: (n,) bounds of measurement errors.

    longest: the period is where a search for the longest one starts. What a search finds on its
    way: free, (K,) ρ without the hold, of which nothing may be proved; rates, (K-1, m) what |dũ/dt|
    stays below in every funnel looked for.
    """

    period: float
    error: FloatArray
    longest: bool = False
    free: FloatArray = field(default_factory=lambda: np.zeros(0))
    rates: FloatArray | None = None

    @classmethod
    def of(
        cls, hold: float | Literal["largest"] | None, error: ArrayLike | None, n: int
    ) -> "Hold | None":
        """What a user asks for; None if nothing. OptionError on what cannot be."""
        if hold is None and error is None:
            return None
        hold = float(hold) if is_number(hold) else hold  # type: ignore[arg-type]
        longest = isinstance(hold, str) and hold == "largest"
        if not (longest or hold is None or (isinstance(hold, float) and 0 < hold < np.inf)):
            raise OptionError("hold", hold, "seconds above 0, 'largest' or None")
        try:
            bounds = np.zeros(n) if error is None else np.asarray(error, dtype=np.float64)
        except (TypeError, ValueError):
            bounds = np.full(n, np.nan)
        if bounds.shape != (n,) or not (np.isfinite(bounds) & (bounds >= 0)).all():
            raise OptionError("error", error, f"{n} bounds of 0 or more, one for each state")
        period = hold if isinstance(hold, float) else LONGEST if longest else 0.0
        return cls(period, bounds, longest) if period or bounds.any() else None

    @property
    def shortest(self) -> float:
        """The shortest period to try, s."""
        return SHORTEST if self.longest else self.period

    def claim(self) -> Json:
        """The members of the claim."""
        stated: Json = {"hold": self.period} if self.period else {}
        return stated | ({"error": self.error.tolist()} if self.error.any() else {})

    def refuse(self, field: VectorField, policy: ContinuousPolicy) -> None:
        """Raise DataError for dynamics and policies that no hold is searched for."""
        if not field.m:
            raise DataError("there is no input to hold and none that a wrong state could change")
        if field.squares_inputs:
            raise DataError(
                "a hold needs dynamics that are affine in each input: give them as a function, "
                "then what is not affine is bounded"
            )
        if self.period and not (policy.u.is_continuous() and policy.K.is_continuous()):
            raise DataError(
                "a hold needs a policy that does not jump at knots: neither its gain nor its "
                "motion's inputs"
            )

    def widths(self, policy: ContinuousPolicy, rates: FloatArray) -> FloatArray:
        """(intervals, m) W for rates (intervals, m)."""
        shaken = (np.abs(policy.K.control) @ self.error).max(axis=1)
        first = np.searchsorted(policy.t[1:], policy.t[:-1] - self.period, side="right")
        return np.array(
            [
                self.period * rates[j : k + 1].max(axis=0) + shaken[j : k + 1].max(axis=0)
                for k, j in enumerate(np.minimum(first, np.arange(len(first))).tolist())
            ]
        )


@dataclass(frozen=True, eq=False)
class Changes:
    """dũ/dt in a funnel at both ends of every interval, whatever the widths of δ.

    It has degree at most 1 in each δ_i, so the corners of |δ_i| ≤ 1 give it for all others; those
    that only push are at 0. A row is an input in an interval, in a mode at a vertex of w.

    interval, entry, taken, shoved: see `InputRates`. products: per end, by degree in z (B, corners,
    M_q) coefficients of the products of δ, of -h dũ_i/dt. chosen: (corners, m) 1 where a product
    has δ_i. h: (intervals,) s.
    """

    interval: IntArray
    entry: IntArray
    taken: FloatArray
    shoved: FloatArray
    products: tuple[list[FloatArray], list[FloatArray]]
    chosen: IntArray
    h: FloatArray
    curving: tuple[int, ...]

    @classmethod
    def of(cls, steps: LSteps, funnel: ContinuousFunnel) -> "Changes":
        """Make the changes for this funnel; steps: with widths, of any size."""
        field, K = steps.field, len(funnel.t) - 1
        corners = corners_of([not pushes for pushes in _pushing(field, 1 + field.n, field.m)])
        chosen, count = (corners > 0).astype(int), len(corners)
        signs = _signs(chosen)
        unit, curving = np.ones((K, field.m)), steps.multiplied
        found: tuple[list[list[FloatArray]], list[list[FloatArray]]] = ([], [])
        rows = []
        intervals, no_basis = [Part(k, 0, 0) for k in range(K)], np.zeros((1, field.n), dtype=int)
        for batch in _batches(steps, intervals, no_basis, unit, signs=(1,)):
            pieces, entry = batch.pieces, batch.entry
            corner, vertex = np.divmod(
                pieces.cases.vertex, (int(pieces.cases.vertex.max()) + 1) // count
            )
            order = np.lexsort((corner, entry, vertex, *pieces.cases.mode.T, pieces.cases.interval))
            first = order[::count]
            stated = pieces.cases.interval, entry, batch.taken, batch.shoved
            rows.append(tuple(part[first] for part in stated))
            for end in (0, 1):
                c, *_ = _at_end(steps, funnel, batch, end)
                at_corners = [part[order].reshape(len(first), count, -1) for part in c]
                found[end].append([signs.T @ part / count for part in at_corners])
        together = [
            [np.concatenate(parts) for parts in zip(*of_end, strict=True)] for of_end in found
        ]
        interval, entry, taken, shoved = (
            np.concatenate(parts) for parts in zip(*rows, strict=True)
        )
        return cls(
            interval,
            entry,
            taken,
            shoved,
            (together[0], together[1]),
            chosen,
            np.diff(funnel.t),
            curving,
        )

    def rates(self, widths: FloatArray, size: FloatArray | float = 1.0) -> FloatArray:
        """(intervals, m) the largest at the ends of intervals, for δ in these widths.

        size: (K,) at the knots, of a funnel's half-widths over those of the one this is of.
        """
        result, signs = np.zeros(widths.shape), _signs(self.chosen)
        weights = np.prod(np.where(self.chosen == 1, widths[:, None], 1.0), axis=2)[self.interval]
        place = np.repeat(np.column_stack([self.interval, self.entry]), len(signs), axis=0)
        pushed = self.taken + (self.shoved * widths[self.interval]).sum(axis=1)
        h, taken = self.h[place[:, 0]], np.repeat(pushed, len(signs))
        sizes = np.broadcast_to(size, len(self.h) + 1)
        for end, products in enumerate(self.products):
            scale = sizes[self.interval + end, None, None]
            p = [signs @ (weights[..., None] * part) * scale**q for q, part in enumerate(products)]
            for sign in (-1, 1):
                flat = [sign * part.reshape(len(h), -1) for part in p]
                least = least_rates(flat, self.curving).least
                np.maximum.at(result, tuple(place.T), least / h + taken)
        return result


def _signs(chosen: IntArray) -> FloatArray:
    """(corners, corners) of the products at each corner of |δ_i| = 1."""
    corners = 2.0 * chosen - 1.0
    return np.asarray(np.prod(np.where(chosen == 1, corners[:, None], 1.0), axis=2))


def fastest(
    changes: Changes, policy: ContinuousPolicy, hold: Hold, size: FloatArray | float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """(intervals, m) R and W for a funnel: each for the other, R with room; size: see
    `Changes.rates`.
    """
    rates = np.zeros((len(policy.t) - 1, changes.chosen.shape[1]))
    last = np.zeros_like(rates)
    for _ in range(MAX_ROUNDS):
        before = rates
        rates = np.maximum(before, ROOM * changes.rates(hold.widths(policy, before), size))
        if (rates <= SETTLED * before).all():
            break
        change = rates - before
        ratio = np.minimum(change / np.where(last > 0, last, np.inf), LARGEST_RATIO)
        rates, last = rates + change * ratio / (1 - ratio), change
    return rates, hold.widths(policy, rates)


def prove_rates(
    steps: LSteps,
    funnel: ContinuousFunnel,
    rates: FloatArray,
    basis: IntArray,
) -> list[Json]:
    """The rate pieces of a proof with this basis (k, n), in its order.

    Raises Infeasible if a rate is not shown on some part of time.
    """
    waiting = [Part(k, 0, 0) for k in range(len(rates))]
    widths = steps.widths
    assert widths is not None  # a search for a hold sets them first
    found: list[Json] = []
    while waiting:
        written: dict[Part, list[Json | None]] = {}
        for batch in _batches(steps, waiting, basis, widths):
            of = _witnessed(steps, funnel, batch, rates)
            c = rate_polynomial(steps.field, steps.policy, funnel, of, of.room(rates, widths))
            rows = rate_documents(funnel, of.pieces, c)
            places = zip(of.entry.tolist(), of.sign.tolist(), rows, strict=True)
            for b, (entry, sign, row) in enumerate(places):
                place = of.pieces.cases.interval, of.pieces.cases.level, of.pieces.cases.index
                part = Part(*(int(e[b]) for e in place))
                stated = None if row is None else row | {"input": entry, "sign": sign}
                written.setdefault(part, []).append(stated)
        waiting = []
        for part, stated_rows in written.items():
            shown = [row for row in stated_rows if row is not None]
            if len(shown) == len(stated_rows):
                found += shown
            elif part.level < MAX_LEVEL:
                waiting += part.halves()
            else:
                raise Infeasible(
                    "the input's rate is not shown to keep its bound from "
                    f"{unsolved(steps.policy, (part,))}: try more knots there"
                )
    return found


def _batches(
    steps: LSteps,
    parts: list[Part],
    basis: IntArray,
    widths: FloatArray,
    *,
    signs: tuple[int, ...] = (-1, 1),
) -> Iterator[InputRates]:
    """Every rate on these parts of time, as many as fit at once."""
    field, policy, n = steps.field, steps.policy, steps.field.n
    of_inputs = _pushing(field, 1 + n, field.m)
    own = _pushing(field, 1 + n + field.m, len(field.uncertain))
    corners = corners_of([not pushes for pushes in (*of_inputs, *own)])
    limited = steps.limits[:, 0].astype(int).tolist()
    cases = [
        (v, entry, sign, mode)
        for mode in range(len(steps.modes))
        for v in range(len(corners))
        for entry in range(field.m)
        for sign in signs
        if entry not in limited or not steps.modes[mode][limited.index(entry)]
    ]
    vertex, entry, sign, mode = np.array(cases).reshape(-1, 4).T
    limits = len(steps.limits)
    halves = np.ptp(field.uncertain, axis=1) / 2
    size = max(1, CELLS // (len(cases) * len(basis) ** 2 * 16))
    for alike in (parts[k : k + size] for k in range(0, len(parts), size)):
        count = len(alike) * len(cases)
        place = np.repeat(
            np.array([(p.interval, p.level, p.index) for p in alike]), len(cases), axis=0
        )
        v, i, side, m = (np.tile(row, len(alike)) for row in (vertex, entry, sign, mode))
        pieces = Pieces(
            basis,
            Cases(
                interval=place[:, 0],
                vertex=v,
                level=place[:, 1],
                index=place[:, 2],
                mode=steps.modes[m],
                off=at_corners(field, corners, widths[place[:, 0]])[np.arange(count), v],
            ),
            T=np.tile(np.eye(n), (count, 1, 1)),
            mu=np.zeros((count, 2, 0)),
            gram=np.zeros((count, 2, len(basis), len(basis))),
            tau=np.zeros((count, 2, 1 + limits, n + 1, n + 1)),
            stated=np.empty(count, dtype=object),
        )
        gains = policy.K.control[place[:, 0]][np.arange(count), :, i]
        spans = np.searchsorted(field.breaks, policy.t[place[:, 0]], side="right")
        shoved, own_shoved = (
            np.abs(gains @ _pushes(field, first, found)[spans]).max(axis=1)
            for first, found in ((1 + n, of_inputs), (1 + n + field.m, own))
        )
        yield InputRates(pieces, i, side, own_shoved @ halves, shoved)


def _pushing(field: VectorField, first: int, count: int) -> list[bool]:
    """Say which of `count` variables from this column only add constants to ẋ, always."""
    rows = np.concatenate([p.exponents for equations in field.pieces for p in equations])
    return [bool((rows[rows[:, first + j] > 0].sum(axis=1) == 1).all()) for j in range(count)]


def _pushes(field: VectorField, first: int, pushing: list[bool]) -> FloatArray:
    """(spans, n, count) what a unit of each variable that only pushes adds to ẋ; else zero."""
    exponents, table = field.coefficients
    alone = exponents[:, first : first + len(pushing)] * (exponents.sum(axis=1) == 1)[:, None]
    return np.asarray(table @ (alone * pushing))


def _at_end(
    steps: LSteps, funnel: ContinuousFunnel, of: InputRates, end: int
) -> tuple[list[FloatArray], FloatArray]:
    """-h sign dũ_i/dt by degree in z, (B, M_q), at one end of each part; and z by x̄, (B, n, n)."""
    pieces, n, curving = of.pieces, funnel.n, steps.multiplied
    T, inverse = frames_of(funnel, pieces.cases.interval, _ends(pieces)[end], curving)
    framed = replace(of, pieces=replace(pieces, T=T, tau=np.zeros_like(pieces.tau)))
    c = rate_polynomial(steps.field, steps.policy, funnel, framed, np.zeros(len(pieces)), end)
    sizes = [len(monomials_of(n, q)) for q in range(4)]
    none = [np.zeros((len(pieces), size)) for size in sizes]
    return [c[q][:, 0] if q in c else none[q] for q in range(4)], inverse


def _witnessed(
    steps: LSteps,
    funnel: ContinuousFunnel,
    of: InputRates,
    rates: FloatArray,
) -> InputRates:
    """The rates with τ as a proof states it, and Gram matrices in x̄ at both ends."""
    pieces, k, curving = of.pieces, of.pieces.cases.interval, steps.multiplied
    tau, gram = pieces.tau.copy(), pieces.gram.copy()
    assert steps.widths is not None  # as in `prove_rates`
    room = np.diff(funnel.t)[k] * of.room(rates, steps.widths)
    one = int(np.flatnonzero(~pieces.basis.any(axis=1))[0])
    for end in (0, 1):
        c, inverse = _at_end(steps, funnel, of, end)
        shown = least_rates([-part for part in c], curving)
        found = shown.gram(pieces.basis)
        found[:, one, one] += room
        constant, quartic = shown.multipliers.T
        bent = inverse[:, list(curving)]
        rho = funnel.rho[k] + _ends(pieces)[end] * (funnel.rho[k + 1] - funnel.rho[k])
        tau[:, end, 0, 0, 0] = constant / rho
        tau[:, end, 0, 1:, 1:] = (quartic / rho)[:, None, None] * (bent.swapaxes(1, 2) @ bent)
        M = substitution(pieces.basis, inverse)
        gram[:, end] = M.swapaxes(1, 2) @ found @ M
    return replace(of, pieces=stated_multipliers(replace(pieces, tau=tau, gram=gram)))


def _ends(pieces: Pieces) -> tuple[FloatArray, FloatArray]:
    """(B,) start and end of each part, as fractions of the interval."""
    whole = 2.0**pieces.cases.level
    return pieces.cases.index / whole, (pieces.cases.index + 1) / whole
