"""Search for the proof that an implicit model is well posed and incrementally stable."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nlsid_core.arrays import Json, objects_at
from nlsid_core.errors import CertificateRejected, DataError, Infeasible, SolverError
from nlsid_core.identification.proofs.conditions import Inequality, constraint
from nlsid_core.identification.proofs.sets import (
    SETS,
    STORAGE,
    Names,
    Storage,
    inequalities,
)
from nlsid_core.models import ImplicitModel
from nlsid_core.polynomial.algebra import as_polynomial
from nlsid_core.polynomial.documents import write_polynomial
from nlsid_core.proofs import binding, decide, proof_document
from nlsid_core.sos import Program, Solution, forms_of, solve, symmetric_template
from nlsid_core.sos.proofs import inequality, quadratic_form

KIND = "stable_set"
FAILURES = (Infeasible, SolverError, CertificateRejected, DataError)  # of a search for a proof


@dataclass(frozen=True, eq=False)
class ImplicitProof:
    """What a proof file of kind `stable_set` holds, decided by the kernel for the model.

    set: of thesis Chapter 2, with its δ. box: (low, high) of every state and input; empty for
    everywhere. inequalities: a witness for each. storage: its member.
    """

    set: str
    delta: float
    box: tuple[tuple[float, float], ...]
    inequalities: Json
    storage: Json

    @property
    def rate(self) -> float:
        """1: the difference of two solutions is square summable, and no rate is claimed."""
        return 1.0

    def document(self, model: ImplicitModel, file: str) -> Json:
        """The proof file's content for the model stored in `file` beside it."""
        about = {"model": binding(file, model.document())}
        claim: Json = {"kind": KIND, "about": about, "set": self.set, "delta": self.delta}
        if self.box:
            claim["box"] = [list(ends) for ends in self.box]
        return proof_document(claim, {"inequalities": self.inequalities} | self.storage)


def prove_implicit(
    model: ImplicitModel,
    *,
    delta: float,
    set: str = "2.13",
    ends: Sequence[tuple[float, float]] = (),
    scale: Mapping[str, float] | None = None,
) -> ImplicitProof | None:
    """A proof at the stated δ that the model is in the set, or None if the search finds none.

    set: of thesis Chapter 2; "2.11" for any model, "2.13" for separable ones, "2.19" for linear
    ones. ends: (low, high) of every state and input for a claim on that box; none is global.
    scale: the sizes of the variables of `Names`, for the search (default 1).
    Raises DataError for an unknown set or a negative δ.
    """
    if set not in SETS or not delta > 0.0:
        raise DataError(f"set '{set}' (known: {', '.join(SETS)}), delta {delta:g} (positive)")
    names, box = Names.of(model), [list(pair) for pair in ends]
    unknown = storage_template(set, names)
    try:
        wanted = inequalities(model, set, unknown, delta=delta, ends=box)
        of_storage = {key: part for key, part in wanted.items() if key in ("stable", "storage")}
        storage = _valued(unknown, _solved(of_storage, names, scale)) if set in STORAGE else None
        parts = inequalities(model, set, storage, delta=delta, ends=box)
        witnesses = _witnesses(parts, names, scale)
        written = {STORAGE[set]: _written(storage, set, names)} if set in STORAGE else {}
        proof = ImplicitProof(set, delta, tuple((a, b) for a, b in ends), witnesses, written)
        decide(proof.document(model, "model.json"), {"model.json": model.document()})
    except FAILURES:
        return None
    return proof


def _witnesses(
    parts: dict[str, Inequality], names: Names, scale: Mapping[str, float] | None
) -> Json:
    """The kernel's witness for each inequality."""
    witnesses: Json = {}
    for key, part in parts.items():
        found = _solved({key: part}, names, scale)[key]
        used = part.variables(names.all)
        wide = np.array([[e.over(used) for e in row] for row in part.matrix], dtype=object)
        c = wide[0, 0].exact() if len(wide) == 1 else quadratic_form(wide)
        domain = [g.over(c.names) for g in part.domain]
        witness = inequality(c, found.gram, domain=domain, multipliers=found.multipliers)
        witnesses[key] = _lifted(witness, part, c.names, names)
    return witnesses


def _lifted(witness: Json, part: Inequality, used: Sequence[str], names: Names) -> Json:
    """In all the claim's variables, v, x, w, their gaps, y; times y[0] for a matrix of order 1."""
    everything = (*names.all, *forms_of(2 * len(names.x) + 1))
    places = [everything.index(name) for name in used]
    first = everything.index(forms_of(1)[0])

    def rows(basis: list[list[int]]) -> list[list[int]]:
        lifted = []
        for row in basis:
            wide = [0] * len(everything)
            for place, power in zip(places, row, strict=True):
                wide[place] = power
            wide[first] += int(len(part.matrix) == 1)
            lifted.append(wide)
        return lifted

    found = witness | {"basis": rows(witness["basis"])}
    if "multipliers" in found:
        found["multipliers"] = [
            multiplier | {"of": part.kept[multiplier["of"]], "basis": rows(multiplier["basis"])}
            for multiplier in found["multipliers"]
        ]
    return found


def storage_template(kind: str, names: Names) -> Storage:
    """The storage of a set with an unknown at every coefficient; None for linear models."""
    return symmetric_template("M", len(names.x)) if kind in STORAGE else None


def _valued(storage: Storage, solution: Solution) -> Storage:
    """With the unknowns at their values, exactly these floats."""
    assert storage is not None
    return objects_at(storage.shape, lambda at: solution.value(as_polynomial(storage[at])).exact())


def _solved(
    parts: dict[str, Inequality], names: Names, scale: Mapping[str, float] | None
) -> Solution:
    """Gram matrices (and unknowns) for inequalities in the variables that occur, in order."""
    constraints = tuple(constraint(part, name=key) for key, part in parts.items())
    largest = max(len(part.matrix) for part in parts.values())
    forms = forms_of(largest) if largest > 1 else ()
    everything = {name for part in parts.values() for name in part.variables(names.all)}
    used = (*(name for name in names.all if name in everything), *forms)
    kept = {name: size for name, size in (scale or {}).items() if name in used}
    return solve(Program(used, constraints, scale=kept))


def _written(storage: Storage, kind: str, names: Names) -> list[list[Any]]:
    assert storage is not None
    if STORAGE[kind] == "P":
        return [[float(entry) for entry in row] for row in storage]
    return [[write_polynomial(entry.over(names.x)) for entry in row] for row in storage]
