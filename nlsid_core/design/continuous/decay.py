"""Decay in a funnel: V̇ ≤ λ(σ - V) wherever σ ≤ V ≤ 1, for the least floor σ that is proved.

With x̄ = √ρ Tz and W = ρ|z|², at the ends of every piece of time
    |z|²ρ̇/ρ - Ẇ/ρ + λ(σ - |z|²) = m + v'Xv + τ(1 - |z|²) + τ'(|z|² - σ) + Στ_l q_l,
X ⪰ 0, every τ = y'Sy with S ⪰ 0 and y = (1, z): one cone program. m becomes definite as in
`pieces`, whose witnesses these are. Source: thesis Lemma 5.3, (5.4).
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.sparse as sp

from nlsid_core import conic
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.conic import Cone, ConeProgram
from nlsid_core.design.continuous.closed_loop import Pieces, batches, closed_loop_polynomial
from nlsid_core.design.continuous.graded import monomials_of, positions
from nlsid_core.design.continuous.lstep import LSteps, section_at
from nlsid_core.design.continuous.pieces import (
    MAX_LEVEL,
    Part,
    Proved,
    affine,
    draft,
    stacked,
    substitution,
    unsolved,
)
from nlsid_core.design.continuous.witnesses import piece_margins, stated_multipliers
from nlsid_core.errors import DataError, Infeasible, SolverError
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.polynomial.values import monomial_values

MAX_DEGREE = 3  # of f: the squares have degree 2
FIRST, STEP = 1.1, 1.5  # of the floor that points in the funnel need: what is tried, and then more
LEAST_FLOOR = 1e-3
KAPPAS = (1.0, 2.0, 4.0)  # times what bounds pushes best on the boundary
DIRECTIONS, RADII = 200, 12  # of the points at which a floor is looked for
COST = 1e-6  # of the trace of every S, which else has no bound
TOLERANCE = 1e-7
BITS = 12  # of a floor's digits


def refuse_decay(steps: LSteps) -> None:
    """Raise DataError for dynamics that no decay is searched for."""
    if steps.field.degree > MAX_DEGREE:
        raise DataError(
            f"a decay is searched for dynamics of degree up to {MAX_DEGREE}, not "
            f"{steps.field.degree}"
        )


def prove_decay(steps: LSteps, policy: ContinuousPolicy, funnel: ContinuousFunnel) -> Proved:
    """Pieces of all time that prove the decay at rate `steps.decay`, with its floor.

    Raises Infeasible with the time and the floor that is needed there, if it is not below 1.
    """
    best: tuple[float, LSteps] | None = None
    for factor in KAPPAS if steps.kappa is not None else KAPPAS[:1]:
        tried = _with_kappa(steps, factor)
        needed = max(_needed(tried, policy, funnel, k) for k in range(len(funnel.t) - 1))
        if best is None or needed < best[0]:
            best = needed, tried
    assert best is not None
    needed, steps = best
    floor, unproved = max(FIRST * needed, LEAST_FLOOR), None
    while floor < 1:
        floor = float(np.ceil(floor * 2**BITS) / 2**BITS)
        found = _prove(steps, policy, funnel, floor)
        if isinstance(found, Proved):
            return found
        floor, unproved = STEP * floor, found
    where = "" if unproved is None else f"; not proved from {unsolved(policy, (unproved,))}"
    raise Infeasible(
        f"no decay of {steps.decay:g} 1/s in the funnel: points in it need a floor of "
        f"{needed:.3g}{where}. Ask for a slower decay"
    )


def _with_kappa(steps: LSteps, factor: float) -> LSteps:
    found = copy(steps)
    found.kappa = None if steps.kappa is None else factor * steps.kappa
    return found


@dataclass(frozen=True, eq=False)
class _End:
    """One end of a part in every case, in z: (cases, M) of what V̇ leaves without its floor.

    In 1/s, over the monomials of degree 0 to 4. sides: (cases, L, M₂) of q. scale: h ρ².
    """

    T: FloatArray
    rho: float
    scale: float
    rates: FloatArray
    sides: FloatArray


def _ends(
    steps: LSteps, policy: ContinuousPolicy, funnel: ContinuousFunnel, part: Part, end: int
) -> _End:
    """What the programs of one end of a part are made of."""
    k, s, n = part.interval, part.ends()[end], funnel.n
    rho = float((1 - s) * funnel.rho[k] + s * funnel.rho[k + 1])
    section = section_at(steps, policy, funnel.P, k, s)
    T = np.sqrt(rho) * section.base
    pieces = _blank(steps, [part], np.tile(T, (steps.cases, 1, 1)), 0.0)
    c = closed_loop_polynomial(steps.field, policy, funnel, pieces, end)
    scale = float(funnel.t[k + 1] - funnel.t[k]) * rho**2
    rates = np.concatenate(
        [
            np.broadcast_to(c[q][:, 0], (steps.cases, size)) if q in c
            else np.zeros((steps.cases, size))
            for q, size in enumerate(len(monomials_of(n, q)) for q in range(5))
        ],
        axis=1,
    )  # fmt: skip
    homes = 1 + positions(np.eye(n, dtype=np.int64), monomials_of(n, 1))
    demands = np.zeros((len(section.u), 1 + n))
    demands[:, 0] = section.u
    demands[:, homes] = -section.K @ T
    sides = np.zeros((steps.cases, len(steps.limits), len(_rows(n, 2))))
    for case in range(steps.cases):
        *_, mode = steps.split(case)
        for place, (i, low, high) in enumerate(steps.limits.tolist()):
            above, below = demands[int(i)].copy(), -demands[int(i)]
            above[0], below[0] = above[0] - low, below[0] + high
            side = int(mode[place])
            if side == 0:
                sides[case, place] = np.bincount(
                    _products(n).ravel(), np.outer(above, below).ravel(), len(_rows(n, 2))
                )
            else:
                sides[case, place, : 1 + n] = -above if side < 0 else -below
    return _End(T, rho, scale, rates / scale, sides)


def _blank(steps: LSteps, parts: Sequence[Part], T: FloatArray, floor: float) -> Pieces:
    """Pieces of a decay whose multipliers and Gram matrices are zero."""
    n = steps.program.n
    blank, basis = draft(steps, list(parts), T), _rows(n, 2)
    count, more = len(blank), 2 + len(steps.limits)
    return replace(
        blank,
        basis=basis,
        mu=np.zeros((count, 2, 0)),
        gram=np.zeros((count, 2, len(basis), len(basis))),
        tau=np.zeros((count, 2, more, n + 1, n + 1)),
        decay=(steps.decay, floor),
    )


def _needed(steps: LSteps, policy: ContinuousPolicy, funnel: ContinuousFunnel, k: int) -> float:
    """The least floor that points at both ends of an interval leave possible."""
    n, rng, needed = funnel.n, np.random.default_rng(0), 0.0
    z = rng.normal(size=(DIRECTIONS, n))
    z = np.vstack([z, np.eye(n)])
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    radii = np.linspace(1 / RADII, 1, RADII) ** 0.5
    z = (radii[:, None, None] * np.vstack([z, -z])).reshape(-1, n)
    values, level = monomial_values(_rows(n, 4), z), (z**2).sum(axis=1)
    for end in (0, 1):
        found = _ends(steps, policy, funnel, Part(k, 0, 0), end)
        for rates, sides in zip(found.rates, found.sides, strict=True):
            here = (sides @ values[:, : sides.shape[1]].T >= 0).all(axis=0)
            floor = np.minimum(-values @ rates / steps.decay, level)
            needed = max(needed, float(np.max(floor[here], initial=0.0)))
    return needed


def _prove(
    steps: LSteps, policy: ContinuousPolicy, funnel: ContinuousFunnel, floor: float
) -> Proved | Part:
    """The pieces for this floor, or a part of time on which there is no proof."""
    known: dict[tuple[int, float], tuple[FloatArray, FloatArray] | None] = {}
    waiting = [Part(k, 0, 0) for k in range(len(funnel.t) - 1)]
    done: list[Pieces] = []
    while waiting:
        found = []
        for part in waiting:
            piece = _piece(steps, policy, funnel, part, floor, known)
            if piece is None:
                return part
            found.append(piece)
        pieces = stated_multipliers(stacked(found))
        margins = np.full(len(pieces), np.nan)
        for chosen in batches(steps.field, funnel, pieces):
            margins[chosen] = piece_margins(steps.field, policy, funnel, pieces.select(chosen))
        good = np.isfinite(margins).reshape(len(waiting), -1).all(axis=1)
        done.append(pieces.select(np.flatnonzero(np.repeat(good, steps.cases))))
        failed = [part for part, kept in zip(waiting, good.tolist(), strict=True) if not kept]
        deepest = next((part for part in failed if part.level == MAX_LEVEL), None)
        if deepest is not None:
            return deepest
        waiting = [half for part in failed for half in part.halves()]
    pieces = stacked(done)
    modes = list(pieces.mode.T)[::-1]
    order = np.lexsort((pieces.vertex, *modes, pieces.index / 2.0**pieces.level, pieces.interval))
    return Proved(pieces.select(order), np.full(len(order), steps.decay * (1 - floor)), ())


def _piece(
    steps: LSteps, policy: ContinuousPolicy, funnel: ContinuousFunnel, part: Part, floor: float,
    known: dict[tuple[int, float], tuple[FloatArray, FloatArray] | None],
) -> Pieces | None:  # fmt: skip
    """All cases of one part, in x̄; None if an end of it leaves no margin."""
    n = funnel.n
    gram, tau = [], []
    for end in (0, 1):
        key = part.interval, part.ends()[end]
        if key not in known:
            known[key] = _solved(_ends(steps, policy, funnel, part, end), steps, floor)
        found = known[key]
        if found is None:
            return None
        gram.append(found[0])
        tau.append(found[1])
    blank = _blank(steps, [part], np.tile(np.eye(n), (steps.cases, 1, 1)), floor)
    return replace(blank, gram=np.stack(gram, axis=1), tau=np.stack(tau, axis=1))


def _solved(end: _End, steps: LSteps, floor: float) -> tuple[FloatArray, FloatArray] | None:
    """(cases, k, k) Gram matrices and (cases, 2 + L, n+1, n+1) S, in x̄, scaled as c is."""
    n = steps.program.n
    inverse = np.linalg.inv(end.T)
    M = substitution(_rows(n, 2), inverse)
    around = np.eye(n + 1)
    around[1:, 1:] = inverse
    grams, taus = [], []
    level = np.zeros(len(_rows(n, 2)))
    level[positions(2 * np.eye(n, dtype=np.int64), _rows(n, 2))] = 1.0
    inside, above = -level, level.copy()
    inside[0], above[0] = 1.0, -floor
    # The order of y is (1, z), of monomials (1, degree 1 in the order of `monomials`).
    for rates, sides in zip(end.rates, end.sides, strict=True):
        target = rates.copy()
        target[0] += steps.decay * floor
        try:
            m, X, S = _program(target, np.vstack([inside, above, sides]))
        except SolverError:
            return None
        if m <= 0:
            return None
        gram = X + m * np.diag(_spread(n))
        S[0] += m * np.diag(np.r_[0.75, np.full(n, 0.5)])
        scales = np.r_[end.scale / end.rho, end.scale / end.rho, np.full(len(sides), end.scale)]
        grams.append(end.scale * M.T @ gram @ M)
        taus.append(scales[:, None, None] * (around.T @ S @ around))
    return np.array(grams), np.array(taus)


def _program(target: FloatArray, q: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """m, X (k, k) and S (len(q), n+1, n+1): target = m + v'Xv + Σ y'S y q, m as large as can be.

    m is at most the target's size: a mode that does not occur has no bound. q: (Q, M₂).
    Raises SolverError if the solver finds nothing.
    """
    n = next(n for n in range(1, 17) if len(_rows(n, 4)) == len(target))
    size = float(np.abs(target).max())
    sizes = np.abs(q).max(axis=1)
    squares, sides, shifts = _tables(n)
    blocks = [_one(len(target)), squares]
    for row in q / sizes[:, None]:
        shift = sum((float(row[e]) * shifts[e] for e in np.flatnonzero(row)), start=0 * shifts[0])
        blocks.append(shift @ sides)
    A = sp.hstack(blocks, "csr")
    k, y, count = len(_rows(n, 2)), n + 1, A.shape[1]
    first, step = 1 + k * (k + 1) // 2, y * (y + 1) // 2
    cost = np.zeros(count)
    cost[0] = -1.0
    for start in range(first, count, step):
        cost[start : start + step] = COST * conic.svec(np.eye(y))
    x = conic.solve(
        ConeProgram(
            P=sp.csc_matrix((count, count)),
            q=cost,
            A=sp.vstack([A, _one(count).T, -sp.eye(count, format="csr")[1:]], "csc"),
            b=np.r_[target / size, 1.0, np.zeros(count - 1)],
            cones=(
                Cone("zero", len(target)),
                Cone("nonnegative", 1),
                Cone("psd", k),
                *[Cone("psd", y)] * len(q),
            ),
        ),
        tolerance=TOLERANCE,
    ).x
    S = [conic.smat(x[i : i + step]) * size for i in range(first, count, step)]
    return float(x[0]) * size, conic.smat(x[1:first]) * size, np.array(S) / sizes[:, None, None]


def _one(count: int) -> sp.csr_matrix:
    return sp.csr_matrix(([1.0], ([0], [0])), shape=(count, 1))


def _spread(n: int) -> FloatArray:
    """The diagonal over v of ¼ + ¼|z|² + ½|z|⁴, which is 1 - (1 - |z|²)(¾ + ½|z|²)."""
    rows = _rows(n, 2)
    degree, largest = rows.sum(axis=1), rows.max(axis=1)
    return np.where(degree < 2, 0.25, np.where(largest == 2, 0.5, 1.0))


@lru_cache(maxsize=8)
def _rows(n: int, degree: int) -> IntArray:
    """(M, n) monomials of degree 0 to this one."""
    return np.concatenate([monomials_of(n, q) for q in range(degree + 1)])


@lru_cache(maxsize=8)
def _products(n: int) -> IntArray:
    """(n+1, n+1): where products of monomials of degree 0 and 1 are among those up to 2."""
    rows = _rows(n, 1)
    return positions((rows[:, None] + rows[None]).reshape(-1, n), _rows(n, 2)).reshape(n + 1, -1)


@lru_cache(maxsize=8)
def _tables(n: int) -> tuple[sp.csr_matrix, sp.csr_matrix, list[sp.csr_matrix]]:
    """v'Xv over monomials up to 4 from svec X; y'Sy over those up to 2 from svec S; and what a
    monomial up to degree 2 makes of a polynomial of degree 2.
    """

    def squared(rows: IntArray, into: IntArray) -> sp.csr_matrix:
        i, j = conic.triangle(len(rows))
        weights = np.where(i == j, 1.0, conic.SQRT2)
        shape = len(into), len(i)
        return sp.csr_matrix((weights, (positions(rows[i] + rows[j], into), range(len(i)))), shape)

    v, all_rows = _rows(n, 2), _rows(n, 4)
    shape = len(all_rows), len(v)
    shifts = [
        sp.csr_matrix((np.ones(len(v)), (positions(v + e, all_rows), range(len(v)))), shape)
        for e in v
    ]
    return squared(v, all_rows), squared(affine(n), v), shifts
