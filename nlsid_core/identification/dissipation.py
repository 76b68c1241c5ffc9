"""`prove_gain`, `prove_passivity`: how much two runs of a model with two inputs can differ.

The kernel's own driven reading of the model file gives F, H and the vertices E of
    diag(0, P, 0) - λ F'PF + s(w̄, H z) + sym(N E) ≻ 0,   s = γ²|w̄|² - |ȳ|²  or  2w̄'ȳ - 2ι|w̄|².
It is linear in P, N and γ² (or -ι), so the least is one cone program; a second one, a little above
the least, finds P and N with the most room, and the kernel decides them. Source:
docs/certificate_dissipation.md.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
import scipy.sparse as sp
from scipy.linalg import LinAlgError, block_diag

from nlsid_core import conic, files, kernel, proofs
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.errors import CertificateRejected, DataError, SolverError
from nlsid_core.kernel import increments
from nlsid_core.kernel.files import parse
from nlsid_core.kernel.matrix_polynomials import Box

ROOMS = (1e-4, 1e-3, 1e-2, 0.1)  # relative, above the least γ², tried until the kernel proves it
LARGEST = 1e4  # entry of a multiplier in balanced units: where nothing else bounds it
FREQUENCIES = 512  # from 0 to half the sampling rate, at which the mean's response is looked at
SOLVER = "clarabel refined"  # alone: where it stalls, slower ones find nothing better
OUTPUTS = (1.0, 10.0, 1e3)  # of the output's unit, larger where a storage is much more than seen
BALANCES = 3  # programs, after which units of the state change little
CORNERS = 16  # vertices that balance a program
MOST_LEAVES = 16  # of a box whose vertices are too coarse
LEAST_GRAMIAN = 1e-8  # of its mean: states that the output hardly sees

# A box, or the entry that is halved and what becomes of the halves.
Tree: TypeAlias = "Box | tuple[int, tuple[Tree, Tree]]"


@dataclass(frozen=True, eq=False)
class DissipationProof:
    """Σ λ^t |ȳ|² <= γ² Σ λ^t |ū|² + V(0), or Σ λ^t ū'ȳ >= ι Σ λ^t |ū|² - V(0)/2, V = x̄'Px̄.

    kind: gain or passivity, of γ or ι = number. ū, ȳ: differences of two runs, in units of
    `u_scales` and `y_scales`. box: {y, u} or {y} that both runs stay in; None if everywhere.
    Decided by the kernel.
    """

    kind: Literal["gain", "passivity"]
    number: float
    discount: float
    u_scales: FloatArray
    y_scales: FloatArray
    box: Json | None
    P: FloatArray
    multipliers: Json | None

    def document(self, model: Any, file: str) -> Json:
        """The proof file's content for the model it was made for, stored in `file` beside it."""
        claim: Json = {
            "kind": "dissipation",
            "about": {"model": proofs.binding(file, model.document())},
            "supply": {"kind": self.kind, "number": self.number},
            "discount": self.discount,
            "scales": {"u": self.u_scales.tolist(), "y": self.y_scales.tolist()},
        }
        if self.box is not None:
            claim["box"] = self.box
        proof: Json = {"P": self.P.tolist()}
        if self.multipliers is not None:
            proof["multipliers"] = self.multipliers
        return proofs.proof_document(claim, proof)


def prove_gain(
    model: Any,
    *,
    discount: float = 1.0,
    u_scales: Sequence[float] | None = None,
    y_scales: Sequence[float] | None = None,
    box: Json | None = None,
) -> DissipationProof | None:
    """The least incremental l2 gain that one quadratic storage proves, or None if it finds none.

    u_scales, y_scales: units of inputs and outputs, 1 by default. Raises DataError for a model or a
    box of which the kernel has no increments.
    """
    return _proved(model, "gain", discount, u_scales, y_scales, box)


def prove_passivity(
    model: Any,
    *,
    discount: float = 1.0,
    u_scales: Sequence[float] | None = None,
    y_scales: Sequence[float] | None = None,
    box: Json | None = None,
) -> DissipationProof | None:
    """The largest index of incremental passivity that one quadratic storage proves, or None.

    As `prove_gain`. A negative one is how much of |ū|² the model falls short of being passive.
    """
    return _proved(model, "passivity", discount, u_scales, y_scales, box)


