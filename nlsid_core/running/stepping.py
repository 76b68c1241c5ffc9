"""`Stepper`: one sample of any identified model, in the state that tubes are proved in.

    ŷ(t) = g(x, w(t)),    x⁺ = f(x, w(t)),    w(t) stacks u(t), u(t-1), …
An observer is x⁺ = f(x, w) + L (y - g(x, w)): the injection comes after the model's own step, so
every class has one. Several states are advanced at once; what depends on the input alone is
computed once for them. The state is that of docs/certificate_stability.md, "The increment form".
"""

import copy
from collections import deque
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.models import (
    BlockCascade,
    CellNetwork,
    DifferenceEquation,
    ImplicitModel,
    MonotoneEquation,
    Signal,
    StableModel,
    StateAffineModel,
)
from nlsid_core.models.implicit_step import SingleStep
from nlsid_core.models.monotone_equation import solve_increasing
from nlsid_core.models.starts import nearest_start
from nlsid_core.polynomial.products import Products

Rows: TypeAlias = list[list[float]]


class Stepper:
    """A model's steps along one run.

    order: n; lags: how many samples `begin` needs; delays: how old an input may be. y, u: the
    model's signals. Raises DataError for an implicit model that is not of recorded signals.
    """

    def __init__(self, model: StableModel) -> None:
        self.model = model
        single = isinstance(model, DifferenceEquation | BlockCascade)
        self.y: tuple[Signal, ...] = (model.y,) if isinstance(model.y, Signal) else model.y
        self.u: tuple[Signal, ...] = (model.u,) if single else model.u  # type: ignore[assignment]
        if not self.y:
            raise DataError("an implicit model without recorded signals has no tube of its outputs")
        self._kind: Any = _KINDS[type(model)](model)
        self.order: int = self._kind.order
        self.delays: int = self._kind.delays
        self.lags: int = max(self._kind.lags, self.delays)
        self._past: deque[FloatArray] = deque(maxlen=self.delays + 1)

    def begin(self, y: FloatArray, u: FloatArray) -> FloatArray:
        """The state (n,) after the samples y (k, p), u (k, n_u), k >= lags.

        Of more samples than `lags` all are used: the run from the nearest start. A block cascade's
        first filter starts as if its input had always been the first one.
        """
        if len(y) < self.lags or y.shape[1] != len(self.y) or u.shape != (len(y), len(self.u)):
            raise ShapeError(
                f"y and u should be (k, {len(self.y)}) and (k, {len(self.u)}), k >= {self.lags}; "
                f"are {y.shape} and {u.shape}"
            )
        if len(y) == self.lags or isinstance(self.model, CellNetwork):
            return self._begun(y, u)
        start = nearest_start(lambda starts: self._run(starts, u)[0], y, self.lags)
        return np.asarray(self._run(start[None], u)[1][0])

    def _run(self, starts: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Outputs (B, k, p), and states (B, n) after them, from the first outputs (B, lags, p)."""
        x = np.stack([self._begun(start, u[: self.lags]) for start in starts])
        outputs = list(starts.swapaxes(0, 1))
        for given in u[self.lags :]:
            y, x = self.advance(x, given)
            outputs.append(y)
        return np.stack(outputs, axis=1), x

    def _begun(self, y: FloatArray, u: FloatArray) -> FloatArray:
        """The state after samples that are taken as they are; a network's, by its own search."""
        self._past.clear()
        self._past.extend(u[max(0, len(u) - self._kind.delays - 1) :])
        return np.asarray(self._kind.begin(y, u))

    def ahead(self) -> "Stepper":
        """Another one in the same place, whose steps leave this one where it is."""
        other = copy.copy(self)
        other._past = self._past.copy()
        return other

    def advance(self, x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Outputs (B, p) and next states (B, n) of states x (B, n) under the input u (n_u,) now.

        Raises DataError on an input that the model refuses, SolverError where an implicit model
        has no next output.
        """
        self._past.append(u)
        found: tuple[FloatArray, FloatArray] = self._kind.advance(x, self._past)
        return found

    def advance_few(self, x: Rows, u: list[float]) -> tuple[Rows, Rows]:
        """As `advance`, of lists: so few numbers cost less than numpy's calls do."""
        if isinstance(self._kind, _Linear):
            return self._kind.advance_few(x, u)
        outputs, after = self.advance(np.array(x), np.array(u))
        return outputs.tolist(), after.tolist()


class _Linear:
    """x⁺ = A x + B u + f, y = x_1 + D u + c."""

    delays = 0

    def __init__(self, model: DifferenceEquation) -> None:
        self._model = model
        self.order = self.lags = len(model)
        self._A, self._B, self._f = model.A.T.copy(), model.B[:, 0], model.offset
        self._D, self._c = model.D, float(model.c)
        self._driven = list(zip(model.B[:, 0].tolist(), model.offset.tolist(), strict=True))
        self._a = model.a.tolist()

    def begin(self, y: FloatArray, u: FloatArray) -> FloatArray:
        n = self.order
        return self._model.state_after(y[len(y) - n :, 0], u[len(u) - n :, 0])

    def advance(self, x: FloatArray, past: deque[FloatArray]) -> tuple[FloatArray, FloatArray]:
        u = past[-1][0]
        return x[:, :1] + (self._D * u + self._c), x @ self._A + (self._B * u + self._f)

    def advance_few(self, x: Rows, now: list[float]) -> tuple[Rows, Rows]:
        """A's first column is a; the rest of A shifts."""
        (u,) = now
        force = [b * u + f for b, f in self._driven]
        direct = self._D * u + self._c
        outputs, after = [], []
        for first, *others in x:
            outputs.append([first + direct])
            rows = zip(self._a, (*others, 0.0), force, strict=True)
            after.append([a * first + next_one + now for a, next_one, now in rows])
        return outputs, after


class _StateAffine:
    """G_0(w) ȳ = -(G_1(w) ȳ(t-1) + … + p(w)), x the lagged ȳ."""

    def __init__(self, model: StateAffineModel) -> None:
        self._model = model
        p = self._p = len(model.y)
        self.order, self.lags = len(model) * p, len(model)
        self.delays = len(model)
        self._low, self._high = model.u_range.T
        self._rows = np.array([self.delays - d for _, d in model.window], dtype=np.intp)
        self._columns = np.array([i for i, _ in model.window], dtype=np.intp)
        # All polynomials on common monomials: [G_0 G_1 … G_n p] row by row of the equation.
        parts = [*model.G, model.p]
        exponents, places = np.unique(
            np.vstack([part.exponents for part in parts]), axis=0, return_inverse=True
        )
        self._products = Products(exponents)
        table = np.zeros((len(exponents), p, (len(model) + 1) * p + 1))
        place = iter(places.ravel().tolist())
        for k, part in enumerate(parts):
            values = part.coefficients.reshape(len(part.exponents), p, -1)
            for row in values:
                table[next(place), :, k * p : k * p + values.shape[2]] += row
        # A constant G_0 is divided out once.
        self._solved = not model.G[0].exponents.any()
        if self._solved:
            table[:] = np.linalg.solve(model.G[0].coefficients.sum(axis=0), table)
        self._table = table.reshape(len(exponents), -1)
        self._point = np.ones((1, len(model.window) + 1))
        self._refuses = model.on_out_of_range == "refuse"

    def begin(self, y: FloatArray, _u: FloatArray) -> FloatArray:
        model, n = self._model, self.lags
        newest = (y[len(y) - n :] - model.y_offset) / model.y_scale
        return np.asarray(newest[::-1].ravel())

    def advance(self, x: FloatArray, past: deque[FloatArray]) -> tuple[FloatArray, FloatArray]:
        model, p = self._model, self._p
        u = np.array(past)
        if self._refuses:
            model.windows(u)
        scaled = (np.minimum(np.maximum(u, self._low), self._high) - model.u_offset) / model.u_scale
        self._point[0, :-1] = scaled[self._rows, self._columns]
        found = (self._products(self._point) @ self._table).reshape(p, -1)
        right = x @ found[:, p:-1].T + found[:, -1]
        after: FloatArray = -right
        if not self._solved and p == 1:
            after /= found[0, 0]
        elif not self._solved:
            after = np.asarray(np.linalg.solve(found[:, :p], after.T).T)
        return after * model.y_scale + model.y_offset, _shifted(after, x)


class _Cascade:
    """Both filters' states, as in the increment form: v(t-1) …, and the second's observer form."""

    delays = 0

    def __init__(self, model: BlockCascade) -> None:
        n1 = max(len(model.a1), model.b1.shape[1] - 1)
        n2 = max(len(model.a2), model.b2.shape[1] - 1)
        self._model, self._n1, self._n2 = model, n1, n2
        self.order, self.lags = n1 + n2, max(n1, n2, 1)
        self._a1, self._a2 = np.zeros(n1), np.zeros(n2)
        self._a1[: len(model.a1)], self._a2[: len(model.a2)] = model.a1, model.a2
        self._b1, self._b2 = np.zeros((len(model.b1), n1)), np.zeros((len(model.b2), n2))
        self._b1[:, : model.b1.shape[1] - 1] = model.b1[:, 1:]
        self._b2[:, : model.b2.shape[1] - 1] = model.b2[:, 1:]

    def begin(self, y: FloatArray, u: FloatArray) -> FloatArray:
        model, n1, n2 = self._model, self._n1, self._n2
        rest = 1.0 - float(model.a1.sum())
        if rest == 0.0:
            raise DataError("the first filter has a pole at 1: no state goes with a held input")
        first = np.full((1, n1), u[0, 0] / rest)
        fs = []
        for value in u[:, 0]:
            f, first = self._first(first, float(value))
            fs.append(f[0])
        second = np.zeros(n2)
        newest_y, newest_f = y[::-1, 0], np.array(fs)[::-1]
        for i in range(n2):  # what the past says of y(t + i)
            k = n2 - i
            second[i] = self._a2[i:] @ newest_y[:k] + np.sum(self._b2[:, i:].T * newest_f[:k])
        return np.concatenate([first[0], second])

    def _first(self, x: FloatArray, u: float) -> tuple[FloatArray, FloatArray]:
        """f at every phase (B, M), and the first filter's next state (B, n₁)."""
        v = x @ self._a1 + u
        f = self._model.f(v[:, None] * self._model.b1[:, 0] + x @ self._b1.T)
        return f, _shifted(v[:, None], x)

    def advance(self, x: FloatArray, past: deque[FloatArray]) -> tuple[FloatArray, FloatArray]:
        n1 = self._n1
        f, first = self._first(x[:, :n1], past[-1][0])
        y = (f @ self._model.b2[:, 0])[:, None]
        after = f @ self._b2
        if self._n2:
            y = y + x[:, n1 : n1 + 1]
            after = after + y * self._a2
            after[:, :-1] += x[:, n1 + 1 :]
        return y, np.hstack([first, after])


class _Network:
    """x of a cell network, from the first samples by least squares."""

    delays = 0

    def __init__(self, model: CellNetwork) -> None:
        self._model = model
        self.order, self.lags = len(model.start), model.start_samples

    def begin(self, y: FloatArray, u: FloatArray) -> FloatArray:
        return np.asarray(self._model.states(u, self._model.start_from(y, u))[1][-1])

    def advance(self, x: FloatArray, past: deque[FloatArray]) -> tuple[FloatArray, FloatArray]:
        return self._model.advance(x, past[-1])


class _Monotone:
    """e(ȳ) = c + a'x + b'w, x the lagged ȳ."""

    def __init__(self, model: MonotoneEquation) -> None:
        self._model = model
        self.order = self.lags = len(model)
        self.delays = max((d for _, d in model.window), default=0)
        self._e = tuple(model.e.tolist())

    def begin(self, y: FloatArray, _u: FloatArray) -> FloatArray:
        return np.asarray((y[len(y) - self.lags :, 0] - self._model.y_offset)[::-1])

    def advance(self, x: FloatArray, past: deque[FloatArray]) -> tuple[FloatArray, FloatArray]:
        model = self._model
        force = model.c
        for weight, (i, d) in zip(model.b.tolist(), model.window, strict=True):
            force += weight * (past[-1 - d][i] - model.u_offset[i])
        targets = (x @ model.a + force).tolist()
        pairs = zip(targets, x[:, 0].tolist(), strict=True)
        after = np.array([[solve_increasing(self._e, t, guess)] for t, guess in pairs])
        return after + model.y_offset, _shifted(after, x)


class _Implicit:
    """0 = h(v, x, w), x⁺ = [v; ã(x, w)], y = v."""

    def __init__(self, model: ImplicitModel) -> None:
        self._step = SingleStep(model)
        self._unknowns, self._window = model.unknowns, model.window
        self.order, self.lags = len(model), model.lags
        self.delays = max((d for _, d in model.window), default=0)

    def begin(self, y: FloatArray, _u: FloatArray) -> FloatArray:
        return np.asarray(y[len(y) - self.lags :][::-1].ravel())

    def advance(self, x: FloatArray, past: deque[FloatArray]) -> tuple[FloatArray, FloatArray]:
        w = np.array([past[-1 - d][i] for i, d in self._window])
        after = self._step(x, w)
        return after[:, : self._unknowns], after


_KINDS: dict[type, Callable[..., Any]] = {
    DifferenceEquation: _Linear,
    StateAffineModel: _StateAffine,
    BlockCascade: _Cascade,
    CellNetwork: _Network,
    MonotoneEquation: _Monotone,
    ImplicitModel: _Implicit,
}


def _shifted(newest: FloatArray, x: FloatArray) -> FloatArray:
    """`newest`, and all of x but as many of its last columns."""
    return np.hstack([newest, x])[:, : x.shape[1]]
