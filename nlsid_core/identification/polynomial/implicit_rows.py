"""Implicit models of recorded signals: a dataset as rows of their equation.

    e(y(t)) = f(x(t), w(t)),   x = [y(t-1); …; y(t-n)],   w stacks delayed inputs
Signals are scaled to zero mean and unit spread, undone once in `ImplicitRows.model`. The equation
errors of all samples enter the searches by the triangular factor of their monomials alone, so a
search costs the same for any number of samples.
Source: thesis (2.4), (2.7).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from math import comb

import numpy as np
from scipy.linalg import solve_triangular

from nlsid_core.arrays import BoolArray, FloatArray, IntArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError, ShapeError
from nlsid_core.identification.polynomial.options import Polynomial as Options
from nlsid_core.identification.proofs.sets import Names
from nlsid_core.identification.regressors import FEWER, refuse_poor, signal_scale
from nlsid_core.models import ImplicitModel, MonotoneEquation, Polynomials, signals_of
from nlsid_core.models.monotone_equation import increasing
from nlsid_core.polynomial import Polynomial, monomial_values, monomials, variables

MOST_TERMS = 1000  # of e and f: with 10 000 samples a step takes 2.5 s and 0.8 GB, of one core
MOST_MONOMIALS = 1000  # of a square in an inequality of the set, before it is built
LARGEST_BLOCK = 60  # of a program: measured 1 to 6 s each at order 55, 22 s and 1 GB at 84
SLOW = "each of some fifty programs of a search would take longer than ten seconds"
FARTHEST = 0.01  # weight of the outputs before the newest in the error that is bounded


@dataclass(frozen=True, eq=False)
class ImplicitRows:
    """The scaled rows. R: triangular factor of the monomials [φ_e(y(t)), φ_f(x, w)], over √N.

    left, right: their exponents. y_scale, u_scale: (mean, spread) of the signals.
    """

    R: FloatArray
    left: IntArray
    right: IntArray
    y_scale: tuple[FloatArray, FloatArray]
    u_scale: tuple[FloatArray, FloatArray]
    model_class: Options
    dataset: Dataset

    @property
    def names(self) -> Names:
        """The variables v, x, w."""
        n_v, m = len(self.y_scale[0]), self.right.shape[1] - self.states
        return Names(
            *(
                tuple(f"{c}{i}" for i in range(k))
                for c, k in (("v", n_v), ("x", self.states), ("w", m))
            )
        )

    @property
    def set(self) -> str:
        """The set of the models; 3.8 is 2.11 for what is affine but in y(t)."""
        assert self.model_class.form is not None, "equations of Chapter 4 have rows of their own"
        return "2.11" if self.model_class.form == "3.8" else self.model_class.form

    @property
    def states(self) -> int:
        """The number of states."""
        return len(self.y_scale[0]) * self.model_class.lags

    @cached_property
    def driven(self) -> BoolArray:
        """(m,) which terms of f hold no state: no inequality of any set has them."""
        return np.asarray(~self.right[:, : self.states].any(axis=1))

    @cached_property
    def reduced(self) -> tuple[FloatArray, FloatArray]:
        """(R, F) for the coefficients c of [e; -f] that are not `driven`, (k,) an equation.

        The least of the squared equation error over the driven ones is |R c|², at F c.
        """
        driven = np.concatenate([np.zeros(len(self.left), dtype=bool), self.driven])
        first = int(driven.sum())
        ordered = np.column_stack([self.R[:, driven], self.R[:, ~driven]])
        factor = np.asarray(np.linalg.qr(ordered, mode="r"))
        return factor[first:, first:], -solve_triangular(
            factor[:first, :first], factor[:first, first:]
        )

    @property
    def weight(self) -> FloatArray:
        """(n, n) Q: |x - x̂|²_Q, the newest outputs' squared errors in units of their spread."""
        n_v = len(self.y_scale[0])
        return np.diag(np.where(np.arange(self.states) < n_v, 1.0, FARTHEST))

    @property
    def units(self) -> tuple[FloatArray, FloatArray]:
        """(mean, spread) of every entry of [x; w]."""
        window = self.model_class.window(len(self.u_scale[0]))
        of_u = [i for i, _ in window]
        lags = self.model_class.lags
        mean, spread = (
            np.concatenate([np.tile(y, lags), u[of_u]])
            for y, u in zip(self.y_scale, self.u_scale, strict=True)
        )
        return mean, spread

    @property
    def ends(self) -> list[tuple[float, float]]:
        """The box of every state and input, in the signals' units; empty: everywhere."""
        box, n_v = self.model_class.box or (), len(self.y_scale[0])
        if not box:
            return []
        if len(box) != n_v + len(self.u_scale[0]):
            raise DataError(
                f"output_range and input_range have {len(box)} intervals for {n_v} outputs and "
                f"{len(self.u_scale[0])} inputs"
            )
        of_u = [i for i, _ in self.model_class.window(len(self.u_scale[0]))]
        return [*(list(box[:n_v]) * self.model_class.lags), *(box[n_v + i] for i in of_u)]

    def equation(self, e: FloatArray, f: FloatArray) -> MonotoneEquation:
        """e(v) = f(x, w) of set 3.8, of scaled e (m_e, 1) and f (m_f, 1)."""
        first, (mean, spread) = self.dataset.trajectories[0], self.y_scale
        powers = increasing(np.pad(e[:, 0], (0, 3 - len(e)))) / spread[0] ** np.arange(1, 4)
        constant = f[~self.right.any(axis=1)].sum()
        slopes = self.right.T @ f[:, 0] / self.units[1]  # every other term is one state or input
        return MonotoneEquation(
            e=powers / powers[0],  # the scale of both sides is free
            a=slopes[: self.states] / powers[0],
            b=slopes[self.states :] / powers[0],
            c=float(constant / powers[0]),
            window=self.model_class.window(len(self.u_scale[0])),
            y_offset=float(mean[0]),
            u_offset=self.u_scale[0],
            period=self.dataset.period,
            y=signals_of(first, "y")[0],
            u=signals_of(first, "u"),
            bags=self.dataset.bags,
        )

    def model(
        self, e: FloatArray, f: FloatArray, monotonicity: float
    ) -> ImplicitModel | MonotoneEquation:
        """e(v) = f(x, w) in the signals' units, of scaled e (m_e, n_v), f (m_f, n_v).

        monotonicity: of the scaled e, and of the model: both sides are multiplied by the square of
        the largest spread, so that every condition on the scaled model holds with the same δ.
        """
        if self.model_class.form == "3.8":
            return self.equation(e, f)
        largest = float(np.max(self.y_scale[1]))
        n_v, n, names = len(self.y_scale[0]), self.states, self.names
        mean, spread = self.units
        mean, spread = (np.concatenate([part[:n_v], part]) for part in (mean, spread))
        everything = (*names.v, *names.x, *names.w)
        exponents = np.vstack(
            [
                np.hstack(
                    [self.left, np.zeros((len(self.left), n + len(names.w)), dtype=np.int64)]
                ),
                np.hstack([np.zeros((len(self.right), n_v), dtype=np.int64), self.right]),
            ]
        )
        scaled = {
            name: (x - float(m)) / float(s)
            for name, x, m, s in zip(everything, variables(everything), mean, spread, strict=True)
        }
        parts = []
        for i, column in enumerate(np.concatenate([e, -f]).T):
            p = Polynomial(exponents, column, everything)
            used = np.asarray(p.exponents.any(axis=0)).tolist()
            inside = {k: v for (k, v), occurs in zip(scaled.items(), used, strict=True) if occurs}
            weight = largest**2 / float(self.y_scale[1][i])
            parts.append((p.substitute(inside) * weight).over(everything))
        h = _stacked(parts)
        if self.set == "2.19":
            h = _with_symmetric_left(h, n_v)
        first, window = self.dataset.trajectories[0], self.model_class.window(len(self.u_scale[0]))
        lags = range(1, self.model_class.lags + 1)
        return ImplicitModel(
            h=h,
            shift=delayed_states(n - n_v, n + len(names.w)),
            monotonicity=monotonicity,
            period=self.dataset.period,
            states=tuple(f"{name}(t-{k})" for k in lags for name in first.y_names),
            inputs=tuple(
                f"{first.u_names[i]}(t-{d})" if d else f"{first.u_names[i]}(t)" for i, d in window
            ),
            y=signals_of(first, "y"),
            u=signals_of(first, "u"),
            window=window,
            bags=self.dataset.bags,
        )


