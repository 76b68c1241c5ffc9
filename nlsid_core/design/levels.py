"""Weights of a level that follows the commands, chosen on the trials that design a tube.

    min Σ_k √g(k)   subject to   g(k) = Σ_i weights_i G_i(k) >= E(k) at every sample,   weights >= 0
as a few linear programs: √ is concave, so its slope at the last solution bounds it from above.
Source: docs/certificate_tube.md, "A level that follows the commands"; reweighting: E. Candes,
M. Wakin, S. Boyd, Enhancing Sparsity by Reweighted l1 Minimization, J. Fourier Anal. Appl. (2008).
"""

from collections.abc import Sequence
from itertools import combinations
from typing import Literal

import numpy as np
from scipy.optimize import linprog
from scipy.signal import lfilter

from nlsid_core.arrays import FloatArray
from nlsid_core.funnels.level import CHANGE, VALUE, CommandLevel, Term

LevelKind = Literal["auto", "constant", "commands"]  # auto: commands if that is worth it
FADING = (0.7, 0.85, 0.93, 0.97, 0.99)  # of sums over the past, by sample
PROGRAMS = 4  # reweighted ones
FLOORS = (0.001, 0.01, 0.03, 0.1, 0.3)  # of the largest E: the least constant part of a level
PAIRS_UP_TO = 4  # inputs of which products of two are tried
WORTH = 0.8  # of a constant level's mean half-width: a rule that gains less is mostly chance
FEWEST = 4  # trials of a design: of fewer, a half is one trial and tells nothing of the others
ADDED = 200  # samples that a round takes into a program, worst first
ROUNDS = 20
NEGLIGIBLE = 1e-6  # of the largest summand: a weight that is left out


def candidates(inputs: Sequence[FloatArray]) -> tuple[Term, ...]:
    """What is tried, for runs with inputs (N, n_u): the constant first.

    Squares of inputs and, of a few, of their products; of their changes; fading sums of both.
    """
    u = np.concatenate(list(inputs))
    n_u = u.shape[1]
    products: list[tuple[int, ...]] = [(i,) for i in range(n_u)]
    if n_u <= PAIRS_UP_TO:
        products += list(combinations(range(n_u), 2))
    terms = [Term(())]
    for factors in products:
        s = np.prod(u[:, list(factors)], axis=1)
        low, high = float(s.min()), float(s.max())
        if not high > low:
            continue
        scale = _rounded(high - low)
        centres = {0.0, _rounded((low + high) / 2.0)} if len(factors) == 1 else {0.0}
        for fading in (0.0, *FADING):
            terms += [Term(factors, VALUE, c, scale, fading) for c in sorted(centres)]
            terms.append(Term(factors, CHANGE, 0.0, scale, fading))
    return tuple(terms)


def followed(
    energies: Sequence[FloatArray], inputs: Sequence[FloatArray], *, always: bool = False
) -> CommandLevel | None:
    """A level for E (N,) of each trial, or None where it gains little (`WORTH`) or there are too
    few trials (`FEWEST`) to tell.

    inputs: (settling + N, n_u) of each trial, from its run's start. What is narrower, and how small
    the constant part may be, is decided by the mean half-width where each half of the trials is
    scaled with what the other half gave. √g is 1 on average over the trials. always: not None.
    """
    if len(energies) < FEWEST and not always:
        return None
    terms = candidates(inputs)
    G = [_columns(terms, u)[len(u) - len(E) :] for u, E in zip(inputs, energies, strict=True)]
    halves = _halves(list(zip(energies, G, strict=True)))
    tried = {floor: _tried(halves, floor) for floor in (1.0, *FLOORS)}
    floor = min(FLOORS if always else tried, key=tried.__getitem__)
    columns = np.concatenate(G)
    weights = _weights(np.concatenate(list(energies)), columns, floor)
    if weights is None:
        weights, floor = np.eye(len(terms))[0], 1.0
    if tried[floor] > WORTH * tried[1.0] and not always:
        return None
    shares = weights * columns.max(axis=0)
    kept = shares > NEGLIGIBLE * shares.max()
    scaled = weights[kept] / float(np.mean(np.sqrt(columns @ weights))) ** 2
    return CommandLevel(
        tuple(t for t, keep in zip(terms, kept, strict=True) if keep),
        np.array([_rounded(weight) for weight in scaled]),
    )


def _columns(terms: Sequence[Term], u: FloatArray) -> FloatArray:
    """G (N, len(terms)) along one run."""
    squares: dict[Term, FloatArray] = {}
    columns = []
    for term in terms:
        plain = Term(term.inputs, term.of, term.centre, term.scale)
        if plain not in squares:
            squares[plain] = plain.values(u)
        columns.append(lfilter([1.0], [1.0, -term.fading], squares[plain]))
    return np.column_stack(columns)


Block = tuple[FloatArray, FloatArray]  # E (N,) and G (N, terms)


def _halves(blocks: list[Block]) -> tuple[Block, Block]:
    """Every second trial, or of a single one its halves in time."""
    if len(blocks) == 1:
        E, G = blocks[0]
        blocks = [(E[: len(E) // 2], G[: len(E) // 2]), (E[len(E) // 2 :], G[len(E) // 2 :])]
    first, second = (
        (np.concatenate([E for E, _ in part]), np.concatenate([G for _, G in part]))
        for part in (blocks[::2], blocks[1::2])
    )
    return first, second


def _tried(halves: tuple[Block, Block], floor: float) -> float:
    """Mean half-width of one half with the other's weights, over both ways; floor 1: constant."""
    found = []
    for (E, G), (E_next, G_next) in (halves, halves[::-1]):
        weights = _weights(E, G, floor)
        if weights is None:
            return float("inf")
        g = G_next @ weights
        scale = float((E_next / g).max())
        found.append(float(np.mean(np.sqrt(scale * g))))
    return float(np.mean(found))


def _weights(E: FloatArray, G: FloatArray, floor: float) -> FloatArray | None:
    """Weights of the columns of G, at least `floor` of the largest E for the constant, the first.

    None where no program is solved.
    """
    most = float(E.max())
    if floor >= 1.0 or not most > 0.0:
        return np.asarray(np.eye(G.shape[1])[0] * (most if most > 0.0 else 1.0))
    sizes = np.maximum(G.max(axis=0), np.finfo(float).tiny)
    A, b = G / sizes, E / most
    bounds = [(floor, None)] + [(0.0, None)] * (A.shape[1] - 1)
    worst = np.argsort(b)[::-1][:ADDED]
    weights: FloatArray = np.eye(A.shape[1])[0]
    for _ in range(PROGRAMS):
        cost = A.T @ (1.0 / np.sqrt(A @ weights)) / len(A)
        for _ in range(ROUNDS):
            solved = linprog(cost, A_ub=-A[worst], b_ub=-b[worst], bounds=bounds, method="highs")
            if solved.x is None:
                return None
            below = b - A @ solved.x
            if not below.max() > 1e-9:
                break
            worst = np.union1d(worst, np.argsort(below)[::-1][:ADDED])
        weights = np.maximum(solved.x, 0.0)
    return np.asarray(weights * most / sizes)


def _rounded(value: float) -> float:
    """To three significant digits: a number that a sentence can state exactly."""
    return float(f"{value:.3g}")
