"""`solved`: the semidefinite program of a tube, for one observer L and one rate ρ of forgetting.

    min Σ_j 1/(τ_j a_j²)   over P, R, N, N_j, τ   such that (D) and (O_j) hold at every vertex E and
                           tr(R S_k) <= 1 at every sample k of the trials, S_k = Σ ρ^(k-j) e_j e_j'
It is convex: data, weights of the outputs and storage are found together. What bounds R comes by
cutting planes. Its answers are candidates; the kernel decides them.
Source: docs/certificate_tube.md.
"""

import warnings
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple, TypeAlias

import cvxpy
import numpy as np
from scipy.linalg import LinAlgError, block_diag, null_space, solve_discrete_lyapunov
from scipy.signal import lfilter

from nlsid_core.arrays import FloatArray, Json
from nlsid_core.design.increment_form import Form

Leaf: TypeAlias = FloatArray | tuple[FloatArray, FloatArray]  # vertices, or `independent_rows`
cp: Any = cvxpy  # its functions are not seen by type checkers
SCALES = (1.0, 1e2, 1e4)  # of the balance, tried in order: slow vertices spread what V is worth
ROOM = 1e-6  # least eigenvalue asked for, in balanced units
WORST = 0.3  # part of it that a solution has to have
TAU_ROOM = 1e-3  # relative, given up of τ for the exact proof
UNREACHED = 1e-4  # of the Gramian's mean: noise on states that no injection moves
MANY = 4  # vertices, above which one matrix stands for all of them where it can
LARGEST = 1e4  # entry of a multiplier in balanced units
ROUNDS = 6  # of cutting planes, most of the time 2-4
CUT = 1e-3  # relative, by which a window may exceed the level at which R is designed


@dataclass(frozen=True, eq=False)
class Found:
    """L, ρ and what a program found for them; multipliers: the tree, as a proof file holds it."""

    L: FloatArray
    rho: float
    P: FloatArray
    R: FloatArray
    tau: FloatArray
    multipliers: Json | None


class Pair(NamedTuple):
    """A pair to try: L (n, p), ρ, and its innovations e (N, p)."""

    L: FloatArray
    rho: float
    e: list[FloatArray]


def gramian(form: Form, pair: Pair) -> tuple[FloatArray, FloatArray]:
    """W, mean over a few vertices, and R = diag(1/(p max S_jj)), so that no window has E > 1."""
    p, (L, rho, e) = len(form.H), pair
    fading = [lfilter([1.0], [1.0, -rho], part**2, axis=0) for part in e]
    most = np.max([squares.max(axis=0) for squares in fading], axis=0)
    R = np.diag(1.0 / (p * np.maximum(most, np.finfo(float).tiny)))
    noise = L @ np.linalg.inv(R) @ L.T
    noise = noise + UNREACHED * (np.trace(noise) / len(noise) or 1.0) * np.eye(len(noise))
    Ws = [solve_discrete_lyapunov(A / np.sqrt(rho), noise) for A in form.corners]
    W = np.mean(Ws, axis=0)
    return (W + W.T) / 2.0, R


def solved(form: Form, pair: Pair, amplitudes: FloatArray) -> Found | None:
    """P, R, N, τ of the least Σ 1/(τ_j a_j²), E <= 1 on the trials (one output: R = 1).

    Units: x in those of the Gramian W^(1/2) of the increments at a few vertices, or of the inverse
    of the stability proof's storage if that gives nothing; e_j, o_j of √max S_jj; ν of what it
    moves state and output by; E with an identity in ν at its mean.
    """
    try:
        W, R0 = gramian(form, pair)
    except (LinAlgError, ValueError):
        return None
    inverse = form.storage * (np.trace(W) / np.trace(form.storage))
    for balance, scale in product((W, inverse), SCALES):
        found = _balanced(form, pair, amplitudes, scale * balance, R0)
        if found is not None:
            return found
    return None


