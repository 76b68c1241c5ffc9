"""Dynamics that are not polynomial: cubic Taylor models along a motion, with remainders bounded.

`Rates` holds a Python function of t, x, u and w; `Cubic` is what it becomes on one box. Rates that
are cubics as they are written stay what they are; every other one has a bounded w of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from math import inf, nextafter
from typing import Any

import numpy as np

from nlsid_core.arrays import ArrayLike, FloatArray, IntArray, objects
from nlsid_core.dynamics.taylor_model import (
    DEGREE,
    ROUNDING,
    SUMMED,
    TaylorModel,
    variables_of,
)
from nlsid_core.dynamics.vector_field import (
    Plan,
    VectorField,
    arguments,
    box_of,
    no_entry,
    variable_names,
)
from nlsid_core.errors import DataError, NlsidError, NotPolynomial, ShapeError
from nlsid_core.polynomial import Polynomial
from nlsid_core.polynomial.algebra import as_polynomial, constant, variables

EXPANSION = (
    "cubic Taylor models with a remainder bounded in float64 arithmetic that counts every rounding "
    "and trusts elementary functions to a few units in the last place"
)
CENTRE_BITS = 12  # of a centre, relative to the radius: powers of x - c have short coefficients
NEGLIGIBLE = 1e-12  # of a row's size: such coefficients go to its remainder
MAX_TOTAL_DEGREE = 7  # of a monomial, t included, that the kernel reads
MAX_PRODUCTS = 3  # uncertain entries, remainders included, with which w may multiply x: corners
KNOWN = (
    "+, -, *, /, abs, whole powers, np.sqrt, np.sin, np.cos, np.tan, np.exp, np.log, np.tanh, "
    "np.arctan, np.arctan2, and nlsid_core.dynamics.solve(A, b) for small linear systems"
)


@dataclass(frozen=True, eq=False)
class Rates:
    """ẋ = function(...) of some of t, x (n,), u (m,), w, named so; w in the box `uncertain`.

    exact: the rates that are polynomials of degree 3 at most in (x, u); else None. uses: of every
    other rate, the entries of z = (t, x, u, w) that it depends on. affine: every cubic is affine in
    each input, as a hold needs it; what is left out is in its remainder. valid: (D, 3) as of a
    VectorField: every box is cut to it, and every field of cubics states it.

    Raises NlsidError, naming what is supported, on a function that nothing here expands.
    """

    function: Callable[..., Any]
    n: int
    m: int
    uncertain: FloatArray
    exact: tuple[Polynomial | None, ...]
    uses: tuple[frozenset[int], ...]
    affine: bool = False
    valid: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    @classmethod
    def of(
        cls,
        function: Callable[..., Any],
        n: int,
        m: int,
        uncertain: ArrayLike | None = None,
        *,
        affine: bool = False,
    ) -> Rates:
        """Look at the function once, with symbols."""
        box = box_of(function, uncertain)
        names = ("t", *variable_names(n, m, len(box)))
        blank = cls(function, n, m, box, (), ())
        symbols = [_Symbol(p.exact(), frozenset([j])) for j, p in enumerate(variables(names))]
        traced = [_Symbol.made(row) for row in blank.called(symbols)]
        exact = [row.cubic(names, 1 + n + m) for row in traced]
        if affine:
            inputs = slice(1 + n, 1 + n + m)
            exact = [None if p is None or (p.exponents[:, inputs] > 1).any() else p for p in exact]
        return cls(function, n, m, box, tuple(exact), tuple(row.uses for row in traced), affine)

    @classmethod
    def numeric(cls, function: Callable[..., Any], n: int, m: int) -> Rates:
        """Only for values at points: nothing is asked of the function but numbers."""
        return cls(function, n, m, box_of(function, None), (), ())

    @property
    def depends_on_time(self) -> bool:
        """True if the function has an argument t."""
        return "t" in arguments(self.function)

    @property
    def inexact(self) -> list[int]:
        """The rates that need expanding."""
        return [i for i, p in enumerate(self.exact) if p is None]

    @cached_property
    def plan(self) -> Plan:
        """The plan for values of the exact rates, with 0 in the place of the others."""
        names = ("t", *variable_names(self.n, self.m, len(self.uncertain)))
        none = constant(0.0, names=names)
        return Plan.of([none if p is None else p for p in self.exact], names)

    @property
    def expanded(self) -> list[int]:
        """The entries of (x, u) that a rate depends on that needs expanding: they have a box."""
        used = set().union(*(self.uses[i] for i in self.inexact)) if self.inexact else set()
        return sorted(j - 1 for j in used if 0 < j <= self.n + self.m)

    def called(self, z: Sequence[Any]) -> list[Any]:
        """The rates for entries z = (t, x, u, w) of any kind."""
        n, m = self.n, self.m
        held = objects(z)
        parts = {
            "t": z[0],
            "x": held[1 : 1 + n],
            "u": held[1 + n : 1 + n + m],
            "w": held[1 + n + m :],
        }
        try:
            rows = self.function(**{name: parts[name] for name in arguments(self.function)})
            rows = (
                list(np.asarray(rows, dtype=object).reshape(-1))
                if isinstance(rows, np.ndarray)
                else list(rows)
            )
        except NlsidError:
            raise
        except IndexError as error:
            raise no_entry(error, n, m, len(self.uncertain)) from error
        except ZeroDivisionError as error:
            raise DataError(f"the dynamics divide by zero ({error})") from error
        except Exception as error:
            raise DataError(
                f"the dynamics cannot be expanded ({type(error).__name__}: {error}); known are "
                f"{KNOWN}. Write what is not known with these, or give its effect as a bounded w"
            ) from error
        if len(rows) != n:
            raise ShapeError(f"the dynamics return {len(rows)} rates for {n} states")
        return rows

    def __call__(
        self, t: float, X: ArrayLike, U: ArrayLike, W: ArrayLike | None = None
    ) -> FloatArray:
        """ẋ (N, n) at X (N, n), U (N, m), W (N, n_w) or (n_w,); w in the centre if not given."""
        X, U = (np.atleast_2d(np.asarray(part, dtype=np.float64)) for part in (X, U))
        given = self.uncertain.mean(axis=1) if W is None else np.asarray(W, dtype=np.float64)
        W = np.broadcast_to(given, (len(X), len(self.uncertain)))
        names = arguments(self.function)

        def called(x: FloatArray, u: FloatArray, w: FloatArray) -> Any:
            parts = {"t": t, "x": x, "u": u, "w": w}
            return self.function(**{name: parts[name] for name in names})

        try:
            first = np.asarray(called(X[0], U[0], W[0]), dtype=np.float64).reshape(-1)
        except NlsidError:
            raise
        except IndexError as error:
            raise no_entry(error, self.n, self.m, len(self.uncertain)) from error
        except Exception as error:
            raise DataError(
                f"the dynamics have no value at t = {t:.6g}, x = {X[0].tolist()}, u = "
                f"{U[0].tolist()} ({type(error).__name__}: {error})"
            ) from error
        if first.shape != (self.n,):
            raise ShapeError(f"the dynamics return {len(first)} rates for {self.n} states")
        if len(X) == 1:
            return first[None]
        try:  # all points at once, if the function is written so that this is the same
            rows = [np.broadcast_to(row, (len(X),)) for row in called(X.T, U.T, W.T)]
            last = np.asarray(called(X[-1], U[-1], W[-1]), dtype=np.float64).reshape(-1)
            whole = np.array(rows, dtype=np.float64).T
            if whole.shape == X.shape and np.allclose(whole[[0, -1]], [first, last], 1e-12, 1e-12):
                return whole
        except (TypeError, ValueError, IndexError):
            pass
        return np.array(
            [called(x, u, w) for x, u, w in zip(X, U, W, strict=True)], dtype=np.float64
        )

    def on(self, low: FloatArray, high: FloatArray, times: tuple[float, float]) -> Cubic:
        """The cubics on the box low ≤ (x, u) ≤ high, (n + m,), and the times; DataError if none."""
        low, high = low.copy(), high.copy()
        for j, least, most in self.valid.tolist():
            low[int(j)], high[int(j)] = max(low[int(j)], least), min(high[int(j)], most)
        bottom = np.concatenate([[times[0]], low, self.uncertain[:, 0]])
        top = np.concatenate([[times[1]], high, self.uncertain[:, 1]])
        centre, radius = _centred(bottom, top)
        z = [
            TaylorModel.variable(j, c, r)
            for j, (c, r) in enumerate(zip(centre.tolist(), radius.tolist(), strict=True))
        ]
        rows = self.called(z) if self.inexact else []
        chosen = {i: _Row.of(rows[i], self) for i in self.inexact}
        return Cubic(self, centre, radius, chosen)


@dataclass(frozen=True, eq=False)
class _Row:
    """Σ coefficients·Π d_j and a bound of the rest. places: (M, 3) those j, -1 for none."""

    monomials: tuple[tuple[int, ...], ...]
    coefficients: FloatArray
    bound: float
    places: IntArray

    @classmethod
    def of(cls, row: Any, rates: Rates) -> _Row:
        """Products of w with anything else go to the bound, if too many corners would decide.

        Of affine rates a square d_j² of an input is 1/2 ± 1/2, as |d_j| ≤ 1.
        """
        if not isinstance(row, TaylorModel):
            return cls(((),), np.array([float(row)]), 0.0, np.full((1, 3), -1))
        first = 1 + rates.n + rates.m
        products = len(rates.uncertain) + len(rates.inexact) <= MAX_PRODUCTS
        kept, values, bound = [], [], row.error
        for key, value in zip(row.keys.tolist(), row.coefficients.tolist(), strict=True):
            used = variables_of(key)
            if rates.affine:
                used, value, left = _once(used, value, range(1 + rates.n, first))
                bound = nextafter(bound + left, inf)
            uncertain = sum(j >= first for j in used)
            if uncertain > 1 or (uncertain and len(used) > 1 and not products):
                bound = nextafter(bound + abs(value), inf)
            else:
                kept.append(used)
                values.append(value)
        places = np.array([(*used, -1, -1, -1)[:3] for used in kept])
        return cls(tuple(kept), np.array(values), bound, places)


@dataclass(frozen=True, eq=False)
class Cubic:
    """What `rates` are on one box, z = centre + radius·d: exact rates, and rows with bounds."""

    rates: Rates
    centre: FloatArray
    radius: FloatArray
    rows: dict[int, _Row]

    @property
    def bounds(self) -> FloatArray:
        """(n,) the most that the cubics leave out; 0 for exact rates."""
        return np.array(
            [self.rows[i].bound if i in self.rows else 0.0 for i in range(self.rates.n)]
        )

    def __call__(self, t: float, X: FloatArray, U: FloatArray, w: FloatArray) -> FloatArray:
        """ẋ (N, n) of the cubics at X (N, n), U (N, m) and w (..., n_w + remainders)."""
        rates, given = self.rates, len(self.rates.uncertain)
        z = np.hstack(
            [np.full((len(X), 1), t), X, U, np.broadcast_to(w[..., :given], (len(X), given))]
        )
        result = rates.plan(z.T)
        if not self.rows:
            return result
        d = np.divide(z - self.centre, self.radius, out=np.zeros_like(z), where=self.radius > 0)
        stack = np.hstack([d, np.ones((len(X), 1))])
        for place, (i, row) in enumerate(self.rows.items()):
            products = stack[:, row.places[:, 0]]
            for j in (1, 2):
                products = products * stack[:, row.places[:, j]]
            result[:, i] = products @ row.coefficients + row.bound * w[..., given + place]
        return result

    def pushes(self) -> FloatArray:
        """(n, n_w + remainders) what each w adds to ẋ, where it does nothing else."""
        rates, given = self.rates, len(self.rates.uncertain)
        first = 1 + rates.n + rates.m
        result = np.zeros((rates.n, given + len(self.rows)))
        for i, p in enumerate(rates.exact):
            for exponent, c in () if p is None else p.terms():
                for j in np.flatnonzero(exponent[first:]).tolist():
                    result[i, j] = float(c)
        for place, (i, row) in enumerate(self.rows.items()):
            result[i, given + place] = row.bound
            for used, c in zip(row.monomials, row.coefficients.tolist(), strict=True):
                if used and used[0] >= first:
                    width = float(self.radius[used[0]])
                    result[i, used[0] - first] += c / width if width else 0.0
        return result

    def nonlinear_states(self) -> tuple[int, ...]:
        """What `VectorField.nonlinear_states` is, whatever coefficients vanish on this box."""
        n, last = self.rates.n, 1 + self.rates.n + self.rates.m
        rows = [
            [j for j in used if 0 < j < last]
            for row in self.rows.values()
            for used in row.monomials
        ]
        for p in self.rates.exact:
            exponents = [] if p is None else p.exponents[:, 1:last].tolist()
            rows += [[1 + j for j, e in enumerate(row) for _ in range(e)] for row in exponents]
        high = [row for row in rows if len(row) > 1]
        if any(sum(j > n for j in row) > 1 for row in high):
            return tuple(range(n))
        return tuple(sorted({j - 1 for row in high for j in row if j <= n}))

    @cached_property
    def equations(self) -> tuple[tuple[Polynomial, ...], FloatArray]:
        """(n) polynomials in t, x, u, w with exact coefficients, and bounds (n,) of the rest."""
        rates = self.rates
        names = ("t", *variable_names(rates.n, rates.m, len(rates.uncertain)))
        found, bounds = [], np.zeros(rates.n)
        for i, p in enumerate(rates.exact):
            if p is None:
                p, bounds[i] = self._in_states(self.rows[i], names)
            found.append(p)
        return tuple(found), bounds

    def box(self) -> tuple[FloatArray, FloatArray]:
        """(n + m,) low and high of (x, u), rounded inward."""
        chosen = slice(1, 1 + self.rates.n + self.rates.m)
        centre, radius = self.centre[chosen], self.radius[chosen]
        return np.nextafter(centre - radius, np.inf), np.nextafter(centre + radius, -np.inf)

    def _in_states(self, row: _Row, names: tuple[str, ...]) -> tuple[Polynomial, float]:
        """Σ (coefficient/Π r_j)·Π (z_j - c_j), the quotient rounded, and a bound of the rest."""
        sizes = np.abs(row.coefficients)
        kept = sizes > NEGLIGIBLE * (float(sizes.sum()) + row.bound)
        scales = np.append(self.radius, 1.0)[row.places[kept]].prod(axis=1)
        lost = float(sizes[~kept].sum() + ROUNDING * sizes.sum())
        # Floats are whole numbers over powers of two: all of them over the same ones.
        centre, unit = _whole(self.centre)
        quotients, common = _whole(row.coefficients[kept] / scales)
        total: dict[tuple[int, ...], int] = {}
        for place, value in zip(np.flatnonzero(kept).tolist(), quotients, strict=True):
            parts = {(0,) * len(names): value << unit * (3 - len(row.monomials[place]))}
            for j in row.monomials[place]:  # times z_j - centre_j
                product: dict[tuple[int, ...], int] = {}
                for exponent, c in parts.items():
                    higher = (*exponent[:j], exponent[j] + 1, *exponent[j + 1 :])
                    product[higher] = product.get(higher, 0) + (c << unit)
                    if centre[j]:
                        product[exponent] = product.get(exponent, 0) - c * centre[j]
                parts = product
            for exponent, c in parts.items():
                total[exponent] = total.get(exponent, 0) + c
        coefficients = objects([Fraction(c, 1 << common + 3 * unit) for c in total.values()])
        exponents = np.array(list(total), dtype=np.int64).reshape(-1, len(names))
        return Polynomial(exponents, coefficients, names), (row.bound + lost) * SUMMED


def _whole(values: FloatArray) -> tuple[list[int], int]:
    """Whole numbers that are the values times 2^k, and k."""
    ratios = [value.as_integer_ratio() for value in values.tolist()]
    k = max((below.bit_length() - 1 for _, below in ratios), default=0)
    return [above << k - below.bit_length() + 1 for above, below in ratios], k


def taylor_field(
    rate: Callable[..., Any],
    t: ArrayLike,
    x: ArrayLike,
    u: ArrayLike,
    *,
    radius: ArrayLike,
    uncertain: ArrayLike | None = None,
) -> VectorField:
    """rate(t, x, u, w) as a cubic per interval of a motion, and what it leaves out as bounded w.

    rate: of any of these arguments, named so. t: (K,) s; x: (K, n), u: (K, m) the motion there.
    radius: (n + m,), or (K-1, n + m), how far (x, u) may be from the motion's range on an interval:
    `valid` states those boxes, so a funnel is proved to stay in them. uncertain: rows (low, high)
    of the entries of w. Every state whose rate is not a cubic as it stands has a w in [-1, 1] more,
    scaled to its bound. Raises DataError, naming what is supported, if rate cannot be expanded.
    """
    t, x, u = (np.asarray(part, dtype=np.float64) for part in (t, x, u))
    if t.ndim != 1 or x.ndim != 2 or u.ndim != 2 or not len(t) == len(x) == len(u) >= 2:
        raise ShapeError(
            f"a motion should be t (K,), x (K, n) and u (K, m), is {t.shape}, {x.shape}, {u.shape}"
        )
    z = np.hstack([x, u])
    radius = np.asarray(radius, dtype=np.float64)
    if radius.shape not in (z.shape[1:], (len(z) - 1, z.shape[1])):
        raise ShapeError(f"radius should have {z.shape[1]} entries, has shape {radius.shape}")
    if not (radius >= 0).all():
        raise DataError(f"radius should be how far (x, u) may be, 0 or more; it is {radius}")
    rates = Rates.of(rate, x.shape[1], u.shape[1], uncertain)
    low, high = np.minimum(z[:-1], z[1:]) - radius, np.maximum(z[:-1], z[1:]) + radius
    spans = zip(low, high, t[:-1].tolist(), t[1:].tolist(), strict=True)
    return field_of([rates.on(a, b, (start, end)) for a, b, start, end in spans], t)


def field_of(cubics: Sequence[Cubic], t: FloatArray) -> VectorField:
    """The vector field of one `Cubic` per interval between the times t (K,)."""
    rates = cubics[0].rates
    n, m, given, rows = rates.n, rates.m, rates.uncertain, rates.inexact
    names = ("t", *variable_names(n, m, len(given) + len(rows)))
    pieces: list[tuple[Polynomial, ...]] = []
    valid = []
    for span, cubic in enumerate(cubics):
        found, bounds = cubic.equations
        equations = [p.over(names) for p in found]
        for place, i in enumerate(rows):
            unit = np.zeros((1, len(names)), dtype=np.int64)
            unit[0, 1 + n + m + len(given) + place] = 1
            equations[i] = equations[i] + Polynomial(unit, np.array([bounds[i]]), names).exact()
        pieces.append(tuple(equations))
        low, high = cubic.box()
        valid += [(j, float(low[j]), float(high[j]), span) for j in rates.expanded]
    uncertain = np.vstack([given, np.tile([-1.0, 1.0], (len(rows), 1))])
    if not rows:
        return VectorField((pieces[0],), n, m, uncertain=uncertain, valid=rates.valid)
    made = VectorField(
        tuple(pieces), n, m, t[1:-1], uncertain, np.array(valid).reshape(-1, 4), EXPANSION
    )
    return made.within(rates.valid[~np.isin(rates.valid[:, 0], rates.expanded)])


def _once(
    used: tuple[int, ...], value: float, inputs: range
) -> tuple[tuple[int, ...], float, float]:
    """value·Π d_j with no input's d_j twice, and the most that this differs by where |d| ≤ 1."""
    for j in used:
        if j in inputs and used.count(j) > 1:
            rest = list(used)
            rest.remove(j)
            rest.remove(j)
            return tuple(rest), value / 2, nextafter(abs(value) / 2, inf)
    return used, value, 0.0


