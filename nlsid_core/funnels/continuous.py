"""`ContinuousFunnel`: {x : V(t, x) ≤ 1} with V = |x - x₀(t)|²_{P(t)} / ρ(t), thesis Section 6.1."""

from dataclasses import dataclass
from functools import cached_property
from math import gamma, pi

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import ArrayLike, FloatArray, Json, keep
from nlsid_core.dynamics.piecewise import PiecewisePolynomial, linear_through
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.funnels.factor import STEPS, UNIT, factor_of, rounding_of

FORMAT, KIND = "nlsid/funnel", "continuous"

ROUNDING = 1e-12  # by which a time may miss the ends: 0.1 added up ten times misses 1


@dataclass(frozen=True, eq=False)
class ContinuousFunnel:
    """x: nominal states (n,), continuous, cubic at most. P: (K, n, n) and rho: (K,) at its knots.

    P and ρ are linear between knots. vector_field and policy are digests of what it was made for.
    A funnel by itself claims nothing: its proof does.

    Raises ShapeError or DataError if parts do not fit, P is not symmetric positive definite or
    ρ is not positive.
    """

    x: PiecewisePolynomial
    P: FloatArray
    rho: FloatArray
    vector_field: str
    policy: str

    def __post_init__(self) -> None:
        P, rho = np.array(self.P, dtype=np.float64), np.array(self.rho, dtype=np.float64)
        n, knots = self.n, len(self.x.t)
        if P.shape != (knots, n, n) or rho.shape != (knots,):
            raise ShapeError(
                f"P should be {(knots, n, n)} and rho {(knots,)}, are {P.shape} and {rho.shape}"
            )
        if not (np.isfinite(P).all() and (P.transpose(0, 2, 1) == P).all()):
            raise DataError("P should be finite and symmetric at every knot")
        if not (np.isfinite(rho).all() and (rho > 0).all()):
            raise DataError(f"rho should be positive at every knot, its least is {np.min(rho):g}")
        lowest = np.linalg.eigvalsh(P)[:, 0]
        if not (lowest > 0).all():
            k = int(np.argmin(lowest))
            raise DataError(f"P is not positive definite at knot {k} (eigenvalue {lowest[k]:.3g})")
        if not self.x.is_continuous():
            raise DataError("the nominal states of a funnel should be continuous")
        keep(self, {"P": P, "rho": rho})

    @property
    def n(self) -> int:
        """The number of states."""
        return int(self.x.control.shape[-1])

    @property
    def t(self) -> FloatArray:
        """(K,) knots in s."""
        return self.x.t

    @property
    def t0(self) -> float:
        """Start in s."""
        return float(self.x.t[0])

    @property
    def tf(self) -> float:
        """End in s."""
        return float(self.x.t[-1])

    @property
    def made_for(self) -> tuple[str, str]:
        """The digests of the vector field and of the policy."""
        return self.vector_field, self.policy

    @property
    def last(self) -> float:
        """The end in s: the last moment that the proof covers."""
        return self.tf

    @cached_property
    def factors(self) -> FloatArray:
        """(K, n, n) upper triangular F at the knots, F'F = P; DataError if P is not ≻ 0."""
        return np.array([factor_of(P) for P in self.P])

    @cached_property
    def rounding(self) -> FloatArray:
        """(K,) what rounding can hide of |F x̄|, of itself; DataError if that is too much."""
        return rounding_of(self.factors, "the funnel's P")

    def size(self, when: float, deviation: FloatArray) -> float:
        """√V of x - x₀ (n,) at `when` s, x₀ as `nominal` gives it; 1 on the boundary, rounded up.

        P is linear between knots, so |x̄|²_P is a mean of |F x̄|² at two knots: nothing cancels.
        """
        t = self._inside(when)
        k = int(self.x.piece(t))
        step = self.t[k + 1] - self.t[k]
        early, late = (self.t[k + 1] - t) / step, (t - self.t[k]) / step
        F = self.factors[k : k + 2]
        before, after = np.square(np.linalg.norm(F @ deviation, axis=1)).tolist()
        rho = early * self.rho[k] + late * self.rho[k + 1]
        at_nominal = STEPS * UNIT * np.abs(self.x.control[k]).max(axis=0)  # of evaluating x₀
        lost = np.linalg.norm(np.abs(F) @ at_nominal, axis=1).max()
        size = (np.sqrt(early * before + late * after) + lost) / np.sqrt(rho)
        return float(size * (1.0 + max(self.rounding[k : k + 2])))

    def start_size(self, x_bar: FloatArray) -> float:
        """How far out of the set at the start x - x₀ (n,) is: 1 on its boundary, rounded up."""
        return self.size(self.t0, x_bar)

    def widths(self, when: float) -> FloatArray:
        """(n,) the largest |x̄_i| in the set at `when` s, in the states' units."""
        return np.sqrt(np.diag(np.linalg.inv(self.shape(when))))

    def nominal(self, t: float) -> FloatArray:
        """(n,) x₀(t)."""
        return np.asarray(self.x(self._inside(t)))

    def shape(self, t: float) -> FloatArray:
        """(n, n) P(t)/ρ(t): the ellipsoid is |x - x₀|² ≤ 1 in this norm."""
        P = linear_through(self.t, self.P)(self._inside(t))
        return np.asarray(P / linear_through(self.t, self.rho)(t))

    def value(self, t: float, X: ArrayLike) -> FloatArray:
        """V(t, x) at states X (N, n), (N,); at most 1 inside."""
        x_bar = self._states(X) - self.nominal(t)
        return np.asarray(np.einsum("ni,ij,nj->n", x_bar, self.shape(t), x_bar))

    def boundary(self, t: float, directions: ArrayLike) -> FloatArray:
        """The boundary points (N, n) that the unit sphere's points (N, n) are mapped to."""
        L = np.linalg.cholesky(self.shape(t))
        return self.nominal(t) + np.linalg.solve(L.T, np.asarray(directions, float).T).T

    def volume(self, t: float) -> float:
        """Volume of {V(t, ·) ≤ 1} in the states' units."""
        n = self.n
        unit_ball = pi ** (n / 2) / gamma(n / 2 + 1)
        return float(unit_ball / np.sqrt(np.linalg.det(self.shape(t))))

    def volume_integral(self) -> float:
        """∫ volume dt over the knots by the trapezoidal rule."""
        volumes = np.array([self.volume(s) for s in self.t])
        return float((volumes[1:] + volumes[:-1]) @ np.diff(self.t) / 2)

    def outline(self, t: float, axes: tuple[int, int], points: int = 100) -> FloatArray:
        """(points, 2): the boundary of the projection onto two axes."""
        chosen = list(axes)
        shadow = np.linalg.inv(self.shape(t))[np.ix_(chosen, chosen)]
        angle = np.linspace(0, 2 * np.pi, points)
        unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return np.asarray(self.nominal(t)[chosen] + unit @ np.linalg.cholesky(shadow).T)

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {
            "format": FORMAT,
            "version": files.VERSION,
            "kind": KIND,
            "vector_field": self.vector_field,
            "policy": self.policy,
            "t": self.t.tolist(),
            "x": self.x.control.tolist(),
            "P": self.P.tolist(),
            "rho": self.rho.tolist(),
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "funnel") -> "ContinuousFunnel":
        """Raises DocumentError if the document is not a funnel of this kind."""
        files.header(document, FORMAT, source=source, kind=KIND)
        t = files.array(document, "t", (None,), source=source)
        return cls(
            PiecewisePolynomial(t, files.array(document, "x", (None, None, None), source=source)),
            files.array(document, "P", (None, None, None), source=source),
            files.array(document, "rho", (None,), source=source),
            files.member(document, "vector_field", str, source=source),
            files.member(document, "policy", str, source=source),
        )

    def _inside(self, t: float) -> float:
        """The time t, or the end that it misses by rounding."""
        nearest = min(max(t, self.t0), self.tf)
        if not abs(t - nearest) <= ROUNDING * (1.0 + abs(nearest)):
            raise DataError(f"t = {t!r} s; the funnel is defined from {self.t0:g} to {self.tf:g} s")
        return nearest

    def _states(self, X: ArrayLike) -> FloatArray:
        X = np.asarray(X, dtype=np.float64)
        if X.ndim != 2 or X.shape[1] != self.n:
            raise ShapeError(f"states should have shape (N, {self.n}), have {X.shape}")
        return X