def _balanced(
    form: Form, pair: Pair, amplitudes: FloatArray, W: FloatArray, R0: FloatArray
) -> Found | None:
    """`solved` in the units of W^(1/2)."""
    m, p, (L, rho, e) = form.m, len(form.H), pair
    try:
        values, vectors = np.linalg.eigh(W)
        root = (vectors * np.sqrt(np.maximum(values, np.finfo(float).tiny))) @ vectors.T
        T = np.linalg.inv(root)
    except (LinAlgError, ValueError):
        return None
    sizes = 1.0 / np.sqrt(np.diag(R0) * p)
    moved = np.linalg.norm(np.vstack([T @ form.F[:, :m], form.H[:, :m] / sizes[:, None]]), axis=0)
    nu = 1.0 / np.where(moved > 0.0, moved, 1.0)
    S = block_diag(np.diag(nu), root)
    modes = [
        (np.hstack([T @ F @ S, T @ L * sizes]), np.hstack([H @ S / sizes[:, None], np.eye(p)]))
        for F, H in form.modes
    ]
    D = np.linalg.inv(form.mean[:, :m] * nu) if m else np.zeros((0, 0))
    ends = [independent_rows(E) if len(E) > MANY and not form.ray else None for E in form.leaves]
    leaves: list[Leaf] = [D @ E @ S for E in form.leaves]
    if ends and None not in ends:
        D = np.diag(1.0 / nu)
        leaves = [(D @ mean @ S, D @ half @ S) for mean, half in ends]  # type: ignore[misc]
    windows = _Windows([part / sizes for part in e], rho)
    solution = None
    for _ in range(ROUNDS if p > 1 else 1):
        solution = _program(modes, leaves, rho, windows.chosen, sizes / amplitudes, ray=form.ray)
        if solution is None:
            return None
        if p == 1 or not windows.cut(solution[1]):
            break
    assert solution is not None
    P, R, tau, Ns = solution
    # E should be at most 1 on the trials; with one output R = 1, so that E has the unit of e².
    P, R = T.T @ P @ T, R / np.outer(sizes, sizes)
    unit = float(sizes[0] ** 2) if p == 1 else 1.0
    outside = np.linalg.inv(block_diag(S, np.diag(sizes))).T
    found = [[_shaped(outside @ N @ D * unit, form.ray) for N in leaf] for leaf in Ns]
    return Found(
        L,
        rho,
        (P + P.T) * (unit / 2.0),
        np.eye(1) if p == 1 else (R + R.T) / 2.0,
        unit * (1.0 - TAU_ROOM) * tau / sizes**2,
        None if form.tree is None else _with_multipliers(form.tree, found),
    )


def slowed(form: Form, found: Found, s: float) -> Found:
    """A proof of the observer sL, for an output without its own innovation (c = 1).

    With ζ = s ζ̃ the inequalities of sL are those of L, in P/s² and diag(1/s, 1/s, 1) N/s; without
    e in them, N_j bounds output j by V at every vertex by 1/τ_j = H_j (ρP + sym(N_j E))⁻¹ H_j'.
    Source: docs/theory.md, "Slower observers".
    """
    states = form.F.shape[1]  # of ζ
    supply = np.zeros((states, states))
    supply[form.m :, form.m :] = found.rho * found.P
    leaves = [] if found.multipliers is None else _multipliers(found.multipliers)
    scales = np.concatenate([np.full(states, 1.0 / s), np.ones(len(form.H))])[:, None] / s
    pairs = [(Ns, E) for Ns, vertices in zip(leaves, form.leaves, strict=True) for E in vertices]
    for N in (N for Ns in leaves for N in Ns[1:]):
        N[states:] = 0.0

    def worst(j: int) -> float:
        crosses = [Ns[1 + j][:states] @ E for Ns, E in pairs] or [np.zeros_like(supply)]
        solutions = (np.linalg.solve(supply + N_E + N_E.T, form.H[j]) for N_E in crosses)
        return max(float(form.H[j] @ solution) for solution in solutions)

    scaled: list[list[FloatArray]] = [[scales * N for N in Ns] for Ns in leaves]
    return replace(
        found,
        L=s * found.L,
        P=found.P / s**2,
        tau=(1.0 - TAU_ROOM) / (s**2 * np.array([worst(j) for j in range(len(form.H))])),
        multipliers=None if form.tree is None else _with_multipliers(form.tree, scaled),
    )


