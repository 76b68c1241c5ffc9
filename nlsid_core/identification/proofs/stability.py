"""`prove_stability`: the proof that a model of any class forgets its start, in increment form.

The kernel's own reading of the model file is the lowering: it gives F and the vertices E of
    diag(0, r²P) - F'PF + sym(N E) ≻ 0,
and the search here finds P and N. Without E (a linear model), or with a single vertex, P solves a
Lyapunov equation and N completes the square. Else P and N are found by one semidefinite program a
rate: at a slow rate first, where a box whose vertices are too coarse is split, then 1 - r is raised
and bisected. A network is proved loop by loop, and weights join the loops. The kernel decides the
result. Source: docs/certificate_stability.md.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, block_diag, solve_discrete_lyapunov

from nlsid_core import conic, files, kernel, proofs
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.errors import CertificateRejected, SolverError
from nlsid_core.kernel import increments
from nlsid_core.kernel.files import parse
from nlsid_core.kernel.increments import Box
from nlsid_core.kernel.models import read_model

RATE_ROOM = 0.05  # of 1 - the fastest rate found, given up for a well conditioned P
SLOWEST = 1e-8  # 1 - rate below which nothing is claimed
LEAST_ROOM = 1e-3  # of 1 - rate of the worst vertex alone: what is asked for first
RATE_RISE = 4.0  # of 1 - rate from one attempt to the next, until one is not proved
RATE_STEPS = 6  # bisections of 1 - rate, the first failure among them
FEASIBLE = 1e-7  # least eigenvalue, in balanced units, that the kernel's exact decision can use
MOST_HALVINGS = 100  # of a part's weight: beyond any coupling worth a model
LEAST_PIVOT = 0.1  # of the least eigenvalue of parts alone, that the weight of a part leaves
LARGEST = 1e3  # entry of a multiplier in balanced units: where nothing else bounds it
SPLITTING_ROUNDS = 16
MOST_LEAVES = 64

Matrices = FloatArray  # (count, m, m + n)


@dataclass(frozen=True, eq=False)
class StabilityProof:
    """V = x̄'Px̄ of the difference of two solutions shrinks by rate² or more a sample.

    P: (n, n). multipliers: N of every leaf of the box, as a proof file holds them; None for a model
    whose increments are linear. Decided by the kernel.
    """

    rate: float
    P: FloatArray
    multipliers: Json | None

    def document(self, model: Any, file: str) -> Json:
        """The proof file's content for the model it was made for, stored in `file` beside it."""
        about = {"model": proofs.binding(file, model.document())}
        claim = {"kind": "stability", "about": about, "rate": self.rate}
        proof: Json = {"P": self.P.tolist()}
        if self.multipliers is not None:
            proof["multipliers"] = self.multipliers
        return proofs.proof_document(claim, proof)


@dataclass(frozen=True, eq=False)
class Leaf:
    """A part of the box, its vertices E, and its multiplier N (m + n, m)."""

    box: Box
    E: Matrices
    N: FloatArray | None = None
    margin: float = -np.inf


@dataclass(frozen=True, eq=False)
class Split:
    """Which variable was halved, and what became of the halves."""

    variable: int
    parts: "tuple[Tree, Tree]"


Tree = Leaf | Split


@dataclass(frozen=True, eq=False)
class _Search:
    """The increment form in floats: F (n, m + n), the kernel's form behind it."""

    form: increments.Model
    F: FloatArray
    m: int = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "m", self.F.shape[1] - len(self.F))

    def leaf(self, box: Box) -> Leaf:
        return Leaf(box, np.array(self.form.E.vertices(box), dtype=np.float64))


def prove_stability(model: Any) -> StabilityProof | None:
    """A proof of incremental stability, or None if the search finds none.

    model: of a class that the kernel knows the increment form of.
    """
    try:
        form = read_model(parse(files.encode(model.document()), "model"))
        search = _Search(form, np.array(form.F, dtype=np.float64))
        if not search.m:
            return _decided(model, _linear(search, None))
        root = search.leaf(form.E.box)
        if len(root.E) == 1 and not form.E.ray:
            return _decided(model, _linear(search, root))
        if not form.E.ray and form.E.whole == len(form.E.box):
            layer = _layers(search, root)
            parts = [np.flatnonzero(layer == number) for number in range(layer.max() + 1)]
            return _by_layers(model, search, root, parts)
        return _decided(model, _by_programs(search, root))
    except (kernel.Rejected, LinAlgError, SolverError):
        return None


