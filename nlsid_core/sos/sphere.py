"""The fast path: the largest m with g(z) - m = v(z)'Xv(z) on |z| = 1, X ⪰ 0.

v holds monomials of degree 1 and 2, g is any function in the span of their products (on the sphere
every polynomial of degree ≤ 4), known only by its values at N unisolvent points:

    maximise m      subject to  v_i'Xv_i + m = g_i  (i = 1..N),  X ⪰ 0
    minimise g'y    subject to  Σ y_i v_i v_i' = Z ⪰ 0,  Σ y_i = 1

Every constraint matrix is rank one, so the Schur complement of the HKM direction is a Hadamard
product, (V X V') ∘ (V Z⁻¹ V'). Both sides have known strictly feasible points, and one least-norm
correction a step keeps the equalities, so every iterate is a certificate.
Source: Löfberg and Parrilo, "From coefficients to samples", CDC 2004; Toh, Todd and Tütüncü,
"SDPT3", 1999, for the predictor-corrector.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.linalg import blas, lapack

from nlsid_core import conic
from nlsid_core.arrays import ArrayLike, BoolArray, FloatArray, IntArray, keep
from nlsid_core.conic import Cone, ConeProgram
from nlsid_core.errors import DataError, ShapeError, SolverError
from nlsid_core.polynomial import monomial_values, monomials

CANDIDATES = 1.5  # random points per equality, of which pivoting keeps the best conditioned ones
ONE = 0.25  # of the weights, of the monomial 1
RANK_TOLERANCE = 1e-12  # of a pivot: what a point adds that is needed is 1e-2, else 1e-14
MAX_ITERATIONS = 60  # 8 to 12 are usual
STEP_TO_BOUNDARY = 0.95  # of the way to where X or Z would be singular; 0.99 loses the centre
REGULARISATIONS = (0.0, 1e-15, 1e-14, 1e-13)  # of M, relative to its diagonal; refined away
CENTRING_POWER = 2  # of Mehrotra's ratio of complementarities
CERTIFY_FROM = 1e-6  # of the spread; from here rounding may undo what an iteration gains
WARM_GAP = 0.03  # of the spread: what an iterate for another g has where that differs much
WARM_ROOM = 3.0  # times what g differs by: closer to the optimum an iterate is no good start
WARM_CLEARANCE = 0.5  # of the distance to the boundary that a warm start has to keep


class Iterate(NamedTuple):
    """X, y and m of the normalised problem on the way to its solution, and upper - m there."""

    X: FloatArray
    y: FloatArray
    m: float
    gap: float


@dataclass(frozen=True, eq=False)
class SphereSolution:
    """m ≤ max m ≤ upper, and the multipliers that show it.

    m: shown up to rounding by X (k, k); upper: the dual bound, from y (N,). Both in the unit of g.
    gap: (upper - m) relative to the spread of g. path: the iterates before it, from any of which a
    similar problem can be started. tau: (L, n+1, n+1) Gram matrices of multipliers chosen before,
    whose products are in g.
    """

    m: float
    upper: float
    X: FloatArray
    y: FloatArray
    gap: float
    iterations: int
    path: tuple[Iterate, ...]
    tau: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 0)))


@dataclass(frozen=True, eq=False)
class _AtPoints:
    """V (N, k): at the points v = root⁻¹·weight·monomials, which is orthonormal on the sphere.

    whiten: (k, k), v by the monomials. unit: (k, k), v'(unit)v = 1 on the sphere, and unit_root its
    inverse Cholesky factor. centre: (N,) weights of the mean on the sphere. normal: (N, N) Cholesky
    factor of (VV')².
    """

    V: FloatArray
    whiten: FloatArray
    unit: FloatArray
    unit_root: FloatArray
    centre: FloatArray
    normal: FloatArray

    @classmethod
    def of(cls, basis: IntArray, weight: FloatArray, points: FloatArray) -> "_AtPoints":
        """Raises SolverError if the points do not determine every product."""
        moments = _sphere_moments(basis) * np.outer(weight, weight)
        values, vectors = np.linalg.eigh(moments)
        whiten = (vectors / np.sqrt(values)) @ vectors.T * weight
        V = monomial_values(basis, points) @ whiten.T
        factor, info = lapack.dpotrf((V @ V.T) ** 2, lower=1, clean=1)
        if info:
            raise SolverError(f"the {len(points)} points are not unisolvent (pivot {info})")
        root = np.linalg.inv(np.linalg.cholesky(moments))
        centre = _sphere_means(factor, V)
        return cls(V, whiten, moments, root, centre, np.asfortranarray(factor))


@dataclass(frozen=True, eq=False)
class SphereProgram:
    """Everything that depends on the number of variables only; build it once and solve often.

    n: variables. nonlinear: indices of the variables that enter nonlinearly; degree-2 monomials
    are kept only if they contain one of them (default: all). constant: whether v has the 1, with
    which g may have terms of degree 1 in the others; where all are nonlinear, the sphere has it as
    the sum of squares. basis: (k, n) exponents of v, lower degree first; weight: (k,), the sum of
    (weight·monomial)² is 1 on the sphere.
    points: (N, n) where g has to be evaluated.

    Raises DataError if there is no nonlinear variable.
    """

    n: int
    nonlinear: tuple[int, ...] | None = None
    constant: bool = False
    basis: IntArray = field(init=False)
    weight: FloatArray = field(init=False)
    points: FloatArray = field(init=False)
    _at: "_AtPoints" = field(init=False)

    def __post_init__(self) -> None:
        chosen = self.chosen
        if not chosen or not set(chosen) <= set(range(self.n)):
            raise DataError(f"n = {self.n}, nonlinear = {chosen}: expected indices below n")
        if self.constant and len(chosen) == self.n:
            raise DataError("1 is |z|² on the sphere, which a program of all variables has")
        high = monomials(self.n, [2])
        low = monomials(self.n, [1])
        one = np.zeros((int(self.constant), self.n), dtype=np.int64)
        basis = np.vstack([one, low, high[high[:, list(chosen)].any(axis=1)]])
        points = unisolvent_points(basis)
        weight = weights_of(basis, np.isin(np.arange(self.n), chosen))
        keep(self, {"basis": basis, "weight": weight, "points": points})
        object.__setattr__(self, "_at", _AtPoints.of(basis, weight, points))

    @property
    def chosen(self) -> tuple[int, ...]:
        """The nonlinear variables, or all."""
        return tuple(range(self.n)) if self.nonlinear is None else tuple(self.nonlinear)

    def solve(
        self,
        g: ArrayLike,
        *,
        tolerance: float = 1e-8,
        start: SphereSolution | None = None,
        enough: float = np.inf,
    ) -> SphereSolution:
        """Maximise m for g (N,), the values at `points`, until `gap` ≤ tolerance.

        start: the solution of a similar problem. enough: where m is above it by more than by what
        it may still grow, it is not maximised further. Clarabel is the fallback, and `iterations`
        then 0.
        Raises ShapeError or DataError on bad values, SolverError if nothing works. Rounding may
        stop a large program at a gap above the tolerance (1e-6 at n = 12): `gap` says so.
        """
        values = np.asarray(g, dtype=np.float64)
        if values.shape != (len(self.points),):
            raise ShapeError(f"g should have {len(self.points)} values, has shape {values.shape}")
        if not np.isfinite(values).all():
            raise DataError("g is not finite on the sphere")
        middle, spread = float(values.mean()), float(np.ptp(values))
        if spread <= 1e-15 * abs(middle):
            path = (Iterate(self._at.unit, self._at.centre, -1.0, 1.0),)
            return SphereSolution(middle, middle, 0 * self._at.unit, self._at.centre, 0.0, 0, path)
        wanted = (enough - middle) / spread
        found = _solved(self, (values - middle) / spread, tolerance, start, wanted)
        return SphereSolution(
            m=middle + spread * found.m,
            upper=middle + spread * found.upper,
            X=found.X * spread,
            y=found.y,
            gap=found.gap,
            iterations=found.iterations,
            path=found.path,
        )

    def gram(self, solution: SphereSolution) -> FloatArray:
        """(k, k) Gram matrix of the solution in the monomials `basis`."""
        Q = self._at.whiten.T @ solution.X @ self._at.whiten
        return np.asarray((Q + Q.T) / 2)


def _solved(
    program: SphereProgram,
    g: FloatArray,
    tolerance: float,
    start: SphereSolution | None,
    enough: float,
) -> SphereSolution:
    """Warm; cold if that fails; Clarabel if that fails too."""
    for first in (start, None) if start is not None else (None,):
        try:
            return _interior_point(program, g, tolerance, first, enough)
        except SolverError:
            continue
    return _through_conic(program, g, tolerance)


def _through_conic(program: SphereProgram, g: FloatArray, tolerance: float) -> SphereSolution:
    """The same program as cone data, x = [m, svec X]."""
    k = program._at.V.shape[1]
    i, j = conic.triangle(k)
    rows = program._at.V[:, i] * program._at.V[:, j] * np.where(i == j, 1.0, conic.SQRT2)
    size = 1 + len(i)
    found = conic.solve(
        ConeProgram(
            P=sp.csc_matrix((size, size)),
            q=np.r_[-1.0, np.zeros(len(i))],
            A=sp.vstack([np.c_[np.ones(len(g)), rows], -sp.eye(size, format="csr")[1:]], "csc"),
            b=np.r_[g, np.zeros(len(i))],
            cones=(Cone("zero", len(g)), Cone("psd", k)),
        ),
        tolerance=tolerance,
    )
    first = Iterate(*_first_iterate(program, g, None), gap=1.0)
    y, m = found.z[: len(g)] / found.z[: len(g)].sum(), float(found.x[0])
    X, upper = conic.smat(found.x[1:]), float(g @ y)
    return _certified(program, g, SphereSolution(m, upper, X, y, upper - m, 0, (first,)))


def _interior_point(
    program: SphereProgram,
    g: FloatArray,
    tolerance: float,
    start: SphereSolution | None,
    enough: float,
) -> SphereSolution:
    """Predictor-corrector along the HKM direction, for g of spread 1."""
    V, ones = program._at.V, np.ones(len(g))
    k = V.shape[1]
    X, y, m = _first_iterate(program, g, start)
    best: SphereSolution | None = None
    path: tuple[Iterate, ...] = ()
    M, work = (np.zeros((len(g), len(g)), order="F") for _ in range(2))  # lower triangles, reused
    for iteration in range(MAX_ITERATIONS + 1):
        Z = (V.T * y) @ V
        upper, mu = float(g @ y), float(np.vdot(X, Z)) / k
        path += (Iterate(X, y, m, upper - m),)
        if upper - m <= max(tolerance, CERTIFY_FROM, m - enough):
            found = SphereSolution(m, upper, X, y, upper - m, iteration, path)
            found = _certified(program, g, found)
            if best is not None and found.gap >= best.gap:
                return best
            best = found
            if upper - m <= max(tolerance, found.m - enough):
                return best
        Lx, Lz = _factor(X), _factor(Z)
        if Lx is None or Lz is None:
            break
        inverse, _ = lapack.dtrtri(Lz, lower=1)
        across, dual = V @ Lx, V @ inverse.T
        M = blas.dsyrk(1.0, across, beta=0.0, c=M, overwrite_c=1, lower=1)
        work = blas.dsyrk(1.0, dual, beta=0.0, c=work, overwrite_c=1, lower=1)
        np.multiply(M, work, out=M)
        factor = _factor_or_regularise(M, work)
        if factor is None:
            break
        # M y = diag(VXV'), so dy = shift - y + dm·unit: only small right-hand sides are solved for.
        unit = _solve(M, factor, ones)
        inverse_Z = inverse.T @ inverse
        dm = 1.0 / unit.sum()
        dZ = (V.T * (dm * unit - y)) @ V
        dX = -X - _symmetric(X @ dZ @ inverse_Z)
        a, b = _step(dX, Lx), _step(dZ, Lz)
        predicted = float(np.vdot(X + a * dX, Z + b * dZ)) / k
        aim = mu * min(1.0, max(predicted / mu, 0.0)) ** CENTRING_POWER
        second = _symmetric(dX @ dZ @ inverse_Z)
        diagonal = np.einsum("ij,ij->i", dual, dual)
        bend = np.einsum("ij,ij->i", V @ second, V)
        missing = g - m - np.einsum("ij,ij->i", V @ X, V)
        shift = _solve(M, factor, aim * diagonal - bend - missing)
        dm = (1.0 - shift.sum()) / unit.sum()
        dy = shift + dm * unit - y
        dZ = (V.T * dy) @ V
        dX = aim * inverse_Z - second - X - _symmetric(X @ dZ @ inverse_Z)
        a, b = _step(dX, Lx), _step(dZ, Lz)
        X, m, y = X + a * dX, m + a * dm, y + b * dy
    if best is not None:
        return best
    raise SolverError(
        f"sphere program of {k} monomials: stopped at gap {upper - m:.1e} of the spread after "
        f"{iteration} iterations; asked for {tolerance:.1e}"
    )


def _first_iterate(
    program: SphereProgram, g: FloatArray, start: SphereSolution | None
) -> tuple[FloatArray, FloatArray, float]:
    """Strictly feasible X, y, m: the least-norm X that meets the equalities, shifted."""
    if start is None:
        X, y, m = 0 * program._at.unit, program._at.centre, float(np.min(g))
        clearance = 1.0
    else:
        # The dual constraints do not depend on g, so y stays feasible; X is corrected and shifted.
        X, y, m = _nearby(program, g, start.path)
        clearance = WARM_CLEARANCE * _lowest(program, X)
    X = _corrected(program, X, g - m)
    shift = max(0.0, clearance - _lowest(program, X)) if start else clearance - _lowest(program, X)
    return X + shift * program._at.unit, y, m - shift


def _nearby(
    program: SphereProgram, g: FloatArray, path: tuple[Iterate, ...]
) -> tuple[FloatArray, FloatArray, float]:
    """The last of another g's iterates that is as far from its boundary as the two g differ."""
    V, (X, y, m, _) = program._at.V, path[0]
    differ = float(np.ptp(g - m - np.einsum("ij,ij->i", V @ X, V)))
    least = min(WARM_GAP, WARM_ROOM * differ)
    for iterate in path:
        if iterate.gap < least:
            break
        X, y, m, _ = iterate
    return X, y, m


def _certified(program: SphereProgram, g: FloatArray, found: SphereSolution) -> SphereSolution:
    """Meet the equalities to rounding, and give up as much of m as keeps X positive definite."""
    X = _corrected(program, found.X, g - found.m)
    shift = max(0.0, -_lowest(program, X)) * (1 + 1e-6)
    m = found.m - shift
    return replace(found, X=X + shift * program._at.unit, m=m, gap=found.upper - m)


def _lowest(program: SphereProgram, X: FloatArray) -> float:
    """The largest t with X - t·unit ⪰ 0; v'(unit)v = 1 on the sphere, so m moves by t."""
    relative = program._at.unit_root @ X @ program._at.unit_root.T
    return float(np.linalg.eigvalsh(_symmetric(relative))[0])


def _corrected(program: SphereProgram, X: FloatArray, values: FloatArray) -> FloatArray:
    """X plus the least-norm matrix that makes v_i'Xv_i equal the values."""
    V = program._at.V
    residual = values - np.einsum("ij,ij->i", V @ X, V)
    w = lapack.dpotrs(program._at.normal, residual, lower=1)[0]
    X = X + (V.T * w) @ V
    return np.asarray((X + X.T) / 2)


def _factor(A: FloatArray) -> FloatArray | None:
    L, info = lapack.dpotrf(A, lower=1, clean=1)
    return None if info else np.asarray(L)


def _factor_or_regularise(M: FloatArray, work: FloatArray) -> FloatArray | None:
    """Cholesky factor of M, in `work`, with the least regularisation that lets it complete."""
    diagonal = np.diag_indices(len(M))
    for regularisation in REGULARISATIONS:
        np.copyto(work, M)
        if regularisation:
            work[diagonal] *= 1 + regularisation
        factor, info = lapack.dpotrf(work, lower=1, clean=0, overwrite_a=1)
        if not info:
            return np.asarray(factor)
    return None


def _solve(M: FloatArray, factor: FloatArray, rhs: FloatArray) -> FloatArray:
    """M⁻¹rhs refined once: M has condition 1e16 near the end, and the equalities need it.

    A second refinement was never seen to change the number of iterations.
    """
    x = lapack.dpotrs(factor, rhs, lower=1)[0]
    residual = blas.dsymv(-1.0, M, x, beta=1.0, y=rhs, lower=1)
    return np.asarray(x + lapack.dpotrs(factor, residual, lower=1)[0])


def _symmetric(A: FloatArray) -> FloatArray:
    return np.asarray((A + A.T) / 2)


def _step(dA: FloatArray, L: FloatArray) -> float:
    """The longest step that keeps LL' + step·dA positive definite, with a margin; at most 1."""
    half, _ = lapack.dtrtrs(L, dA, lower=1)
    relative, _ = lapack.dtrtrs(L, half.T, lower=1)
    lowest = float(lapack.dsyevr(relative, compute_v=0, range="I", il=1, iu=1)[0][0])
    return min(1.0, STEP_TO_BOUNDARY / -lowest) if lowest < 0 else 1.0


def weights_of(basis: IntArray, chosen: BoolArray) -> FloatArray:
    """(k,) with Σ (weight·monomial)² = 1 on the sphere.

    All chosen: ½|z|^2d for both degrees d; else |z_l|² + ½|z_nl|² + ½|z_nl|²|z|². With 1 in the
    basis that is three quarters of it.
    """
    weight = multinomials(basis) / 2
    linear = ~chosen[basis.argmax(axis=1)] & (basis.sum(axis=1) == 1)
    mixed = (basis.sum(axis=1) == 2) & (basis[:, ~chosen].sum(axis=1) == 1)
    weight[linear] = 1.0
    weight[mixed] = 0.5
    one = ~basis.any(axis=1)
    weight *= 1 - ONE * one.sum()
    weight[one] = ONE
    return np.sqrt(weight)


def multinomials(rows: IntArray) -> FloatArray:
    """The coefficient of each squared monomial, of degree ≤ 2, in its power of |z|²."""
    factorials = np.array([1.0, 1.0, 2.0])
    return np.asarray(factorials[rows.sum(axis=1)] / factorials[rows].prod(axis=1))


def unisolvent_points(basis: IntArray) -> FloatArray:
    """Points on the sphere that determine every function in the span of products of the basis.

    The square of a kernel of the basis is one of its products, and a pivot is what a point adds.
    """
    n = basis.shape[1]
    rng = np.random.default_rng(n)  # one fixed set per n: results repeat
    count = len(np.unique((basis[:, None] + basis[None]).reshape(-1, n), axis=0))
    cloud = _cloud(rng, count, n)
    v = monomial_values(basis, cloud) * np.sqrt(multinomials(basis))
    v /= np.linalg.norm(v, axis=1)[:, None]
    gram = (v @ v.T) ** 2
    _, order, rank, _ = lapack.dpstrf(gram.T, lower=1, tol=RANK_TOLERANCE, overwrite_a=1)
    return np.asarray(cloud[np.sort(order[:rank] - 1)])


def _cloud(rng: np.random.Generator, count: int, n: int) -> FloatArray:
    """Random points on the sphere, more than the `count` of them that are wanted."""
    points = rng.normal(size=(int(CANDIDATES * count) + 10, n))
    return np.asarray(points / np.linalg.norm(points, axis=1)[:, None])


def _sphere_moment(exponents: IntArray) -> FloatArray:
    """Mean over the unit sphere of each monomial: Π (a_i - 1)!! / (n (n + 2) …), zero if odd."""
    n = exponents.shape[1]
    odd_factorial = np.array([1.0, 0.0, 1.0, 0.0, 3.0, 0.0, 15.0])
    result = odd_factorial[exponents].prod(axis=-1)
    for step in range(3):
        result = result / np.where(exponents.sum(axis=-1) > 2 * step, n + 2 * step, 1)
    return np.asarray(result)


def _sphere_moments(basis: IntArray) -> FloatArray:
    """(k, k) means of products of the basis."""
    k, n = basis.shape
    pairs = (basis[:, None] + basis[None]).reshape(-1, n)
    return _sphere_moment(pairs).reshape(k, k)


def _sphere_means(factor: FloatArray, V: FloatArray) -> FloatArray:
    """Weights y with Σ y_i p(z_i) = mean of p on the sphere: Σ y_i v_i v_i' = I, in least norm."""
    rhs = np.einsum("ij,ij->i", V, V)
    return np.asarray(lapack.dpotrs(factor, rhs, lower=1)[0])
