"""From L-steps at the ends of pieces of time to a proof for every instant between them.

The margin m of each L-step is turned into a strictly positive definite Gram matrix,
m = m(¼ + ¾Σ(w_i v_i)²) + m(1-|z|²)ν, so that in between there is room. A piece on
which no proof is found is halved, with a new L-step in its middle. `witnesses` writes what is found
for the kernel, which decides.
"""

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray, Json
from nlsid_core.design.continuous.closed_loop import (
    OWN,
    Cases,
    Pieces,
    batches,
    closed_loop_polynomial,
)
from nlsid_core.design.continuous.graded import monomials_of, positions, product_table
from nlsid_core.design.continuous.lstep import Ends, LSteps, section_at
from nlsid_core.design.continuous.witnesses import (
    affine,
    documents,
    piece_margins,
    rounded,
    stated_margin,
)
from nlsid_core.errors import SolverError
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.polynomial.maps import monomials
from nlsid_core.sos.sphere import ONE, SphereProgram, SphereSolution

MAX_LEVEL = 4  # halvings of an interval: what still fails then fails for lack of margin
ENDS = 2  # parts of an interval that may fail at one level: of more, smaller ones fail as well


@dataclass(frozen=True)
class Part:
    """The part [index, index + 1]/2^level of an interval."""

    interval: int
    level: int
    index: int

    def ends(self) -> tuple[float, float]:
        """Start and end as fractions of the interval."""
        return self.index / 2**self.level, (self.index + 1) / 2**self.level

    def halves(self) -> tuple["Part", "Part"]:
        """The two parts it is made of."""
        return (
            Part(self.interval, self.level + 1, 2 * self.index),
            Part(self.interval, self.level + 1, 2 * self.index + 1),
        )


@dataclass(frozen=True, eq=False)
class Proved:
    """pieces, each one's margin in 1/s; unproved: parts that ended the search without a proof."""

    pieces: Pieces
    margins: FloatArray
    unproved: tuple[Part, ...]

    def on(self, intervals: Collection[int]) -> "Proved":
        """The pieces of these intervals that are proved from end to end."""
        left = set(intervals) - {part.interval for part in self.unproved}
        chosen = np.flatnonzero(np.isin(self.pieces.cases.interval, list(left)))
        return Proved(self.pieces.select(chosen), self.margins[chosen], ())


def prove_pieces(
    steps: LSteps,
    funnel: ContinuousFunnel,
    ends: list[Ends] | None = None,
    *,
    kept: Proved | None = None,
) -> Proved:
    """A proof for all time, or the first part on each interval where there is none.

    ends: L-steps at the ends of the intervals, where they are at hand. kept: pieces that are proved
    already.
    """
    known: dict[tuple[int, float], list[SphereSolution]] = {}
    for k, pair in enumerate(ends or []):
        known[k, 0.0], known[k, 1.0] = pair.start, pair.end
    done: list[tuple[Pieces, FloatArray]] = []
    over: set[int] = set()
    if kept is not None and len(kept.pieces):
        done = [(replace(kept.pieces, kappa=steps.kappa), kept.margins)]
        over = set(kept.pieces.cases.interval.tolist())
    waiting = [Part(k, 0, 0) for k in range(len(funnel.t) - 1) if k not in over]
    unproved: dict[int, Part] = {}
    while waiting:
        for part in waiting:  # the rest of an interval is of no use without it
            if part.interval not in unproved and not _solved(steps, funnel, part, known):
                unproved[part.interval] = part
        waiting = [part for part in waiting if part.interval not in unproved]
        if not waiting:
            break
        pieces = rounded(_pieces(steps, funnel, waiting, known))
        margins = np.full(len(pieces), np.nan)
        for chosen in batches(pieces):
            margins[chosen] = piece_margins(
                steps.field, steps.policy, funnel, pieces.select(chosen)
            )
        by_part = np.asarray(np.isfinite(margins).reshape(len(waiting), -1).all(axis=1))
        keep = np.repeat(by_part, steps.cases)
        if keep.any():
            chosen = np.flatnonzero(keep)
            done.append((pieces.select(chosen), margins[chosen]))
        failed = [part for part, good in zip(waiting, by_part.tolist(), strict=True) if not good]
        count = Counter(part.interval for part in failed)
        for part in failed:
            if part.level == MAX_LEVEL or count[part.interval] > ENDS:
                unproved[part.interval] = part
        waiting = [
            half for part in failed if part.interval not in unproved for half in part.halves()
        ]
    return Proved(*_joined(steps, done), unproved=tuple(unproved.values()))