def _multipliers(tree: Json) -> list[list[FloatArray]]:
    """N_0 … N_p of every leaf, in order."""
    if "split" in tree:
        return [leaf for part in tree["parts"] for leaf in _multipliers(part)]
    return [[np.array(N, dtype=np.float64) for N in tree["N"]]]


def _shaped(N: FloatArray, ray: bool) -> FloatArray:
    """(T, 0 … 0)', T >= 0, where there is a ray."""
    if ray:
        N = N.copy()
        N[1:, 0], N[0, 0] = 0.0, max(N[0, 0], 0.0)
    return N


class _Windows:
    """S_k = Σ ρ^(k-j) e_j e_j' of every sample k, and those that bound R: tr(R S_k) <= 1."""

    def __init__(self, e: list[FloatArray], rho: float) -> None:
        outer = [np.einsum("ti,tj->tij", part, part) for part in e]
        self._S = np.concatenate([lfilter([1.0], [1.0, -rho], part, axis=0) for part in outer])
        p = self._S.shape[1]
        self.chosen = [self._S[int(np.argmax(self._S[:, j, j]))] for j in range(p)]
        self.chosen.append(self._S[int(np.argmax(np.trace(self._S, axis1=1, axis2=2)))])

    def cut(self, R: FloatArray) -> bool:
        """Take the window in which R is exceeded the most; False if it is in none."""
        used = np.einsum("ij,kji->k", R, self._S)
        worst = int(np.argmax(used))
        if used[worst] <= 1.0 + CUT:
            return False
        self.chosen.append(self._S[worst])
        return True


