"""`ImplicitModel`: e(x⁺) = f(x, w) with polynomial e and f, e strictly monotone.

Source: thesis (2.7), (2.11)-(2.12).
"""

from dataclasses import dataclass

import numpy as np

from nlsid_core import _json
from nlsid_core._types import ArrayLike, FloatArray, Json
from nlsid_core.errors import DataError, DocumentError, ShapeError, SolverError
from nlsid_core.models.polynomials import Polynomials
from nlsid_core.models.signal import FORMAT, VERSION

KIND = "implicit"
RESIDUAL = 1e-12  # of e(v) = z relative to 1 + |z|: a few units of rounding
NEWTON_STEPS = 60
SHORTEST_STEP = 2.0**-30
ELLIPSOID_STEPS = 4000  # each shrinks the volume by exp(-1/(2(n+1))) or more


@dataclass(frozen=True, eq=False)
class ImplicitModel:
    """e(x⁺) = f(x, w): n states, m inputs, one sample is `period` s.

    e: polynomials in n variables, f: in n + m, both with (n,) coefficients. monotonicity: δ > 0 of
    (v - v̂)'(e(v) - e(v̂)) ≥ δ|v - v̂|², which makes e a bijection and bounds its inverse.

    Raises ShapeError or DataError on parts that do not fit.
    """

    e: Polynomials
    f: Polynomials
    monotonicity: float
    period: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]

    def __post_init__(self) -> None:
        n, m = len(self.states), len(self.inputs)
        for name, part, variables in (("e", self.e, n), ("f", self.f, n + m)):
            if part.coefficients.shape[1:] != (n,) or part.exponents.shape[1] != variables:
                raise ShapeError(
                    f"{name} should have {n} polynomials in {variables} variables; has exponents "
                    f"{part.exponents.shape}, coefficients {part.coefficients.shape}"
                )
        if not n or not 0.0 < self.monotonicity < np.inf or not 0.0 < self.period < np.inf:
            raise DataError("states, monotonicity and period should be positive")

    def __len__(self) -> int:
        """The number of states n."""
        return len(self.states)

    def step(self, x: ArrayLike, w: ArrayLike) -> FloatArray:
        """x⁺ (B, n) of states x (B, n) and inputs w (B, m), all trajectories at once."""
        now, given = np.asarray(x, dtype=np.float64), np.asarray(w, dtype=np.float64)
        if now.ndim != 2 or now.shape[1] != len(self) or given.shape != (
            len(now), len(self.inputs)
        ):  # fmt: skip
            raise ShapeError(f"x should be (B, {len(self)}), w (B, {len(self.inputs)})")
        return self.invert(self.f(np.concatenate([now, given], axis=1)), start=now)

    def invert(self, z: FloatArray, *, start: FloatArray) -> FloatArray:
        """v (B, n) with e(v) = z (B, n): Newton with step halving, else the ellipsoid method.

        Source: Theorem 2.5 and the remark after Proposition 2.7.
        """
        v = start.copy()
        slope = self.e.jacobian(len(self))
        tolerance = RESIDUAL * (1.0 + np.linalg.norm(z, axis=1))
        residual = self.e(v) - z
        size = np.linalg.norm(residual, axis=1)
        for _ in range(NEWTON_STEPS):
            active = np.flatnonzero(size > tolerance)
            if not len(active):
                return v
            direction = np.linalg.solve(slope(v[active]), -residual[active][..., None])[..., 0]
            length = np.ones(len(active))
            waiting = np.arange(len(active))
            while len(waiting):
                rows = active[waiting]
                trial = v[rows] + length[waiting, None] * direction[waiting]
                found = self.e(trial) - z[rows]
                better = np.linalg.norm(found, axis=1) < size[rows]
                moved = rows[better]
                v[moved], residual[moved] = trial[better], found[better]
                size[moved] = np.linalg.norm(found[better], axis=1)
                waiting = waiting[~better]
                length[waiting] /= 2.0
                waiting = waiting[length[waiting] >= SHORTEST_STEP]
        for row in np.flatnonzero(size > tolerance):
            v[row] = self.ellipsoid(z[row], start=start[row])
        return v

    def ellipsoid(self, z: FloatArray, *, start: FloatArray) -> FloatArray:
        """v (n,) with e(v) = z (n,) by the ellipsoid method; needs only that e is monotone.

        The first ball {v : |v - start| ≤ |e(start) - z|/δ} holds the solution, and (v - v*)'(e(v)
        - z) ≥ 0 cuts every ellipsoid through its centre. Raises SolverError if the residual does
        not get small: then `monotonicity` is not true.
        """
        n, v = len(self), start.copy()
        best, least = v, np.inf
        radius = float(np.linalg.norm(self.e(v[None])[0] - z)) / self.monotonicity
        P = radius**2 * np.eye(n)
        goal = np.sqrt(RESIDUAL) * (1.0 + float(np.linalg.norm(z)))
        for _ in range(ELLIPSOID_STEPS):
            g = self.e(v[None])[0] - z
            size = float(np.linalg.norm(g))
            if size < least:
                best, least = v.copy(), size
            if size <= RESIDUAL * (1.0 + float(np.linalg.norm(z))) or not g @ P @ g > 0.0:
                break
            step = P @ g / np.sqrt(g @ P @ g)
            v = v - step / (n + 1)
            if n == 1:
                P = P / 4.0
            else:
                P = n**2 / (n**2 - 1.0) * (P - 2.0 / (n + 1) * np.outer(step, step))
        if least > goal:
            raise SolverError(
                f"e(v) = z is solved to {least:.1e} only; e is not {self.monotonicity:g}-monotone"
            )
        return best

    def simulate(self, x: ArrayLike, w: ArrayLike) -> FloatArray:
        """States (B, N+1, n) from x (B, n) with inputs w (B, N, m)."""
        state, inputs = np.asarray(x, dtype=np.float64), np.asarray(w, dtype=np.float64)
        if inputs.ndim != 3:
            raise ShapeError(f"w should be (B, N, {len(self.inputs)}), is {inputs.shape}")
        states: list[FloatArray] = [state]
        for t in range(inputs.shape[1]):
            states.append(self.step(states[-1], inputs[:, t]))
        return np.stack(states, axis=1)

    def jacobian(self, after: ArrayLike, x: ArrayLike, w: ArrayLike) -> FloatArray:
        """(B, n, n + m): ∂x⁺/∂[x; w] = E(x⁺)⁻¹ ∂f(x, w) along a step that has been made."""
        now = np.concatenate([np.asarray(x, float), np.asarray(w, float)], axis=1)
        slope_f = self.f.jacobian(now.shape[1])(now)
        slope_e = self.e.jacobian(len(self))(np.asarray(after, dtype=np.float64))
        return np.asarray(np.linalg.solve(slope_e, slope_f))

    def document(self) -> Json:
        """The JSON form; every number round-trips exactly."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "kind": KIND,
            "equation": "e(x+) = f(x, w)",
            "period": self.period,
            "states": list(self.states),
            "inputs": list(self.inputs),
            "monotonicity": self.monotonicity,
            "e": self.e.document(),
            "f": self.f.document(),
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "model") -> "ImplicitModel":
        """Raises DocumentError if the document is not an implicit model."""
        _json.header(document, FORMAT, VERSION, source=source)
        kind = _json.member(document, "kind", str, source=source)
        if kind != KIND:
            raise DocumentError(f"{source}: kind is '{kind}', expected '{KIND}'")
        states, inputs = (
            _json.member(document, key, list, source=source) for key in ("states", "inputs")
        )
        if not all(isinstance(name, str) for name in (*states, *inputs)):
            raise DocumentError(f"{source}: states and inputs should be names")
        n, m = len(states), len(inputs)
        parts = {
            key: Polynomials.from_document(
                _json.member(document, key, dict, source=source), variables, (n,),
                source=f"{source} {key}",
            )
            for key, variables in (("e", n), ("f", n + m))
        }  # fmt: skip
        return cls(
            e=parts["e"],
            f=parts["f"],
            monotonicity=_json.number(document, "monotonicity", source=source),
            period=_json.number(document, "period", source=source),
            states=tuple(states),
            inputs=tuple(inputs),
        )
