"""`ImplicitModel`: 0 = h(v, x, w), x⁺ = [v; ã(x, w)], polynomial, with a unique v for every (x, w).

Separable models e(x⁺) = f(x, w) are h = e(v) - f(x, w) without ã.
Source: thesis (2.4), (2.7), (2.11).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import ArrayLike, FloatArray, IntArray, Json
from nlsid_core.errors import DataError, DocumentError, ShapeError
from nlsid_core.models.monotone import ellipsoid, newton
from nlsid_core.models.polynomials import Polynomials
from nlsid_core.models.signal import FORMAT, Recorded, Signal, recorded, tail, window_of
from nlsid_core.polynomial.values import monomial_values

KIND = "implicit"


@dataclass(frozen=True, eq=False)
class ImplicitModel(Recorded):
    """0 = h(v, x, w), x⁺ = [v; ã(x, w)]: n states, m inputs, one sample is `period` s.

    h: n_v polynomials in [v; x; w]; shift: ã, n - n_v polynomials in [x; w]. monotonicity: δ > 0
    of (v - v̂)'(h(v, x, w) - h(v̂, x, w)) ≥ δ|v - v̂|², which makes v unique.

    y, u, window: of a model of recorded signals, whose v is y(t), whose x stacks
    y(t-1) … y(t-k), and whose w_j is u_i(t-d) for (i, d) = window[j].

    Raises ShapeError or DataError on parts that do not fit.
    """

    h: Polynomials
    shift: Polynomials
    monotonicity: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    y: tuple[Signal, ...] = ()
    u: tuple[Signal, ...] = ()
    window: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        n, m, n_v = len(self.states), len(self.inputs), self.unknowns
        if self.h.coefficients.ndim != 2 or not 0 < n_v <= n:
            raise ShapeError(f"h should have 1 to {n} polynomials, has {n_v}")
        parts = [("h", self.h, n_v, n_v + n + m), ("shift", self.shift, n - n_v, n + m)]
        for name, part, rows, variables in parts:
            if part.coefficients.shape[1:] != (rows,) or part.exponents.shape[1] != variables:
                raise ShapeError(
                    f"{name} should have {rows} polynomials in {variables} variables; has "
                    f"exponents {part.exponents.shape}, coefficients {part.coefficients.shape}"
                )
        if not 0.0 < self.monotonicity < np.inf:
            raise DataError("monotonicity should be positive")
        self.require_period()
        if self.y and (len(self.y) != n_v or n % n_v or len(self.window) != m):
            raise ShapeError(
                f"{len(self.y)} outputs and a window of {len(self.window)} inputs for {n} states, "
                f"{n_v} of them unknown, and {m} inputs"
            )
        if any(not (0 <= i < len(self.u) and d >= 0) for i, d in self.window):
            raise DataError(f"window {self.window} names inputs or delays that are not there")

    @classmethod
    def separable(
        cls,
        e: Polynomials,
        f: Polynomials,
        *,
        monotonicity: float,
        period: float,
        states: tuple[str, ...],
        inputs: tuple[str, ...],
    ) -> "ImplicitModel":
        """e(x⁺) = f(x, w): e in n variables, f in n + m, both with (n,) coefficients."""
        n, m = len(states), len(inputs)
        for name, part, variables in (("e", e, n), ("f", f, n + m)):
            if part.coefficients.shape[1:] != (n,) or part.exponents.shape[1] != variables:
                raise ShapeError(
                    f"{name} should have {n} polynomials in {variables} variables; has exponents "
                    f"{part.exponents.shape}, coefficients {part.coefficients.shape}"
                )
        left = np.hstack([e.exponents, np.zeros((len(e.exponents), n + m), dtype=np.int64)])
        right = np.hstack([np.zeros((len(f.exponents), n), dtype=np.int64), f.exponents])
        h = Polynomials(
            np.concatenate([left, right]), np.concatenate([e.coefficients, -f.coefficients])
        )
        return cls(h, _nothing(n + m), monotonicity, states, inputs, period=period)

    def separated(self) -> tuple[Polynomials, Polynomials] | None:
        """(e, f) if h = e(v) - f(x, w) and there is no ã, else None."""
        n_v = self.unknowns
        left = self.h.exponents[:, :n_v].any(axis=1)
        if n_v < len(self) or self.h.exponents[left, n_v:].any():
            return None
        return (
            Polynomials(self.h.exponents[left, :n_v], self.h.coefficients[left]),
            Polynomials(self.h.exponents[~left, n_v:], -self.h.coefficients[~left]),
        )

    def __len__(self) -> int:
        """The number of states n."""
        return len(self.states)

    def __str__(self) -> str:
        degree = int(np.max(self.h.exponents[:, : self.unknowns].sum(axis=1), initial=0))
        return (
            f"implicit model: {len(self)} states, {self.unknowns} equations of degree {degree} in "
            f"the next ones, {len(self.inputs)} inputs, {self.period:g} s a sample"
        )

    @property
    def lags(self) -> int:
        """How many past samples of y, a recorded signal, the state stacks."""
        return len(self) // self.unknowns

    @property
    def history(self) -> int:
        """How many past samples of recorded signals a step looks back."""
        return max(self.lags, *(d for _, d in self.window), 0)

    @property
    def unknowns(self) -> int:
        """The number n_v of equations, and of states they determine."""
        return int(self.h.coefficients.shape[-1])

    def step(self, x: ArrayLike, w: ArrayLike) -> FloatArray:
        """x⁺ (B, n) of states x (B, n) and inputs w (B, m), all trajectories at once."""
        now, given = np.asarray(x, dtype=np.float64), np.asarray(w, dtype=np.float64)
        if (
            now.ndim != 2
            or now.shape[1] != len(self)
            or given.shape != (len(now), len(self.inputs))
        ):
            raise ShapeError(f"x should be (B, {len(self)}), w (B, {len(self.inputs)})")
        known = np.concatenate([now, given], axis=1)
        v = self.solve(known, start=now[:, : self.unknowns])
        return np.concatenate([v, self.shift(known)], axis=1)

    def solve(self, known: FloatArray, *, start: FloatArray) -> FloatArray:
        """v (B, n_v) with h(v, known) = 0 for known = [x, w] (B, n + m).

        Newton's method with step halving; where it fails, the ellipsoid method, guaranteed for a
        true monotonicity. Raises SolverError where that is not true.
        """
        of_known, powers, table = self._in_v
        weights = (monomial_values(of_known, known) @ table).reshape(len(known), len(powers), -1)
        at_zero = weights[:, ~powers.any(axis=1)].sum(axis=1)
        size = 1.0 + np.linalg.norm(at_zero, axis=1)
        lowered = [np.maximum(powers - unit, 0) for unit in np.eye(powers.shape[1], dtype=np.int64)]

        def c(v: FloatArray, rows: IntArray) -> FloatArray:
            return np.asarray((monomial_values(powers, v)[:, :, None] * weights[rows]).sum(axis=1))

        def slope_of(v: FloatArray, rows: IntArray) -> FloatArray:
            columns = [
                (power * monomial_values(lower, v))[:, :, None] * weights[rows]
                for power, lower in zip(powers.T, lowered, strict=True)
            ]
            return np.stack([column.sum(axis=1) for column in columns], axis=2)

        v, failed = newton(c, slope_of, start=start, size=size)
        for row in failed:
            v[row] = self.ellipsoid(known[row], start=start[row])
        return v

    def ellipsoid(self, known: FloatArray, *, start: FloatArray) -> FloatArray:
        """v (n_v,) with h(v, known) = 0 for known = [x, w] (n + m,), by the ellipsoid method.

        Raises SolverError if monotonicity is not true.
        """
        zero = self.h(_with(np.zeros_like(start), known)[None])
        return ellipsoid(
            lambda v: self.h(_with(v, known)[None])[0],
            start=start,
            monotonicity=self.monotonicity,
            size=1.0 + float(np.linalg.norm(zero)),
        )

    def simulate(self, x: ArrayLike, w: ArrayLike) -> FloatArray:
        """States (B, N+1, n) from x (B, n) with inputs w (B, N, m)."""
        state, inputs = np.asarray(x, dtype=np.float64), np.asarray(w, dtype=np.float64)
        if inputs.ndim != 3:
            raise ShapeError(f"w should be (B, N, {len(self.inputs)}), is {inputs.shape}")
        states: list[FloatArray] = [state]
        for t in range(inputs.shape[1]):
            states.append(self.step(states[-1], inputs[:, t]))
        return np.stack(states, axis=1)

    def windows(self, u: FloatArray) -> FloatArray:
        """w(t), (N - history, m), for t = history … of recorded inputs u (N, n_u)."""
        h, N = self.history, len(u)
        columns = [u[h - d : N - d, i] for i, d in self.window]
        return np.column_stack(columns) if columns else np.zeros((N - h, 0))

    def jacobian(self, after: ArrayLike, x: ArrayLike, w: ArrayLike) -> FloatArray:
        """(B, n, n + m): ∂x⁺/∂[x; w] = [-H₁⁻¹[H₂, H₃]; ∂ã] along a step that has been made."""
        known = np.concatenate([np.asarray(x, float), np.asarray(w, float)], axis=1)
        v = np.asarray(after, dtype=np.float64)[:, : self.unknowns]
        slope = self._slope(_with(v, known))
        top = -np.linalg.solve(slope[..., : self.unknowns], slope[..., self.unknowns :])
        rest = self.shift.jacobian(known.shape[1])(known)
        return np.concatenate([top, rest], axis=1)

    @cached_property
    def _in_v(self) -> tuple[IntArray, IntArray, FloatArray]:
        """h as polynomials in v: exponents (k, n + m) of [x; w] and (p, n_v) of v, and the table
        (k, p n_v) by which monomials of [x; w] give the coefficients of the monomials of v.
        """
        n_v, exponents = self.unknowns, self.h.exponents
        known, place = np.unique(exponents[:, n_v:], axis=0, return_inverse=True)
        powers, of = np.unique(exponents[:, :n_v], axis=0, return_inverse=True)
        table = np.zeros((len(known), len(powers), n_v))
        np.add.at(table, (place.ravel(), of.ravel()), self.h.coefficients)
        return known, powers, table.reshape(len(known), -1)

    @cached_property
    def _slope(self) -> Polynomials:
        return self.h.jacobian(self.h.exponents.shape[1])

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        document: Json = {
            "format": FORMAT,
            "version": files.VERSION,
            "kind": KIND,
            "equation": "0 = h(v, x, w), x+ = [v; shift(x, w)]",
            "period": self.period,
            "states": list(self.states),
            "inputs": list(self.inputs),
            "monotonicity": self.monotonicity,
            "h": self.h.document(),
        }
        if self.unknowns < len(self):
            document["shift"] = self.shift.document()
        if self.y:
            document |= {
                "y": [signal.document() for signal in self.y],
                "u": [signal.document() for signal in self.u],
                "window": [list(entry) for entry in self.window],
                **tail(self),
            }
        return document

    @classmethod
    def from_document(cls, document: Json, *, source: str = "model") -> "ImplicitModel":
        """Raises DocumentError if the document is not an implicit model."""
        files.header(document, FORMAT, source=source, kind=KIND)
        if "centre" in document:
            raise DocumentError(f"{source}: models with a centre are checked, and not run")
        states, inputs = (
            files.member(document, key, list, source=source) for key in ("states", "inputs")
        )
        if not all(isinstance(name, str) for name in (*states, *inputs)):
            raise DocumentError(f"{source}: states and inputs should be names")
        n, m = len(states), len(inputs)
        left = files.member(document, "h", dict, source=source)
        n_v = files.array(left, "coefficients", (None, None), source=f"{source} h").shape[1]
        if not 0 < n_v <= n:
            raise DocumentError(f"{source}: h should hold 1 to {n} polynomials, holds {n_v}")

        def part(key: str, variables: int, size: int) -> Polynomials:
            member = files.member(document, key, dict, source=source)
            return Polynomials.from_document(member, variables, (size,), source=f"{source} {key}")

        if "y" in document:
            made = recorded(document, several=("y", "u"), source=source)
            made["window"] = window_of(document, source=source)
        else:
            made = {"period": files.number(document, "period", source=source)}
        return cls(
            h=part("h", n_v + n + m, n_v),
            shift=part("shift", n + m, n - n_v) if n_v < n else _nothing(n + m),
            monotonicity=files.number(document, "monotonicity", source=source),
            states=tuple(states),
            inputs=tuple(inputs),
            **made,
        )


def _nothing(variables: int) -> Polynomials:
    return Polynomials(np.zeros((0, variables), dtype=np.int64), np.zeros((0, 0)))


def _with(v: FloatArray, known: FloatArray) -> FloatArray:
    return np.concatenate([v, known], axis=-1)
