"""One step of an implicit closed loop around a nominal: exact equations, and what bounds its roots.

Around the nominal x̄ = T z and v̄⁺ = T⁺w, T⁺ the block of the rates: h(z, w) = 0 is the trapezoidal
equation with q⁺ substituted, and S⁺x̄⁺ is linear in (z, w). All floats are taken as the rationals
they are. An identified h has spurious roots far away, so nothing is said of w beyond a bound.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import comb

import numpy as np

from nlsid_core._types import FloatArray, IntArray, Json
from nlsid_core.certificate import polynomial_data as data
from nlsid_core.certificate import reach
from nlsid_core.certificate.composed import compose
from nlsid_core.certificate.identity import MAX_ORDER, Mode
from nlsid_core.certificate.nonnegative import prove_lower_bound
from nlsid_core.certificate.reach import Rational, rational
from nlsid_core.errors import CertificateRejected, Undecided
from nlsid_core.models.trapezoidal import TrapezoidalModel
from nlsid_core.polynomial import Gram, Polynomial, monomials

RATES_SHRUNK = (1, 4, 16)  # how much smaller than z the next rates are made, bounded together
HOPELESS = Fraction(2**60)  # a slope that vanishes bounds no difference


@dataclass(frozen=True, eq=False)
class ImplicitLoop:
    """h: (m, d) over the monomials of (z, w); rows, of S⁺x̄⁺: (1 + n + d, n), constant first."""

    h: Rational
    rows: Rational

    @property
    def joints(self) -> int:
        """d."""
        return int(self.h.shape[1])

    @property
    def states(self) -> int:
        """n = 2d."""
        return 2 * self.joints


@dataclass(frozen=True, eq=False)
class ImplicitStepProof:
    """reach b; Gram matrix, multipliers of 1 - |z|² and 1 - |w|², and those of the equations."""

    reach: float
    gram: Gram
    multipliers: tuple[Gram, Gram]
    equality_multipliers: tuple[Polynomial, ...]

    def document(self) -> Json:
        """The JSON form."""
        return {
            "reach": self.reach,
            "gram": data.write_gram(self.gram),
            "multipliers": [data.write_gram(gram) for gram in self.multipliers],
            "equality_multipliers": [data.write_polynomial(p) for p in self.equality_multipliers],
        }


def refuse_size(model: TrapezoidalModel) -> None:
    """Raise Undecided, before any work, if a step's Gram matrix would be too large to decide."""
    n, degree = len(model) + model.joints, int(np.max(model.exponents.sum(axis=1)))
    order = comb(n + max(1, (degree + 1) // 2), n)
    if order > MAX_ORDER:
        raise Undecided(f"degree {degree} in {n} variables: order {order} is above {MAX_ORDER}")


def implicit_loop(
    model: TrapezoidalModel,
    *,
    x: FloatArray,
    u: FloatArray,
    K: FloatArray,
    x_next: FloatArray,
    T: FloatArray,
    T_next: FloatArray,
    S_next: FloatArray,
) -> ImplicitLoop:
    """The exact equations around one sample of a motion, u = u_k - K x̄."""
    d, n, half = model.joints, len(model), Fraction(model.period) / 2
    before, after = rational(T), rational(T_next[d:, d:])
    zero = np.full((n, d), Fraction(0), dtype=object)
    state = np.hstack([before, zero])  # x̄ of (z, w)
    rate = np.hstack([np.full((d, n), Fraction(0), dtype=object), after])  # v̄⁺
    place = state[:d] + half * (state[d:] + rate)  # q̄⁺, with what the nominals differ by below
    start, following = rational(x), rational(x_next)
    reached = start[:d] + half * (start[d:] + following[d:])
    inputs = -(rational(K) @ state)
    h = -half * (
        _composed(model, np.vstack([state, inputs]), np.concatenate([start, rational(u)]))
        + _composed(
            model,
            np.vstack([place, rate, inputs]),
            np.concatenate([reached, following[d:], rational(u)]),
        )
    )
    h[0] += following[d:] - start[d:]
    linear = (rate - state[d:]).T
    for j, unit in enumerate(np.eye(n + d, dtype=np.int64)):
        index = _index(n + d, unit)
        h[index] += linear[j]
    offset = np.concatenate([reached - following[:d], np.full(d, Fraction(0), dtype=object)])
    rows = np.vstack([offset[None], np.vstack([place, rate]).T])
    return ImplicitLoop(h, np.asarray(rows @ rational(S_next).T))


def step_polynomials(
    loop: ImplicitLoop, radius: float, bound: float
) -> tuple[list[Polynomial], list[Polynomial], Fraction]:
    """S⁺x̄⁺/size and h over powers of two, z in units of radius, w of bound; and size."""
    n, d = loop.states, loop.joints
    names = names_of(n, d)
    scale = [Fraction(radius)] * n + [Fraction(bound)] * d
    degree = reach.degree_of(loop.h, n + d)
    basis = monomials(n + d, range(degree + 1))
    weights = np.array([_power(scale, row) for row in basis.tolist()], dtype=object)
    equations = [_polynomial(basis, column * weights, names) for column in loop.h.T]
    linear = np.vstack([np.zeros((1, n + d), np.int64), np.eye(n + d, dtype=np.int64)])
    lengths = np.array([Fraction(1), *scale], dtype=object)
    scaled = loop.rows * lengths[:, None]
    size = _two_power(np.abs(scaled).max())
    rows = [Polynomial(linear, column / size, names) for column in scaled.T]
    return rows, equations, size


def prove_implicit_reach(
    loop: ImplicitLoop,
    radius: float,
    bound: float,
    proof: ImplicitStepProof,
    *,
    mode: Mode = "exact",
) -> float:
    """Prove |z| ≤ radius, |w| ≤ bound and h = 0 ⇒ |S⁺x̄⁺| ≤ proof.reach; the Gram matrix's margin.

    The identity is reach² - |S⁺x̄⁺|² - ν'h - σ₁(1 - |z|²) - σ₂(1 - |w|²) = v'Qv in units of radius
    and bound. Raises CertificateRejected with the reason.
    """
    if not (np.isfinite(bound) and bound > 0):
        raise CertificateRejected(
            f"the bound on the next rate is {bound}; without one a step can end at a spurious root"
        )
    rows, equations, size = step_polynomials(loop, radius, bound)
    return prove_lower_bound(
        -squared(rows),
        -((Fraction(proof.reach) / size) ** 2),
        proof.gram,
        domain=unit_balls(loop.states, loop.joints),
        multipliers=proof.multipliers,
        equalities=equations,
        equality_multipliers=proof.equality_multipliers,
        mode=mode,
    )


def roots_between(
    loop: ImplicitLoop, *, radius: Fraction, bound: Fraction, response: Fraction
) -> Fraction:
    """D with |w₂ - w₁| ≤ D·|r| for roots of two states |r| apart, radius and response in |z|, |r|.

    And for every root |w₂| ≤ bound of z + r there is such a root w₁ of z: w ↦ w - M h(z, w)
    contracts around w₂, M near the inverse of ∂h/∂w. Raises CertificateRejected if it may not.
    """
    B, C, N = _normalised(loop)
    near = 2 * (1 + _norm(B)) * response  # where w₁ is looked for, around w₂
    D = min(
        (
            _difference(B, C, slope, weight)
            for weight in _weights(bound, radius)
            for slope in [_slope(N, weight, (radius, bound + near), (response, 2 * near))]
        ),
    )
    if D * response > near:
        raise CertificateRejected(
            "roots may differ by more than a disturbance explains; cut the bound or the radius"
        )
    return D


def implicit_response(
    loop: ImplicitLoop,
    unit: Rational,
    *,
    radius: Fraction,
    reached: Fraction,
    D: Fraction,
    response: Fraction,
) -> Fraction:
    """e with |S⁺(x̄⁺(z + r) - x̄⁺(z)) - unit r| ≤ e for |z| ≤ radius, |r| ≤ response.

    reached: at least |w₁| of the undisturbed step; D: of `roots_between`.
    """
    B, C, N = _normalised(loop)
    n = loop.states
    error = min(
        _norm(C - _identity(len(C))) * nearer + slope * (1 + nearer / weight)
        for weight in _weights(reached, radius)
        for slope in [_slope(N, weight, (radius, reached), (response, D * response))]
        for nearer in [min(D, _difference(B, C, slope, weight))]
    )
    by_state, by_rate = loop.rows[1 : n + 1].T, loop.rows[n + 1 :].T
    return (_norm(by_state - by_rate @ B - unit) + _norm(by_rate) * error) * response


def names_of(n: int, d: int) -> tuple[str, ...]:
    """z0 … z(n-1), then w0 … w(d-1)."""
    return (*(f"z{i}" for i in range(n)), *(f"w{i}" for i in range(d)))


def unit_balls(n: int, d: int) -> list[Polynomial]:
    """1 - |z|² and 1 - |w|²."""
    balls = []
    for members in (range(n), range(n, n + d)):
        squares = 2 * np.eye(n + d, dtype=np.int64)[list(members)]
        exponents = np.vstack([np.zeros((1, n + d), dtype=np.int64), squares])
        balls.append(Polynomial(exponents, np.r_[1.0, -np.ones(len(squares))], names_of(n, d)))
    return balls


def squared(rows: Sequence[Polynomial]) -> Polynomial:
    """|rows|²."""
    total: Polynomial = rows[0] * rows[0]
    for row in rows[1:]:
        total = total + row * row
    return total


def _composed(model: TrapezoidalModel, A: Rational, b: Rational) -> Rational:
    """The acceleration at Az + b, exactly."""
    whole, bits = compose(model.exponents, model.coefficients, A, b)
    values = np.empty(whole.shape, dtype=object)
    values.ravel()[:] = [Fraction(entry, 1 << bits) for entry in whole.ravel()]
    return values


def _normalised(loop: ImplicitLoop) -> tuple[Rational, Rational, Rational]:
    """M h = constant + B z + C w + N: B (d, n), C (d, d) near 1, and N over its monomials."""
    n, d = loop.states, loop.joints
    linear = np.array([loop.h[_index(n + d, e)] for e in np.eye(n + d, dtype=np.int64)]).T
    M = rational(np.linalg.inv(linear[:, n:].astype(np.float64)))
    N = loop.h @ M.T
    first = monomials(n + d, range(reach.degree_of(loop.h, n + d) + 1)).sum(axis=1) <= 1
    N[first] = Fraction(0)
    return M @ linear[:, :n], M @ linear[:, n:], N


def _weights(bound: Fraction, radius: Fraction) -> list[Fraction]:
    """Powers of two σ that w may be divided by beside z; which serves best depends on N."""
    return [_two_power(bound / radius) * factor for factor in RATES_SHRUNK]


def _slope(
    N: Rational,
    weight: Fraction,
    sizes: tuple[Fraction, Fraction],
    steps: tuple[Fraction, Fraction],
) -> Fraction:
    """μ with |N(ζ + ω) - N(ζ)| ≤ μ(|r| + |Δ|/weight), ω = (r, Δ), for |z|, |w| and |r|, |Δ| up to
    sizes and steps.
    """
    variables = 3 * int(N.shape[1])  # z and w
    linear = np.full((N.shape[1], variables), Fraction(0), dtype=object)
    basis = monomials(variables, range(reach.degree_of(N, variables) + 1))
    powers = basis[:, 2 * N.shape[1] :].sum(axis=1).tolist()
    shrunk = N * np.array([weight**power for power in powers], dtype=object)[:, None]
    size, step = (reach.root_above(z**2 + (w / weight) ** 2) for z, w in (sizes, steps))
    return reach.stretch(reach.curvature(shrunk, linear, variables), Fraction(1), size, step)


def _difference(B: Rational, C: Rational, slope: Fraction, weight: Fraction) -> Fraction:
    """D of |Δ| ≤ D|r| from |Δ| ≤ |B||r| + |C - 1||Δ| + slope(|r| + |Δ|/weight)."""
    shrink = 1 - _norm(C - _identity(len(C))) - slope / weight
    if shrink <= 0:
        return HOPELESS
    return (_norm(B) + slope) / shrink


def _norm(M: Rational) -> Fraction:
    return reach.norm_above(M)


def _identity(d: int) -> Rational:
    return rational(np.eye(d))


def _index(n: int, exponent: IntArray) -> int:
    """Where a monomial of degree 1 is among `monomials(n, range(…))`."""
    linear = monomials(n, range(2))
    return int(np.flatnonzero((linear == exponent).all(axis=1))[0])


def _power(scale: Sequence[Fraction], exponent: Sequence[int]) -> Fraction:
    value = Fraction(1)
    for factor, power in zip(scale, exponent, strict=True):
        value *= factor**power
    return value


def _polynomial(basis: np.ndarray, column: np.ndarray, names: tuple[str, ...]) -> Polynomial:
    """The column's polynomial over a power of two near its largest coefficient; zeros left out."""
    kept = column != 0
    return Polynomial(basis[kept], column[kept] / _two_power(np.abs(column).max()), names)


def _two_power(value: Fraction) -> Fraction:
    exponent = round(float(np.log2(float(value))))
    return Fraction(2**exponent) if exponent >= 0 else Fraction(1, 2**-exponent)
