"""`Polynomials`: polynomials with common monomials, as a model stores and evaluates them."""

from dataclasses import dataclass

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray, IntArray, Json, keep
from nlsid_core.errors import DataError, DocumentError, ShapeError
from nlsid_core.polynomial.values import monomial_values

MAX_DEGREE = 20  # a polynomial of higher degree in a document is an attack, not a model


@dataclass(frozen=True, eq=False)
class Polynomials:
    """Polynomials in w with common exponents (m, n_w) and coefficients (m, ...)."""

    exponents: IntArray
    coefficients: FloatArray

    def __post_init__(self) -> None:
        exponents = np.array(self.exponents, dtype=np.int64)
        coefficients = np.array(self.coefficients, dtype=np.float64)
        if exponents.ndim != 2 or len(exponents) != len(coefficients):
            raise ShapeError(f"{exponents.shape} exponents for {coefficients.shape} coefficients")
        if (exponents < 0).any() or not np.isfinite(coefficients).all():
            raise DataError("exponents should not be negative, coefficients finite")
        keep(self, {"exponents": exponents, "coefficients": coefficients})

    def __call__(self, w: FloatArray) -> FloatArray:
        """(..., *coefficients.shape[1:]) values at w (..., n_w)."""
        values = monomial_values(self.exponents, w.reshape(-1, w.shape[-1]))
        stacked = np.tensordot(values, self.coefficients, axes=1)
        return np.asarray(stacked.reshape(*w.shape[:-1], *self.coefficients.shape[1:]))

    def jacobian(self, variables: int) -> "Polynomials":
        """Derivatives in the first `variables` variables, as a last axis of the coefficients."""
        exponents, coefficients = [], []
        for j in range(variables):
            power = self.exponents[:, j]
            lowered = self.exponents.copy()
            lowered[:, j] = np.maximum(power - 1, 0)
            slopes = np.zeros((*self.coefficients.shape, variables))
            slopes[..., j] = (self.coefficients.T * power).T
            exponents.append(lowered)
            coefficients.append(slopes)
        return Polynomials(np.concatenate(exponents), np.concatenate(coefficients))

    def document(self) -> Json:
        """The JSON form."""
        return {"exponents": self.exponents.tolist(), "coefficients": self.coefficients.tolist()}

    @classmethod
    def from_document(
        cls, document: Json, variables: int, shape: tuple[int, ...], *, source: str
    ) -> "Polynomials":
        """Raises DocumentError if parts are missing or do not fit."""
        exponents = files.array(document, "exponents", (None, variables), source=source)
        if (exponents % 1.0).any() or (abs(exponents) > MAX_DEGREE).any():
            raise DocumentError(f"{source}: exponents should be integers up to {MAX_DEGREE}")
        coefficients = files.array(
            document, "coefficients", (len(exponents), *shape), source=source
        )
        return cls(exponents.astype(np.int64), coefficients)