@dataclass(frozen=True, eq=False)
class _Form:
    """Balanced: F (N, m + N + q), H (p, same), E of each leaf, S of z = S z', D of E' = D E S."""

    F: FloatArray
    H: FloatArray
    leaves: list[FloatArray]
    m: int
    q: int
    ray: bool
    S: FloatArray
    D: FloatArray
    output: float
    unit: float  # of the supply: the output's, squared of a gain

    def supply(self, kind: str) -> tuple[FloatArray, FloatArray]:
        """S0 + g S1, g = γ² or -ι, in units of the output."""
        size = self.F.shape[1]
        W = np.eye(size)[size - self.q :]
        if kind == "gain":
            return -self.H.T @ self.H, W.T @ W
        return W.T @ self.H + self.H.T @ W, 2.0 * W.T @ W

    def gap(self, P: FloatArray, discount: float) -> FloatArray:
        """diag(0, P, 0) - λ F'PF, for P (..., N, N)."""
        gap = -discount * np.asarray(self.F.T @ P @ self.F)
        states = slice(self.m, self.F.shape[1] - self.q)
        gap[..., states, states] += P
        return gap


def _proved(
    model: Any,
    kind: Literal["gain", "passivity"],
    discount: float,
    u_scales: Sequence[float] | None,
    y_scales: Sequence[float] | None,
    box: Json | None,
) -> DissipationProof | None:
    bounds = None if box is None else parse(files.encode(box), "box")
    try:
        read = increments.read_model(
            parse(files.encode(model.document()), "model"), bounds, driven=True
        )
    except kernel.Rejected as refusal:
        raise DataError(f"the model has no increments for two inputs: {refusal}") from refusal
    p, q = len(read.H), read.driven
    if not q:
        raise DataError(
            "the model has no inputs, so nothing drives two runs apart: its proof of stability "
            "says how fast they approach each other"
        )
    u = np.ones(q) if u_scales is None else np.asarray(u_scales, dtype=np.float64)
    y = np.ones(p) if y_scales is None else np.asarray(y_scales, dtype=np.float64)
    if u.shape != (q,) or y.shape != (p,) or not (min(u) > 0.0 and min(y) > 0.0):
        raise DataError(f"scales should be {q} of inputs and {p} of outputs, all positive")
    if kind == "passivity" and p != q:
        raise DataError(f"passivity needs as many inputs as outputs; the model has {q} and {p}")
    if kind == "passivity" and read.limits == "clip":
        raise DataError(
            "the model clips its inputs to a range, and no index of passivity is proved of such: "
            "what is applied differs by less than what is given, which a gain allows and a "
            "product does not. Identify it with on_out_of_range: refuse"
        )
    if not 0.0 < discount <= 1.0:
        raise DataError(f"the discount should satisfy 0 < discount <= 1, not {discount}")
    tree: Tree = read.box
    least, storage, form = np.inf, None, None
    while storage is None and len(_leaves(tree)) <= MOST_LEAVES:
        for times in OUTPUTS:
            for _ in range(BALANCES):  # each balanced by the storage of the one before
                try:
                    form = _balanced(read, tree, kind, u, y, discount, storage, times)
                    z = conic.solve(_program(form, kind, discount, None), SOLVER).x
                except (SolverError, LinAlgError):
                    break
                least, storage = float(z[-2]), _outside(form, _storage(form, z))
            if storage is not None:
                break
        if read.whole == len(read.box):
            break
        tree = tree if storage is not None else _halved(read, tree)
    if storage is None or form is None:
        return None
    for room in ROOMS:
        g = least + room * (abs(least) if kind == "gain" else max(abs(least), room))
        found = _with_room(form, kind, discount, g)
        if found is None:
            continue
        P, Ns = found
        multipliers = _written(tree, iter(Ns)) if form.m else None
        number = float(np.sqrt(g) if kind == "gain" else -g) * form.output
        proof = DissipationProof(kind, number, discount, u, y, box, P, multipliers)
        try:
            document = proof.document(model, "model.json")
            proofs.decide(document, {"model.json": model.document()})
        except CertificateRejected:
            continue
        return proof
    return None


