"""Time-varying LQR and Lyapunov functions along a nominal motion: Riccati and Lyapunov equations.

Source: thesis Section 6.1, (6.2).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from nlsid_core import files
from nlsid_core.arrays import ArrayLike, FloatArray
from nlsid_core.dynamics import (
    Nominal,
    PiecewisePolynomial,
    Rates,
    VectorField,
    constant_on,
    cubic_through,
    linear_through,
)
from nlsid_core.errors import DataError, Infeasible, NlsidError, SolverError
from nlsid_core.options import numbers
from nlsid_core.policies.continuous import ContinuousPolicy

RTOL = 1e-9  # of S between knots, to √(S_ii S_jj); P's interpolation error is far larger
EASY, MOST_STEPS = 1e-12, 256  # of the same: then fewer steps are tried next; of an interval
GAUSS = 15**0.5 / 10  # of a step: from its middle to the outer two of Gauss's three points
NOMINAL_RTOL, NOMINAL_ATOL = 1e-11, 1e-12
RICCATI = "the Riccati equation: is the linearisation controllable?"
BLOW_UP = 1e12  # relative growth of S past which the linearisation is as good as uncontrollable


@dataclass(frozen=True, eq=False)
class Tracking:
    """A policy and its cost-to-go S (K, n, n) at the knots."""

    policy: ContinuousPolicy
    S: FloatArray


def tvlqr(
    field: VectorField,
    nominal: Nominal,
    *,
    Q: ArrayLike,
    R: ArrayLike,
    S_final: ArrayLike,
    linear: bool = False,
) -> Tracking:
    """The LQR around `nominal` by -Ṡ = A'S + SA - SBR⁻¹B'S + Q, S(t_f) = S_final, K = R⁻¹B'S.

    Q, S_final: (n, n) ⪰ 0 and ≻ 0; R: (m, m) ≻ 0. linear: whether K is linear between knots, and
    so continuous; else it is constant.

    Raises DataError on indefinite weights, Infeasible if the linearisation cannot be controlled.
    """
    Q = definite(Q, field.n, "Q", strict=False)
    R = definite(R, field.m, "R", strict=True)
    S_final = definite(S_final, field.n, "S_final", strict=True)
    R_inverse = np.linalg.inv(R)

    def hamiltonian(t: float) -> FloatArray:
        return _hamiltonian(*_linearised(field, nominal, t), Q, R_inverse)

    S = _backward(hamiltonian, nominal.t, S_final, RICCATI)

    def gain_at(k: int, side: float) -> FloatArray:
        return np.asarray(R_inverse @ _linearised(field, nominal, nominal.t[k], side)[1].T @ S[k])

    knots = len(nominal.t)
    after = np.array([gain_at(k, 1.0) for k in range(knots - 1)])
    K = constant_on(nominal.t, after)
    if linear:
        before = np.array([gain_at(k, -1.0) for k in range(1, knots)])
        inner = (before[:-1] + after[1:]) / 2  # the dynamics of two intervals may differ a little
        K = linear_through(nominal.t, np.concatenate([after[:1], inner, before[-1:]]))
    policy = ContinuousPolicy(nominal.x, nominal.u, K, files.digest(field.document()))
    return Tracking(policy, S)


def steady(
    field: VectorField, nominal: Nominal, *, Q: FloatArray, R: FloatArray, S_final: FloatArray
) -> FloatArray:
    """S (n, n) at the motion's end if it stayed there as long again, to S_final: K hardly turns."""
    end = _linearised(field, nominal, float(nominal.t[-1]), -1.0)
    H = _hamiltonian(*end, Q, np.asarray(np.linalg.inv(R)))
    return np.asarray(_backward(lambda _: H, nominal.t, S_final, RICCATI)[0])


