"""The sets of stable implicit models of thesis Chapter 2, as inequalities of `conditions`.

For a model 0 = h(v, x, w), x⁺ = [v; ã(x, w)] and a set:
    2.19   E = E' ≻ 0 of a linear model               V = |x - x̂|²_E
    2.11   M ⪰ 0                                      V = |x - x̂|²_M
    2.13   P ≻ 0                                      V = |e(x) - e(x̂)|²_{P⁻¹}
In each, V falls by δ|x - x̂|² or more a sample. What the kernel decides is stated by its claim
`stable_set`; here the same inequalities may hold a storage with unknowns.
Source: thesis Lemmas 2.11 and 2.13, (2.19), Theorem 2.5.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nlsid_core.arrays import objects
from nlsid_core.errors import DataError
from nlsid_core.identification.proofs import conditions
from nlsid_core.identification.proofs.conditions import GAP, Domain, Inequality
from nlsid_core.models.implicit import ImplicitModel
from nlsid_core.models.polynomials import Polynomials
from nlsid_core.polynomial import Polynomial

SETS = ("2.11", "2.13", "2.19")
STORAGE = {"2.11": "M", "2.13": "P"}
Ends = list[list[float]]
Storage = NDArray[np.object_] | None


@dataclass(frozen=True)
class Names:
    """v0 …, x0 …, w0 …, whatever the model calls its states and inputs."""

    v: tuple[str, ...]
    x: tuple[str, ...]
    w: tuple[str, ...]

    @classmethod
    def of(cls, model: ImplicitModel) -> "Names":
        """The names for one model."""
        sizes = (model.unknowns, len(model), len(model.inputs))
        return cls(*(tuple(f"{c}{i}" for i in range(k)) for c, k in zip("vxw", sizes, strict=True)))

    @property
    def all(self) -> tuple[str, ...]:
        """With the gaps of v and x."""
        return (*self.v, *self.x, *self.w, *self.gaps(self.v), *self.gaps(self.x))

    @staticmethod
    def gaps(names: tuple[str, ...]) -> tuple[str, ...]:
        """The differences between two solutions."""
        return tuple(name + GAP for name in names)


def inequalities(
    model: ImplicitModel, kind: str, storage: Storage, *, delta: float, ends: Ends
) -> dict[str, Inequality]:
    """What has to hold, by name; exact, or linear in a storage that holds unknowns.

    Raises DataError if the model is not of the set's form.
    """
    names = Names.of(model)
    h = exact_polynomials(model.h, (*names.v, *names.x, *names.w))
    known = _domain((*names.x, *names.w), ends)
    found = {"monotone": conditions.monotone(h, names.v, model.monotonicity, domain=known)}
    if kind == "2.11":
        assert storage is not None
        shift = exact_polynomials(model.shift, (*names.x, *names.w))
        inside = known + _domain(names.v, ends[: len(names.v)])
        part = conditions.implicit_derivatives(h, shift, storage, (names.v, names.x), delta=delta)
        found["stable"] = replace(part, domain=inside)
        found["storage"] = Inequality(storage)
    else:
        e, f = _separated(model, names)
        E, F = conditions.slopes(e, names.x), conditions.slopes(f, names.x)
        if kind == "2.19":
            _refuse_curved(E, F, ends)
            found["stable"] = conditions.linear(E, F, delta)
        else:
            assert storage is not None
            found["stable"] = conditions.derivatives(E, F, storage, delta=delta, domain=known)
    return {key: part.relevant() for key, part in found.items()}


def exact_polynomials(parts: Polynomials, names: tuple[str, ...]) -> NDArray[np.object_]:
    """The stored polynomials with exact coefficients."""
    columns = parts.coefficients.T
    return objects([Polynomial(parts.exponents, column, names).exact() for column in columns])


def _separated(
    model: ImplicitModel, names: Names
) -> tuple[NDArray[np.object_], NDArray[np.object_]]:
    found = model.separated()
    if found is None:
        raise DataError("the model is not e(x+) = f(x, w); this set is for such models")
    e, f = found
    return exact_polynomials(e, names.x), exact_polynomials(f, (*names.x, *names.w))


def _refuse_curved(E: NDArray[np.object_], F: NDArray[np.object_], ends: Ends) -> None:
    if ends:
        raise DataError("a linear model is stable everywhere: the claim has no box")
    if any(entry.degree for row in (*E, *F) for entry in row):
        raise DataError("the model is not linear in its states")
    if any(E[i, j] != E[j, i] for i in range(len(E)) for j in range(i)):
        raise DataError("E is not symmetric; multiply the model's equation by E' first")


def _domain(names: tuple[str, ...], ends: Ends) -> Domain:
    for name, (low, high) in zip(names, ends, strict=bool(ends)):
        if not low < high:
            raise DataError(f"the box of {name} is empty: {low:g} to {high:g}")
    return tuple(g.exact() for g in conditions.box(names, ends)) if ends else ()