def _solved(
    steps: LSteps,
    funnel: ContinuousFunnel,
    part: Part,
    known: dict[tuple[int, float], list[SphereSolution]],
) -> bool:
    """L-steps at both ends of the part; False if one leaves no margin."""
    k = part.interval
    h = float(funnel.t[k + 1] - funnel.t[k])
    for s in part.ends():
        rho = float((1 - s) * funnel.rho[k] + s * funnel.rho[k + 1])
        if (k, s) not in known:
            section = section_at(steps, funnel.P, k, s)
            near = next((known[k, end] for end in part.ends() if (k, end) in known), None)
            try:
                known[k, s] = steps.solve(section, rho, near)
            except SolverError:
                return False
        growth = (funnel.rho[k + 1] - funnel.rho[k]) / h / rho
        if min(found.m for found in known[k, s]) + growth <= 0:
            return False
    return True


def _pieces(
    steps: LSteps,
    funnel: ContinuousFunnel,
    parts: list[Part],
    known: dict[tuple[int, float], list[SphereSolution]],
) -> Pieces:
    """The pieces of the proof for these parts, part by part, case by case, all of them in x̄."""
    n, program = funnel.n, steps.program
    basis = proof_basis(program)
    full = monomials(n, Pieces.multiplier_degrees(basis))
    linear = [j for j in range(n) if j not in steps.nonlinear]
    order = linear + [j for j in range(n) if j not in linear]
    both: dict[str, list[FloatArray]] = {"mu": [], "gram": [], "tau": []}
    for end in (0, 1):
        T, rho, rows = [], [], []
        for part in parts:
            s = part.ends()[end]
            i = part.interval
            rho_here = float((1 - s) * funnel.rho[i] + s * funnel.rho[i + 1])
            section = section_at(steps, funnel.P, i, s)
            T += [np.sqrt(rho_here) * section.shape.base] * steps.cases
            rho += [rho_here] * steps.cases
            rows += known[i, s]
        blank = draft(steps, parts, np.array(T))
        scale = np.diff(funnel.t)[blank.cases.interval] * rho
        tau = np.array([s * solution.tau for s, solution in zip(scale, rows, strict=True)])
        tau = tau.reshape(len(rows), -1, n + 1, n + 1)
        blank = replace(blank, tau=np.stack([tau, tau], axis=1))
        c = closed_loop_polynomial(steps.field, steps.policy, funnel, blank, end)
        at_end = {q: part[:, 0] for q, part in c.items()}
        mu = np.zeros((len(rows), len(full)))
        gram = np.zeros((len(rows), len(basis), len(basis)))
        for b, solution in enumerate(rows):
            i = int(blank.cases.interval[b])
            h = float(funnel.t[i + 1] - funnel.t[i])
            growth = float(funnel.rho[i + 1] - funnel.rho[i]) / h / rho[b]
            target = {q: values[b] for q, values in at_end.items()}
            gram[b], scaled = end_proof(program, solution, target, h * rho[b], solution.m + growth)
            mu[b] = scaled / rho[b]
        # From z to y = x̄ in the order in which T is triangular: z = A y.
        A = np.triu(np.linalg.inv(np.array(T)[:, order]))
        M = substitution(basis, A)
        around = np.tile(np.eye(n + 1), (len(rows), 1, 1))
        around[:, 1:, 1:] = A
        both["gram"].append(M.swapaxes(1, 2) @ gram @ M)
        both["mu"].append(np.einsum("bij,bi->bj", substitution(full, A), mu))
        both["tau"].append(around.swapaxes(1, 2)[:, None] @ tau @ around[:, None])
    # Entry j of y is x̄ at order[j]: the same numbers, of monomials with their columns exchanged.
    back = np.argsort(order)
    places = positions(full, full[:, back])
    sides = np.r_[0, 1 + back]
    return replace(
        blank,
        basis=basis[:, back],
        T=np.tile(np.eye(n), (len(blank), 1, 1)),
        mu=np.stack(both["mu"], axis=1)[:, :, places],
        gram=np.stack(both["gram"], axis=1),
        tau=np.stack(both["tau"], axis=1)[..., sides[:, None], sides],
    )


