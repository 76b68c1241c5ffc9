"""`Jump`: a guard that falls through 0, and the reset of the state there, both polynomials."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import ArrayLike, FloatArray, Json, keep
from nlsid_core.dynamics.taylor import EXPANSION, Rates, box_of
from nlsid_core.dynamics.vector_field import (
    equation_document,
    read_equation,
    variable_names,
)
from nlsid_core.errors import DataError, DocumentError, ShapeError
from nlsid_core.options import numbers
from nlsid_core.polynomial import Polynomial, trace, variables

FORMAT = "nlsid/jump"
MAX_DEGREE, MAX_STATES = 7, 16
DIRECTION_BITS = 6  # of the direction onto a guard


@dataclass(frozen=True, eq=False)
class Jump:
    """When guard(x) is first 0 from `start` s of the clock on, the state becomes reset(x, w).

    guard: in x0 .. x(n-1). reset: one polynomial for each state after it, in these and in w0 ..,
    affine in each entry of w. uncertain: (n_w, 2) lower and upper bounds of w. valid: (D, 3) rows
    (j, low, high): guard and reset describe the system only where x_j is within. expansion: one
    sentence, as in a `VectorField`, where they expand others.

    Raises ShapeError or DataError on parts that do not fit.
    """

    n: int
    start: float
    guard: Polynomial
    reset: tuple[Polynomial, ...]
    uncertain: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    valid: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    expansion: str = ""

    def __post_init__(self) -> None:
        if not 1 <= self.n <= MAX_STATES or not 1 <= len(self.reset) <= MAX_STATES:
            raise ShapeError(f"a jump leads from and to 1 to {MAX_STATES} states")
        if not np.isfinite(self.start):
            raise DataError(f"start should be a time in s, is {self.start}")
        box = box_of(self.uncertain)
        names = variable_names(self.n, 0, len(box))
        guard = self.guard.exact().over(names[: self.n])
        reset = tuple(p.exact().over(names) for p in self.reset)
        if max(p.degree for p in (guard, *reset)) > MAX_DEGREE:
            raise DataError(f"guard and reset should have degree {MAX_DEGREE} at most")
        if any((p.exponents[:, self.n :] > 1).any() for p in reset):
            raise DataError("the reset is not affine in each uncertain w")
        valid = np.array(self.valid, dtype=np.float64).reshape(-1, 3)
        if not np.isfinite(valid).all() or not np.isin(valid[:, 0], range(self.n)).all():
            raise DataError(f"rows of valid should be (state, low, high), are {valid.tolist()}")
        keep(self, {"uncertain": box, "valid": valid})
        object.__setattr__(self, "start", float(self.start))
        object.__setattr__(self, "guard", guard)
        object.__setattr__(self, "reset", reset)

    @classmethod
    def of(
        cls,
        guard: Callable[..., Any],
        reset: Callable[..., Any],
        n: int,
        *,
        start: float,
        box: ArrayLike | None = None,
        uncertain: ArrayLike | None = None,
        then: ArrayLike | None = None,
    ) -> "Jump":
        """Of functions guard(x), a polynomial, and reset(x) or reset(x, w), (n,).

        box: (n, 2) where a reset that is no polynomial of degree 3 or less is expanded, each such
        entry with a remainder as one more w; `valid` then states the box. uncertain: rows
        (low, high) of w. then: (n after, n) of what the reset is multiplied by, once it is expanded
        (None: nothing): what is exact before that has no remainder.

        Raises DataError if an expansion needs a box, NlsidError on what nothing here expands.
        """
        rates = Rates.of(reset, n, 0, uncertain)
        (traced,) = np.ravel(trace(guard, {"x": n})).tolist()
        after = np.eye(n) if then is None else numbers(then, "then")
        if after.ndim != 2 or after.shape[1] != n:
            raise ShapeError(f"then should have shape (states after, {n}), has {after.shape}")
        if not rates.inexact:
            exact = [p for p in rates.exact if p is not None]
            return cls(n, start, traced, _multiplied(after, exact), rates.uncertain)
        if box is None:
            raise DataError("the reset is no polynomial of degree 3 or less: give a box for it")
        rows = numbers(box, "box")
        if rows.shape != (n, 2) or not (rows[:, 0] <= rows[:, 1]).all():
            raise DataError(f"box should be rows (low, high), one for each of {n} states")
        cubic = rates.on(rows[:, 0], rows[:, 1], (start, start))
        found, bounds = cubic.equations()
        given = len(rates.uncertain)
        names = variable_names(n, 0, given + len(rates.inexact))
        entries = [p.over(names) for p in found]
        for place, i in enumerate(rates.inexact):
            unit = np.zeros((1, len(names)), dtype=np.int64)
            unit[0, n + given + place] = 1
            entries[i] = entries[i] + Polynomial(unit, bounds[i : i + 1], names).exact()
        low, high = cubic.box()
        valid = np.array([(j, low[j], high[j]) for j in rates.expanded])
        remainders = np.tile([-1.0, 1.0], (len(rates.inexact), 1))
        around = np.vstack([rates.uncertain, remainders])
        return cls(n, start, traced, _multiplied(after, entries), around, valid, EXPANSION)

    def along(self, flow: ArrayLike) -> "Jump":
        """The same jump, its reset extended off the guard so that it changes little along a flow.

        flow: (n,) dx/dt at the guard, about. The reset is taken at x - flow g(x)/(g'flow), which is
        x where g = 0: a claim about the guard is the same and is proved with fewer pieces. The
        direction is rounded to few bits. Raises DataError for a guard that is not affine, or that
        the flow does not cross.
        """
        flow, (slope, _) = np.asarray(flow, dtype=np.float64), self.slopes(np.zeros(self.n))
        if self.guard.degree > 1 or not slope @ flow:
            raise DataError("the guard should be affine, and the flow should cross it")
        direction = -flow / (slope @ flow)
        unit = 2.0 ** (np.ceil(np.log2(np.abs(direction).max())) - DIRECTION_BITS)
        names = variable_names(self.n, 0, 0)
        onto = {
            name: x + Fraction(float(step)) * self.guard
            for name, x, step in zip(
                names,
                (p.exact() for p in variables(names)),
                np.round(direction / unit) * unit,
                strict=True,
            )
        }
        return replace(self, reset=tuple(p.substitute(onto) for p in self.reset))

    def vertices(self) -> FloatArray:
        """(2^n_w, n_w) corners of the box of w; one empty row without uncertainty."""
        corners = list(product(*self.uncertain.tolist()))
        return np.array(corners).reshape(2 ** len(self.uncertain), -1)

    def height(self, X: ArrayLike) -> FloatArray:
        """guard(x) (N,) at states X (N, n)."""
        return self.guard.rounded()(np.asarray(X, dtype=np.float64))

    def __call__(self, X: ArrayLike, w: ArrayLike | None = None) -> FloatArray:
        """reset(x, w) (N, n after) at states X (N, n); w (n_w,), the centre of its box if None."""
        X = np.asarray(X, dtype=np.float64)
        w = self.uncertain.mean(axis=1) if w is None else np.asarray(w, dtype=np.float64)
        columns = np.hstack([X, np.broadcast_to(w, (len(X), len(self.uncertain)))])
        return np.stack([p.rounded()(columns) for p in self.reset], axis=1)

    def slopes(self, x: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """∂guard/∂x (n,) and ∂reset/∂x (n after, n) at x (n,), w in the centre of its box."""
        x = np.asarray(x, dtype=np.float64)
        z = np.concatenate([x, self.uncertain.mean(axis=1)])
        names = variable_names(self.n, 0, 0)
        of_guard = [float(self.guard.derivative(name).rounded()(x)) for name in names]
        of_reset = [[float(p.derivative(name).rounded()(z)) for name in names] for p in self.reset]
        return np.array(of_guard), np.array(of_reset)

    def document(self) -> Json:
        """The JSON form; every coefficient is exact."""
        return {
            "format": FORMAT,
            "version": files.VERSION,
            "states": self.n,
            "start": self.start,
            "uncertain": self.uncertain.tolist(),
            "valid": self.valid.tolist(),
            "expansion": self.expansion,
            "guard": equation_document(self.guard),
            "reset": [equation_document(p) for p in self.reset],
        }

    @classmethod
    def from_document(cls, document: Json, *, source: str = "jump") -> "Jump":
        """Raises DocumentError if the document is not a jump."""
        files.header(document, FORMAT, source=source)
        n = files.member(document, "states", int, source=source)
        start = files.number(document, "start", source=source)
        rows = files.member(document, "uncertain", list, source=source)
        uncertain = files.array(document, "uncertain", (len(rows), 2), source=source)
        if not 1 <= n <= MAX_STATES:
            raise DocumentError(f"{source}: {n} states are not a jump's")
        names = variable_names(n, 0, len(uncertain))
        guard = read_equation(document.get("guard"), names[:n], source=f"{source} guard")
        reset = [
            read_equation(entry, names, source=f"{source} reset")
            for entry in files.member(document, "reset", list, source=source)
        ]
        bounds = files.member(document, "valid", list, source=source)
        valid = files.array(document, "valid", (len(bounds), 3), source=source)
        expansion = files.member(document, "expansion", str, source=source)
        return cls(n, start, guard, tuple(reset), uncertain, valid, expansion)

    @classmethod
    def load(cls, path: Path | str) -> "Jump":
        """Read a jump; DocumentError says what is wrong with the file."""
        return cls.from_document(files.load_document(path), source=str(path))

    def save(self, path: Path | str) -> None:
        """Write the jump; the file appears whole or not at all."""
        files.write_document(path, self.document())


def _multiplied(M: FloatArray, entries: Sequence[Polynomial]) -> tuple[Polynomial, ...]:
    """M times polynomials, exactly."""
    zero = 0 * entries[0].exact()
    return tuple(
        sum((Fraction(m) * p.exact() for m, p in zip(row, entries, strict=True) if m), zero)
        for row in M.tolist()
    )
