"""`Polynomial`: a sum of monomials, as an exponent matrix and a coefficient vector.

Coefficients are float64, or rationals (an object array of `Fraction`) where every operation is
exact. An operation of the two is exact: every float64 is a rational.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from fractions import Fraction
from numbers import Integral, Rational
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from nlsid_core.arrays import ArrayLike, FloatArray, IntArray, keep, objects, objects_at
from nlsid_core.errors import DataError, NotPolynomial, ShapeError
from nlsid_core.polynomial.operations import OPERATORS, REFUSED
from nlsid_core.polynomial.values import monomial_values

Coefficients: TypeAlias = NDArray[Any]
Number: TypeAlias = int | float | Fraction
# True while a user's function is called on polynomials, where == has no one answer
TRACING: ContextVar[bool] = ContextVar("tracing", default=False)


@dataclass(frozen=True, eq=False, repr=False)
class Polynomial:
    """Σ_k coefficients[k] · Π_j names[j]^exponents[k, j], in canonical form.

    exponents: (m, n) nonnegative integers. coefficients: (m,) float64, or Fractions. names: the n
    variables. Construction sorts terms by degree, adds repeated ones, drops zeros and freezes.
    Polynomials in different variables combine in the union of their variables.

    Raises ShapeError on sizes that do not fit, DataError on NaN, infinity, negative exponents or
    repeated names.
    """

    exponents: IntArray
    coefficients: Coefficients
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        names = tuple(self.names)
        coefficients = np.array(self.coefficients)
        exponents = np.array(self.exponents)
        if exponents.size == 0:
            exponents = np.zeros((len(coefficients), len(names)), dtype=np.int64)
        if exponents.shape != (len(coefficients), len(names)) or coefficients.ndim != 1:
            raise ShapeError(
                f"{len(coefficients)} coefficients in {len(names)} variables need exponents of "
                f"shape {(len(coefficients), len(names))}, given {exponents.shape}"
            )
        if len(set(names)) != len(names):
            raise DataError(f"variable names repeat: {', '.join(names)}")
        if exponents.dtype.kind not in "iu" or (exponents < 0).any():
            raise DataError("exponents should be nonnegative integers")
        if coefficients.dtype == object:
            coefficients = _rationals(coefficients)
        else:
            coefficients = coefficients.astype(np.float64)
            if not np.isfinite(coefficients).all():
                raise DataError(f"coefficients should be finite, are {coefficients}")
        exponents, coefficients = _merge(exponents.astype(np.int64), coefficients)
        keep(self, {"exponents": exponents, "coefficients": coefficients})
        object.__setattr__(self, "names", names)

    # -- shape -------------------------------------------------------------------------------

    def __len__(self) -> int:
        return len(self.coefficients)

    @property
    def degree(self) -> int:
        """Total degree; 0 for constants and for the zero polynomial."""
        return int(np.max(self.exponents.sum(axis=1), initial=0))

    @property
    def is_exact(self) -> bool:
        """True if the coefficients are rationals."""
        return self.coefficients.dtype == object

    def terms(self) -> Iterator[tuple[tuple[int, ...], Any]]:
        """(exponent, coefficient) of every term, lowest degree first."""
        for exponent, coefficient in zip(self.exponents.tolist(), self.coefficients, strict=True):
            yield tuple(exponent), coefficient

    def coefficient(self, exponent: Sequence[int]) -> Any:
        """The coefficient of one monomial; 0 if it does not occur."""
        found = np.flatnonzero((self.exponents == np.asarray(exponent)).all(axis=1))
        return self.coefficients[found[0]] if found.size else 0

    def exact(self) -> "Polynomial":
        """The same polynomial with rational coefficients; nothing is rounded."""
        rationals = np.array([Fraction(c) for c in self.coefficients.tolist()], dtype=object)
        return Polynomial(self.exponents, rationals, self.names)

    def rounded(self) -> "Polynomial":
        """With float64 coefficients, each the nearest to its exact value."""
        return Polynomial(self.exponents, self.coefficients.astype(np.float64), self.names)

    def over(self, names: Sequence[str]) -> "Polynomial":
        """The same polynomial in the variables `names`, in that order.

        Raises DataError if a variable that occurs is not among them.
        """
        if tuple(names) == self.names:
            return self
        wide = np.zeros((len(self), len(names)), dtype=np.int64)
        for name, column in zip(self.names, self.exponents.T, strict=True):
            if name in names:
                wide[:, list(names).index(name)] = column
            elif column.any():
                raise DataError(f"variable {name} occurs, but is not among {', '.join(names)}")
        return Polynomial(wide, self.coefficients, tuple(names))

    # -- values ------------------------------------------------------------------------------

    def __call__(self, points: ArrayLike) -> FloatArray:
        """Values at points (..., n), in the order of `names`; shape (...)."""
        points = np.asarray(points, dtype=np.float64)
        if points.shape[-1:] != (len(self.names),):
            raise ShapeError(f"points should have shape (..., {len(self.names)}): {self.names}")
        values = monomial_values(self.exponents, points.reshape(-1, len(self.names)))
        return np.asarray(
            (values @ self.coefficients.astype(np.float64)).reshape(points.shape[:-1])
        )

    def derivative(self, name: str) -> "Polynomial":
        """The partial derivative with respect to one variable (zero if it does not occur)."""
        if name not in self.names:
            return constant(0, names=self.names)
        j = self.names.index(name)
        keep = self.exponents[:, j] > 0
        exponents = self.exponents[keep]
        coefficients = self.coefficients[keep] * exponents[:, j]
        exponents[:, j] -= 1
        return Polynomial(exponents, coefficients, self.names)

    def substitute(self, values: Mapping[str, "Polynomial | Number"]) -> "Polynomial":
        """Put a number or a polynomial in the place of variables; the others stay."""
        missing = [name for name in values if name not in self.names]
        if missing:
            raise DataError(f"no variable {', '.join(missing)}; it has {', '.join(self.names)}")
        constants: dict[str, Any] = {}
        rest: list[tuple[str, Polynomial]] = []
        for name in (name for name in self.names if name in values):
            value = values[name]
            if isinstance(value, (float, Fraction)):
                constants[name] = value
                continue
            inner = as_polynomial(value)
            if inner.degree:
                rest.append((name, inner))
            else:
                constants[name] = inner.coefficient([0] * len(inner.names))
        return self._at(constants)._horner(rest)

    def _at(self, constants: Mapping[str, Any]) -> "Polynomial":
        """Numbers in the place of variables, all at once."""
        if not constants:
            return self
        exact = self.is_exact or any(isinstance(value, Fraction) for value in constants.values())
        p = self.exact() if exact else self
        numbers = [Fraction(c) if exact else float(c) for c in constants.values()]
        values = np.array(numbers, dtype=object if exact else np.float64)
        column = {name: j for j, name in enumerate(p.names)}
        powers = p.exponents[:, [column[name] for name in constants]]
        term, which = np.nonzero(powers)
        coefficients = p.coefficients.copy()
        np.multiply.at(coefficients, term, values[which] ** powers[term, which])
        kept = [j for j, name in enumerate(p.names) if name not in constants]
        return Polynomial(p.exponents[:, kept], coefficients, tuple(p.names[j] for j in kept))

    def _horner(self, substitutions: list[tuple[str, "Polynomial"]]) -> "Polynomial":
        if not substitutions:
            return self
        (name, value), rest = substitutions[0], substitutions[1:]
        j = self.names.index(name)
        powers = self.exponents[:, j]
        kept = self.names[:j] + self.names[j + 1 :]
        reduced = np.delete(self.exponents, j, axis=1)
        result = constant(0, names=kept)
        for power in range(int(np.max(powers, initial=0)), -1, -1):
            part = Polynomial(
                reduced[powers == power], self.coefficients[powers == power], kept
            )._horner(rest)
            result = result * value + part if len(result) else part
        return result

    # -- arithmetic --------------------------------------------------------------------------

    def __add__(self, other: Any) -> Any:
        return self._combine(other, _sum)

    def __radd__(self, other: Any) -> Any:
        return self._combine(other, _sum)

    def __sub__(self, other: Any) -> Any:
        return self._combine(other, lambda a, b: _sum(a, -b))

    def __rsub__(self, other: Any) -> Any:
        return self._combine(other, lambda a, b: _sum(-a, b))

    def __mul__(self, other: Any) -> Any:
        return self._combine(other, _product)

    def __rmul__(self, other: Any) -> Any:
        return self._combine(other, _product)

    def __truediv__(self, other: Any) -> Any:
        return self._combine(other, _quotient)

    def __rtruediv__(self, other: Any) -> Any:
        return self._combine(other, lambda a, b: _quotient(b, a))

    def __neg__(self) -> "Polynomial":
        return Polynomial(self.exponents, -self.coefficients, self.names)

    def __pos__(self) -> "Polynomial":
        return self

    def __pow__(self, power: Any) -> "Polynomial":
        whole = isinstance(power, (Integral, float, np.floating)) and float(power).is_integer()
        if not whole or power < 0:
            raise NotPolynomial(f"power {power!r} of {_short(self)} is not a polynomial")
        result, square, left = constant(1, names=self.names), self, int(power)
        while left:
            result = _product(result, square) if left & 1 else result
            left >>= 1
            square = _product(square, square) if left else square
        return result

    def __eq__(self, other: object) -> bool:
        try:
            difference = _sum(self, -as_polynomial(other))
        except NotPolynomial:
            return NotImplemented
        if difference.degree and TRACING.get():
            raise NotPolynomial(f"comparison == of {_short(self)} is not a polynomial")
        return len(difference) == 0

    def __hash__(self) -> int:
        if self.degree and TRACING.get():
            raise NotPolynomial(f"a set or dictionary of {_short(self)} is not a polynomial")
        return hash(frozenset((exponent[exponent > 0].tobytes()) for exponent in self.exponents))

    def __float__(self) -> float:
        if self.degree:
            raise NotPolynomial(f"float() or a math function of {_short(self)}: not a polynomial")
        return float(self.coefficients.sum())

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **_: Any) -> Any:
        """NumPy's protocol: `array * polynomial` and `np.sqrt(polynomial)` arrive here."""
        names = OPERATORS.get(ufunc.__name__)
        if method != "__call__" or names is None or len(inputs) > 2:
            raise NotPolynomial(f"{ufunc.__name__} of {_short(self)} is not a polynomial")
        if isinstance(inputs[0], Polynomial):
            return getattr(inputs[0], names[0])(*inputs[1:])
        return getattr(inputs[1], names[1])(inputs[0])

    def _combine(
        self, other: Any, operation: Callable[["Polynomial", "Polynomial"], "Polynomial"]
    ) -> Any:
        if isinstance(other, np.ndarray) and other.ndim:
            return objects_at(other.shape, lambda at: self._combine(other[at], operation))
        return operation(self, as_polynomial(other))

    # -- text --------------------------------------------------------------------------------

    def __repr__(self) -> str:
        text = ""
        for exponent, coefficient in reversed(list(self.terms())):
            factors = [
                name if power == 1 else f"{name}**{power}"
                for name, power in zip(self.names, exponent, strict=True)
                if power
            ]
            size = str(abs(coefficient)).removesuffix(".0")  # exact: floats print shortest
            if factors and size == "1":
                size = ""
            sign = "-" if coefficient < 0 else "+"
            text += f" {sign} " if text else "-" if sign == "-" else ""
            text += "*".join(([size] if size else []) + factors)
        return text or "0"


