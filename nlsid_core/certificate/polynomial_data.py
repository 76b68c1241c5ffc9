"""Polynomials and Gram matrices as JSON, and back, strictly.

A number is a JSON number (an exact float64) or a string "p" or "p/q" (an exact rational).
"""

import re
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlsid_core import _json
from nlsid_core._types import IntArray, Json
from nlsid_core.errors import DocumentError
from nlsid_core.polynomial import Gram, Polynomial

_RATIONAL = re.compile(r"-?[0-9]{1,4000}(/[1-9][0-9]{0,3999})?", re.ASCII)
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_.\[\]]{0,63}", re.ASCII)
MAX_VARIABLES = 200


def write_polynomial(p: Polynomial) -> Json:
    """A polynomial without its variable names, which a claim states once."""
    return {
        "exponents": p.exponents.tolist(),
        "coefficients": [write_number(c) for c in p.coefficients.tolist()],
    }


def write_gram(gram: Gram) -> Json:
    """A Gram matrix with its basis."""
    return {
        "basis": gram.basis.tolist(),
        "Q": [[write_number(entry) for entry in row] for row in gram.Q.tolist()],
    }


def write_number(value: float | Fraction) -> float | str:
    """A float64 as a JSON number; a rational too if it is one, else as a string."""
    if isinstance(value, Fraction):
        try:
            rounded = float(value)
        except OverflowError:
            return str(value)
        return rounded if Fraction(rounded) == value else str(value)
    return float(value)


def read_names(document: Json, *, source: str) -> tuple[str, ...]:
    """The `variables` of a claim: distinct names, at least one."""
    names = _json.member(document, "variables", list, source=source)
    if not 0 < len(names) <= MAX_VARIABLES or not all(
        isinstance(name, str) and _NAME.fullmatch(name) for name in names
    ):
        raise DocumentError(f"{source}: 'variables' should be 1 to {MAX_VARIABLES} plain names")
    if len(set(names)) != len(names):
        raise DocumentError(f"{source}: variable names repeat: {', '.join(names)}")
    return tuple(names)


def read_polynomial(document: Any, names: Sequence[str], *, source: str) -> Polynomial:
    """A polynomial in `names`; DocumentError says what is wrong."""
    _only(document, {"exponents", "coefficients"}, source)
    exponents = _exponents(document, "exponents", len(names), source)
    values = _json.member(document, "coefficients", list, source=source)
    if len(values) != len(exponents):
        raise DocumentError(f"{source}: {len(exponents)} exponents, {len(values)} coefficients")
    if len({tuple(row) for row in exponents.tolist()}) < len(exponents):
        # Adding its coefficients would round, and the claim be about another polynomial.
        raise DocumentError(f"{source}: a monomial occurs twice")
    return Polynomial(exponents, _numbers(values, source), tuple(names))


def read_gram(document: Any, names: Sequence[str], *, source: str) -> Gram:
    """A Gram matrix in `names`; DocumentError says what is wrong."""
    _only(document, {"basis", "Q"}, source)
    basis = _exponents(document, "basis", len(names), source)
    rows = _json.member(document, "Q", list, source=source)
    if len(rows) != len(basis) or not all(
        isinstance(row, list) and len(row) == len(basis) for row in rows
    ):
        raise DocumentError(f"{source}: Q should be {len(basis)}x{len(basis)}, as its basis")
    flat = _numbers([entry for row in rows for entry in row], source)
    return Gram(basis, flat.reshape(len(basis), len(basis)), tuple(names))


def read_number(value: Any, *, source: str) -> float | Fraction:
    """One number."""
    number = _numbers([value], source)[0]
    return number if isinstance(number, Fraction) else float(number)


def read_list(document: Json, key: str, *, source: str) -> list[Any]:
    """`document[key]`, a list; empty if it is missing."""
    return list(_json.member(document, key, list, source=source)) if key in document else []


def only(document: Json, keys: set[str], *, source: str) -> None:
    """Refuse members nobody reads: they would look like part of what was proved."""
    strangers = sorted(set(document) - keys)
    if strangers:
        raise DocumentError(f"{source}: unknown member '{strangers[0]}'; known: {sorted(keys)}")


def _only(document: Any, keys: set[str], source: str) -> None:
    if not isinstance(document, dict):
        raise DocumentError(f"{source}: expected an object, found {type(document).__name__}")
    only(document, keys, source=source)


def _exponents(document: Json, key: str, n: int, source: str) -> IntArray:
    rows = _json.member(document, key, list, source=source)
    for row in rows:
        if not isinstance(row, list) or len(row) != n or not all(type(e) is int for e in row):
            raise DocumentError(
                f"{source}: a row of '{key}' should be {n} integers, is {row!r:.80}"
            )
        if min(row) < 0:
            raise DocumentError(f"{source}: '{key}' holds a negative exponent: {row}")
    return np.array(rows, dtype=np.int64).reshape(-1, n)


def _numbers(values: list[Any], source: str) -> NDArray[Any]:
    """float64 if all are JSON numbers, else Fractions."""
    if all(type(value) is float for value in values):
        return np.array(values, dtype=np.float64)
    exact = np.empty(len(values), dtype=object)
    exact[:] = [_number(value, source) for value in values]
    if any(type(value) is str for value in values):
        return exact
    return exact.astype(np.float64) if all(_is_float(v) for v in exact) else exact


def _number(value: Any, source: str) -> Fraction:
    if type(value) in (int, float):
        return Fraction(value)
    if type(value) is str and _RATIONAL.fullmatch(value):
        return Fraction(value)
    raise DocumentError(f"{source}: {value!r:.40} is neither a number nor a rational 'p/q'")


def _is_float(value: Fraction) -> bool:
    return Fraction(float(value)) == value
