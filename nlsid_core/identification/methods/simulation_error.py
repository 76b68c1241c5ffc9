"""Simulation error minimisation (SEM): the usual comparator, and a last step for proved models.

With Δ = ŷ - ỹ over all rows, G Δ = -ε: the simulation error |Δ|² = |L⁻¹ε|² has the form of the
robust bound with L = G, instead of a convex K. Its exact sensitivities are
    ∂(L⁻¹ε)/∂θ_i = L⁻¹(ε_i - G_i r),   r = G⁻¹ε = -Δ,
and p, which enters linearly, is projected out: Gauss-Newton in the left parameters only.
Nothing makes the minimiser global. Source: thesis Definition 2.2 and Section 1.1.1.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_solve
from scipy.linalg.lapack import dgbtrf, dgbtrs, dtbtrs

from nlsid_core.arrays import FloatArray
from nlsid_core.identification.methods.banded import (
    Diagonals,
    Rows,
    lower_band,
    shift,
)
from nlsid_core.identification.methods.newton import Point, Root, project


class SimulationError:
    """|ŷ - ỹ|² over all rows in the left parameters θ, where `inside` holds (None: anywhere)."""

    def __init__(self, rows: Rows, *, inside: Callable[[FloatArray], bool] | None = None) -> None:
        self.rows, self.inside = rows, inside

    def at(self, theta: FloatArray) -> Point:
        """Value and best p; LinAlgError if the simulation diverges or G is singular."""
        if self.inside is not None and not self.inside(theta):
            raise LinAlgError("outside the set that is searched")
        return project(self.rows, theta, theta, Band.of(self.rows.G(theta)))

    def derivatives(self, point: Point) -> tuple[FloatArray, FloatArray]:
        """Gradient, and the Hessian of Gauss and Newton."""
        V = self._moved(point)
        return 2.0 * V.T @ point.x, point.curvature(V)

    def slopes(self, point: Point) -> FloatArray:
        """(N, n): the derivatives of the residual at the best p, as Gauss and Newton take them."""
        J = point.factor.half_solve(self._moved(point), overwrite=True)
        inner = cho_solve(point.normal, point.projected.T @ J, check_finite=False)
        return np.asarray(J - point.projected @ inner)

    def _moved(self, point: Point) -> FloatArray:
        """(N, n): ε_i - G_i r."""
        rows = self.rows
        r = point.residual
        V = rows.errors.copy(order="F")
        for D, group, weights in rows.groups:
            V[:, group] -= weights * shift(r, D)[:, None]
        return V


@dataclass(frozen=True, eq=False)
class Band:
    """L of L⁻¹ε: a banded matrix by its diagonals, lower triangular or factored by elimination."""

    band: FloatArray
    below: int
    above: int
    order: FloatArray | None  # of the elimination

    @classmethod
    def of(cls, L: Diagonals) -> Root:
        """LinAlgError if L is singular."""
        N, below, above = len(next(iter(L.values()))), max(L), max(0, -min(L))
        if above == 0:
            band = lower_band(L)
            if not band[0].all():
                raise LinAlgError("a leading coefficient is zero")
            return cls(band, below, 0, None)
        band = np.zeros((2 * below + above + 1, N), order="F")
        for D, diagonal in L.items():
            column = shift(diagonal, -D)
            band[below + above + D] = column
        factored, order, info = dgbtrf(band, below, above, overwrite_ab=True)
        if info != 0:
            raise LinAlgError(f"elimination failed ({info})")
        return cls(factored, below, above, order)

    @property
    def pivots(self) -> FloatArray:
        """(N,): of LL', up to the order of the elimination."""
        diagonal = 0 if self.order is None else self.below + self.above
        return np.asarray(self.band[diagonal] ** 2)

    def half_solve(self, B: FloatArray, *, overwrite: bool = False) -> FloatArray:
        """L⁻¹B."""
        return self._solve(B, transposed=False, overwrite=overwrite)

    def half_solve_transposed(self, B: FloatArray) -> FloatArray:
        """L⁻ᵀB."""
        return self._solve(B, transposed=True)

    def _solve(self, B: FloatArray, *, transposed: bool, overwrite: bool = False) -> FloatArray:
        columns = B[:, None] if B.ndim == 1 else B
        if self.order is None:
            trans = "T" if transposed else "N"
            found, info = dtbtrs(self.band, columns, uplo="L", trans=trans, overwrite_b=overwrite)
        else:
            found, info = dgbtrs(
                self.band,
                self.below,
                self.above,
                columns,
                self.order,
                trans=int(transposed),
                overwrite_b=overwrite,
            )
        if info != 0:
            raise LinAlgError(f"triangular solve failed ({info})")
        return np.asarray(found.reshape(B.shape, order="F"))
