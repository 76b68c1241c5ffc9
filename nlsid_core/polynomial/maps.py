"""Vectors and matrices of polynomials: from a Python function, Jacobian, sums."""

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlsid_core.arrays import ArrayLike, FloatArray, IntArray, objects, objects_at
from nlsid_core.errors import NotPolynomial, ShapeError
from nlsid_core.polynomial.algebra import (
    TRACING,
    Polynomial,
    as_polynomial,
    variables,
)


def trace(function: Callable[..., Any], arguments: Mapping[str, int]) -> NDArray[Any]:
    """Call `function` on polynomial vectors and return the polynomials it computes, exactly.

    `arguments` names each positional argument and its length: {"x": 6, "u": 3} calls
    function(x, u) with object arrays of the variables x0..x5 and u0..u2. Every float the function
    uses enters as the rational it is, so nothing is rounded; `.rounded()` makes float64 ones.
    Returns an object array of the shape the function returned.

    Raises NotPolynomial naming the operation if the function is not polynomial.
    """
    names = [f"{name}{i}" for name, size in arguments.items() for i in range(size)]
    unknowns = [variable.exact() for variable in variables(names)]
    vectors, start = [], 0
    for size in arguments.values():
        vectors.append(objects(unknowns[start : start + size]))
        start += size
    title = getattr(function, "__name__", "function")
    token = TRACING.set(True)
    try:
        result = function(*vectors)
    except NotPolynomial as error:
        raise NotPolynomial(f"{title}: {error}") from error
    except TypeError as error:
        raise NotPolynomial(f"{title} cannot be called on polynomials: {error}") from error
    finally:
        TRACING.reset(token)
    array = result if isinstance(result, np.ndarray) else np.array(result, dtype=object)
    traced = np.empty(array.shape, dtype=object)
    for index in np.ndindex(array.shape):
        try:
            traced[index] = as_polynomial(array[index]).exact().over(names)
        except NotPolynomial as error:
            raise NotPolynomial(f"{title}, output {list(index)}: {error}") from error
    return traced


def jacobian(polynomials: ArrayLike | Sequence[Polynomial], names: Sequence[str]) -> NDArray[Any]:
    """∂p_i/∂names_j as an object array (..., len(names))."""
    array: Any = np.asarray(polynomials, dtype=object)
    shape = (*array.shape, len(names))
    return objects_at(shape, lambda at: array[at[:-1]].derivative(names[at[-1]]))


def monomials(n: int, degrees: Sequence[int]) -> IntArray:
    """(m, n) exponents of every monomial in n variables whose total degree is in `degrees`."""
    rows = []
    for degree in sorted(set(degrees)):
        for chosen in combinations_with_replacement(range(n), degree):
            row = [0] * n
            for j in chosen:
                row[j] += 1
            rows.append(row)
    return np.array(rows, dtype=np.int64).reshape(len(rows), n)


def added(polynomials: Sequence[Polynomial]) -> Polynomial:
    """The sum of one or more polynomials, made in one step."""
    names = tuple(dict.fromkeys(name for p in polynomials for name in p.names))
    exact = any(p.is_exact for p in polynomials)
    parts = [p.over(names).exact() if exact else p.over(names) for p in polynomials]
    exponents = np.concatenate([p.exponents for p in parts])
    return Polynomial(exponents, np.concatenate([p.coefficients for p in parts]), names)


def combinations(weights: FloatArray, polynomials: Sequence[Polynomial]) -> NDArray[Any]:
    """weights (m, k) times k polynomials: an object array (m,), each entry made in one step."""
    names = tuple(dict.fromkeys(name for p in polynomials for name in p.names))
    exponents, table = coefficient_table([p.over(names) for p in polynomials])
    rows = weights @ table.T
    return objects([Polynomial(exponents, row, names) for row in rows])


def coefficient_table(polynomials: Sequence[Polynomial]) -> tuple[IntArray, FloatArray]:
    """Common monomials (m, n) of polynomials in the same variables, and coefficients (m, k)."""
    if any(p.names != polynomials[0].names for p in polynomials):
        raise ShapeError("the polynomials should be in the same variables, in the same order")
    stacked = np.concatenate([p.exponents for p in polynomials])
    exponents, position = np.unique(stacked, axis=0, return_inverse=True)
    table = np.zeros((len(exponents), len(polynomials)))
    column = np.repeat(np.arange(len(polynomials)), [len(p) for p in polynomials])
    table[position.ravel(), column] = np.concatenate([p.coefficients for p in polynomials])
    return exponents, table
