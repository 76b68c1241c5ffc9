"""One step of a closed loop as the kernel rebuilds it, in floats for the search, and back again.

The kernel's own polynomials are evaluated, so that what the search optimises is what is decided.
Bounds are rounded up, and nothing here is trusted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import factorial, prod

import numpy as np
from numpy.typing import ArrayLike

from nlsid_core.arrays import FloatArray, IntArray, Json
from nlsid_core.errors import Infeasible
from nlsid_core.kernel import text
from nlsid_core.kernel.files import Terms
from nlsid_core.kernel.polynomials import Polynomial, Ring
from nlsid_core.kernel.sampled_step import Sample
from nlsid_core.models.state_map import StateModel
from nlsid_core.policies.sampled import SampledPolicy
from nlsid_core.sos.witness import expanded, multiplier, witness

WIDTH = 4096  # bits that a coefficient may take
ABOVE = 1.0 + 1e-9  # over a singular value computed in floats, to be proved exactly


@dataclass(frozen=True, eq=False)
class Frame:
    """Norms along a motion, before any radius: S and T = S⁻¹ (N + 1), the response's A, and caps.

    cap: (N + 1,) the largest radius in the box of the data, policy's inputs included.
    """

    S: FloatArray
    T: FloatArray
    A: FloatArray
    cap: FloatArray

    def sample(self, policy: SampledPolicy, k: int) -> Sample:
        """Sample k, exactly."""
        parts = {"x": policy.x, "u": policy.u, "K": policy.K, "S": self.S, "A": self.A}
        here = {name: exact(values[k]) for name, values in parts.items()}
        return Sample(**here, x_next=exact(policy.x[k + 1]), S_next=exact(self.S[k + 1]))


def exact(values: ArrayLike) -> list:  # type: ignore[type-arg]
    """Nested lists of the Fractions that the floats are."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim > 1:
        return [exact(row) for row in array]
    return [Fraction(entry) for entry in array.tolist()]


def floats(M: Sequence[Sequence[Fraction]]) -> FloatArray:
    """The floats nearest to a matrix of Fractions."""
    return np.array([[float(entry) for entry in row] for row in M])


def map_of(model: StateModel) -> list[Terms]:
    """The model's map, exactly."""
    exponents = [bytes(row) for row in model.exponents.tolist()]
    return [list(zip(exponents, column, strict=True)) for column in exact(model.coefficients.T)]


def ring_of(variables: int) -> Ring:
    """The kernel's polynomials in so many variables."""
    return Ring(variables, WIDTH)


def terms(p: Polynomial, ring: Ring) -> dict[tuple[int, ...], Fraction]:
    """Coefficients by exponents."""
    return {
        ring.exponents(key): Fraction(value, p.denominator)
        for key, value in p.terms.items()
        if value
    }


def scaled_terms(p: Polynomial, ring: Ring, scale: Sequence[float]) -> dict[tuple[int, ...], float]:
    """The coefficients of p(scale * y), in floats."""
    lengths = [Fraction(length) for length in scale]
    return {
        e: float(value * prod(length**power for length, power in zip(lengths, e, strict=True)))
        for e, value in terms(p, ring).items()
    }


def inverse_bound(ST: Sequence[Sequence[Fraction]]) -> float:
    """κ with |z| ≤ κ|S T z|, rounded up."""
    return float(ABOVE / np.linalg.svd(floats(ST), compute_uv=False)[-1])


def curvature_bounds(p: Sequence[Polynomial], ring: Ring) -> list[float]:
    """γ_m of the parts of degree m = 1, 2, … of p; as in the kernel."""
    columns: dict[int, list[list[float]]] = {}
    rows = [terms(q, ring) for q in p]
    for e in set().union(*rows):
        share = (prod(map(factorial, e)) / factorial(sum(e))) ** 0.5
        columns.setdefault(sum(e), []).append([share * float(q.get(e, 0)) for q in rows])
    highest = max(columns, default=0)
    return [
        float(ABOVE * np.linalg.norm(np.array(columns[m]), 2)) if m in columns else 0.0
        for m in range(1, highest + 1)
    ]


def stated_multiplier(
    basis: IntArray, Q: FloatArray, scale: Sequence[float], ring: Ring
) -> tuple[Json, Polynomial]:
    """A multiplier v'Qv of y, x = scale * y, as the proof states it, and exactly."""
    unit = _unit(basis, scale)
    stated = multiplier(basis, Q / np.multiply.outer(unit, unit))
    return _trimmed(stated), polynomial({e: c[0] for e, c in expanded(stated).items()}, ring)


def stated_squares(
    c: Polynomial, basis: IntArray, Q: FloatArray, scale: Sequence[float], ring: Ring
) -> Json:
    """The witness of c ≥ 0 near v'Qv of y, x = scale * y; Infeasible if there is no room."""
    rest = scaled_terms(c, ring, scale)
    sums = (basis[:, None] + basis[None]).reshape(-1, basis.shape[1]).tolist()
    for e, entry in zip(sums, Q.ravel().tolist(), strict=True):
        rest[tuple(e)] = rest.get(tuple(e), 0.0) - entry
    residual = {e: value / float(_unit([e], scale)[0]) for e, value in rest.items()}
    unit = _unit(basis, scale)
    return _trimmed(witness(basis, Q / np.multiply.outer(unit, unit), residual=residual))


def polynomial(values: Mapping[tuple[int, ...], Fraction], ring: Ring) -> Polynomial:
    """The kernel's polynomial with these coefficients."""
    return ring.dot(list(values.values()), list(map(ring.monomial, values)))


def half_widths(S: FloatArray, radius: FloatArray, widens: float) -> FloatArray:
    """(N + 1, n): the largest |x̄_i| where |S_k x̄| ≤ radius_k + widens, rounded up."""
    widths = []
    for shape, size in zip(S, radius.tolist(), strict=True):
        square = (Fraction(size) + Fraction(widens)) ** 2
        rows = [square * reach for reach in _reaches(exact(shape))]
        widths.append([above(text.root_above(row)) for row in rows])
    return np.array(widths)


def above(value: Fraction) -> float:
    """A float at least `value`."""
    nearest = float(value)
    return nearest if Fraction(nearest) >= value else float(np.nextafter(nearest, np.inf))


def _reaches(S: list[list[Fraction]]) -> list[Fraction]:
    """|S⁻ᵀ e_i|² for each i, S upper triangular."""
    n, result = len(S), []
    for i in range(n):
        y: list[Fraction] = []
        for row in range(n):
            known = sum((S[j][row] * y[j] for j in range(row)), Fraction(0))
            y.append((int(row == i) - known) / S[row][row])
        result.append(sum((entry**2 for entry in y), Fraction(0)))
    return result


def _unit(basis: ArrayLike, scale: Sequence[float]) -> FloatArray:
    """The monomials at `scale`."""
    return np.asarray(np.prod(np.asarray(scale) ** np.asarray(basis), axis=1), dtype=np.float64)


def _trimmed(stated: Json) -> Json:
    """Without the basis, which a proof states once."""
    if not stated["squares"]["factors"]:
        raise Infeasible("a multiplier without squares")
    return {"columns": stated["columns"], "squares": stated["squares"]}