def lyapunov(
    field: VectorField,
    policy: ContinuousPolicy,
    *,
    Q: ArrayLike,
    P_final: ArrayLike,
) -> FloatArray:
    """P (K, n, n) at the knots from -Ṗ = A'P + PA + Q along the closed loop, thesis (6.2)."""
    Q = definite(Q, field.n, "Q", strict=False)
    P_final = definite(P_final, field.n, "P_final", strict=True)
    nominal = Nominal(policy.x, policy.u)

    def hamiltonian(t: float) -> FloatArray:
        A, B = _linearised(field, nominal, t)
        closed = A - B @ policy.K(t)
        return np.block([[closed, np.zeros_like(closed)], [-Q, -closed.T]])

    return _backward(hamiltonian, nominal.t, P_final, "the Lyapunov equation")


def integrate_nominal(
    field: VectorField | Callable[..., Any],
    u: Callable[[float], ArrayLike] | PiecewisePolynomial,
    *,
    t: ArrayLike,
    start: ArrayLike | None = None,
    final: ArrayLike | None = None,
) -> Nominal:
    """The motion with input u(t) from `start` at t[0], or back from `final` at t[-1], as cubics.

    field: or a function of some of t, x, u, named so. t: (K,) knots in s. Raises DataError unless
    one end is given and the knots increase.
    """
    t = numbers(t, "t")
    if t.ndim != 1 or len(t) < 2 or not (np.diff(t) > 0).all() or not np.isfinite(t).all():
        raise DataError(f"t should be two or more times that increase, is {t.tolist()}")
    if (start is None) == (final is None):
        raise DataError("give the state at the start or at the end, not both")
    given = numbers(start if final is None else final, "the state")
    if given.ndim != 1 or not np.isfinite(given).all():
        raise DataError(f"the state should be n finite numbers, is {given.tolist()}")
    inputs = u if isinstance(u, PiecewisePolynomial) else _cubic_input(u, t)
    m = inputs.control.shape[2]
    rates = field if isinstance(field, VectorField) else Rates.numeric(field, len(given), m)
    values = inputs.ends()
    span, order = ((t[0], t[-1]), t) if final is None else ((t[-1], t[0]), t[::-1])
    solved = solve_ivp(
        lambda s, x: rates(s, x[None], inputs(s)[None])[0],
        span,
        given,
        t_eval=order,
        rtol=NOMINAL_RTOL,
        atol=NOMINAL_ATOL,
        max_step=float(np.diff(t).min()),
    )
    if not solved.success or solved.y.shape[1] != len(t):
        raise SolverError(f"the nominal cannot be integrated: {solved.message}")
    x = solved.y.T if final is None else solved.y.T[::-1]
    slopes = np.array([rates(s, x[k][None], values[k][None])[0] for k, s in enumerate(t)])
    return Nominal(cubic_through(t, x, slopes), inputs)


def nominal_through(t: ArrayLike, x: ArrayLike, u: ArrayLike, field: VectorField) -> Nominal:
    """Samples x (K, n), u (K, m) at times t (K,), as cubics with the field's slopes."""
    t, x, u = (np.asarray(part, dtype=np.float64) for part in (t, x, u))
    inputs = linear_through(t, u)
    rates = np.array([field(s, x[k][None], u[k][None])[0] for k, s in enumerate(t)])
    return Nominal(cubic_through(t, x, rates), inputs)


def _cubic_input(u: Callable[[float], ArrayLike], t: FloatArray) -> PiecewisePolynomial:
    """Cubics through u at four Chebyshev-like points of each interval: exact for cubic u(t)."""
    if not callable(u):
        raise DataError(f"u should be a function of the time, is {u!r}")

    def value(when: float) -> FloatArray:
        try:
            return np.ravel(numbers(u(when), f"u({when:.6g})"))
        except NlsidError:
            raise
        except Exception as error:
            raise DataError(
                f"u has no value at t = {when:.6g} ({type(error).__name__}: {error})"
            ) from error

    share = np.array([0.0, 1 / 3, 2 / 3, 1.0])
    values = [[value(float(a + s * (b - a))) for s in share] for a, b in itertools.pairwise(t)]
    counts = {len(row) for rows in values for row in rows}
    if len(counts) > 1:
        raise DataError(f"u should return as many inputs at all times, returns {sorted(counts)}")
    # Values at the four points from Bernstein control points, inverted.
    to_values = np.array(
        [[(1 - s) ** 3, 3 * s * (1 - s) ** 2, 3 * s**2 * (1 - s), s**3] for s in share]
    )
    pieces = [np.linalg.solve(to_values, np.array(rows)) for rows in values]
    control = np.array(pieces)
    control[1:, 0] = control[:-1, -1]
    return PiecewisePolynomial(t, control)