def build_implicit_rows(
    dataset: Dataset, model_class: Options, factor: Callable[[Dataset], FloatArray] | None = None
) -> ImplicitRows:
    """The rows t = h … of every trial.

    factor: makes R of the scaled trials (None: that of the monomials as they are measured).
    Raises DataError on too little or too poor data, ShapeError if the set is not for its outputs.
    """
    y_scale, u_scale = signal_scale(dataset, "y"), signal_scale(dataset, "u")
    n_v, history = len(y_scale[0]), model_class.history
    if model_class.form == "3.8" and n_v > 1:
        raise ShapeError(f"set 3.8 is for one output, the data have {n_v}; 2.11 is for several")
    for trial in dataset:
        if history >= len(trial):
            raise DataError(
                f"{trial.name}: {len(trial)} samples, a history of {history} needs more"
            )
    refuse_large(model_class, n_v, len(u_scale[0]))
    left = monomials(n_v, range(1, model_class.degrees.left + 1))
    window = model_class.window(len(u_scale[0]))
    right = right_basis(model_class, n_v * model_class.lags, len(window))
    scaled = tuple(
        replace(t, y=(t.y - y_scale[0]) / y_scale[1], u=(t.u - u_scale[0]) / u_scale[1])
        for t in dataset
    )
    if factor is not None:
        R = factor(Dataset(scaled))
    else:
        stacked = np.concatenate([_monomials(t, model_class, left, right) for t in scaled])
        refuse_poor(stacked[:, len(left) :])
        R = np.linalg.qr(stacked, mode="r") / np.sqrt(len(stacked))
    made = ImplicitRows(R, left, right, y_scale, u_scale, model_class, dataset)
    _refuse_data_outside(made)
    return made


