"""Multipliers for one mode of limited inputs: τ_l ≥ 0 with g - Σ τ_l q_l as large as can be.

maximise m subject to g - m - Σ τ_l q_l = v'Xv on |z| = 1, X ⪰ 0, τ_l = y'S_l y, S_l ≻ 0, y =
(1, z), q_l ≥ 0 what holds in the mode: the L-step of a clipped policy's claim.
"""

import numpy as np
import scipy.sparse as sp

from nlsid_core import conic
from nlsid_core.arrays import FloatArray
from nlsid_core.conic import Cone, ConeProgram
from nlsid_core.polynomial.values import monomial_values
from nlsid_core.sos.sphere import SphereProgram

FLOOR = 1e-6  # every S is at least that times I, for g and q of size 1: the checker wants S ≻ 0
CLEAR = 0.02  # of q's size: a q that is below -CLEAR everywhere needs no program to rule it out
COST = 1e-6  # of the trace of S, which else has no bound where a mode hardly occurs
TOLERANCE = 1e-7
ROUNDING = 1e-9  # of q: what is as near to affine is


def multipliers(
    program: SphereProgram, g: FloatArray, q: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """S (L, n+1, n+1) and Σ τ_l q_l (N,) at the program's points, for g (N,) and q (L, N) there."""
    n, count = program.n, len(q)
    spread = max(float(np.ptp(g)), 1e-12)
    sizes = np.maximum(np.abs(q).max(axis=1), 1e-12)
    unit = q / sizes[:, None]
    S = np.tile(FLOOR * np.eye(n + 1), (count, 1, 1))
    most = _largest(program, unit)
    impossible = np.flatnonzero(most < -CLEAR)
    if len(impossible):
        chosen = int(impossible[0])
        S[chosen, 0, 0] += 1 / -float(most[chosen])
    elif (unit < CLEAR).any():
        S += _solved(program, (g - g.mean()) / spread - 2 * FLOOR * unit.sum(axis=0), unit)
    S *= (spread / sizes)[:, None, None]
    y = np.hstack([np.ones((len(g), 1)), program.points])
    return S, np.asarray(np.einsum("ln,na,lab,nb->n", q, y, S, y))


def _largest(program: SphereProgram, q: FloatArray) -> FloatArray:
    """(L,) of each q on the whole sphere, where it is affine; else at the points."""
    y = np.hstack([np.ones((q.shape[1], 1)), program.points])
    affine = np.linalg.lstsq(y, q.T, rcond=None)[0]
    exact = np.abs(y @ affine - q.T).max(axis=0) <= ROUNDING * np.abs(q).max(axis=1)
    whole = affine[0] + np.linalg.norm(affine[1:], axis=0)
    return np.asarray(np.where(exact, whole, q.max(axis=1)))


def _solved(program: SphereProgram, g: FloatArray, q: FloatArray) -> FloatArray:
    """(L, n+1, n+1) for g and q of size 1; x = [m, svec X, svec S_1, ...], m ≤ max g."""
    n, count, points = program.n, len(q), len(g)
    k = len(program.basis)
    v = monomial_values(program.basis, program.points) * program.weight
    y = np.hstack([np.ones((points, 1)), program.points])
    products = _products(y)
    rows = np.hstack(
        [np.ones((points, 1)), _products(v), *(part[:, None] * products for part in q)]
    )
    size = rows.shape[1]
    first, side = 1 + k * (k + 1) // 2, (n + 1) * (n + 2) // 2
    cost = np.zeros(size)
    cost[0] = -1.0
    trace = conic.svec(np.eye(n + 1))
    for start in range(first, size, side):
        cost[start : start + side] = COST * trace
    below = sp.csr_matrix(([1.0], ([0], [0])), shape=(1, size))
    x = conic.solve(
        ConeProgram(
            P=sp.csc_matrix((size, size)),
            q=cost,
            A=sp.vstack([sp.csr_matrix(rows), below, -sp.eye(size, format="csr")[1:]], "csc"),
            b=np.r_[g, float(np.max(g)), np.zeros(size - 1)],
            cones=(
                Cone("zero", points),
                Cone("nonnegative", 1),
                Cone("psd", k),
                *[Cone("psd", n + 1)] * count,
            ),
        ),
        tolerance=TOLERANCE,
    ).x
    return np.array([conic.smat(x[i : i + side]) for i in range(first, size, side)])


def _products(values: FloatArray) -> FloatArray:
    """(N, k(k+1)/2) rows with row·svec(X) = v'Xv for v (N, k)."""
    i, j = conic.triangle(values.shape[1])
    return np.asarray(values[:, i] * values[:, j] * np.where(i == j, 1.0, conic.SQRT2))