def _balanced(
    read: increments.Model,
    tree: Tree,
    kind: str,
    u: FloatArray,
    y: FloatArray,
    discount: float,
    P: FloatArray | None,
    times: float,
) -> _Form:
    """Inputs and outputs in their scales, the output then in units of the largest response seen.

    times: of that unit, while there is no P.

    States in units of P, or of the mean's observability Gramian; ν of what it moves state and
    output by; E with an identity in ν at its mean.
    """
    m, q, n = read.unknowns, read.driven, read.states
    F = np.array(read.F, dtype=np.float64)
    H = np.array(read.H, dtype=np.float64) / y[:, None]
    leaves = [np.array(read.vertices(box, None), dtype=np.float64) for box in _leaves(tree)]
    mean = np.mean([E.mean(axis=0) for E in leaves], axis=0) if m else np.zeros((0, F.shape[1]))
    F[:, m + n :] *= u
    H[:, m + n :] *= u
    mean[:, m + n :] *= u
    responses = [_explicit(F, H, mean, m)]
    if m:
        some = [E * np.r_[np.ones(m + n), u] for leaf in leaves for E in leaf]
        responses += [_explicit(F, H, E, m) for E in some[:: max(1, len(some) // CORNERS)]]
    peaks = [_peak(AB * np.sqrt(discount), CD) for AB, CD in responses]
    output = (max(peaks) or 1.0) * (times if P is None else 1.0)
    H, unit = H / output, output**2 if kind == "gain" else output
    if P is None:
        seen = [_observed(AB[:, :n] * np.sqrt(discount), CD[:, :n]) for AB, CD in responses]
        P = np.mean(seen, axis=0) * (times / output) ** 2
    else:
        P = P / unit
    values, vectors = np.linalg.eigh((P + P.T) / 2.0)
    values = np.maximum(values, LEAST_GRAMIAN * values.mean())
    root = (vectors * np.sqrt(values)) @ vectors.T  # x' = root x
    moved = np.linalg.norm(np.vstack([root @ F[:, :m], H[:, :m]]), axis=0)
    nu = 1.0 / np.where(moved > 0.0, moved, 1.0)
    inside = block_diag(np.diag(nu), np.linalg.inv(root), np.eye(q))
    S = block_diag(np.diag(nu), np.linalg.inv(root), np.diag(u))
    D = np.linalg.inv(mean[:, :m] * nu)
    E = [D @ leaf @ S for leaf in leaves if m]
    return _Form(root @ F @ inside, H @ inside, E, m, q, read.ray, S, D, output, unit)


def _explicit(F: FloatArray, H: FloatArray, E: FloatArray, m: int) -> tuple[FloatArray, FloatArray]:
    """[A, B] and [C, D] with ν eliminated by E."""
    solved = np.linalg.solve(E[:, :m], E[:, m:])
    AB, CD = (rows[:, m:] - rows[:, :m] @ solved for rows in (F, H))
    return AB, CD


def _peak(AB: FloatArray, CD: FloatArray) -> float:
    """The largest response over the frequencies of a grid; 0 on one where there is a pole."""
    n = len(AB)
    A, B, C, D = AB[:, :n], AB[:, n:], CD[:, :n], CD[:, n:]
    z = np.exp(1j * np.linspace(0.0, np.pi, FREQUENCIES))
    try:
        G = C @ np.linalg.solve(z[:, None, None] * np.eye(n) - A, B[None]) + D
    except LinAlgError:
        return 0.0
    return float(np.linalg.svd(G, compute_uv=False)[:, 0].max())


def _observed(A: FloatArray, C: FloatArray) -> FloatArray:
    """P = A'PA + C'C by doubling, or a finite part of the sum."""
    P, power = C.T @ C, A
    for _ in range(30):
        after = P + power.T @ P @ power
        if not np.isfinite(after).all() or np.abs(after).max() > 1e12 * np.abs(C.T @ C).max():
            break
        P, power = after, power @ power
    return P


def _leaves(tree: Tree) -> list[Box]:
    if isinstance(tree, list):
        return [tree]
    return [leaf for part in tree[1] for leaf in _leaves(part)]


def _halved(read: increments.Model, tree: Tree) -> Tree:
    """Every leaf halved in the variable that leaves the smallest ranges of E."""
    if not isinstance(tree, list):
        i, (first, second) = tree
        return i, (_halved(read, first), _halved(read, second))
    best: tuple[float, Tree] | None = None
    for i, (low, high) in list(enumerate(tree))[read.whole :]:
        middle = (low + high) / 2
        parts = [[*tree[:i], half, *tree[i + 1 :]] for half in ((low, middle), (middle, high))]
        spread = sum(
            float(np.ptp(np.array(read.vertices(part, None), dtype=np.float64), axis=0).sum())
            for part in parts
        )
        if best is None or spread < best[0]:
            best = spread, (i, (parts[0], parts[1]))
    assert best is not None
    return best[1]


def _written(tree: Tree, Ns: Iterator[FloatArray]) -> Json:
    """The tree of multipliers as a proof file holds it."""
    if isinstance(tree, list):
        return {"N": next(Ns).tolist()}
    return {"split": tree[0], "parts": [_written(part, Ns) for part in tree[1]]}


def _storage(form: _Form, z: FloatArray) -> FloatArray:
    n = len(form.F)
    return np.asarray(np.tensordot(z[: n * (n + 1) // 2], _symmetric(n), axes=1))


def _outside(form: _Form, P: FloatArray) -> FloatArray:
    """P in the model's own units of the state."""
    m, n = form.m, len(form.F)
    inverse = np.linalg.inv(form.S[m : m + n, m : m + n])
    outside = inverse.T @ P @ inverse * form.unit
    return np.asarray((outside + outside.T) / 2.0)


def _symmetric(n: int) -> FloatArray:
    rows, columns = np.triu_indices(n)
    basis = np.zeros((len(rows), n, n))
    basis[np.arange(len(rows)), rows, columns] = basis[np.arange(len(rows)), columns, rows] = 1.0
    return basis


def _with_room(
    form: _Form, kind: str, discount: float, g: float
) -> tuple[FloatArray, list[FloatArray]] | None:
    """P and the leaves' N at this γ² or -ι, in the model's units."""
    try:
        z = conic.solve(_program(form, kind, discount, g), SOLVER).x
    except SolverError:
        return None
    m, n = form.m, len(form.F)
    P = _outside(form, _storage(form, z))
    size, inverse = form.F.shape[1], np.linalg.inv(form.S).T
    Ns = z[n * (n + 1) // 2 : -2].reshape(len(form.leaves), size, m)
    Ns = inverse @ Ns @ form.D * form.unit
    if form.ray:
        Ns[:, 1:, 0] = 0.0
    return P, list(Ns)


def _program(form: _Form, kind: str, discount: float, g: float | None) -> conic.ConeProgram:
    """The least g with every vertex's matrix ⪰ 0, or for a given g the most t with ⪰ t I.

    Unknowns [P; N; g; t].
    """
    m, n, size = form.m, len(form.F), form.F.shape[1]
    basis = _symmetric(n)
    entries = np.eye(size * m).reshape(size * m, size, m)
    unknowns = len(entries) * len(form.leaves)
    count = len(basis) + unknowns + 2
    S0, S1 = form.supply(kind)
    inner = conic.svec(form.gap(basis, discount)).T
    blocks, b, cones = [], [], []
    for i, E in [(i, E) for i, leaf in enumerate(form.leaves) for E in leaf] or [(0, None)]:
        part = np.zeros((inner.shape[0], count))
        part[:, : len(basis)] = inner
        if E is not None:
            X, place = entries @ E, len(basis) + i * len(entries)
            part[:, place : place + len(entries)] = conic.svec(X + X.transpose(0, 2, 1)).T
        part[:, -2] = conic.svec(S1)
        part[:, -1] = -conic.svec(np.eye(size))
        blocks.append(sp.csc_matrix(-part))
        b.append(conic.svec(S0))
        cones.append(conic.Cone("psd", size))
    positive = np.zeros((n * (n + 1) // 2, count))
    positive[:, : len(basis)] = conic.svec(basis).T
    positive[:, -1] = -conic.svec(np.eye(n))
    blocks.append(sp.csc_matrix(-positive))
    b.append(np.zeros(len(positive)))
    cones.append(conic.Cone("psd", n))
    fixed = np.zeros((1, count))
    fixed[0, -1 if g is None else -2] = 1.0
    blocks.append(sp.csc_matrix(fixed))
    b.append(np.array([0.0 if g is None else g]))
    cones.append(conic.Cone("zero", 1))
    upper, lower = np.full((2, unknowns), LARGEST)
    if form.ray:  # N = (T, 0, ..., 0), T >= 0
        upper[1:] = lower[1:] = lower[0] = 0.0
    own = sp.eye_array(unknowns, count, k=len(basis), format="csc")
    last = sp.csc_matrix(([1.0], ([0], [count - 1])), (1, count))
    bounded = sp.vstack([own, -own, last])
    blocks.append(bounded)
    b.append(np.concatenate([upper, lower, [1.0]]))
    cones.append(conic.Cone("nonnegative", bounded.shape[0]))
    objective = np.zeros(count)
    objective[-2 if g is None else -1] = 1.0 if g is None else -1.0
    return conic.ConeProgram(
        sp.csc_matrix((count, count)),
        objective,
        sp.csc_matrix(sp.vstack(blocks)),
        np.concatenate(b),
        tuple(cones),
    )