def storage_on(form: increments.Model) -> StabilityProof | None:
    """P, N and a rate for an increment form on a box, not decided; None if the search finds none.

    The leaves of its multipliers are parts of the box on which one N serves.
    """
    search = _Search(form, np.array(form.F, dtype=np.float64))
    try:
        return _by_programs(search, search.leaf(form.E.box))
    except (kernel.Rejected, LinAlgError, SolverError):
        return None


def _decided(model: Any, found: StabilityProof | None) -> StabilityProof | None:
    if found is None:
        return None
    try:
        proofs.decide(found.document(model, "model.json"), {"model.json": model.document()})
    except CertificateRejected:
        return None
    return found


def _linear(search: _Search, leaf: Leaf | None) -> StabilityProof | None:
    """P of (A/r)'P(A/r) - P + I = 0, x⁺ = A x what is left with ν eliminated.

    With ν = r̃ - G x, r̃ = E_ν⁻¹E ζ: N ζ = F_ν'PAx + F_ν'PF_ν r̃ leaves r²P - A'PA on x and
    F_ν'PF_ν on r̃. Source: thesis (2.19), Definition 2.3.
    """
    m = search.m
    lead = np.zeros((m, search.F.shape[1])) if leaf is None else leaf.E[0]
    A, G = _eliminated(search, lead)
    rate = _slower(A)
    if not 0.0 < rate < 1.0 - SLOWEST:
        return None
    P = _lyapunov(A / rate)
    P /= np.abs(P).max()
    if leaf is None:
        return StabilityProof(rate, P, None)
    left = search.F[:, :m].T @ P
    inverse = np.linalg.inv(lead[:, :m])
    weight = left @ search.F[:, :m]
    weight += np.trace(weight) * 1e-3 * np.eye(m)  # where a ν does not move the state
    N = np.hstack([weight, left @ A + weight @ G]).T @ inverse
    return StabilityProof(rate, P, {"N": N.tolist()})


def _layers(search: _Search, root: Leaf) -> NDArray[np.intp]:
    """(m + n,): the layer of every ν and x. A ν is one deeper than what it reads from outside the
    loops that it is in; all else is as deep as the deepest that it depends on.
    """
    reads = np.vstack([(root.E != 0.0).any(axis=0), search.F != 0.0])
    np.fill_diagonal(reads, True)
    reach = np.linalg.matrix_power(reads.astype(float), len(reads)) > 0.0
    deeper = reads & ~reach.T
    deeper[search.m :] = False
    layer: NDArray[np.intp] = np.zeros(len(reads), dtype=np.intp)
    for _ in range(len(reads)):
        layer = np.where(reads, layer + deeper, 0).max(axis=1)
    return layer


def _by_layers(
    model: Any, search: _Search, root: Leaf, parts: Sequence[NDArray[np.intp]]
) -> StabilityProof | None:
    """P = diag(w₀P₀, w₁P₁ …) of parts, each proved alone: its weight is halved until what couples
    it to those before it is nothing.

    A part whose ν read its own x is proved by programs. Of another P_l solves
    (A/r)'P(A/r) - P + I = 0, and N ζ = G'P_l G ν + G'P_l A x_l, G ν what ν moves x_l by, leaves
    G'P_l G on ν.
    """
    m, F = search.m, search.F
    A = F[:, m:]
    rate, alone = 0.0, []
    for part in parts:
        nu, x, found = part[part < m], part[part >= m] - m, None
        E = np.unique(root.E[:, nu][:, :, part], axis=0)
        if len(E) > 1:
            found = _by_programs(_Search(search.form, F[np.ix_(x, part)]), Leaf(root.box, E))
            if found is None:
                return None
        alone.append(found)
        rate = max(rate, _slower(A[np.ix_(x, x)]) if found is None else found.rate)
    if not 0.0 < rate < 1.0 - SLOWEST:
        return None
    P, N, weight, least = np.zeros_like(A), np.zeros((m + len(A), m)), 1.0, np.inf
    done: NDArray[np.bool_] = np.zeros(m + len(A), dtype=bool)
    for part, found in zip(parts, alone, strict=True):
        nu, x = part[part < m], part[part >= m] - m
        if found is None or found.multipliers is None:
            P_l, N_l = _filters(F[np.ix_(x, nu)], A[np.ix_(x, x)], rate)
        else:
            P_l, N_l = found.P, np.array(found.multipliers["N"])
        done[part] = True
        for _ in range(MOST_HALVINGS):
            P[np.ix_(x, x)], N[np.ix_(part, nu)] = weight * P_l, weight * N_l
            cross = N @ root.E
            M = _gap(F, P, rate, m) + cross + cross.transpose(0, 2, 1)
            least = min(least, _least_in_units(M[:, part][:, :, part]))
            if _least_in_units(M[:, done][:, :, done]) > LEAST_PIVOT * least:
                break
            weight *= 0.5
        else:
            return None
    return _decided(model, StabilityProof(rate, P, {"N": N.tolist()}))


