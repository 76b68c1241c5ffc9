"""`SingleStep`: one sample of an implicit model, for a few states at once, with little overhead.

For given (x, w) every equation is a polynomial in v alone, whose coefficients are found for all
states together. Then Newton's method runs from the last output on: on plain numbers for a single
equation, on arrays of all states for several.
"""

import math

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.models.implicit import ImplicitModel
from nlsid_core.models.monotone import NEWTON_STEPS, RESIDUAL
from nlsid_core.polynomial.products import Products


class SingleStep:
    """x⁺ (B, n) of states x (B, n) under one input w (m,); as `ImplicitModel.step` to rounding.

    Where Newton's full steps do not go down, `ImplicitModel.solve` takes over, and raises
    SolverError as it does.
    """

    def __init__(self, model: ImplicitModel) -> None:
        self._model, self._unknowns, n = model, model.unknowns, len(model)
        h, shift, n_v = model.h, model.shift, model.unknowns
        known, places = np.unique(
            np.vstack([h.exponents[:, n_v:], shift.exponents]), axis=0, return_inverse=True
        )
        powers, of = np.unique(h.exponents[:, :n_v], axis=0, return_inverse=True)
        places, of = places.ravel(), of.ravel()
        self._split = len(powers) * n_v
        # The monomials of (x, w) times this: h's coefficients of v's monomials, then ã.
        self._table = np.zeros((len(known), self._split + n - n_v))
        for place, power, values in zip(places[: len(of)], of, h.coefficients, strict=True):
            self._table[place, power * n_v : (power + 1) * n_v] += values
        for place, values in zip(places[len(of) :], shift.coefficients, strict=True):
            self._table[place, self._split :] += values
        self._products, self._size = Products(known), known.shape[1] + 1
        self._degrees: list[int] = powers[:, 0].tolist()
        # What is multiplied by h's coefficients: monomials of v, and their derivatives.
        units = np.eye(n_v, dtype=np.int64)
        self._in_v = Products(np.concatenate([powers, *(np.maximum(powers - e, 0) for e in units)]))
        self._factors = np.concatenate([np.ones(len(powers)), *powers.T])

    def __call__(self, x: FloatArray, w: FloatArray) -> FloatArray:
        """The next states (B, n)."""
        n, n_v = x.shape[1], self._unknowns
        known = np.ones((len(x), self._size))
        known[:, :n], known[:, n : self._size - 1] = x, w
        found = self._products(known) @ self._table
        after = np.empty_like(x)
        after[:, n_v:] = found[:, self._split :]
        rows = found[:, : self._split]
        if n_v == 1:
            pairs = zip(rows.tolist(), x[:, 0].tolist(), strict=True)
            after[:, 0] = [self._single(row, start) for row, start in pairs]
        else:
            after[:, :n_v] = self._several(rows.reshape(len(x), -1, n_v), x[:, :n_v])
        failed = ~np.isfinite(after[:, :n_v]).all(axis=1)
        if failed.any():
            after[failed, :n_v] = self._model.solve(known[failed, :-1], start=x[failed, :n_v])
        return after

    def _single(self, row: list[float], v: float) -> float:
        """The root of Σ row_i v^degree_i, or NaN."""
        polynomial = [0.0] * (self._degrees[-1] + 1)  # highest degree first
        for degree, c in zip(self._degrees, row, strict=True):
            polynomial[-1 - degree] = c
        enough, before = RESIDUAL * (1.0 + abs(polynomial[-1])), math.inf
        for _ in range(NEWTON_STEPS):
            value = slope = 0.0
            for c in polynomial:
                slope = slope * v + value
                value = value * v + c
            error = abs(value)
            if error <= enough:
                return v
            if not error < before or slope == 0.0:
                break
            before = error
            v -= value / slope
        return math.nan

    def _several(self, C: FloatArray, start: FloatArray) -> FloatArray:
        """(B, n_v) roots of the equations with coefficients C (B, monomials, n_v), or NaNs."""
        (B, count, p), v = C.shape, np.ones((len(C), C.shape[2] + 1))  # v, and 1
        v[:, :p], before = start, np.inf
        enough = RESIDUAL * (1.0 + float(np.abs(C[:, 0]).max()))  # the constant, if there is one
        with np.errstate(all="ignore"):
            for _ in range(NEWTON_STEPS):
                factors = (self._in_v(v) * self._factors).reshape(B, -1, count)
                values, slopes = (
                    factors[:, 0, None] @ C,
                    factors[:, 1:] @ C,
                )  # [i, j]: of C_j in v_i
                error = float(np.linalg.norm(values, axis=2).max())
                if error <= enough:
                    return v[:, :p]
                if not error < before:
                    break
                try:
                    v[:, :p] -= np.linalg.solve(slopes.swapaxes(1, 2), values.swapaxes(1, 2))[
                        ..., 0
                    ]
                except np.linalg.LinAlgError:
                    break
                before = error
        return np.full((B, p), np.nan)