def ellipsoid_inside(
    inner_centre: ArrayLike, inner: ArrayLike, outer_centre: ArrayLike, outer: ArrayLike
) -> float | None:
    """A multiplier λ that shows {|x-a|²_A ≤ 1} ⊂ {|x-b|²_B ≤ 1}, or None if none was found.

    S-lemma: λ ≥ 0 with [λA - B, -B(a-b); ·, 1 - λ - |a-b|²_B] ⪰ 0. The smallest eigenvalue is
    concave in λ; golden-section search in floating point.
    """
    A, B = np.asarray(inner, dtype=np.float64), np.asarray(outer, dtype=np.float64)
    d = np.asarray(inner_centre, dtype=np.float64) - np.asarray(outer_centre, dtype=np.float64)
    lower = float(
        np.linalg.eigvalsh(
            np.linalg.solve(np.linalg.cholesky(A), np.linalg.solve(np.linalg.cholesky(A), B).T)
        )[-1]
    )
    upper = 1.0 - float(d @ B @ d)
    if upper < lower:
        return None
    if not d.any():
        return upper if upper == lower else (upper + lower) / 2

    def least(multiplier: float) -> float:
        corner = 1 - multiplier - d @ B @ d
        M = np.block(
            [[multiplier * A - B, -(B @ d)[:, None]], [-(B @ d)[None], np.array([[corner]])]]
        )
        return float(np.linalg.eigvalsh(M)[0])

    low, high = lower, upper
    for _ in range(80):
        a, b = low + 0.382 * (high - low), low + 0.618 * (high - low)
        low, high = (a, high) if least(a) < least(b) else (low, b)
    best = (low + high) / 2
    return best if least(best) >= 0 else None
