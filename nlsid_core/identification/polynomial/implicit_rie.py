"""Robust identification error of implicit models, with a stable set of thesis Chapter 2.

In signals of unit spread, with ε = e(ỹ(t)) - f(x̃, w̃) the equation error of a sample, the search is
    minimise (1/N) Σ |ε|²_{S⁻¹}   over e, f, the set's storage and S ≻ 0,
the set's inequality keeping |x - x̂|²_Q in place of δ|x - x̂|², and S:
    2.11        … - |x - x̂|²_Q ≥ |v - v̂|²_S
    2.13, 2.19  P - S (E - S) in place of the block P (E)
Each term bounds the robust identification error of its sample, (2.28):
    2.11: -|ν|²_S - 2ν'ε ≤ |ε|²_{S⁻¹};  else: |a + ε|²_{P⁻¹} ≤ |a|²_{(P-S)⁻¹} + |ε|²_{S⁻¹}.
With linear models it is equal to it (Claim 2.18: a weighted equation error). S is one for all
samples, so what the data say is the triangular factor of their monomials, however many there are.
Terms of f in the inputs alone are in no inequality and cost a search nothing: for any e, S and
other terms of f, least squares gives the best.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlsid_core.arrays import FloatArray
from nlsid_core.errors import DataError, Infeasible
from nlsid_core.identification.polynomial.implicit_rows import (
    FARTHEST,
    LARGEST_BLOCK,
    SLOW,
    ImplicitRows,
)
from nlsid_core.identification.polynomial.monotone_rie import least_monotone
from nlsid_core.identification.proofs import conditions
from nlsid_core.identification.proofs.conditions import Inequality, constraint
from nlsid_core.identification.proofs.sets import Names
from nlsid_core.identification.proofs.stability import StabilityProof, prove_stability
from nlsid_core.identification.proofs.stable_sets import (
    ImplicitProof,
    prove_implicit,
    storage_template,
)
from nlsid_core.identification.regressors import FEWER
from nlsid_core.models import ImplicitModel, MonotoneEquation
from nlsid_core.polynomial import Polynomial, variables
from nlsid_core.polynomial.maps import combinations
from nlsid_core.sos import (
    Builder,
    NonNegative,
    NormBound,
    Program,
    Solution,
    forms_of,
    matrix_sum_of_squares,
    solve,
    symmetric_template,
    template,
)
from nlsid_core.sos.program import Constraint

ROOM = 0.01  # of the least bound, given back to step from the boundary into the interior
NOISE_FREE = 1e-8  # the same where the bound is zero: 0.01 % of the spread
HALF = 0.5  # of what the search keeps: what is left for the exact proof
SMALL_DELTA = 1e-3  # δ that is tried for a model no set was kept for, e being 1-monotone

Objects = NDArray[np.object_]
Model = ImplicitModel | MonotoneEquation
Proof = ImplicitProof | StabilityProof


@dataclass(frozen=True, eq=False)
class ImplicitFit:
    """The model, its exact proof, and the bound: the mean of |x - x̂|²_Q, in squared spreads.

    model, proof: a `MonotoneEquation` and a `StabilityProof` of set 3.8, else an `ImplicitModel`
    and an `ImplicitProof`. e, f: the coefficients (m, n_v) for scaled signals.
    """

    model: Any
    proof: Any
    bound: float
    e: FloatArray
    f: FloatArray


def minimise_implicit_rie(rows: ImplicitRows, *, slowest: float = 1.0) -> ImplicitFit:
    """The stable model with the least bound on its simulation error, and its proof.

    slowest: the storage shrinks by its square or more, a sample.

    Raises Infeasible if there is none in the set or it has no exact proof, SolverError as the
    solver does.
    """
    if rows.model_class.form == "3.8":
        best, bound = least_monotone(rows, slowest)
        model: Model = rows.equation(*best)
    else:
        e, f = unknowns(rows)
        S = symmetric_template("S", len(e))
        parts = set_constraints(rows, e, f, S, slowest)
        found, bound = _interior([*parts, *_weighted(rows, S)], rows.names)
        best = coefficients(found, rows)
        model = kept_in_set(rows, *best, float(np.linalg.eigvalsh(_values(found, S))[0]))
    proof = prove_kept(model, rows)
    if proof is None:
        raise Infeasible(
            f"no exact proof in set {rows.set} for the minimiser; try lower degrees, "
            "a box, or more data"
        )
    return ImplicitFit(model, proof, bound, *best)


def refuse_large_program(rows: ImplicitRows) -> None:
    """DataError if a semidefinite block of the set's program is larger than `LARGEST_BLOCK`."""
    e, f = unknowns(rows)
    S = symmetric_template("S", len(e))
    program = Program(indeterminates_of(rows.names), tuple(set_constraints(rows, e, f, S, 1.0)))
    size = max(cone.size for cone in Builder(program).cones if cone.kind == "psd")
    if size > LARGEST_BLOCK:
        raise DataError(
            f"a semidefinite block of order {size} in set {rows.set}, more than "
            f"{LARGEST_BLOCK}: {SLOW}; {FEWER}"
        )