def _filters(G: FloatArray, A: FloatArray, rate: float) -> tuple[FloatArray, FloatArray]:
    """P and N of filters x⁺ = A x + G ν."""
    P = _lyapunov(A / rate) if len(A) else np.zeros((0, 0))
    P /= np.abs(P).max(initial=1.0)
    size = G.T @ P @ G
    size += (np.trace(size) * 1e-3 if len(A) else 1.0) * np.eye(len(size))
    return P, np.vstack([size, A.T @ P @ G])


def _slower(A: FloatArray) -> float:
    """A little slower than x⁺ = A x is."""
    radius = float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))
    return radius + RATE_ROOM * (1.0 - radius)


def _least_in_units(M: Matrices) -> float:
    """The least eigenvalue of all, in units in which every diagonal entry is one."""
    diagonals = np.einsum("vii->vi", M)
    if not M.size:
        return np.inf
    if not diagonals.min() > 0.0:
        return -np.inf
    units = 1.0 / np.sqrt(diagonals)
    return float(np.linalg.eigvalsh(M * units[:, :, None] * units[:, None])[:, 0].min())


def _eliminated(search: _Search, E: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A = F_x - F_ν G, G = E_ν⁻¹E_x."""
    m = search.m
    G = np.linalg.solve(E[:, :m], E[:, m:]) if m else E
    return search.F[:, m:] - search.F[:, :m] @ G, G


def _lyapunov(A: FloatArray) -> FloatArray:
    """P = A'PA + I."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of bad conditioning: the kernel judges the result
        P = solve_discrete_lyapunov(A.T, np.eye(len(A)))
    return np.asarray((P + P.T) / 2.0)


def _by_programs(search: _Search, root: Leaf) -> StabilityProof | None:
    """A slow rate first, the box being halved where the program is short; then the fastest.

    1 - rate is raised as long as it is proved, then bisected, and a little of it is given up.
    """
    tree: Tree = root
    for _ in range(SPLITTING_ROUNDS):
        leaves = _leaves(tree)
        alone = 1.0 - _radius(search, leaves)
        room, found = LEAST_ROOM * alone, None
        if room > SLOWEST:
            found = _at_rate(search, tree, 1.0 - room)
            if found.proved:
                return _with_room(search, *_fastest(search, room, alone, found))
            tree = found.tree
        if search.form.E.whole == len(search.form.E.box) or len(leaves) > MOST_LEAVES // 2:
            return None
        tree = _refined(search, tree, None if found is None else found.P)
    return None


def _fastest(search: _Search, room: float, most: float, found: "_Found") -> tuple[float, "_Found"]:
    """The largest 1 - rate that is proved, to some per cent, from one that is."""
    upper, steps = min(RATE_RISE * room, most), 0
    while room < upper and steps < RATE_STEPS:
        tried = upper if steps == 0 else float(np.sqrt(room * upper))
        better = _at_rate(search, found.tree, 1.0 - tried, balance=found.P)
        if not better.proved:
            upper, steps = tried, steps + 1
            continue
        found, room = better, tried
        if steps == 0:
            upper = min(RATE_RISE * upper, most)
        else:
            steps += 1
    return room, found


def _with_room(search: _Search, room: float, fastest: "_Found") -> StabilityProof:
    """A slightly slower rate, for a well conditioned P."""
    rate = 1.0 - room * (1.0 - RATE_ROOM)
    last = _at_rate(search, fastest.tree, rate, balance=fastest.P)
    if not last.proved:
        rate, last = 1.0 - room, fastest
    return StabilityProof(rate, last.P, _written(last.tree))


@dataclass(frozen=True, eq=False)
class _Found:
    """What one program found: P, the tree with N and a margin in every leaf."""

    P: FloatArray
    tree: Tree
    margin: float

    @property
    def proved(self) -> bool:
        return self.margin >= FEASIBLE


def _at_rate(
    search: _Search, tree: Tree, rate: float, *, balance: FloatArray | None = None
) -> _Found:
    """P and N with the largest least eigenvalue over all vertices, in balanced units.

    Units: x in those of P^(1/2) for `balance`, or else for P of the mean vertex; ν of what it moves
    the state by; E with an identity in ν at its mean.
    """
    leaves = _leaves(tree)
    F, m, n = search.F, search.m, len(search.F)
    mean = np.mean([leaf.E.mean(axis=0) for leaf in leaves], axis=0)
    A, _ = _eliminated(search, mean)
    P0 = balance if balance is not None else _mean_storage(A, rate)
    root = np.linalg.cholesky(P0).T  # x' = root x
    scale = np.linalg.norm(root @ F[:, :m], axis=0)
    scale = np.where(scale > 0.0, 1.0 / np.where(scale > 0.0, scale, 1.0), 1.0)
    S = block_diag(np.diag(scale), np.linalg.inv(root))  # ζ = S ζ'
    D = np.linalg.inv(mean[:, :m] * scale)
    F = root @ F @ S
    program, unknown_P = _program(search, F, [D @ leaf.E @ S for leaf in leaves], rate)
    try:
        z = conic.solve(program).x
    except SolverError:
        return _Found(P0, tree, -np.inf)
    P = np.tensordot(z[: len(unknown_P)], unknown_P, axes=1)
    P_outside = root.T @ P @ root
    size = float(np.abs(P_outside).max())
    outside = np.linalg.inv(S).T
    rest, proved = z[len(unknown_P) : -1].reshape(len(leaves), m + n, m), {}
    for leaf, N in zip(leaves, rest, strict=True):
        Es = D @ leaf.E @ S
        gaps = _gap(F, P, rate, m) + N @ Es + (N @ Es).transpose(0, 2, 1)
        least = float(np.linalg.eigvalsh(gaps)[:, 0].min())
        N_outside = outside @ N @ D / size
        if search.form.E.ray:
            N_outside[1:, 0] = 0.0
        proved[id(leaf)] = replace(leaf, N=N_outside, margin=least)
    P_outside = (P_outside + P_outside.T) / (2.0 * size)
    return _Found(P_outside, _replaced(tree, proved), min(leaf.margin for leaf in proved.values()))


def _mean_storage(A: FloatArray, rate: float) -> FloatArray:
    """P of the mean vertex at this rate, or at its own rate if it is slower."""
    radius = float(np.abs(np.linalg.eigvals(A)).max())
    return _lyapunov(A / max(rate, radius + RATE_ROOM * abs(1.0 - radius)))


def _gap(F: FloatArray, P: FloatArray, rate: float, m: int) -> FloatArray:
    """diag(0, r²P) - F'PF, for P (..., n, n)."""
    gap = -np.asarray(F.T @ P @ F)
    gap[..., m:, m:] += rate**2 * P
    return gap


def _program(
    search: _Search, F: FloatArray, vertices: Sequence[Matrices], rate: float
) -> tuple[conic.ConeProgram, FloatArray]:
    """Maximise t: every vertex's matrix ⪰ t I, tr P = n. Unknowns [P; N of every leaf; t]."""
    m, n = search.m, len(F)
    rows, columns = np.triu_indices(n)
    basis = np.zeros((len(rows), n, n))
    basis[np.arange(len(rows)), rows, columns] = basis[np.arange(len(rows)), columns, rows] = 1.0
    entries = np.eye((m + n) * m).reshape(-1, m + n, m)
    size = len(basis) + len(vertices) * len(entries) + 1
    inner = conic.svec(_gap(F, basis, rate, m))
    blocks, cones = [], []
    for i, Es in enumerate(vertices):
        place = len(basis) + i * len(entries)
        for E in Es:
            X = entries @ E
            part = np.zeros((inner.shape[1], size))
            part[:, : len(basis)] = inner.T
            part[:, place : place + len(entries)] = conic.svec(X + X.transpose(0, 2, 1)).T
            part[:, -1] = -conic.svec(np.eye(m + n)[None])[0]
            blocks.append(sp.csc_matrix(-part))
            cones.append(conic.Cone("psd", m + n))
    trace = np.zeros((1, size))
    trace[0, : len(basis)] = np.trace(basis, axis1=1, axis2=2)
    bounded = np.zeros((2 * (size - 1 - len(basis)) + 1, size))
    count = (len(bounded) - 1) // 2
    bounded[:count, len(basis) : -1], bounded[count:-1, len(basis) : -1] = (
        np.eye(count),
        -np.eye(count),
    )
    bounded[-1, -1] = 1.0
    limits = np.full(len(bounded), LARGEST)
    limits[-1] = 1.0
    if search.form.E.ray:  # N = (T, 0, ..., 0), T >= 0
        fixed = np.arange(count) % len(entries) > 0
        limits[:count][fixed] = limits[count:-1][fixed] = 0.0
        limits[count:-1][~fixed] = 0.0
    A = sp.vstack([*blocks, sp.csc_matrix(trace), sp.csc_matrix(bounded)]).tocsc()
    b = np.concatenate([np.zeros(A.shape[0] - 1 - len(bounded)), [n], limits])
    cones += [conic.Cone("zero", 1), conic.Cone("nonnegative", len(bounded))]
    q = np.zeros(size)
    q[-1] = -1.0
    return conic.ConeProgram(sp.csc_matrix((size, size)), q, A, b, tuple(cones)), basis


def _radius(search: _Search, leaves: Sequence[Leaf]) -> float:
    """The largest spectral radius over the vertices; infinite where ν is not determined."""
    worst = 0.0
    for leaf in leaves:
        for E in leaf.E:
            try:
                A, _ = _eliminated(search, E)
            except LinAlgError:
                return np.inf
            worst = max(worst, float(np.abs(np.linalg.eigvals(A)).max()))
    return worst


def _refined(search: _Search, tree: Tree, P: FloatArray | None) -> Tree:
    """The leaves that fell short, halved in the variable that helps the most.

    With P and N from a program: that after which the least eigenvalues are the largest. Without:
    that which leaves the smallest ranges of E.
    """
    changed: dict[int, Tree] = {}
    for leaf in _leaves(tree):
        if leaf.margin >= FEASIBLE:
            continue
        halves = []
        for i, (low, high) in list(enumerate(leaf.box))[search.form.E.whole :]:
            middle = (low + high) / 2
            ends = ((low, middle), (middle, high))
            parts = [search.leaf([*leaf.box[:i], end, *leaf.box[i + 1 :]]) for end in ends]
            spread = sum(float(np.ptp(part.E, axis=0).sum()) for part in parts)
            least = [0.0]
            if P is not None and leaf.N is not None:
                least = sorted(_least(search, P, leaf.N, part.E) for part in parts)
            halves.append(((*least, -spread, i), Split(i, (parts[0], parts[1]))))
        changed[id(leaf)] = max(halves, key=lambda half: half[0])[1]
    return _replaced(tree, changed)


def _least(search: _Search, P: FloatArray, N: FloatArray, E: Matrices) -> float:
    """The least eigenvalue over vertices, as seen by P and N of an earlier program."""
    M = _gap(search.F, P, 1.0, search.m) + N @ E + (N @ E).transpose(0, 2, 1)
    return float(np.linalg.eigvalsh(M)[:, 0].min())


def _leaves(tree: Tree) -> list[Leaf]:
    if isinstance(tree, Leaf):
        return [tree]
    return [leaf for part in tree.parts for leaf in _leaves(part)]


def _replaced(tree: Tree, changed: Mapping[int, Tree]) -> Tree:
    if isinstance(tree, Leaf):
        return changed.get(id(tree), tree)
    first, second = (_replaced(part, changed) for part in tree.parts)
    return Split(tree.variable, (first, second))


def _written(tree: Tree) -> Json:
    if isinstance(tree, Leaf):
        assert tree.N is not None
        return {"N": tree.N.tolist()}
    return {"split": tree.variable, "parts": [_written(part) for part in tree.parts]}
