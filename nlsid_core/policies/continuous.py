"""`ContinuousPolicy`: u = u₀(t) - K(t) (x - x₀(t)) around a motion, all piecewise polynomials."""

from dataclasses import dataclass, field
from itertools import product

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import ArrayLike, FloatArray, IntArray, Json, keep
from nlsid_core.dynamics.piecewise import PiecewisePolynomial
from nlsid_core.errors import DataError, ShapeError

FORMAT, KIND = "nlsid/policy", "continuous"
MAX_LIMITED = 3  # inputs: 27 modes, each proved


@dataclass(frozen=True, eq=False)
class ContinuousPolicy:
    """x: nominal states (n,), u: nominal inputs (m,), K: gains (m, n), on the same knots.

    K may be constant, linear or cubic on each piece. x has to be continuous. vector_field: digest
    of the dynamics the policy was made for. Units are those of the dynamics, SI. limits: (L, 3)
    rows (input, low, high): that input is clipped to [low, high].

    Raises ShapeError or DataError on parts that do not fit.
    """

    x: PiecewisePolynomial
    u: PiecewisePolynomial
    K: PiecewisePolynomial
    vector_field: str
    limits: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        n, m = self.x.control.shape[2:], self.u.control.shape[2:]
        if len(n) != 1 or len(m) != 1 or self.K.control.shape[2:] != (*m, *n):
            raise ShapeError(f"x {n}, u {m} and K {self.K.control.shape[2:]} do not fit together")
        for part in (self.u, self.K):
            if not np.array_equal(part.t, self.x.t):
                raise DataError("x, u and K of a policy should have the same knots")
        if not self.x.is_continuous():
            raise DataError("the nominal states of a policy should be continuous")
        limits = np.array(self.limits, dtype=np.float64).reshape(-1, 3)
        inputs = limits[:, 0].tolist()
        sound = np.isfinite(limits).all() and (limits[:, 1] < limits[:, 2]).all()
        if not sound or not set(inputs) <= set(range(*m)) or len(set(inputs)) < len(inputs):
            raise DataError(
                f"rows of limits should be (input, low, high), low < high, each of {m[0]} inputs "
                f"at most once; they are {limits.tolist()}"
            )
        if len(limits) > MAX_LIMITED:
            raise DataError(
                f"{len(limits)} limited inputs make 3^{len(limits)} modes; at most {MAX_LIMITED} "
                "are decided: keep the others within their limits by rows of the dynamics' valid"
            )
        keep(self, {"limits": limits})

    @property
    def t(self) -> FloatArray:
        """(K,) knots in s."""
        return self.x.t

    @property
    def made_for(self) -> str:
        """The digest of the vector field."""
        return self.vector_field

    @property
    def planned(self) -> FloatArray:
        """(K, m) the nominal inputs at the knots."""
        return self.clipped(self.u.ends())

    @property
    def last(self) -> float:
        """s: the end of the motion."""
        return float(self.x.t[-1])

    def covers(self, when: float, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The least and greatest input (m,) that the proof covers at `when` s: its own."""
        u = self(when, x)
        return u, u

    def __call__(self, t: float, X: ArrayLike) -> FloatArray:
        """Inputs (..., m) at time t for states X (..., n)."""
        X = np.asarray(X, dtype=np.float64)
        n = self.x.control.shape[2]
        if X.shape[-1:] != (n,):
            raise ShapeError(f"the policy takes states (..., {n}), is given {X.shape}")
        return self.clipped(self.u(t) - (X - self.x(t)) @ self.K(t).T)

    def clipped(self, U: FloatArray) -> FloatArray:
        """Inputs (..., m) within the limits."""
        result = np.array(U, dtype=np.float64)
        for i, low, high in self.limits.tolist():
            result[..., int(i)] = np.clip(result[..., int(i)], low, high)
        return result

    def modes(self) -> IntArray:
        """(3^L, L) every combination of 0: free, -1: at its low limit, 1: at its high limit."""
        rows = list(product((0, -1, 1), repeat=len(self.limits)))
        return np.array(rows, dtype=np.int64).reshape(len(rows), len(self.limits))

    def entry(self, j: int, k: int) -> tuple[FloatArray, FloatArray]:
        """Entry j of (x, u) on piece k: control points of its nominal, and rows g (r, n).

        It differs from the nominal by g'x̄ for a convex combination of the rows.
        """
        n = self.x.control.shape[2]
        if j < n:
            return self.x.control[k, :, j], np.eye(n)[[j]]
        return self.u.control[k, :, j - n], self.K.control[k, :, j - n]

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {
            "format": FORMAT,
            "version": files.VERSION,
            "kind": KIND,
            "vector_field": self.vector_field,
            "t": self.t.tolist(),
            "x": self.x.control.tolist(),
            "u": self.u.control.tolist(),
            "K": self.K.control.tolist(),
            "limits": self.limits.tolist(),
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "policy") -> "ContinuousPolicy":
        """Raises DocumentError if the document is not a policy of this kind."""
        files.header(document, FORMAT, source=source, kind=KIND)
        t = files.array(document, "t", (None,), source=source)
        x = files.array(document, "x", (None, None, None), source=source)
        u = files.array(document, "u", (None, None, None), source=source)
        if u.shape[2]:
            K = files.array(document, "K", (None, None, None, None), source=source)
        else:  # an autonomous system: JSON cannot tell the shape of nothing
            K = np.zeros((len(x), 1, 0, x.shape[2]))
        rows = files.member(document, "limits", list, source=source)
        return cls(
            PiecewisePolynomial(t, x),
            PiecewisePolynomial(t, u),
            PiecewisePolynomial(t, K),
            files.member(document, "vector_field", str, source=source),
            files.array(document, "limits", (len(rows), 3), source=source),
        )