def _program(
    modes: list[tuple[FloatArray, FloatArray]],
    leaves: list[Leaf],
    rho: float,
    windows: list[FloatArray],
    weights: FloatArray,
    *,
    ray: bool,
) -> tuple[FloatArray, FloatArray, FloatArray, list[list[FloatArray]]] | None:
    """P, R, τ and [N, N_1 … N_p] of each leaf, or None.

    modes: F (n, m + n + p) = [F L], H (p, m + n + p) = [H I], all in balanced units; more than one
    of a linear model only. Of several outputs, where E is one matrix, M + sym(N [E 0]) ≻ 0 has a
    solution N just where M ≻ 0 on the null space of [E 0] (Finsler's lemma): these N are no
    unknowns of the program.
    """
    n, p = len(modes[0][0]), len(modes[0][1])
    size = modes[0][0].shape[1]
    m = size - n - p
    P = cp.Variable((n, n), symmetric=True)
    tau = cp.Variable(p)
    R: Any = np.eye(1) if p == 1 else cp.Variable((p, p), symmetric=True)
    supply: Any = _placed(rho * P, m, size) + _placed(R, m + n, size)
    forms = [supply - F.T @ P @ F for F, _ in modes]
    forms += [supply - tau[j] * np.outer(h, h) for _, H in modes for j, h in enumerate(H)]
    room = ROOM * np.eye(size)
    constraints: list[Any] = [P >> ROOM * np.eye(n)]
    if p > 1:
        constraints += [R >> ROOM * np.eye(p), *(cp.trace(R @ S) <= 1.0 for S in windows)]
    if not m:
        constraints += [M >> room for M in forms]
    constant = p > 1 and not ray and len(leaves) == 1 and len(leaves[0]) == 1
    only = np.hstack([leaves[0][0], np.zeros((m, p))]) if constant else None
    if only is not None:
        Z = null_space(only)
        constraints += [Z.T @ M @ Z >> ROOM * np.eye(Z.shape[1]) for M in forms]
    unknown: list[list[Any]] = []
    for vertices in leaves if m and only is None else []:
        Ns: list[Any] = []
        for M in forms:
            N: Any
            if isinstance(vertices, tuple):  # mean and half
                mean, half = (np.hstack([part, np.zeros((m, p))]) for part in vertices)
                T = cp.Variable(m, nonneg=True)
                constraints.append(T <= LARGEST)
                Ns.append(mean.T @ cp.diag(T))
                cross = mean.T @ cp.diag(T) @ mean - half.T @ cp.diag(T) @ half
                constraints.append(M + (cross + cross.T) / 2.0 >> room)
                continue
            if ray:
                T = cp.Variable((1, 1), nonneg=True)
                N = cp.vstack([T, np.zeros((size - 1, 1))])
            else:
                N = cp.Variable((size, m))
                constraints.append(cp.abs(N) <= LARGEST)
            Ns.append(N)
            for E in vertices:
                cross = N @ np.hstack([E, np.zeros((m, p))])
                constraints.append(M + cross + cross.T >> room)
        unknown.append(Ns)
    least = cp.sum(cp.multiply(weights**2, cp.inv_pos(tau)))
    problem = cp.Problem(cp.Maximize(tau[0]) if p == 1 else cp.Minimize(least), constraints)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of inaccuracy: the kernel judges the result
            problem.solve(solver=cp.CLARABEL)
    except (cp.SolverError, ArithmeticError):
        return None
    if P.value is None or tau.value is None or not (np.asarray(tau.value) > 0.0).all():
        return None
    for constraint in constraints:
        if (
            isinstance(constraint, cp.constraints.PSD)
            and float(np.linalg.eigvalsh(constraint.args[0].value)[0]) < (WORST - 1.0) * ROOM
        ):
            return None
    R_found = np.eye(1) if p == 1 else np.asarray(R.value)
    found = [[np.asarray(N.value) for N in Ns] for Ns in unknown]
    if only is not None:
        found = [[finsler(np.asarray(M.value), only) for M in forms]]
    return np.asarray(P.value), R_found, np.asarray(tau.value), found


def independent_rows(vertices: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """ē and h (m, m + n), where the vertices are all rows e_j = ē_j ± h_j; else None.

    With N = ē'T, T >= 0 diagonal, N E + E'N' is at least ē'Tē - h'Th at all of them, 2xy being
    x² + y² at most: one matrix in place of 2^m.
    """
    low, high = vertices[0], vertices[-1]
    free = [j for j in range(len(low)) if not np.array_equal(low[j], high[j])]
    if len(vertices) != 2 ** len(free):
        return None
    for vertex in vertices:
        if any(
            not np.array_equal(row, a) and not np.array_equal(row, b)
            for row, a, b in zip(vertex, low, high, strict=True)
        ):
            return None
    return (low + high) / 2.0, (high - low) / 2.0


def finsler(M: FloatArray, E: FloatArray) -> FloatArray:
    """N with M + sym(N E) = Z'MZ on the null space of E, 1 on its complement and 0 between them."""
    Z = null_space(E)
    Y = null_space(Z.T)
    N = (0.5 * np.eye(len(M)) - (Z @ Z.T + 0.5 * Y @ Y.T) @ M) @ Y
    return np.asarray(N @ np.linalg.inv(E @ Y))


def _placed(M: Any, start: int, size: int) -> Any:
    """M in the rows and columns from `start` on of a matrix that is zero elsewhere."""
    J = np.zeros((M.shape[0], size))
    J[:, start : start + len(J)] = np.eye(len(J))
    return J.T @ M @ J


def _with_multipliers(tree: Json, leaves: list[list[FloatArray]]) -> Json:
    """The tree with these multipliers in its leaves, in order."""
    if "split" in tree:
        parts = [_with_multipliers(part, leaves) for part in tree["parts"]]
        return {"split": tree["split"], "parts": parts}
    return {"N": [N.tolist() for N in leaves.pop(0)]}
