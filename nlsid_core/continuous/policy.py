"""`Policy`: u = u₀(t) - K(t) (x - x₀(t)) around a nominal motion, all piecewise polynomials."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nlsid_core import _json
from nlsid_core._types import ArrayLike, FloatArray, Json
from nlsid_core.continuous.piecewise import PiecewisePolynomial
from nlsid_core.errors import DataError, ShapeError

FORMAT = "nlsid/trajectory_policy"
VERSION = 1


@dataclass(frozen=True, eq=False)
class Policy:
    """x: nominal states (n,), u: nominal inputs (m,), K: gains (m, n), on the same knots.

    K may be constant, linear or cubic on each piece. x has to be continuous. vector_field: digest
    of the dynamics the policy was made for. Units are those of the dynamics, SI.

    Raises ShapeError or DataError on parts that do not fit.
    """

    x: PiecewisePolynomial
    u: PiecewisePolynomial
    K: PiecewisePolynomial
    vector_field: str

    def __post_init__(self) -> None:
        n, m = self.x.control.shape[2:], self.u.control.shape[2:]
        if len(n) != 1 or len(m) != 1 or self.K.control.shape[2:] != (*m, *n):
            raise ShapeError(f"x {n}, u {m} and K {self.K.control.shape[2:]} do not fit together")
        for part in (self.u, self.K):
            if not np.array_equal(part.t, self.x.t):
                raise DataError("x, u and K of a policy should have the same knots")
        if not self.x.is_continuous():
            raise DataError("the nominal states of a policy should be continuous")

    @property
    def t(self) -> FloatArray:
        """(K,) knots in s."""
        return self.x.t

    def __call__(self, t: float, X: ArrayLike) -> FloatArray:
        """Inputs (N, m) at time t for states X (N, n)."""
        X = np.asarray(X, dtype=np.float64)
        return np.asarray(self.u(t) - (X - self.x(t)) @ self.K(t).T)

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
            "version": VERSION,
            "law": "u = u0(t) - K(t) (x - x0(t)); pieces in Bernstein form",
            "vector_field": self.vector_field,
            "t": self.t.tolist(),
            "x": self.x.control.tolist(),
            "u": self.u.control.tolist(),
            "K": self.K.control.tolist(),
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "policy") -> "Policy":
        """Raises DocumentError if the document is not a policy of this kind."""
        _json.header(document, FORMAT, VERSION, source=source)
        t = _json.array(document, "t", (None,), source=source)
        x = _json.array(document, "x", (None, None, None), source=source)
        u = _json.array(document, "u", (None, None, None), source=source)
        if u.shape[2]:
            K = _json.array(document, "K", (None, None, None, None), source=source)
        else:  # an autonomous system: JSON cannot tell the shape of nothing
            K = np.zeros((len(x), 1, 0, x.shape[2]))
        return cls(
            PiecewisePolynomial(t, x),
            PiecewisePolynomial(t, u),
            PiecewisePolynomial(t, K),
            _json.member(document, "vector_field", str, source=source),
        )

    @classmethod
    def load(cls, path: Path | str) -> "Policy":
        """Read a policy file; DocumentError says what is wrong with it."""
        return cls.from_document(_json.load_document(path), source=str(path))

    def save(self, path: Path | str) -> None:
        """Write the policy; the file appears whole or not at all."""
        _json.write_document(path, self.document())