def _monomials(
    trial: Trajectory, model_class: Options, left: IntArray, right: IntArray
) -> FloatArray:
    """[φ_e(y(t)), φ_f(x, w)] of every row of a scaled trial."""
    N, history, (y, u) = len(trial), model_class.history, (trial.y, trial.u)
    past = [y[history - k : N - k] for k in range(1, model_class.lags + 1)]
    delayed = [u[history - d : N - d, [i]] for i, d in model_class.window(u.shape[1])]
    known = np.hstack([*past, *delayed])
    return np.hstack([monomial_values(left, y[history:]), monomial_values(right, known)])


def right_basis(model_class: Options, states: int, inputs: int) -> IntArray:
    """(m, states + inputs) exponents of f, the constant among them."""
    d = model_class.degrees
    if d.lagged:
        return monomials(states + inputs, range(d.past + 1))
    of_x = monomials(states, range(d.past + 1))
    of_w = monomials(inputs, range(1, d.inputs + 1))
    return np.vstack(
        [
            np.hstack([of_x, np.zeros((len(of_x), inputs), dtype=np.int64)]),
            np.hstack([np.zeros((len(of_w), states), dtype=np.int64), of_w]),
        ]
    )


def refuse_large(model_class: Options, outputs: int, inputs: int) -> None:
    """DataError for more terms or larger squares than a search should begin with.

    Counted before anything is built: a polynomial of degree d in k variables has
    binomial(k + d, d) terms, and so has a square's factor with half the degree.
    """
    n, m = model_class.lags * outputs, len(model_class.window(inputs))
    d, coupled = model_class.degrees, bool(model_class.degrees.lagged)
    k = n + m if coupled else n
    terms = comb(outputs + d.left, d.left) - 1 + comb(k + d.past, d.past)
    if not coupled:
        terms += comb(m + d.inputs, d.inputs) - 1
    if terms > MOST_TERMS:
        raise DataError(
            f"{terms} terms an equation of {n} past outputs and {m} delayed inputs, more than "
            f"{MOST_TERMS}; {FEWER}"
        )
    if outputs + n > LARGEST_BLOCK:
        raise DataError(
            f"a semidefinite block of {outputs} outputs and {n} states, more than "
            f"{LARGEST_BLOCK}: {SLOW}; use fewer lags"
        )
    curved = coupled or d.past > 1
    inside = outputs + (k if curved else 0)
    half = max(d.left, d.past, 2) // 2
    curves, flat = (outputs + n, 0) if curved else (outputs, n)
    square = curves * comb(inside + half, half) + flat
    if square > MOST_MONOMIALS:
        raise DataError(
            f"{square} monomials in a square of set {model_class.form}, more than "
            f"{MOST_MONOMIALS}; {FEWER}"
        )


def _refuse_data_outside(rows: ImplicitRows) -> None:
    """The equation error of a sample outside the box is bounded by nothing."""
    n_v = len(rows.y_scale[0])
    if not rows.ends:
        return
    for i, (low, high) in enumerate(rows.model_class.box or ()):
        letter, j, names = ("y", i, "y_names") if i < n_v else ("u", i - n_v, "u_names")
        for trial in rows.dataset:
            values = getattr(trial, letter)[:, j]
            if values.min() < low or values.max() > high:
                raise DataError(
                    f"{trial.name}: {getattr(trial, names)[j]} reaches "
                    f"[{values.min():g}, {values.max():g}], outside the range [{low:g}, {high:g}]"
                )


def delayed_states(size: int, variables_: int) -> Polynomials:
    """ã(x, w): the first `size` states."""
    return Polynomials(np.eye(variables_, dtype=np.int64)[:size], np.eye(size))


def _stacked(parts: list[Polynomial]) -> Polynomials:
    """Polynomials in the same variables on common exponents."""
    rows = np.vstack([p.exponents for p in parts])
    exponents, place = np.unique(rows, axis=0, return_inverse=True)
    column = np.repeat(np.arange(len(parts)), [len(p) for p in parts])
    coefficients = np.zeros((len(exponents), len(parts)))
    values = np.concatenate([p.coefficients for p in parts]).astype(np.float64)
    np.add.at(coefficients, (place.ravel(), column), values)
    return Polynomials(exponents, coefficients)


def _with_symmetric_left(h: Polynomials, n_v: int) -> Polynomials:
    """E = E' to the last digit."""
    rows = [
        int(np.flatnonzero((h.exponents == unit).all(axis=1))[0])
        for unit in np.eye(h.exponents.shape[1], dtype=np.int64)[:n_v]
    ]
    coefficients = h.coefficients.copy()
    coefficients[rows] = (coefficients[rows] + coefficients[rows].T) / 2.0
    return replace(h, coefficients=coefficients)