def kept_in_set(rows: ImplicitRows, e: FloatArray, f: FloatArray, monotone: float) -> Model:
    """The model of scaled coefficients for which the set's inequality kept Q.

    monotone: what was kept of ∂e/∂v + (∂e/∂v)' in scaled signals.
    """
    return rows.model(e, f, HALF * monotone / 2.0)


def prove_kept(model: Model, rows: ImplicitRows) -> Proof | None:
    """The proof of a model that was kept in the set."""
    return _proved(model, rows, HALF * (FARTHEST if rows.model_class.lags > 1 else 1.0))


def implicit_equation_error(rows: ImplicitRows) -> Model:
    """Least squares on the equation error with a 1-monotone e: well posed, perhaps unstable."""
    return rows.model(*least_squares_coefficients(rows), HALF / 2.0)


def least_squares_coefficients(rows: ImplicitRows) -> tuple[FloatArray, FloatArray]:
    """Scaled e (m_e, n_v) and f (m_f, n_v) of `implicit_equation_error`."""
    e, _ = unknowns(rows)
    one = np.eye(len(e), dtype=np.int64).astype(object)
    entries, bound = _residual(rows), variables("bound")[0]
    parts = [_monotone(e, one, rows.names), NormBound(tuple(entries.ravel()), bound)]
    return coefficients(_interior(parts, rows.names)[0], rows)


def prove_in_set(model: Model, rows: ImplicitRows) -> Proof | None:
    """A proof that a model of these rows is in their class's set, if the search finds one."""
    return _proved(model, rows, SMALL_DELTA)


def _proved(model: Model, rows: ImplicitRows, delta: float) -> Proof | None:
    if isinstance(model, MonotoneEquation):
        return prove_stability(model)
    mean, spread = rows.units
    n_v = len(rows.y_scale[0])
    sizes = np.abs(mean) + spread
    known = (*rows.names.x, *rows.names.w)
    scale = dict(zip((*rows.names.v, *known), (*sizes[:n_v], *sizes), strict=True))
    return prove_implicit(
        model,
        delta=delta,
        set=rows.set,
        ends=rows.ends,
        scale=scale,
    )


def unknowns(rows: ImplicitRows) -> tuple[Objects, Objects]:
    """e in v and f in (x, w) without its `driven` terms, a decision at every coefficient."""
    names = rows.names
    known = (*names.x, *names.w)
    e, f = (np.empty(len(rows.y_scale[0]), dtype=object) for _ in range(2))
    symmetric = symmetric_template("E", len(e)) if rows.set == "2.19" else None
    for i in range(len(e)):
        if symmetric is None:
            e[i] = template(f"e{i}", rows.left, names.v)
        else:
            e[i] = sum(entry * v for entry, v in zip(symmetric[i], variables(names.v), strict=True))
        f[i] = template(f"f{i}", rows.right[~rows.driven], known)
    return e, f


def set_constraints(
    rows: ImplicitRows, e: Objects, f: Objects, S: Objects, rate: float
) -> list[Constraint]:
    """The set's inequalities with Q and S kept, and e monotone wherever v is."""
    names, n_v = rows.names, len(e)
    domain, storage = _domain(rows, (*names.x, *names.w)), storage_template(rows.set, names)
    if rows.set == "2.11":
        assert storage is not None
        shift = np.array(variables(names.x)[: len(names.x) - n_v], dtype=object)
        inside = domain + _domain(rows, names.v)
        part = conditions.implicit_derivatives(
            e - f, shift, storage, (names.v, names.x), delta=0, rate=rate
        )
        part = replace(part, domain=inside)
        of_set = [_minus(part, _diagonal(S, rows.weight)), Inequality(storage)]
    else:
        E = conditions.slopes(np.array([_renamed(p, names) for p in e], dtype=object), names.x)
        F = conditions.slopes(f, names.x)
        if storage is None:
            part = conditions.linear(E, F, 0, rate=rate)
        else:
            part = conditions.derivatives(E, F, storage, delta=0, rate=rate, domain=domain)
        of_set = [_minus(part, _diagonal(rows.weight, S))]
    found: list[Constraint] = [
        constraint(part.relevant(), name=f"set {rows.set}, {k}") for k, part in enumerate(of_set)
    ]
    return [*found, _monotone(e, S, names)]


def _monotone(e: Objects, S: Objects, names: Names) -> Constraint:
    """∂e/∂v + (∂e/∂v)' - S ⪰ 0, for every v."""
    part = conditions.monotone(e, names.v, 0)
    return constraint(_minus(part, S), name="monotone")


