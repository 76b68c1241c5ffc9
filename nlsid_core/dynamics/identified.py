"""Identified models of measured states as the differential equations that they step."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import ArrayLike, FloatArray, IntArray
from nlsid_core.dynamics.vector_field import VectorField, variable_names
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.models import ImplicitModel
from nlsid_core.polynomial import Polynomial

LARGEST_REST = 1e-9  # of the largest coefficient: rounding of a term that is not in e + f
WORST_CONDITION = 1e10  # of E


def identified_field(
    model: ImplicitModel,
    *,
    box: Sequence[tuple[float, float]] | None = None,
    disturbance: ArrayLike | None = None,
) -> VectorField:
    """ẋ = f(x, u) of which the model is the trapezoidal rule, inputs held for a sample.

    E dx/dt = g(x) + r(u) is stepped as e(x⁺) = f(x, u), e = Ex - hg/2 and f = Ex + hg/2 + hr, so E
    is the linear part of (e + f)/2 and hg = f - e. Every linear model of measured states
    (set 2.19) is one, as is every model of a `Polynomial(..., continuous=True)`.
    A step of h differs from the solution by O(h³). What is proved of the model is about its steps.

    box: (low, high) of every state, then every input, where the field is to be used (None:
    everywhere); a funnel stays there. disturbance: (n,) half-widths of what may be added to ẋ at
    any time, per second (None: nothing).
    Raises DataError if the model steps no such equation, ShapeError on rows that do not fit.
    """
    equation, ranges = _of_implicit(model), np.zeros((0, 2))
    n, m = len(model), len(model.u)
    if box is not None:
        ranges = np.asarray(box, dtype=np.float64)
        if ranges.shape != (n + m, 2):
            raise ShapeError(f"box should have {n + m} pairs, states then inputs: {ranges.shape}")
    push = np.zeros(0) if disturbance is None else np.asarray(disturbance, dtype=np.float64)
    if disturbance is not None and (push.shape != (n,) or not (push >= 0).all()):
        raise ShapeError(f"disturbance should be {n} half-widths of 0 or more, is {push}")
    pushed = np.flatnonzero(push)
    names = variable_names(n, m, len(pushed))
    exponents = np.hstack(
        [equation.exponents, np.zeros((len(equation.exponents), len(pushed)), dtype=np.int64)]
    )
    units = np.eye(n + m + len(pushed), dtype=np.int64)
    pieces = []
    for i, column in enumerate(equation.coefficients.T):
        p = Polynomial(exponents, column, names)
        for j in np.flatnonzero(pushed == i):
            p = p + Polynomial(units[[n + m + j]], np.ones(1), names)
        pieces.append(p)
    return VectorField(
        (tuple(pieces),),
        n,
        m,
        uncertain=np.column_stack([-push[pushed], push[pushed]]),
        valid=np.column_stack([np.arange(len(ranges)), ranges]),
    )


@dataclass(frozen=True, eq=False)
class _Equation:
    """ẋ = coefficients' of the monomials (k, n + m) in [x; u]; coefficients: (k, n)."""

    exponents: IntArray
    coefficients: FloatArray


def _of_implicit(model: ImplicitModel) -> _Equation:
    n, parts = len(model), model.separated()
    if parts is None or any(delay != 1 for _, delay in model.window) or not model.window:
        raise DataError(
            "a differential equation comes from a model of measured states, e(x+) = f(x, u) with "
            "the inputs one sample before; identify with lags 1 and delays [1]"
        )
    (left, right), m, h = parts, len(model.u), model.period
    total: dict[tuple[int, ...], FloatArray] = {}  # e + f of x
    difference: dict[tuple[int, ...], FloatArray] = {}  # f - e
    for row, c in zip(left.exponents.tolist(), left.coefficients, strict=True):
        key = (*row, *(0,) * m)
        total[key], difference[key] = c, -c
    inputs = [i for i, _ in model.window]
    for row, c in zip(right.exponents.tolist(), right.coefficients, strict=True):
        powers = [0] * m
        for i, power in zip(inputs, row[n:], strict=True):
            powers[i] += power
        key = (*row[:n], *powers)
        if not any(powers):
            total[key] = total.get(key, 0.0) + c
        elif any(row[:n]):
            raise DataError("states and inputs are multiplied: e would depend on the input, too")
        difference[key] = difference.get(key, 0.0) + c
    largest = max(float(np.max(np.abs(c))) for c in total.values())
    E = np.zeros((n, n))
    for key, c in total.items():
        if sum(key) == 1:
            E[:, key.index(1)] = c / 2.0
        elif any(key) and np.max(np.abs(c)) > LARGEST_REST * largest:
            raise DataError(
                "e + f is not linear in the states, so no E dx/dt = g(x) + r(u) makes this model "
                "by the trapezoidal rule; identify with `continuous: true`"
            )
    if np.linalg.cond(E) > WORST_CONDITION:
        raise DataError("E = (e + f)/2 is singular: the model has a mode that flips every sample")
    return _merged(
        np.array(list(difference), dtype=np.int64),
        np.linalg.solve(h * E, np.array(list(difference.values())).T).T,
    )


def _merged(exponents: IntArray, coefficients: FloatArray) -> _Equation:
    rows, place = np.unique(exponents, axis=0, return_inverse=True)
    summed = np.zeros((len(rows), coefficients.shape[1]))
    np.add.at(summed, place.ravel(), coefficients)
    return _Equation(rows, summed)
