"""Search for the proof that an implicit model is well posed and incrementally stable."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlsid_core import _json
from nlsid_core._types import Json
from nlsid_core.certificate import proof_document
from nlsid_core.certificate.conditions import Inequality
from nlsid_core.certificate.implicit import (
    SETS,
    STORAGE,
    Names,
    Storage,
    inequalities,
    prove,
    well_posed,
)
from nlsid_core.certificate.polynomial_data import write_gram, write_polynomial
from nlsid_core.errors import CertificateRejected, DataError, Infeasible, SolverError, Undecided
from nlsid_core.identification.stable_sets import constraint
from nlsid_core.models import ImplicitModel
from nlsid_core.polynomial import Gram, Polynomial, monomials, variables
from nlsid_core.polynomial.algebra import as_polynomial
from nlsid_core.sos import Program, Solution, forms_of, solve, template
from nlsid_core.sos.program import round_to_power_of_two
from nlsid_core.sos.search import positive_semidefinite

Identity = tuple[Gram, list[Gram]]


@dataclass(frozen=True, eq=False)
class ImplicitProof:
    """The set, δ, the storage, and the Gram matrices of every inequality; decided exactly."""

    set: str
    delta: float
    box: tuple[tuple[float, float], ...]
    storage: Storage
    identities: dict[str, Identity]

    @property
    def rate(self) -> float:
        """1: the difference of two solutions is square summable, and no rate is claimed."""
        return 1.0

    def document(self, model: ImplicitModel, file: str) -> Json:
        """The proof file's content for the model stored in `file` beside it."""
        claim = _claim("implicit_stability", model, file, self.box)
        claim |= {"set": self.set, "delta": self.delta}
        proof = _proof(self.identities)
        if self.set in STORAGE:
            proof[STORAGE[self.set]] = _written(self.storage, self.set, Names.of(model))
        return proof_document(claim, proof)


@dataclass(frozen=True, eq=False)
class WellPosednessProof:
    """The Gram matrices that make the next state unique, for states and inputs in the box."""

    box: tuple[tuple[float, float], ...]
    identities: dict[str, Identity]

    def document(self, model: ImplicitModel, file: str) -> Json:
        """The proof file's content for the model stored in `file` beside it."""
        return proof_document(
            _claim("well_posedness", model, file, self.box), _proof(self.identities)
        )


def prove_well_posed(
    model: ImplicitModel, *, ends: Sequence[tuple[float, float]] = ()
) -> WellPosednessProof | None:
    """A proof that every state and input has one next state: (2.12), or Proposition 2.7.

    ends: as in `prove_implicit`. None if the search finds no proof, or there is none.
    """
    try:
        parts = well_posed(model, ends=[list(pair) for pair in ends])
        identities = _identities(parts, Names.of(model))
    except (Infeasible, SolverError, CertificateRejected, Undecided):
        return None
    return WellPosednessProof(tuple((a, b) for a, b in ends), identities)


def prove_implicit(
    model: ImplicitModel, *, delta: float, set: str = "2.13",
    ends: Sequence[tuple[float, float]] = (), storage_degree: int = 0,
    scale: Mapping[str, float] | None = None,
) -> ImplicitProof | None:  # fmt: skip
    """A proof at the stated δ that the model is in the set, or None if the search finds none.

    set: of thesis Chapter 2; "2.10" and "2.11" for any model, "2.12" and "2.13" for separable ones,
    "2.19" for linear ones. ends: (low, high) of every state and input for a claim on that box; none
    is global. storage_degree: of M in x ("2.11"; "2.10" takes V = Δ'M(x, Δ)Δ). scale: the sizes of
    the variables of `Names`, for the search (default 1).
    Raises DataError for an unknown set or a negative δ.
    """
    if set not in SETS or not delta > 0.0:
        raise DataError(f"set '{set}' (known: {', '.join(SETS)}), delta {delta:g} (positive)")
    names, box = Names.of(model), [list(pair) for pair in ends]
    unknown = storage_template(set, names, 0 if ends and set == "2.11" else storage_degree)
    try:
        wanted = inequalities(model, set, unknown, delta=delta, ends=box)
        of_storage = {key: part for key, part in wanted.items() if key in ("stable", "storage")}
        storage = _valued(unknown, _solved(of_storage, names, scale)) if set in STORAGE else None
        parts = inequalities(model, set, storage, delta=delta, ends=box)
        identities = _identities(parts, names, scale)
    except (Infeasible, SolverError, CertificateRejected, Undecided):
        return None
    return ImplicitProof(set, delta, tuple((a, b) for a, b in ends), storage, identities)