def variables(names: str | Sequence[str]) -> tuple[Polynomial, ...]:
    """One polynomial per name (a sequence, or one string split at spaces), in one common space."""
    names = tuple(names.split()) if isinstance(names, str) else tuple(names)
    unit = np.eye(len(names), dtype=np.int64)
    return tuple(Polynomial(unit[[j]], np.ones(1), names) for j in range(len(names)))


def constant(value: Number, *, names: Sequence[str] = ()) -> Polynomial:
    """A constant; a Fraction makes an exact polynomial, any other number a float64 one."""
    kind = object if isinstance(value, Fraction) else np.float64
    return Polynomial(
        np.zeros((1, len(names)), dtype=np.int64), np.array([value], dtype=kind), tuple(names)
    )


def as_polynomial(value: Any) -> Polynomial:
    """A polynomial as it is, a number as a constant; NotPolynomial for anything else."""
    if isinstance(value, Polynomial):
        return value
    if isinstance(value, np.ndarray) and value.ndim == 0:
        return as_polynomial(value.item())
    if isinstance(value, (Rational, float, np.floating)):
        if isinstance(value, Integral):
            return constant(int(value) if abs(int(value)) <= 2**53 else Fraction(int(value)))
        return constant(Fraction(value) if isinstance(value, Rational) else float(value))
    raise NotPolynomial(f"{value!r} ({type(value).__name__}) is not a real number or a polynomial")


