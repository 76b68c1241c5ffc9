"""`VectorField`: polynomial dynamics ẋ = f(t, x, u, w), exact, piecewise in time if need be."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from itertools import pairwise, product
from typing import Any

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import ArrayLike, FloatArray, IntArray, Json, keep, objects
from nlsid_core.errors import DataError, DocumentError, NlsidError, NotPolynomial, ShapeError
from nlsid_core.options import numbers
from nlsid_core.polynomial import Polynomial, trace, variables
from nlsid_core.polynomial.documents import write_number
from nlsid_core.polynomial.maps import coefficient_table

FORMAT = "nlsid/vector_field"
MANY_PUSHES, FEW_STATES = 3, 4  # with few of both, corners are exact and cheap enough
MAX_UNCERTAIN = 32  # of which more than 10 have to be pushes: their box has too many vertices
MAX_VARIABLES = 200
MAX_SENTENCE = 200  # characters
ARGUMENTS = ("t", "x", "u", "w")
_RATIONAL = re.compile(r"-?[0-9]{1,4000}(/[1-9][0-9]{0,3999})?", re.ASCII)


@dataclass(frozen=True, eq=False)
class VectorField:
    """Equations of motion, ẋ_i = pieces[j][i](t, x, u, w).

    The j-th pieces hold on the j-th of the time spans that `breaks` separate.

    pieces: exact polynomials in `names` = t, x0.., u0.., w0... n, m: numbers of states and inputs.
    breaks: (J-1,) s, increasing, where the equations change. uncertain: (n_w, 2) lower and upper
    bounds of w, which may vary arbitrarily in time within its box: bounded disturbances and
    uncertain parameters; w has to enter with degree at most one in each entry. valid: (D, 3) rows
    (j, low, high): the equations describe the system only where entry j of (x, u) is within; a
    proved funnel stays there. Rows (j, low, high, span), (D, 4), hold in that time span only.
    expansion: for equations that expand others, with what they leave out as w, one sentence that
    says how its bounds were computed; every proof then names it as an assumption. Else empty.

    Raises ShapeError or DataError on equations that do not fit.
    """

    pieces: tuple[tuple[Polynomial, ...], ...]
    n: int
    m: int
    breaks: FloatArray = field(default_factory=lambda: np.zeros(0))
    uncertain: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    valid: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    expansion: str = ""

    def __post_init__(self) -> None:
        bounds = np.array(self.uncertain, dtype=np.float64).reshape(-1, 2)
        breaks = np.array(self.breaks, dtype=np.float64)
        if not (np.isfinite(bounds).all() and (bounds[:, 0] <= bounds[:, 1]).all()):
            raise DataError(
                f"bounds of the uncertain w should be finite pairs low <= high: {bounds}"
            )
        if len(bounds) > MAX_UNCERTAIN:
            raise DataError(f"{len(bounds)} uncertain entries; at most {MAX_UNCERTAIN} are decided")
        if breaks.ndim != 1 or not np.isfinite(breaks).all() or (np.diff(breaks) <= 0).any():
            raise DataError(f"breaks should be increasing times, are {breaks}")
        names = ("t", *variable_names(self.n, self.m, len(bounds)))
        valid = np.array(self.valid, dtype=np.float64)
        if valid.size == 0:
            valid = np.zeros((0, 3))
        sound = valid.ndim == 2 and valid.shape[1] in (3, 4) and np.isfinite(valid).all()
        if not (
            sound
            and np.isin(valid[:, 0], range(self.n + self.m)).all()
            and np.isin(valid[:, 3:], range(len(self.pieces))).all()
        ):
            raise DataError(
                "rows of valid should be (entry of (x, u), low, high), and the span where only "
                f"one is meant; they are {valid.tolist()}"
            )
        if len(self.expansion) > MAX_SENTENCE or not self.expansion.isprintable():
            raise DataError(f"expansion should be one sentence of at most {MAX_SENTENCE} signs")
        if not self.pieces or len(self.pieces) != len(breaks) + 1:
            raise ShapeError(f"{len(self.pieces)} sets of equations for {len(breaks)} breaks")
        pieces = []
        for equations in self.pieces:
            if len(equations) != self.n:
                raise ShapeError(f"{len(equations)} equations for {self.n} states")
            pieces.append(tuple(p.exact().over(names) for p in equations))
            for i, p in enumerate(pieces[-1]):
                if (p.exponents[:, 1 + self.n + self.m :] > 1).any():
                    raise DataError(f"dx{i}/dt is not affine in each uncertain w: {p}")
        keep(self, {"breaks": breaks, "uncertain": bounds, "valid": valid})
        object.__setattr__(self, "pieces", tuple(pieces))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """t, x0.., u0.., w0..."""
        return ("t", *variable_names(self.n, self.m, len(self.uncertain)))

    @cached_property
    def _plans(self) -> tuple[Plan, ...]:
        return tuple(Plan.of(p, self.names) for p in self.pieces)

    @cached_property
    def coefficients(self) -> tuple[IntArray, FloatArray]:
        """(M, variables) the monomials that occur, and (pieces, n, M) their coefficients."""
        exponents, table = _table([p for piece in self.pieces for p in piece], self.names)
        return exponents, table.T.reshape(len(self.pieces), self.n, -1)

    @classmethod
    def from_function(
        cls,
        function: Callable[..., Any],
        n: int,
        m: int,
        *,
        uncertain: ArrayLike | None = None,
        valid: ArrayLike | None = None,
        expansion: str = "",
    ) -> VectorField:
        """Trace a Python function of any of t, x, u, w, named so, that returns ẋ (n,).

        Raises NotPolynomial naming the operation; where a function is taken, it is then expanded.
        """
        given, bounds = arguments(function), box_of(function, uncertain)
        sizes = {"t": 1, "x": n, "u": m, "w": len(bounds)}

        def called(*vectors: Any) -> Any:
            parts = zip(given, vectors, strict=True)
            return function(**{name: v[0] if name == "t" else v for name, v in parts})

        called.__name__ = getattr(function, "__name__", "dynamics")
        try:
            traced = trace(called, {name: sizes[name] for name in given})
        except IndexError as error:
            raise no_entry(error, n, m, len(bounds)) from error
        except ZeroDivisionError as error:
            raise DataError(f"the dynamics divide by zero ({error})") from error
        except NotPolynomial as error:
            raise NotPolynomial(
                f"{error}. Design a funnel with the function itself, which is then expanded along "
                "the motion; or give a polynomial, and what it leaves out as a bounded w"
            ) from error
        except NlsidError:
            raise
        except Exception as error:
            raise NotPolynomial(
                f"{called.__name__} cannot be called with polynomials "
                f"({type(error).__name__}: {error})"
            ) from error
        if traced.shape != (n,):
            raise ShapeError(f"{called.__name__} returned shape {traced.shape}, expected ({n},)")
        equations = []
        for p in traced.tolist():
            renamed = tuple("t" if name == "t0" else name for name in p.names)
            equations.append(Polynomial(p.exponents, p.coefficients, renamed))
        names = ("t", *variable_names(n, m, len(bounds)))
        within = np.zeros((0, 3)) if valid is None else np.asarray(valid, dtype=np.float64)
        pieces = (tuple(p.over(names) for p in equations),)
        return cls(pieces, n, m, uncertain=bounds, valid=within, expansion=expansion)

    def pushed(self, box: ArrayLike) -> VectorField:
        """ẋ = f + w with w in `box` (n, 2) too; a row of zeros adds nothing."""
        rows = np.asarray(box, dtype=np.float64)
        if rows.shape != (self.n, 2):
            raise ShapeError(f"the box of a push on {self.n} states has shape {rows.shape}")
        states = np.flatnonzero(rows.any(axis=1)).tolist()
        names = [f"w{len(self.uncertain) + j}" for j in range(len(states))]
        added = dict(zip(states, variables(names), strict=True))
        return replace(
            self,
            pieces=tuple(
                tuple(p + added[i].exact() if i in added else p for i, p in enumerate(piece))
                for piece in self.pieces
            ),
            uncertain=np.vstack([self.uncertain, rows[states]]),
        )

    def within(self, rows: FloatArray) -> VectorField:
        """The same equations, valid only where entries of (x, u) are within `rows` (D, 3) too."""
        if self.valid.shape[1] == 4:
            spans = range(len(self.pieces))
            more = [[*row, span] for row in rows.tolist() for span in spans]
            rows = np.array(more).reshape(-1, 4)
        return replace(self, valid=np.vstack([self.valid, rows]))

    @property
    def depends_on_time(self) -> bool:
        """True if t occurs, or equations change at some time."""
        used = any(p.exponents[:, 0].any() for piece in self.pieces for p in piece)
        return used or len(self.breaks) > 0

    @property
    def degree(self) -> int:
        """Largest total degree in x and u."""
        columns = slice(1, 1 + self.n + self.m)
        return max(
            int(np.max(p.exponents[:, columns].sum(axis=1), initial=0))
            for equations in self.pieces
            for p in equations
        )

    @property
    def nonlinear_states(self) -> tuple[int, ...]:
        """States such that every term of degree d ≥ 2 in x and u has at least d - 1 of them.

        Those in terms of degree 2 or more, if inputs do not spoil it; else all of them. All, too,
        if w is taken at its corners: a push is a term of degree 1 in Ẇ.
        """
        if len(self.uncertain) and not self.is_pushed:
            return tuple(range(self.n))
        return self.curved_states

    @property
    def curved_states(self) -> tuple[int, ...]:
        """`nonlinear_states` where w is not taken at its corners."""
        found: set[int] = set()
        for equations in self.pieces:
            for p in equations:
                high = p.exponents[p.exponents[:, 1 : 1 + self.n + self.m].sum(axis=1) > 1]
                inputs = high[:, 1 + self.n : 1 + self.n + self.m].sum(axis=1)
                if (inputs > 1).any():
                    return tuple(range(self.n))
                found |= set(np.flatnonzero(high[:, 1 : 1 + self.n].any(axis=0)).tolist())
        return tuple(sorted(found))

    @property
    def is_pushed(self) -> bool:
        """True if w only adds constants to ẋ, and has so many entries that corners are too many.

        Then 2|x̄'Pg|r ≤ r(κ(x̄'Pg)² + 1/κ) bounds what each does, and no corner is needed.
        """
        many = MANY_PUSHES if self.n <= FEW_STATES else 1
        return len(self.uncertain) >= many and self.only_pushes

    @property
    def only_pushes(self) -> bool:
        """True if there is a w and it does nothing but add constants to ẋ."""
        spans = range(len(self.pieces))
        return len(self.uncertain) > 0 and all(self.pushes(span) is not None for span in spans)

    @property
    def squares_inputs(self) -> bool:
        """True if it is not affine in each input."""
        inputs = slice(1 + self.n, 1 + self.n + self.m)
        return any((p.exponents[:, inputs] > 1).any() for e in self.pieces for p in e)

    def pushes(self, span: int) -> FloatArray | None:
        """(n, n_w) what each w adds to ẋ, if those are constants and exact as floats; else None."""
        count = len(self.uncertain)
        result = np.zeros((self.n, count))
        for i, p in enumerate(self.pieces[span]):
            for exponent, coefficient in p.terms():
                used = [j for j in range(count) if exponent[1 + self.n + self.m + j]]
                if used:
                    if sum(exponent) > 1 or Fraction(float(coefficient)) != coefficient:
                        return None
                    result[i, used[0]] = float(coefficient)
        return result

    def vertices(self) -> FloatArray:
        """(2^n_w, n_w) corners of the box of w; one empty row without uncertainty."""
        return np.array(list(product(*self.uncertain.tolist()))).reshape(
            2 ** len(self.uncertain), -1
        )

    def span(self, t: float) -> int:
        """The index of the equations that hold from time t on."""
        return int(np.searchsorted(self.breaks, t, side="right"))

    def validity(self, span: int) -> list[tuple[int, float, float]]:
        """(entry of (x, u), low, high) for every bound that holds in this span."""
        rows = self.valid[(self.valid[:, 3:] == span).all(axis=1)]
        return [(int(j), low, high) for j, low, high in rows[:, :3].tolist()]

    def __call__(
        self,
        t: float,
        X: ArrayLike,
        U: ArrayLike,
        W: ArrayLike | None = None,
        *,
        span: int | None = None,
    ) -> FloatArray:
        """ẋ (N, n) at states X (N, n), inputs U (N, m); w is the centre of its box if not given.

        span: which piece to take, if not the one that holds from t on.
        """
        X, U = np.asarray(X, dtype=np.float64), np.asarray(U, dtype=np.float64)
        U = np.broadcast_to(U, (len(X), self.m))
        w = self.uncertain.mean(axis=1) if W is None else np.asarray(W, dtype=np.float64)
        columns = np.empty((len(self.names), len(X)))
        columns[0] = t
        columns[1 : 1 + self.n] = X.T
        columns[1 + self.n : 1 + self.n + self.m] = U.T
        columns[1 + self.n + self.m :] = w.T if w.ndim == 2 else w[:, None]
        return self._plans[self.span(t) if span is None else span](columns)

    def jacobians(self, t: float, x: ArrayLike, u: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """A (n, n) = ∂f/∂x and B (n, m) = ∂f/∂u at one point, w in the centre of its box."""
        exponents, table = self.coefficients
        factors, powers, lower, home = self._slopes
        w = self.uncertain.mean(axis=1)
        point = np.concatenate([[t], np.asarray(x, float), np.asarray(u, float), w])
        values = (point[:, None] ** np.arange(exponents.max(initial=0) + 1))[
            range(len(point)), lower
        ]
        J = (table[self.span(t)][:, powers] * (factors * values.prod(axis=1))) @ home
        return J[:, : self.n], J[:, self.n :]

    @cached_property
    def _slopes(self) -> tuple[FloatArray, IntArray, IntArray, FloatArray]:
        """For every derivative of a monomial by an entry of (x, u): its factor, the monomial, its
        exponents, and (derivatives, n + m) 1 at the entry.
        """
        exponents, _ = self.coefficients
        within = exponents[:, 1 : 1 + self.n + self.m]
        monomial, entry = np.nonzero(within)
        lower = exponents[monomial]
        lower[np.arange(len(lower)), 1 + entry] -= 1
        home = np.eye(within.shape[1])[entry]
        return within[monomial, entry].astype(np.float64), monomial, lower, home

    def document(self) -> Json:
        """The JSON form; every coefficient is exact."""
        return {
            "format": FORMAT,
            "version": files.VERSION,
            "states": self.n,
            "inputs": self.m,
            "uncertain": self.uncertain.tolist(),
            "breaks": self.breaks.tolist(),
            "valid": self.valid.tolist(),
            "expansion": self.expansion,
            "pieces": [[equation_document(p) for p in part] for part in self.pieces],
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "vector field") -> VectorField:
        """Raises DocumentError if the document is not a vector field."""
        files.header(document, FORMAT, source=source)
        n = files.member(document, "states", int, source=source)
        m = files.member(document, "inputs", int, source=source)
        if not (0 < n <= MAX_VARIABLES and 0 <= m <= MAX_VARIABLES):
            raise DocumentError(f"{source}: {n} states and {m} inputs are not a vector field")
        uncertain = files.member(document, "uncertain", list, source=source)
        bounds = files.array(document, "uncertain", (len(uncertain), 2), source=source)
        names = ("t", *variable_names(n, m, len(bounds)))
        pieces = []
        for part in files.member(document, "pieces", list, source=source):
            if not isinstance(part, list):
                raise DocumentError(f"{source}: a piece should be a list of equations")
            pieces.append(tuple(read_equation(p, names, source=f"{source} equation") for p in part))
        breaks = files.array(document, "breaks", (None,), source=source)
        rows = files.member(document, "valid", list, source=source)
        valid = files.array(document, "valid", (len(rows), None), source=source)
        expansion = files.member(document, "expansion", str, source=source)
        return cls(tuple(pieces), n, m, breaks, bounds, valid, expansion)


@dataclass(frozen=True, eq=False)
class Plan:
    """Values of polynomials, monomials as products of two earlier ones: fast for many points.

    products: (L, 2) rows of the stack [1, variables, products so far]. table: (n, stack size).
    """

    products: tuple[tuple[int, int], ...]
    table: FloatArray

    @classmethod
    def of(cls, equations: Sequence[Polynomial], names: Sequence[str]) -> Plan:
        """Make the plan for n polynomials in the variables `names`."""
        exponents, table = _table(equations, names)
        size = exponents.shape[1]
        known = {(0,) * size: 0}
        known |= {tuple(row): j + 1 for j, row in enumerate(np.eye(size, dtype=int).tolist())}
        products: list[tuple[int, int]] = []

        def place(exponent: tuple[int, ...]) -> int:
            if exponent not in known:
                last = max(j for j, e in enumerate(exponent) if e)
                lower = tuple(e - (j == last) for j, e in enumerate(exponent))
                products.append((place(lower), last + 1))
                known[exponent] = size + len(products)
            return known[exponent]

        rows = [place(tuple(row)) for row in exponents.tolist()]
        full = np.zeros((table.shape[1], size + 1 + len(products)))
        full[:, rows] = table.T
        return cls(tuple(products), full)

    def __call__(self, columns: FloatArray) -> FloatArray:
        """Values (N, n) from variables (number, N)."""
        size = len(columns)
        stack = np.empty((self.table.shape[1], columns.shape[1]))
        stack[0] = 1.0
        stack[1 : size + 1] = columns
        for i, (a, b) in enumerate(self.products, start=size + 1):
            np.multiply(stack[a], stack[b], out=stack[i])
        return (self.table @ stack).T


def arguments(function: Callable[..., Any]) -> tuple[str, ...]:
    """Which of t, x, u, w a function of dynamics takes; it is called with them by name.

    What else it takes keeps its default. DataError of what has none, and if it takes none of them.
    """
    if not callable(function):
        raise DataError(f"dynamics should be a function or a VectorField, is {function!r:.80}")
    given = inspect.signature(function).parameters.values()
    names = tuple(p.name for p in given if p.name in ARGUMENTS)
    unknown = [p for p in given if p.name not in ARGUMENTS and p.default is p.empty]
    if not names or unknown or any(p.kind is p.POSITIONAL_ONLY for p in given):
        said = ", ".join(map(str, given))
        raise DataError(
            "dynamics should be a function of some of t, x, u, w, by these names, and of nothing "
            f"else without a default value; it is of ({said})"
        )
    return names


def box_of(function: Callable[..., Any], uncertain: ArrayLike | None) -> FloatArray:
    """(n_w, 2) bounds of w; DataError unless they are rows (low, high), for a function of w."""
    box = np.zeros((0, 2)) if uncertain is None else numbers(uncertain, "uncertain")
    if box.ndim != 2 or box.shape[1] != 2 or not (box[:, 0] <= box[:, 1]).all():
        raise DataError(f"uncertain should be rows (low, high) of w, is {box.tolist()}")
    if not np.isfinite(box).all():
        raise DataError(f"uncertain should be finite bounds of w, is {box.tolist()}")
    takes = "w" in arguments(function)
    if len(box) and not takes:
        raise DataError("uncertain has rows, but the dynamics have no argument w")
    if takes and not len(box):
        raise DataError(
            "the dynamics have an argument w: give its bounds as `uncertain`; a motion is planned "
            "without, such as of lambda x, u: rate(x, u, [0.0])"
        )
    return box


def no_entry(error: IndexError, n: int, m: int, uncertain: int) -> DataError:
    """What is said of dynamics that ask for an entry beyond the last."""
    return DataError(
        f"the dynamics use an entry that is not there ({error}): x has {n} entries, u has {m}, w "
        f"has {uncertain}"
    )


def variable_names(n: int, m: int, uncertain: int) -> tuple[str, ...]:
    """x0.., u0.., w0.."""
    return tuple(
        f"{letter}{i}"
        for letter, size in (("x", n), ("u", m), ("w", uncertain))
        for i in range(size)
    )


def _table(equations: Sequence[Polynomial], names: Sequence[str]) -> tuple[IntArray, FloatArray]:
    if not any(len(p) for p in equations):
        empty = np.zeros((1, len(names)), dtype=np.int64)
        return empty, np.zeros((1, len(equations)))
    exponents, table = coefficient_table([p.rounded() for p in equations])
    return exponents, table


def equation_document(p: Polynomial) -> Json:
    """Distinct monomials in increasing order; a coefficient that is no float64 as "p/q"."""
    order = [k for k in np.lexsort(p.exponents.T[::-1]).tolist() if p.coefficients[k]]
    exact = [Fraction(p.coefficients[k]) for k in order]
    return {
        "exponents": p.exponents[order].tolist(),
        "coefficients": [write_number(value) for value in exact],
    }


def read_equation(document: Any, names: Sequence[str], *, source: str) -> Polynomial:
    """The polynomial of an `equation_document`; DocumentError says what is wrong with it."""
    if not isinstance(document, dict):
        raise DocumentError(f"{source}: expected an object, found {type(document).__name__}")
    rows = files.member(document, "exponents", list, source=source)
    values = files.member(document, "coefficients", list, source=source)
    sound = all(
        isinstance(row, list)
        and len(row) == len(names)
        and all(type(e) is int and e >= 0 for e in row)
        for row in rows
    )
    if not sound or len(values) != len(rows):
        raise DocumentError(
            f"{source}: 'exponents' should hold a row of {len(names)} whole numbers of 0 or more "
            "for every coefficient"
        )
    if any(later <= row for row, later in pairwise(rows)):
        raise DocumentError(f"{source}: monomials should be distinct, in increasing order")
    coefficients = objects([_number(value, source) for value in values])
    exponents = np.array(rows, dtype=np.int64).reshape(-1, len(names))
    return Polynomial(exponents, coefficients, tuple(names))


def _number(value: Any, source: str) -> Fraction:
    if type(value) in (int, float):
        return Fraction(value)
    if type(value) is str and _RATIONAL.fullmatch(value):
        return Fraction(value)
    raise DocumentError(f"{source}: {value!r:.40} is neither a number nor a text p/q")