def _centred(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centres of few bits and radii that cover [low, high]."""
    half = np.maximum((high - low) / 2, 1e-12)
    grid = np.exp2(np.floor(np.log2(half)) - CENTRE_BITS)
    centre = np.round((low + high) / 2 / grid) * grid
    radius = np.maximum(np.maximum(high - centre, centre - low), half) * (1 + 2.0**-40)
    return centre, np.where(high > low, radius, np.where(centre == low, 0.0, radius))


class _Symbol:
    """A polynomial, or something that is none; and the entries of z that it depends on."""

    __slots__ = ("p", "uses")

    def __init__(self, p: Polynomial | None, uses: frozenset[int]) -> None:
        self.p, self.uses = p, uses

    @classmethod
    def made(cls, value: Any) -> _Symbol:
        if isinstance(value, _Symbol):
            return value
        return cls(as_polynomial(value).exact(), frozenset())

    def cubic(self, names: tuple[str, ...], first: int) -> Polynomial | None:
        """The polynomial if it can stand in a vector field as it is; first: the place of w0."""
        if self.p is None:
            return None
        p = self.p.over(names)
        e = p.exponents
        small = (e[:, 1:first].sum(axis=1) <= DEGREE).all() and (e[:, first:] <= 1).all()
        return p if small and p.degree <= MAX_TOTAL_DEGREE else None

    def _with(self, other: Any, name: str) -> Any:
        if isinstance(other, np.ndarray) and other.ndim:
            return NotImplemented
        other = _Symbol.made(other)
        uses, p = self.uses | other.uses, None
        if self.p is not None and other.p is not None:
            try:
                p = getattr(self.p, name)(other.p)
            except NotPolynomial:
                p = None
        if p is not None and p.degree > MAX_TOTAL_DEGREE:
            p = None
        return _Symbol(p, uses)

    def _power(self, power: Any) -> _Symbol:
        try:
            p = (
                None
                if self.p is None or self.p.degree * power > MAX_TOTAL_DEGREE
                else self.p**power
            )
        except NotPolynomial:
            p = None
        return _Symbol(p, self.uses)

    def _unknown(self, *others: Any) -> _Symbol:
        uses = self.uses.union(*(o.uses for o in others if isinstance(o, _Symbol)))
        return _Symbol(None, uses)

    def _refused(self, *_: Any) -> Any:
        raise TypeError("a comparison: which branch holds is not known on a whole box")

    __pow__ = _power
    __eq__ = __ne__ = __lt__ = __le__ = __gt__ = __ge__ = __bool__ = _refused
    __hash__ = None  # type: ignore[assignment]
    __abs__ = sqrt = sin = cos = tan = exp = log = tanh = arctan = arctan2 = fabs = _unknown
    absolute = _unknown

    def square(self) -> _Symbol:
        return self._power(2)

    def __float__(self) -> float:
        raise TypeError(
            "functions of `math` take numbers only: take NumPy's, such as np.sin; "
            "an array of floats holds numbers only: return a list"
        )

    def __neg__(self) -> _Symbol:
        return _Symbol(None if self.p is None else -self.p, self.uses)

    def __pos__(self) -> _Symbol:
        return self


for _name in ("add", "radd", "sub", "rsub", "mul", "rmul", "truediv", "rtruediv"):
    setattr(
        _Symbol, f"__{_name}__", lambda self, other, _name=f"__{_name}__": self._with(other, _name)
    )