def _merge(exponents: IntArray, coefficients: Coefficients) -> tuple[IntArray, Coefficients]:
    """Sort by degree, then lexicographically; add equal terms; drop zeros."""
    if len(exponents) > 1:
        order = np.lexsort((*exponents.T[::-1], exponents.sum(axis=1)))
        exponents, coefficients = exponents[order], coefficients[order]
        first = np.r_[True, (exponents[1:] != exponents[:-1]).any(axis=1)]
        if not first.all():
            starts = np.flatnonzero(first)
            exponents, coefficients = exponents[starts], np.add.reduceat(coefficients, starts)
    keep = (coefficients != 0).astype(bool)
    return exponents[keep], coefficients[keep]


def _rationals(values: Coefficients) -> Coefficients:
    try:
        exact = [Fraction(value) for value in values.tolist()]
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"coefficients should be numbers: {error}") from error
    return objects(exact)


def _aligned(a: Polynomial, b: Polynomial) -> tuple[Polynomial, Polynomial]:
    if a.names != b.names:
        names = a.names + tuple(name for name in b.names if name not in a.names)
        a, b = a.over(names), b.over(names)
    if a.is_exact != b.is_exact:
        a, b = a.exact(), b.exact()
    return a, b


def _sum(a: Polynomial, b: Polynomial) -> Polynomial:
    a, b = _aligned(a, b)
    return Polynomial(
        np.concatenate([a.exponents, b.exponents]),
        np.concatenate([a.coefficients, b.coefficients]),
        a.names,
    )


def _product(a: Polynomial, b: Polynomial) -> Polynomial:
    a, b = _aligned(a, b)
    exponents = a.exponents[:, None, :] + b.exponents[None, :, :]
    return Polynomial(
        exponents.reshape(len(a) * len(b), len(a.names)),
        np.multiply.outer(a.coefficients, b.coefficients).ravel(),
        a.names,
    )


def _quotient(a: Polynomial, b: Polynomial) -> Polynomial:
    if b.degree:
        raise NotPolynomial(f"division by {_short(b)} is not a polynomial")
    if not len(b):
        raise ZeroDivisionError(f"division of {_short(a)} by zero")
    a, b = _aligned(a, b)
    return Polynomial(a.exponents, a.coefficients / b.coefficients[0], a.names)


def _short(p: Polynomial) -> str:
    text = repr(p)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _refusal(operation: str) -> Callable[..., Polynomial]:
    def refuse(self: Polynomial, *_: Any) -> Polynomial:
        raise NotPolynomial(f"{operation} of {_short(self)} is not a polynomial")

    return refuse


for _name, _operation in REFUSED.items():
    setattr(Polynomial, _name, _refusal(_operation))