def proof_basis(program: SphereProgram) -> IntArray:
    """1 and the rest of the program's basis."""
    if program.constant:
        return program.basis
    return np.vstack([np.zeros((1, program.n), dtype=np.int64), program.basis])


def _spread(program: SphereProgram) -> FloatArray:
    """Weights of squares of the basis that add to 1 on the sphere: a quarter of it for the 1."""
    if program.constant:
        return program.weight**2
    return np.concatenate([[ONE], (1 - ONE) * program.weight**2])


def draft(steps: LSteps, parts: list[Part], T: FloatArray) -> Pieces:
    """Pieces that state frames T (parts x cases, n, n) only: μ, Q and S are zero."""
    basis, count = proof_basis(steps.program), len(parts) * steps.cases
    whole = np.array([(p.interval, p.level, p.index) for p in parts], dtype=np.int64).reshape(-1, 3)
    repeated = np.repeat(whole, steps.cases, axis=0)
    corners, limited, n = len(steps.corners), len(steps.limits), steps.program.n
    off = [steps.off(part.interval) for part in parts for _ in steps.modes]
    return Pieces(
        basis,
        Cases(
            interval=repeated[:, 0],
            vertex=np.tile(np.arange(steps.cases) % corners, len(parts)),
            level=repeated[:, 1],
            index=repeated[:, 2],
            mode=np.tile(np.repeat(steps.modes, corners, axis=0), (len(parts), 1)),
            off=np.array(off).reshape(count, steps.corners.shape[1]),
        ),
        T=T,
        mu=np.zeros((count, 2, Pieces.multiplier_size(basis))),
        gram=np.zeros((count, 2, len(basis), len(basis))),
        tau=np.zeros((count, 2, limited, n + 1, n + 1)),
        stated=np.empty(count, dtype=object),
        kappa=steps.kappa,
    )


def end_proof(
    program: SphereProgram,
    solution: SphereSolution,
    target: dict[int, FloatArray],
    scale: float,
    m: float,
) -> tuple[FloatArray, FloatArray]:
    """Q and ρμ with target + ρμ(1 - |z|²) = v'Qv, where target/scale ≥ m on the sphere.

    All of m is used up.
    """
    n = program.n
    basis = proof_basis(program)
    Q = np.zeros((len(basis), len(basis)))
    home = positions(program.basis, basis)
    Q[np.ix_(home, home)] = program.gram(solution) * scale
    Q[np.diag_indices(len(basis))] += scale * m * _spread(program)
    linear = np.array([j not in program.chosen for j in range(n)])
    first = target.get(1, np.zeros(n))
    for j in np.flatnonzero(linear).tolist():
        place = int(positions(np.eye(n, dtype=np.int64)[[j]], basis)[0])
        Q[0, place] = Q[place, 0] = first[int(positions(basis[[place]], monomials_of(n, 1))[0])] / 2
    # ρμ(1 - |z|²) = v'Qv - target, solved degree by degree from below: μ_q = d_q + |z|²μ_(q-2).
    degrees = range(5)
    offset = np.concatenate([target.get(q, np.zeros(len(monomials_of(n, q)))) for q in degrees])
    rows = np.concatenate([monomials_of(n, q) for q in degrees])
    pairs = positions((basis[:, None] + basis[None]).reshape(-1, n), rows)
    difference = np.bincount(pairs, Q.ravel(), len(rows)) - offset
    starts = np.cumsum([0] + [len(monomials_of(n, q)) for q in degrees])
    squares = positions(2 * np.eye(n, dtype=np.int64), monomials_of(n, 2))
    mu: list[FloatArray] = []
    for q in Pieces.multiplier_degrees(basis):
        part = difference[starts[q] : starts[q + 1]]
        if q >= 2:
            homes = product_table(n, 2, q - 2)[squares]
            lower = np.broadcast_to(mu[q - 2], homes.shape)
            part = part + np.bincount(homes.ravel(), lower.ravel(), len(part))
        mu.append(part)
    # Beyond its constant μ has nonlinear variables only; in others it is rounding, which products
    # with |z|² would put where the Gram matrix has no place for it.
    for q in range(1, len(mu)):
        mu[q] = np.where(monomials_of(n, q)[:, linear].any(axis=1), 0.0, mu[q])
    return Q, np.concatenate(mu)


