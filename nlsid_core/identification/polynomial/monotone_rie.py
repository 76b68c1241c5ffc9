"""The least bound on the simulation error of a monotone equation: one small program.

In scaled signals, with d = v - ṽ, s = v + ṽ, Δ = x - x̃ and [e; -f] = c, the inequality of
`implicit_rie` for set 2.11,
    2d(e(v) - e(ṽ) + c_x'Δ) + ρ²|Δ|²_P - |[d; SΔ]|²_P - |Δ|²_Q - σd² - ε(sd)² = z'Gz + ½ c₃ d⁴,
z = [Δ, d, sd], is affine in P, c and σ, and G ⪰ 0 is one matrix inequality. The bound is |R c|²/σ.
Source: thesis (3.8), Lemma 2.10, (2.28).
"""

from itertools import combinations_with_replacement

import numpy as np
import scipy.sparse as sp

from nlsid_core import conic
from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.conic import Cone, ConeProgram
from nlsid_core.identification.polynomial.implicit_rows import ImplicitRows

CURVED = 1e-6  # of (sd)², so that e increases by more than the solver's rounding


def least_monotone(
    rows: ImplicitRows, slowest: float
) -> tuple[tuple[FloatArray, FloatArray], float]:
    """(e (m_e, 1), f (m_f, 1)) of the least bound, and the bound in squared spreads.

    slowest: V shrinks by its square or more, a sample. Raises SolverError if the solver gives up.
    """
    n, degree, R = rows.states, len(rows.left), rows.R
    c = n * (n + 1) // 2 + np.arange(R.shape[1])
    past = c[degree + np.argmax(rows.right[:, :n], axis=0)]
    weight, bound = c[-1] + 1, c[-1] + 2
    G = stability(rows, slowest, c, past)
    norm = np.zeros((2 + len(R), bound + 1))  # |2 R c, bound - σ| ≤ bound + σ
    norm[:, weight] = [1.0, *np.zeros(len(R)), -1.0]
    norm[:, bound] = [1.0, *np.zeros(len(R)), 1.0]
    norm[1:-1, c] = 2.0 * R
    program = ConeProgram(
        P=sp.csc_matrix((bound + 1, bound + 1)),
        q=np.eye(bound + 1)[bound],
        A=sp.csc_matrix(-np.vstack([conic.svec(G[1:]).T, norm])),
        b=np.concatenate([conic.svec(G[:1])[0], np.zeros(len(norm))]),
        cones=(Cone("psd", G.shape[1]), Cone("second_order", len(norm))),
    )
    found = conic.solve(program).x
    return (found[c[:degree], None], -found[c[degree:], None]), float(found[bound])


def stability(rows: ImplicitRows, slowest: float, c: IntArray, past: IntArray) -> FloatArray:
    """G (1 + unknowns, m, m), the constant first; unknowns P by its upper triangle, c, σ, bound."""
    n, d, sd, degree = rows.states, rows.states, rows.states + 1, len(rows.left)
    G = np.zeros((4 + c[-1], n + 1 + (degree == 3), n + 1 + (degree == 3)))
    moved = [d, *range(n - 1)]  # Δ becomes [d; SΔ]
    for column, (i, j) in enumerate(combinations_with_replacement(range(n), 2)):
        _add(G, i, j, column, slowest**2)
        _add(G, moved[i], moved[j], column, -1.0)
    G[0, :n, :n] = -rows.weight
    _add(G, d, d, c[-1] + 1, -1.0)
    for k in range(n):
        _add(G, k, d, past[k], 1.0)
    _add(G, d, d, c[0], 2.0)
    if degree == 3:
        _add(G, d, sd, c[1], 1.0)
        _add(G, sd, sd, c[2], 1.5)
        G[0, sd, sd] = -CURVED
    return G


def _add(G: FloatArray, i: int, j: int, unknown: int, value: float) -> None:
    """G[i, j] += value times an unknown, symmetric."""
    G[1 + unknown, i, j] += value
    if i != j:
        G[1 + unknown, j, i] += value