def _weighted(rows: ImplicitRows, S: Objects) -> list[Constraint]:
    """(1/N) Σ |ε|²_{S⁻¹} ≤ bound: [t_j, r_j'; r_j, S] ⪰ 0 and Σ t_j ≤ bound, r = R [e; -f]."""
    residual, (bound,) = _residual(rows), variables("bound")
    if len(S) == 1:
        s = S[0, 0]
        return [NormBound((*(2.0 * residual[:, 0]), bound - s), bound + s)]
    t = variables([f"t[{j}]" for j in range(len(residual))])
    blocks: list[Constraint] = [NonNegative(bound - sum(t))]
    for j, row in enumerate(residual):
        matrix = np.empty((len(S) + 1,) * 2, dtype=object)
        matrix[0, 0], matrix[1:, 1:] = t[j], S
        matrix[0, 1:] = matrix[1:, 0] = row
        blocks.append(matrix_sum_of_squares(matrix))
    return blocks


def _residual(rows: ImplicitRows) -> Objects:
    """(p, n_v): the equation errors, affine in the decisions; least over `driven` terms of f."""
    columns, n_v, R = [], len(rows.y_scale[0]), rows.reduced[0]
    for i in range(n_v):
        right = [-c for c in right_coefficients(rows, i)]
        columns.append(combinations(R, [*left_coefficients(rows, i, n_v), *right]))
    return np.array(columns, dtype=object).T


def left_coefficients(rows: ImplicitRows, i: int, n_v: int) -> list[Polynomial]:
    """The decisions in e of equation i, in the order of the rows' monomials."""
    if rows.set != "2.19":
        return list(variables([f"e{i}[{k}]" for k in range(len(rows.left))]))
    E = symmetric_template("E", n_v)
    return [E[i, int(np.argmax(unit))] for unit in rows.left]


def right_coefficients(rows: ImplicitRows, i: int) -> list[Polynomial]:
    """The decisions in f of equation i, in the order of those of the rows' monomials that hold a
    state.
    """
    return list(variables([f"f{i}[{k}]" for k in range(int((~rows.driven).sum()))]))


def _interior(constraints: list[Constraint], names: Names) -> tuple[Solution, float]:
    """A point well inside the constraints whose bound is near the least, and its bound."""
    (bound,), indeterminates = variables("bound"), indeterminates_of(names)
    best = solve(Program(indeterminates, tuple(constraints), minimise=bound)).objective
    allowed = max(best, 0.0) * (1.0 + ROOM) + NOISE_FREE
    inside = NonNegative(allowed - bound)
    found = solve(Program(indeterminates, (*constraints, inside)))
    return found, float(found.values["bound"])


def indeterminates_of(names: Names) -> tuple[str, ...]:
    """What the inequalities of any of the sets hold for."""
    size = max(len(names.x) + max(len(names.x), len(names.v)), len(names.v)) + 1
    return (*names.all, *forms_of(size))


def coefficients(found: Solution, rows: ImplicitRows) -> tuple[FloatArray, FloatArray]:
    """e (m_e, n_v) and f (m_f, n_v), the `driven` terms by least squares for the others."""
    n_v = len(rows.y_scale[0])
    e, of_x = (
        _values(found, part).T
        for part in (
            [left_coefficients(rows, i, n_v) for i in range(n_v)],
            [right_coefficients(rows, i) for i in range(n_v)],
        )
    )
    f = np.zeros((len(rows.right), n_v))
    f[~rows.driven] = of_x
    f[rows.driven] = -rows.reduced[1] @ np.concatenate([e, -of_x])
    return e, f


def _values(found: Solution, matrix: Objects | Sequence[Sequence[Polynomial]]) -> FloatArray:
    return np.array([[float(found.value(entry)) for entry in row] for row in matrix])


def _domain(rows: ImplicitRows, names: tuple[str, ...]) -> conditions.Domain:
    """The box in scaled variables."""
    if not rows.ends:
        return ()
    mean, spread = rows.units
    known = (*rows.names.x, *rows.names.w)
    at = {name: j for j, name in enumerate(known)} | {
        name: j for j, name in enumerate(rows.names.v)
    }
    ends = [
        tuple(((np.array(rows.ends[at[name]]) - mean[at[name]]) / spread[at[name]]).tolist())
        for name in names
    ]
    return conditions.box(names, ends)


def _renamed(p: Polynomial, names: Names) -> Polynomial:
    """The same polynomial of the present state."""
    new = dict(zip(names.v, names.x, strict=True))
    return Polynomial(p.exponents, p.coefficients, tuple(new.get(name, name) for name in p.names))


def _diagonal(first: FloatArray | Objects, second: FloatArray | Objects) -> Objects:
    a = len(first)
    both = np.zeros((a + len(second),) * 2).astype(object)
    both[:a, :a], both[a:, a:] = first, second
    return both


def _minus(part: Inequality, kept: Objects | list[list[Polynomial]]) -> Inequality:
    matrix = part.matrix - np.array(kept, dtype=object)
    return replace(part, matrix=conditions.filled(matrix))