def substitution(rows: IntArray, A: FloatArray) -> FloatArray:
    """M (B, k, k) with v(A z) = M v(z) for A (B, n, n), v the monomials `rows` (k, n).

    Monomials that are not among the rows are dropped: with A triangular in the order of the
    nonlinear variables their coefficients are zero.
    """
    count, n, _ = A.shape
    homes = positions(np.eye(n, dtype=np.int64), monomials_of(n, 1))
    forms = np.zeros_like(A)
    forms[:, :, homes] = A
    powers: dict[tuple[int, ...], FloatArray] = {(0,) * n: np.ones((count, 1))}

    def power(exponent: tuple[int, ...]) -> FloatArray:
        if exponent not in powers:
            last = max(j for j, e in enumerate(exponent) if e)
            lower = power(tuple(e - (j == last) for j, e in enumerate(exponent)))
            result = np.zeros((count, len(monomials_of(n, sum(exponent)))))
            for i, home in enumerate(product_table(n, 1, sum(exponent) - 1)):
                result[:, home] += forms[:, last, i, None] * lower
            powers[exponent] = result
        return powers[exponent]

    M = np.zeros((count, len(rows), len(rows)))
    degree = rows.sum(axis=1)
    for q in np.unique(degree).tolist():
        among = np.flatnonzero(degree == q)
        columns = positions(rows[among], monomials_of(n, q))
        for i in among.tolist():
            M[:, i, among] = power(tuple(rows[i].tolist()))[:, columns]
    return M


def _joined(steps: LSteps, done: list[tuple[Pieces, FloatArray]]) -> tuple[Pieces, FloatArray]:
    """All proved pieces in the order of time."""
    if not done:
        n = steps.program.n
        return draft(steps, [], np.zeros((0, n, n))), np.zeros(0)
    pieces = stacked([part for part, _ in done])
    margins = np.concatenate([m for _, m in done])
    modes = list(pieces.cases.mode.T)[
        ::-1
    ]  # what shares its part of time and its mode is side by side
    order = np.lexsort(
        (
            pieces.cases.vertex,
            *modes,
            pieces.cases.index / 2.0**pieces.cases.level,
            pieces.cases.interval,
        )
    )
    return pieces.select(order), margins[order]


def stacked(parts: Sequence[Pieces]) -> Pieces:
    """All pieces in one; they have the same basis."""

    def joined(rows: Sequence[Any], names: Sequence[str]) -> Json:
        return {name: np.concatenate([getattr(row, name) for row in rows]) for name in names}

    cases = joined([part.cases for part in parts], [f.name for f in fields(Cases)])
    return replace(parts[0], cases=Cases(**cases), **joined(parts, OWN))


def proof_of(steps: LSteps, funnel: ContinuousFunnel, proved: Proved) -> Json:
    """The witnesses of all pieces as a proof states them; the kernel has not decided them yet."""
    pieces, n = proved.pieces, funnel.n
    margin = stated_margin(proved.margins)
    written: list[Json] = [{}] * len(pieces)
    for chosen in batches(pieces):
        found = documents(steps.field, steps.policy, funnel, pieces.select(chosen), margin)
        for i, document in zip(chosen.tolist(), found, strict=True):
            written[i] = document
    used = np.flatnonzero(pieces.mu.any(axis=(0, 1)))
    for document in written:
        document["mu"] = {
            key: [row[i] for i in used.tolist()] for key, row in document["mu"].items()
        }
    rows = monomials(n, Pieces.multiplier_degrees(pieces.basis))[used]
    proof: Json = {
        "basis": pieces.basis.tolist(),
        "pieces": written,
        "margin": margin,
        "multiplier": rows.tolist(),
    }
    if pieces.tau.shape[2]:
        proof["sides"] = affine(n).tolist()
    if pieces.kappa is not None:
        proof["kappa"] = pieces.kappa.tolist()
    return proof


def unsolved(policy: ContinuousPolicy, parts: tuple[Part, ...]) -> str:
    """The first unproved part in words."""
    part = min(parts, key=lambda p: (p.interval, p.ends()))
    start, h = policy.t[part.interval], policy.t[part.interval + 1] - policy.t[part.interval]
    a, b = part.ends()
    return f"{start + a * h:.6g} to {start + b * h:.6g} s"