def _identities(
    parts: dict[str, Inequality], names: Names, scale: Mapping[str, float] | None = None
) -> dict[str, Identity]:
    """Gram matrices for each inequality; raises CertificateRejected if the checker refuses one."""
    identities: dict[str, Identity] = {}
    for key, part in parts.items():
        found = _solved({key: part}, names, scale)[key]
        undone = _gap(part, scale) ** 2 if len(part.matrix) == 1 else 1.0
        gram, *others = (replace(g, Q=undone * g.Q) for g in (found.gram, *found.multipliers))
        multipliers = [positive_semidefinite(other) for other in others]
        prove(part, gram, multipliers, names)
        identities[key] = (gram, multipliers)
    return identities


def _claim(kind: str, model: ImplicitModel, file: str, box: Sequence[tuple[float, float]]) -> Json:
    about = {"model": {"file": file, "digest": _json.digest(model.document())}}
    return {"kind": kind, "box": [list(ends) for ends in box], "about": about}


def _proof(identities: dict[str, Identity]) -> Json:
    written = {
        key: {"gram": write_gram(gram), "multipliers": list(map(write_gram, multipliers))}
        for key, (gram, multipliers) in identities.items()
    }
    return {"inequalities": written}


def storage_template(kind: str, names: Names, degree: int) -> Storage:
    """The storage of a set with an unknown at every coefficient; None for linear models."""
    if kind not in STORAGE:
        return None
    n, key = len(names.x), STORAGE[kind]
    inner = names.x if key != "V" else names.x + Names.gaps(names.x)
    basis = monomials(len(inner), range(degree + 1 if key != "P" else 1))
    M = np.empty((n, n), dtype=object)
    for i in range(n):
        for j in range(i, n):
            M[i, j] = M[j, i] = template(f"M[{i},{j}]", basis, inner)
    if key != "V":
        return M
    gap = np.array(variables(Names.gaps(names.x)))
    V: Polynomial = gap @ M @ gap
    return V


def _valued(storage: Storage, solution: Solution) -> Storage:
    """With the unknowns at their values, exactly these floats."""
    if isinstance(storage, Polynomial):
        return solution.value(storage).exact()
    assert storage is not None
    result: NDArray[np.object_] = np.empty(storage.shape, dtype=object)
    for index in np.ndindex(*storage.shape):
        result[index] = solution.value(as_polynomial(storage[index])).exact()
    return result


def _solved(
    parts: dict[str, Inequality], names: Names, scale: Mapping[str, float] | None
) -> Solution:
    """Gram matrices (and unknowns) for inequalities in the variables that occur, in order.

    The first row of a matrix that vanishes with a gap is taken in units of the gap; `_identities`
    undoes it for a single polynomial, the program where the row has an indeterminate.
    """
    constraints, sizes = [], dict(scale or {})
    for key, part in parts.items():
        gap = _gap(part, scale)
        if len(part.matrix) == 1:
            part = replace(part, matrix=part.matrix * Fraction(1.0 / gap**2))
        elif part.vanishing:
            sizes[forms_of(1)[0]] = 1.0 / gap
        constraints.append(constraint(part, name=key))
    largest = max(len(part.matrix) for part in parts.values())
    forms = forms_of(largest) if largest > 1 else ()
    everything = {name for part in parts.values() for name in part.variables(names.all)}
    used = (*(name for name in names.all if name in everything), *forms)
    kept = {name: size for name, size in sizes.items() if name in used}
    return solve(Program(used, tuple(constraints), scale=kept))


def _gap(part: Inequality, scale: Mapping[str, float] | None) -> float:
    """The size of the gaps with which an inequality vanishes, a power of two; 1 if with none."""
    sizes = [(scale or {}).get(name, 1.0) for name in part.vanishing]
    return round_to_power_of_two(max(sizes, default=1.0))


def _written(storage: Storage, kind: str, names: Names) -> Json | list[list[Any]]:
    if isinstance(storage, Polynomial):
        return write_polynomial(storage.over(names.x + Names.gaps(names.x)))
    assert storage is not None
    if STORAGE[kind] == "P":
        return [[float(entry) for entry in row] for row in storage]
    return [[write_polynomial(entry.over(names.x)) for entry in row] for row in storage]
