"""Linear models of measured states, stable by construction: the comparator for linear systems.

    minimise Σ |E x⁺ - F x - G w - c|²   over [E - I, F'; F, E] ⪰ 0, E = E'
in signals of unit spread. The set holds every stable A = E⁻¹F (2.19), so nothing stable is lost; an
unstable truth gives the stable model nearest in this measure.
Source: thesis (2.19), after its reference [70].
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import Infeasible
from nlsid_core.identification.polynomial.implicit_rows import with_signals
from nlsid_core.identification.proofs.conditions import constraint, linear
from nlsid_core.identification.proofs.stable_sets import ImplicitProof, prove_implicit
from nlsid_core.identification.regressors import refuse_poor, signal_scale
from nlsid_core.models import ImplicitModel
from nlsid_core.models.polynomials import Polynomials
from nlsid_core.polynomial import variables
from nlsid_core.sos import NormBound, Program, Solution, forms_of, solve, symmetric_template

DECREASE = 0.5  # δ that is proved, of the one the search asks for


@dataclass(frozen=True)
class LinearStateClass:
    """Stable linear models whose state is the measured outputs: x⁺ = A x + B u + c."""

    kind: ClassVar[type[ImplicitModel]] = ImplicitModel


@dataclass(frozen=True, eq=False)
class LinearStateFit:
    """The model E x⁺ = F x + G w + c in the signals' units, and its exact proof."""

    model: ImplicitModel
    proof: ImplicitProof

    @property
    def A(self) -> FloatArray:
        """(n, n): E⁻¹F."""
        n = len(self.model)
        zero = np.zeros((1, n + len(self.model.inputs)))
        return self.model.jacobian(zero[:, :n], zero[:, :n], zero[:, n:])[0, :, :n]


def identify_linear_states(dataset: Dataset, *, slowest: float = 1.0) -> LinearStateFit:
    """The stable linear model of the measured outputs as states, x⁺ one sample ahead.

    slowest: two solutions approach each other by it or faster, a sample.
    Raises DataError for data too few or not rich enough, Infeasible if the minimiser has no exact
    proof, SolverError as the solver does.
    """
    x_scale, u_scale = signal_scale(dataset, "y"), signal_scale(dataset, "u")
    steps = [
        [(t.y[1:] - x_scale[0]) / x_scale[1], (t.y[:-1] - x_scale[0]) / x_scale[1],
         (t.u[:-1] - u_scale[0]) / u_scale[1], np.ones((len(t) - 1, 1))]
        for t in dataset
    ]  # fmt: skip
    after, now, w, ones = (np.concatenate(parts) for parts in zip(*steps, strict=True))
    data = np.hstack([after, now, w, ones])
    refuse_poor(data[:, after.shape[1] :])
    n = after.shape[1]
    R = np.linalg.qr(data, mode="r") / np.sqrt(len(data))
    E, found = _solved(R, n, slowest)
    F = _values(found, "F", n, n)
    G = _values(found, "G", n, R.shape[1] - 2 * n)
    first = dataset.trajectories[0]
    D = np.diag(1.0 / x_scale[1])
    E, F, B = D @ E @ D, D @ F @ D, D @ G[:, :-1] / u_scale[1]
    E = (E + E.T) / 2.0
    c = (E - F) @ x_scale[0] - B @ u_scale[0] + D @ G[:, -1]
    units = np.eye(n + len(u_scale[0]), dtype=np.int64)
    model = ImplicitModel.separable(
        e=Polynomials(units[:n, :n], E.T),
        f=Polynomials(np.vstack([units, np.zeros_like(units[:1])]), np.vstack([F.T, B.T, c])),
        monotonicity=DECREASE * float(np.linalg.eigvalsh(E)[0]),
        period=dataset.period,
        states=tuple(first.y_names),
        inputs=tuple(first.u_names),
    )
    window = tuple((i, 1) for i in range(len(u_scale[0])))
    model = with_signals(model, dataset, window)
    delta = DECREASE / float(np.max(x_scale[1])) ** 2
    proof = prove_implicit(model, delta=delta, set="2.19")
    if proof is None:
        raise Infeasible("no exact proof for the minimiser; give more data or fewer states")
    return LinearStateFit(model, proof)


def _solved(R: FloatArray, n: int, slowest: float) -> tuple[FloatArray, Solution]:
    """E, and the solution that holds F and G, for the triangular factor R of [x⁺, x, w, 1]."""
    E = symmetric_template("E", n)
    F, G = _unknown("F", n, n), _unknown("G", n, R.shape[1] - 2 * n)
    (bound,) = variables("bound")
    residual = R[:, :n] @ E - R[:, n : 2 * n] @ F.T - R[:, 2 * n :] @ G.T
    stable = constraint(linear(E, F, rate=slowest), name="linear models (2.19)")
    program = Program(
        forms_of(2 * n),
        (stable, NormBound(tuple(residual.ravel()), bound)),
        minimise=bound,
    )
    found = solve(program)
    values = [[float(found.value(entry)) for entry in row] for row in E]
    return np.array(values), found


def _unknown(name: str, rows: int, columns: int) -> np.ndarray:
    names = [f"{name}[{i},{j}]" for i in range(rows) for j in range(columns)]
    return np.array(variables(names), dtype=object).reshape(rows, columns)


def _values(found: Solution, name: str, rows: int, columns: int) -> FloatArray:
    entries = [[found.values[f"{name}[{i},{j}]"] for j in range(columns)] for i in range(rows)]
    return np.array(entries)
