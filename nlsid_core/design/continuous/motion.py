"""`plan_motion`: a motion between two states by direct collocation.

Hermite and Simpson's collocation, solved by convex programs within a trust region, then by
least-norm Newton steps until the cubics obey the dynamics.
Source: Hargraves and Paris, "Direct trajectory optimization using nonlinear programming and
collocation", 1987; Mao, Szmuk and Açıkmeşe, "Successive convexification", 2016.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from nlsid_core import conic
from nlsid_core.arrays import ArrayLike, BoolArray, FloatArray
from nlsid_core.conic import Cone, ConeProgram
from nlsid_core.design.continuous.setting import largest_defect, limits_of
from nlsid_core.dynamics import Nominal, Rates, VectorField, cubic_through, linear_through
from nlsid_core.errors import DataError, Infeasible, SolverError
from nlsid_core.options import is_number, numbers

FIRST_KNOTS = 25
MORE_KNOTS = 3  # for one interval, at a time, where its cubic misses the dynamics
MAX_KNOTS = 200
KEPT = 0.9  # of the limits: the rest is there to correct with
GOOD = 0.5  # of the defect that a funnel accepts
MAX_STEPS, NEWTON_STEPS = 150, 20
TRUST, SMALLEST = 1.0, 1e-7  # of the sizes of states and inputs
LEAST_SIZE = 1e-4  # of a state's size in the guess: a smaller spread may be what programs leave
PRICE = 1e2  # of a defect, over what the inputs may cost
LOST = 1e6  # a defect of that size, relative to the states': the steps diverge
SETTLED = 1e-10  # largest defect, relative to the states' sizes
SMOOTH = 0.05  # of the time: what the inputs change in that long costs as much as they do
AT_REST = 1e-9  # of the way, in the whole time
ROUNDS = 8  # of convex programs, each with the states' sizes that the last one left
OTHER_STARTS, BENT = 4, 0.3  # guesses beside the first, bent by that of the states' sizes
STALLED = 1e-5  # of the cost: less is not worth another program
NEARER = 0.9  # of the largest defect: programs that leave more are not repeated
STEP = 1e-6  # of the sizes, for central differences: errors of 1e-10


def plan_motion(
    dynamics: VectorField | Callable[..., Any],
    *,
    start: ArrayLike,
    end: ArrayLike,
    seconds: float,
    u: ArrayLike | None = None,
    limits: ArrayLike | None = None,
) -> Nominal:
    """Plan a motion from `start` to `end` in `seconds` with small ∫|u(t) - u|² dt.

    Args:
        dynamics: a VectorField, or a function of some of t, x, u, named so. A field's w is in the
            centre of its box.
        start, end: (n,) states.
        seconds: how long it takes.
        u: (m,) the input that costs nothing, and that the motion starts and ends with if it keeps
            both ends at rest (None: zeros, as many as a VectorField has). The cost weighs each
            input by half of its limits' range, or by |u|, 1 at least.
        limits: rows (input, low, high), or one pair an input, that the motion keeps to nine tenths
            of.

    Raises DataError on input that makes no sense, Infeasible if no motion was found.
    """
    ends = [numbers(part, name) for part, name in ((start, "start"), (end, "end"))]
    if ends[0].ndim != 1 or ends[0].shape != ends[1].shape:
        raise DataError(
            f"start and end should be states (n,), are {ends[0].shape}, {ends[1].shape}"
        )
    if not np.isfinite(ends).all():
        raise DataError(f"start and end should be finite, are {[e.tolist() for e in ends]}")
    if not is_number(seconds) or not 0 < seconds < np.inf:
        raise DataError(f"seconds should be above 0, is {seconds!r}")
    if u is not None:
        rest = numbers(u, "u").reshape(-1)
    elif isinstance(dynamics, VectorField):
        rest = np.zeros(dynamics.m)
    else:
        raise DataError("give u, the input that costs nothing, such as [0] for one input")
    n, m = len(ends[0]), len(rest)
    rates = dynamics if isinstance(dynamics, VectorField) else Rates.numeric(dynamics, n, m)
    box = np.tile([-np.inf, np.inf], (m, 1))
    for i, low, high in [] if limits is None else limits_of(limits, m).tolist():
        middle, half = (low + high) / 2, KEPT * (high - low) / 2
        box[int(i)] = middle - half, middle + half
    much = np.ptp(box, axis=1) / 2
    much = np.where(np.isfinite(much), much, np.maximum(np.abs(rest), 1))
    t = np.linspace(0.0, seconds, FIRST_KNOTS)
    x = np.linspace(ends[0], ends[1], FIRST_KNOTS)
    straight = np.hstack([x, np.tile(rest, (len(t), 1))])
    spread = np.ptp(x, axis=0)
    way = np.where(spread > 0, spread, np.maximum(np.abs(x).max(axis=0), 1))
    mesh = _Mesh(rates, t, n, rest, box, way, much, _held(rates, ends, rest, seconds, box))
    straight[mesh.held, n:] = rest
    z = mesh.started(straight)
    while True:
        found = mesh.nominal(z)
        gaps = found.gaps(rates)
        wanted = largest_defect(found)
        if (gaps <= GOOD * wanted).all():
            return found
        worst = int(gaps.argmax())
        more = np.ceil(np.clip((gaps / (GOOD * wanted)) ** (1 / 3), 1, MORE_KNOTS)).astype(int)
        if len(mesh.t) + (more - 1).sum() > MAX_KNOTS:
            raise Infeasible(
                f"the motion misses its dynamics by {gaps[worst]:.3g}, more than {wanted:.3g}, at "
                f"{mesh.t[worst]:.4g} s between {len(mesh.t)} knots: take more seconds"
            )
        t = np.concatenate(
            [
                np.linspace(a, b, count + 1)[:-1]
                for a, b, count in zip(mesh.t[:-1], mesh.t[1:], more.tolist(), strict=True)
            ]
            + [mesh.t[-1:]]
        )
        z = np.hstack([found.x(t), found.u(t)])
        z[-1, :n] = ends[1]
        mesh = replace(mesh, t=t)
        try:
            z = mesh.settled(z)
        except Infeasible:
            z = mesh.planned(z)


def _held(
    rates: VectorField | Rates,
    ends: Sequence[FloatArray],
    rest: FloatArray,
    seconds: float,
    box: FloatArray,
) -> list[int]:
    """The knots, first or last, at which the input is `rest`: where that keeps the state."""
    if not ((box[:, 0] <= rest) & (rest <= box[:, 1])).all():
        return []
    moving = [
        np.abs(rates(s, x[None], rest[None])).max() * seconds
        for s, x in zip((0.0, seconds), ends, strict=True)
    ]
    size = max(float(np.abs(ends[1] - ends[0]).max()), SMALLEST)
    return [k for k, rate in zip((0, -1), moving, strict=True) if rate <= AT_REST * size]


@dataclass(eq=False)
class _Mesh:
    """Collocation on times t (K,): z (K, n + m) holds x and u; x is fixed at both ends.

    way: (n,) how far each state goes in the guess, or its size where it stays. much: (m,).
    """

    rates: VectorField | Rates
    t: FloatArray
    n: int
    rest: FloatArray
    box: FloatArray
    way: FloatArray
    much: FloatArray
    held: list[int]

    def started(self, straight: FloatArray) -> FloatArray:
        """A motion from the straight guess, or from others that are bent; Infeasible if none."""
        rng = np.random.default_rng(0)
        share, n = (self.t / self.t[-1])[:, None], self.n
        for attempt in range(1 + OTHER_STARTS):
            z = straight.copy()
            if attempt:
                bends = rng.normal(size=(2, n)) * BENT * self.sizes(straight)[:n]
                z[:, :n] += np.sin(np.pi * share) * bends[0] + np.sin(2 * np.pi * share) * bends[1]
                z[[0, -1], :n] = straight[[0, -1], :n]
            try:
                return self.planned(z)
            except Infeasible as refusal:
                said = refusal
        raise said

    def nominal(self, z: FloatArray) -> Nominal:
        """Cubics through the states with the rates there; inputs linear."""
        x, u = z[:, : self.n], z[:, self.n :]
        return Nominal(cubic_through(self.t, x, self.values(self.t, z)), linear_through(self.t, u))

    def values(self, t: FloatArray, z: FloatArray) -> FloatArray:
        """ẋ at times t and rows of z."""
        rows = (
            [
                self.rates(float(s), row[None, : self.n], row[None, self.n :])[0]
                for s, row in zip(t, z, strict=True)
            ]
            if self.rates.depends_on_time
            else [self.rates(float(self.t[0]), z[:, : self.n], z[:, self.n :])]
        )
        return np.asarray(np.vstack(rows))

    def free(self, z: FloatArray) -> BoolArray:
        """What may change: not the states at both ends, nor the input where it is held."""
        free = np.ones(z.shape, dtype=bool)
        free[[0, -1], : self.n] = False
        free[self.held, self.n :] = False
        return free

    def sizes(self, z: FloatArray) -> FloatArray:
        """(n + m,) what is a large change of each entry."""
        spread = np.ptp(z[:, : self.n], axis=0)
        spread = np.where(spread > 0, np.maximum(spread, LEAST_SIZE * self.way), self.way)
        return np.append(spread, self.much)

    def defects(self, z: FloatArray) -> FloatArray:
        """(K-1, n) x₁ - x₀ - h/6 (f₀ + 4 f_middle + f₁), the middle on the cubic.

        They may be infinite or NaN on a path where the dynamics are.
        """
        with np.errstate(all="ignore"):
            return self._defects(z)[0]

    def _defects(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        n, h = self.n, np.diff(self.t)[:, None]
        f = self.values(self.t, z)
        middle = (z[:-1] + z[1:]) / 2
        middle[:, :n] += h / 8 * (f[:-1] - f[1:])
        between = self.values((self.t[:-1] + self.t[1:]) / 2, middle)
        gaps = z[1:, :n] - z[:-1, :n] - h / 6 * (f[:-1] + 4 * between + f[1:])
        return gaps, f, middle

    def slopes(self, z: FloatArray, sizes: FloatArray) -> sp.csr_matrix:
        """The defects' Jacobian ((K-1)n, K(n + m)), by central differences of the rates."""
        n, width, K = self.n, z.shape[1], len(z)
        _, _, middle = self._defects(z)
        at = self._differences(self.t, z, sizes)
        between = self._differences((self.t[:-1] + self.t[1:]) / 2, middle, sizes)
        blocks = sp.lil_matrix(((K - 1) * n, K * width))
        unit = np.eye(n, width)
        for k, h in enumerate(np.diff(self.t).tolist()):
            for side, sign in ((0, -1.0), (1, 1.0)):
                moved = np.eye(width) / 2
                moved[:n] += -sign * h / 8 * at[k + side]
                block = sign * unit - h / 6 * (at[k + side] + 4 * between[k] @ moved)
                rows, columns = k * n, (k + side) * width
                blocks[rows : rows + n, columns : columns + width] = block
        return blocks.tocsr()

    def _differences(self, t: FloatArray, z: FloatArray, sizes: FloatArray) -> FloatArray:
        columns = []
        for j, size in enumerate(sizes.tolist()):
            moved = np.zeros(z.shape[1])
            moved[j] = STEP * size
            columns.append((self.values(t, z + moved) - self.values(t, z - moved)) / (2 * moved[j]))
        return np.stack(columns, axis=2)

    def planned(self, z: FloatArray) -> FloatArray:
        """A motion by convex programs and Newton's steps from a guess; Infeasible if none."""
        z = z.copy()
        z[:, self.n :] = np.clip(z[:, self.n :], *self.box.T)
        gaps = self.defects(z)
        if not np.isfinite(gaps).all():
            k, i = np.argwhere(~np.isfinite(gaps))[0].tolist()
            raise Infeasible(
                f"the dynamics are not finite on the path that is guessed: dx{i}/dt between "
                f"x = {z[k, : self.n].tolist()} and x = {z[k + 1, : self.n].tolist()}. Plan in "
                "parts, between states from which they are"
            )
        least = np.inf
        for _ in range(ROUNDS):
            z = self._descended(z, self.sizes(z))
            try:
                return self.settled(z)
            except Infeasible as refusal:
                said = refusal
            missed = float(np.abs(self.defects(z) / self.way).max())
            if not missed < NEARER * least:
                break
            least = missed
        raise said

    def _costs(self, sizes: FloatArray) -> sp.csc_matrix:
        """The cost of v = (u - rest)/sizes as a matrix: the mean of v² + (τ dv/dt)²."""
        K, width, h = len(self.t), len(sizes), np.diff(self.t)
        span = self.t[-1] - self.t[0]
        mean = (np.append(h, 0) + np.insert(h, 0, 0)) / 2 / span
        change = sp.diags([-np.ones(K), np.ones(K - 1)], [0, 1], (K - 1, K))
        over_time = sp.diags(mean) + change.T @ sp.diags(SMOOTH**2 * span / h) @ change
        inputs = np.arange(width) >= self.n
        return sp.csc_matrix(sp.kron(over_time, sp.diags(inputs / max(inputs.sum(), 1))))

    def _descended(self, z: FloatArray, sizes: FloatArray) -> FloatArray:
        """Convex programs within a trust region: inputs small, defects at a price."""
        states, trust, M = sizes[: self.n], TRUST, self._costs(sizes)
        origin = np.concatenate([np.zeros(self.n), self.rest])

        def merit(z: FloatArray) -> tuple[float, float]:
            v = ((z - origin) / sizes).ravel()
            cost = v @ M @ v
            missed = np.abs(self.defects(z) / states).sum()
            return float(cost + PRICE * missed), float(cost)

        now, _ = merit(z)
        for _ in range(MAX_STEPS):
            try:
                step, promised = self._step(z, sizes, trust, M)
            except SolverError:
                step, promised = np.zeros_like(z), -np.inf
            after, _ = merit(z + step)
            gained, expected = now - after, now - promised
            stalled = expected <= STALLED * max(now, 1e-9)
            taken = bool(np.isfinite(after) and gained > 0.1 * expected)
            if taken and not (stalled and trust < TRUST):
                z, now = z + step, after
                trust = min(2 * trust, 8.0) if gained > 0.5 * expected else trust
            if not taken:
                trust /= 4
            if trust < SMALLEST or (stalled and (taken or trust < TRUST)):
                break
        return z

    def _step(
        self, z: FloatArray, sizes: FloatArray, trust: float, M: sp.csc_matrix
    ) -> tuple[FloatArray, float]:
        """The step (K, n + m) of one convex program, and the merit it promises."""
        n, width, K = self.n, z.shape[1], len(z)
        count = (K - 1) * n
        scale = np.tile(1 / sizes[:n], K - 1)
        J = sp.csc_matrix(sp.diags(scale) @ self.slopes(z, sizes) @ sp.diags(np.tile(sizes, K)))
        d = self.defects(z).ravel() * scale
        high, low = np.full((K, width), trust), np.full((K, width), -trust)
        inputs = z[:, n:]
        high[:, n:] = np.minimum(high[:, n:], (self.box[:, 1] - inputs) / sizes[n:])
        low[:, n:] = np.maximum(low[:, n:], (self.box[:, 0] - inputs) / sizes[n:])
        free = np.flatnonzero(self.free(z).ravel())
        v = ((z - np.concatenate([np.zeros(n), self.rest])) / sizes).ravel()
        size, eye, kept = len(free), sp.eye(len(free)), J[:, free]
        gap, none = sp.eye(count), sp.csr_matrix((size, count))
        program = ConeProgram(
            P=sp.block_diag([2 * M[free][:, free], sp.csc_matrix((count, count))], "csc"),
            q=np.concatenate([2 * (M @ v)[free], np.full(count, PRICE)]),
            A=sp.bmat([[kept, -gap], [-kept, -gap], [eye, none], [-eye, none]], "csc"),
            b=np.concatenate([-d, d, high.ravel()[free] + 1e-9, -low.ravel()[free] + 1e-9]),
            cones=(Cone("nonnegative", 2 * count + 2 * size),),
        )
        y = np.zeros(K * width)
        y[free] = np.clip(conic.solve(program).x[:size], low.ravel()[free], high.ravel()[free])
        cost = (v + y) @ M @ (v + y)
        missed = np.abs(J @ y + d).sum()
        y = y.reshape(K, width)
        return y * sizes, float(cost + PRICE * missed)

    def settled(self, z: FloatArray) -> FloatArray:
        """The nearest z that obeys the collocation, by least-norm Newton steps; else Infeasible."""
        sizes, n, begun = self.sizes(z), self.n, self.defects(z)
        free = self.free(z)
        scale = np.tile(1 / sizes[:n], len(z) - 1)
        for _ in range(NEWTON_STEPS):
            d = self.defects(z).ravel() * scale
            worst = float(np.abs(d).max(initial=0.0))
            if worst <= SETTLED or not worst < LOST:
                break
            J = sp.diags(scale) @ self.slopes(z, sizes) @ sp.diags(np.tile(sizes, len(z)))
            J = J.tocsc()[:, np.flatnonzero(free.ravel())]
            normal = (J @ J.T + 1e-13 * sp.eye(J.shape[0])).tocsc()
            try:
                step = J.T @ splu(normal).solve(d)
            except RuntimeError:  # singular: nothing to go on from
                break
            moved = np.zeros(z.size)
            moved[free.ravel()] = step
            z = z - moved.reshape(z.shape) * sizes
        if not worst <= 100 * SETTLED:
            k, i = divmod(int(np.abs(begun / self.way).argmax()), n)
            off = f"{abs(begun[k, i]):.3g} {'more' if begun[k, i] > 0.0 else 'less'}"
            raise Infeasible(
                f"no motion to that end in {self.t[-1]:g} s was found: on the nearest one x{i} "
                f"changes by {off} than its dynamics say, near {self.t[k]:.4g} s. "
                "Give another end, more or fewer seconds, wider limits, or plan it in parts"
            )
        u, (low, high) = z[:, n:], self.box.T
        reach = (high - low) * (1 / KEPT - 1) / 2
        reach = np.where(np.isfinite(reach), reach, 0)
        if ((u > high + reach) | (u < low - reach)).any():
            raise Infeasible("the motion needs more than the limits: give more seconds")
        return z
