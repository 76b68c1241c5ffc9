"""Seconds per Newton step of the robust simulation error from N = 500 to 10⁶, and the generic LMI.

python -m benchmarks.rwse_scaling [--largest N] [--json]

90 parameters: five lags and a cubic in six delayed inputs, simulated data. The same minimum as a
linear matrix inequality of size N + 1, [K, ε; ε', t] ⪰ 0, goes to a cone solver for comparison.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import resource
import time

import clarabel
import numpy as np
import scipy.sparse as sp
from scipy.signal import lfilter

from benchmarks.machine import describe, peers
from benchmarks.recorded import single
from nlsid_core.arrays import FloatArray
from nlsid_core.identification import Degrees, Polynomial
from nlsid_core.identification.methods.banded import Rows
from nlsid_core.identification.methods.newton import minimise
from nlsid_core.identification.methods.rse import Bound
from nlsid_core.identification.polynomial.rows import build_state_affine_rows

SIZES = (500, 2000, 10_000, 90_000, 300_000, 1_000_000)
LMI_SIZES = (250, 500, 1000)
LMI_TOLERANCE = 1e-9
BURST = 10.0  # samples in which the burst decays
REPEATS = 3
SVEC = float(np.sqrt(2.0))


def simulated_rows(N: int, *, lags: int = 5, degree: int = 3, noise: float = 0.02) -> Rows:
    """Rows of a Wiener-Hammerstein-like device driven by coloured noise."""
    rng = np.random.default_rng(0)
    u = lfilter([1.0, 0.5], [1.0, -0.6], rng.standard_normal(N + lags))
    y = lfilter([0.2, 0.1], [1.0, -1.2, 0.5], np.tanh(lfilter([0.5, 0.3], [1.0, -0.4], u)))
    y += noise * y.std() * rng.standard_normal(len(y))
    return build_state_affine_rows(
        single("simulated", u, y, 1.0), Polynomial(lags, degrees=Degrees(inputs=degree))
    ).rows


def seconds_per_step(rows: Rows) -> float:
    """Median seconds of value, gradient and Hessian of the first bound."""
    bound = Bound(rows, None)
    theta = rows.identity * 1.1
    times = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        bound.derivatives(bound.at(theta))
        times.append(time.perf_counter() - started)
    return float(np.median(times))


def linear_matrix_inequality(rows: Rows) -> tuple[float, float]:
    """(minimum, seconds) of t over [K, ε; ε', t] ⪰ 0, K = G + G' - I, by Clarabel.

    The data are sparse and Clarabel decomposes the cone along their pattern, its default.
    """
    N, zero = len(rows), np.zeros(len(rows))
    parts = []
    for D, weight, error in zip(rows.offsets, rows.weights.T, rows.errors.T, strict=True):
        G = sp.diags(weight[max(D, 0) : N + min(D, 0)], -D, shape=(N, N))
        parts.append(_svec(G + G.T, error, 0.0))
    parts += [_svec(sp.csc_matrix((N, N)), -q, 0.0) for q in rows.Q.T]
    parts.append(_svec(sp.csc_matrix((N, N)), zero, 1.0))
    A = -sp.hstack(parts, format="csc")
    b = _svec(-sp.identity(N), zero, 0.0).toarray().ravel()
    cost = np.zeros(len(parts))
    cost[-1] = 1.0
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_rel = settings.tol_feas = LMI_TOLERANCE
    started = time.perf_counter()
    solver = clarabel.DefaultSolver(
        sp.csc_matrix((len(cost), len(cost))), cost, A, b, [clarabel.PSDTriangleConeT(N + 1)],
        settings,
    )  # fmt: skip
    solution = solver.solve()
    return float(solution.obj_val), time.perf_counter() - started


def _svec(K: sp.spmatrix, error: FloatArray, corner: float) -> sp.csc_matrix:
    """The upper triangle of [K, ε; ε', corner], column by column, off-diagonals times √2."""
    border = sp.csc_matrix(error[:, None])
    M = sp.triu(sp.bmat([[K, border], [border.T, sp.csc_matrix([[corner]])]]), format="coo")
    position = M.col.astype(np.int64) * (M.col.astype(np.int64) + 1) // 2 + M.row
    values = M.data * np.where(M.row == M.col, 1.0, SVEC)
    size = M.shape[0] * (M.shape[0] + 1) // 2
    return sp.csc_matrix((values, (position, np.zeros(len(position), dtype=int))), (size, 1))


def boundary_rows(N: int) -> Rows:
    """A burst that has nothing to do with its input: the minimiser lies on K ⪰ 0."""
    rng = np.random.default_rng(1)
    burst = np.exp(-np.arange(N + 2) / BURST) * rng.standard_normal(N + 2)
    data = single("burst", rng.uniform(-1.0, 1.0, N + 2), burst, 1.0)
    model_class = Polynomial(2, degrees=Degrees(leading=1, lagged=1))
    return build_state_affine_rows(data, model_class).rows


def against_the_inequality(rows: Rows) -> tuple[float, float, float, bool]:
    """(LMI seconds, ours, relative difference of the optima, whether on the boundary)."""
    optimum, lmi_seconds = linear_matrix_inequality(rows)
    started = time.perf_counter()
    found = minimise(Bound(rows, None), rows.identity)
    seconds = time.perf_counter() - started
    difference = abs(found.point.J - optimum) / optimum
    return lmi_seconds, seconds, difference, found.on_boundary


def main() -> None:
    """Print the table, and with --json one JSON object as the last line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--largest", type=int, default=SIZES[-1], help="largest N")
    parser.add_argument("--json", action="store_true", help="last line is one JSON object")
    arguments = parser.parse_args()
    keys: dict[str, float] = {}
    print(
        f"robust simulation error, {describe()}\n\n{'N':>9s}{'p':>5s}{'s per step':>12s}{'GiB':>7s}"
    )
    sizes = [N for N in SIZES if arguments.largest >= N]
    for N in sizes:
        rows = simulated_rows(N)
        keys[f"seconds_{N}"] = seconds_per_step(rows)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        p = len(rows.identity) + rows.Q.shape[1]
        print(f"{len(rows):9d}{p:5d}{keys[f'seconds_{N}']:12.4f}{peak:7.2f}", flush=True)
        keys[f"gib_{N}"] = peak
    steps = [keys[f"seconds_{N}"] for N in sizes]
    keys["slope"] = float(np.polyfit(np.log(sizes[1:]), np.log(steps[1:]), 1)[0])
    print(f"log-log slope {keys['slope']:.3f}\n")
    print(f"{'LMI size':>9s}{'LMI s':>9s}{'ours s':>9s}{'ratio':>9s}{'difference':>12s}  boundary")
    for N in LMI_SIZES:
        for name, rows in ((f"{N}", simulated_rows(N)), (f"{N}_boundary", boundary_rows(N))):
            lmi, ours, difference, boundary = against_the_inequality(rows)
            keys[f"ratio_lmi_{name}"] = lmi / ours
            keys[f"difference_lmi_{name}"] = difference
            print(f"{N:9d}{lmi:9.2f}{ours:9.4f}{lmi / ours:9.0f}{difference:12.1e}  {boundary}",
                  flush=True)  # fmt: skip
    if arguments.json:
        print(json.dumps(keys | peers("clarabel")))


if __name__ == "__main__":
    main()