def _linearised(
    field: VectorField, nominal: Nominal, t: float, side: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    inside = np.clip(t + side * 1e-12, nominal.t[0], nominal.t[-1])
    return field.jacobians(float(inside), nominal.x(t), nominal.u(t))


def _hamiltonian(A: FloatArray, B: FloatArray, Q: FloatArray, R_inverse: FloatArray) -> FloatArray:
    return np.asarray(np.block([[A, -B @ R_inverse @ B.T], [-Q, -A.T]]))


def _backward(
    hamiltonian: Callable[[float], FloatArray], t: FloatArray, final: FloatArray, what: str
) -> FloatArray:
    """S (K, n, n) = Y X⁻¹ at t (K,), with d[X; Y]/dt = H(t) [X; Y] and S(t_f) = final."""
    S = np.empty((len(t), *final.shape))
    S[-1] = final
    most, count = BLOW_UP * float(np.abs(final).max()), 1
    for k in range(len(t) - 2, -1, -1):
        rough, count = _stepped(hamiltonian, t[k : k + 2], S[k + 1], count), 2 * count
        while True:
            S[k] = _stepped(hamiltonian, t[k : k + 2], S[k + 1], count)
            if not np.abs(S[k]).max() <= most:  # or is not a number
                raise Infeasible(f"no bounded solution of {what} (at {t[k]:.4g} s)")
            sizes = np.sqrt(np.diag(S[k]))
            gap = float((np.abs(S[k] - rough) / sizes / sizes[:, None]).max())
            if gap <= RTOL or count >= MOST_STEPS:
                break
            rough, count = S[k], 2 * count
        count = max(1, count // (4 if gap <= EASY else 2))
    return S


def _stepped(
    hamiltonian: Callable[[float], FloatArray], ends: FloatArray, S: FloatArray, count: int
) -> FloatArray:
    """S at the start of an interval from S at its end, in `count` steps of order 6.

    Source: Blanes, Casas, Oteo and Ros, "The Magnus expansion and some of its applications", 2009,
    (253) to (257), with Gauss's three points.
    """
    n, times = len(S), np.linspace(ends[1], ends[0], count + 1)
    for start, end in itertools.pairwise(times.tolist()):
        h, middle = end - start, (start + end) / 2
        first, second, third = (h * hamiltonian(middle + h * side) for side in (-GAUSS, 0, GAUSS))
        slope, bend = (third - first) / (2 * GAUSS), (third - 2 * second + first) / (2 * GAUSS**2)
        inner = _commutator(second, slope)
        outer = slope - _commutator(second, 2 * bend + inner) / 60
        omega = second + bend / 12 + _commutator(inner - 20 * second - bend, outer) / 240
        X, Y = np.split(expm(omega) @ np.vstack([np.eye(n), S]), [n])
        S = np.linalg.solve(X.T, Y.T)
        S = (S + S.T) / 2
    return S


def _commutator(A: FloatArray, B: FloatArray) -> FloatArray:
    return A @ B - B @ A


def definite(M: ArrayLike, n: int, name: str, *, strict: bool) -> FloatArray:
    """M as a symmetric (n, n) array; DataError unless it is one, ⪰ 0 or, if strict, ≻ 0."""
    M = numbers(M, name)
    if (
        M.shape != (n, n)
        or not np.isfinite(M).all()
        or not np.allclose(M, M.T, rtol=1e-12, atol=0.0)
    ):
        raise DataError(f"{name} should be a symmetric {n}x{n} matrix, has shape {M.shape}")
    lowest = float(np.linalg.eigvalsh(M)[0]) if n else 1.0
    if lowest < 0 or (strict and lowest <= 0):
        kind = "positive definite" if strict else "positive semidefinite"
        raise DataError(f"{name} should be {kind}; its smallest eigenvalue is {lowest:.3g}")
    return np.asarray((M + M.T) / 2)
