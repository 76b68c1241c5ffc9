"""Claim: an implicit model 0 = h(v, x, w), x⁺ = [v; ã(x, w)] is well posed and forgets its start.

The claim names the set of thesis Chapter 2 that the model is in; the proof holds the storage and a
Gram matrix for every inequality of `conditions`, which are rebuilt here from the model's numbers:
    2.19   E = E' ≻ 0 of a linear model               V = |x - x̂|²_E
    2.10   V(x, x̂) ≥ 0 with V(x, x) = 0
    2.11   M(x) ⪰ 0                                   V the energy of a path from x to x̂
    2.12, 2.13   P ≻ 0                                V = |e(x) - e(x̂)|²_{P⁻¹}
In each, V falls by δ|x - x̂|² or more a sample, so Σ|x - x̂|² is finite. On a box of states and
inputs the claim is about solutions that stay in it; the unknown v is a next state, so it stays
there too. In 2.11 a box needs a constant M: then straight lines are the paths, and stay inside.
Well posed: h is monotone in v (2.12), or its centre is a bijection (linear, or itself monotone)
and h follows it (Proposition 2.7).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlsid_core import _json
from nlsid_core._types import Json
from nlsid_core.certificate import conditions, exact
from nlsid_core.certificate import polynomial_data as data
from nlsid_core.certificate.conditions import GAP, Domain, Inequality
from nlsid_core.certificate.identity import Mode
from nlsid_core.certificate.nonnegative import prove_lower_bound, quadratic_form
from nlsid_core.certificate.verdict import Decision
from nlsid_core.errors import CertificateRejected, DocumentError
from nlsid_core.models.implicit import ImplicitModel
from nlsid_core.models.polynomials import Polynomials
from nlsid_core.polynomial import Gram, Polynomial

SETS = ("2.10", "2.11", "2.12", "2.13", "2.19")
STORAGE = {"2.10": "V", "2.11": "M", "2.12": "P", "2.13": "P"}
Ends = list[list[float]]
Storage = Polynomial | NDArray[np.object_] | None


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


def decide(claim: Json, proof: Json, about: Mapping[str, Json], mode: Mode) -> Decision:
    """Decide `{set, delta, box}` for the bound model with the storage and Gram matrices."""
    data.only(claim, {"kind", "about", "set", "delta", "box"}, source="claim")
    model, ends = _bound(claim, about)
    names = Names.of(model)
    kind = _json.member(claim, "set", str, source="claim")
    if kind not in SETS:
        raise CertificateRejected(f"the set '{kind}' is unknown; known: {', '.join(SETS)}")
    delta = _json.number(claim, "delta", source="claim")
    if delta <= 0.0:
        raise CertificateRejected(f"delta is {delta:g}; stability needs a positive one")
    storage = _read_storage(kind, proof, names)
    parts = inequalities(model, kind, storage, delta=delta, ends=ends)
    margin = _decided(model, parts, proof, {STORAGE[kind]} if kind in STORAGE else set(), mode)
    where = "while both stay in the stated box of states and inputs" if ends else "for every input"
    return Decision(
        statement=(
            f"incremental stability of an implicit model with {len(model)} states ({kind}): the "
            f"sum of squared differences of two solutions with the same input is finite, {where},"
        ),
        margin=margin,
    )


def decide_well_posed(claim: Json, proof: Json, about: Mapping[str, Json], mode: Mode) -> Decision:
    """Decide for the bound model that every state and input has one next state, on `{box}`."""
    data.only(claim, {"kind", "about", "box"}, source="claim")
    model, ends = _bound(claim, about)
    margin = _decided(model, well_posed(model, ends=ends), proof, set(), mode)
    where = "for states and inputs in the stated box" if ends else "for every state and input"
    return Decision(
        statement=(
            f"an implicit model with {len(model)} states has exactly one next state, {where},"
        ),
        margin=margin,
    )


def well_posed(model: ImplicitModel, *, ends: Ends) -> dict[str, Inequality]:
    """What makes the next state unique, by name, exact."""
    names = Names.of(model)
    h = exact_polynomials(model.h, (*names.v, *names.x, *names.w))
    found = _well_posed(model, h, names, _domain((*names.x, *names.w), ends))
    return {key: part.relevant() for key, part in found.items()}


def inequalities(
    model: ImplicitModel, kind: str, storage: Storage, *, delta: float, ends: Ends
) -> dict[str, Inequality]:
    """What has to hold, by name; exact, or linear in a storage that holds unknowns.

    Raises CertificateRejected if the model is not of the set's form or the storage not a storage.
    """
    found = _inequalities(model, kind, storage, delta, ends)
    return {key: part.relevant() for key, part in found.items()}


def _inequalities(
    model: ImplicitModel, kind: str, storage: Storage, delta: float, ends: Ends
) -> dict[str, Inequality]:
    names = Names.of(model)
    h = exact_polynomials(model.h, (*names.v, *names.x, *names.w))
    known = _domain((*names.x, *names.w), ends)
    result = _well_posed(model, h, names, known)
    if kind in ("2.10", "2.11"):
        shift = exact_polynomials(model.shift, (*names.x, *names.w))
        domain = known + _domain(names.v, ends[: len(names.v)])
        if kind == "2.10":
            assert isinstance(storage, Polynomial)
            _refuse_offset(storage, names)
            result["stable"] = conditions.implicit_increments(
                h, shift, storage, names.v, names.x, delta=delta, domain=domain
            )
            states = _domain(names.x, ends[: len(names.x)])
            result["storage"] = conditions.storage(storage, names.x, domain=states)
        else:
            assert isinstance(storage, np.ndarray)
            _refuse_curved(storage, names, ends)
            result["stable"] = conditions.implicit_derivatives(
                h, shift, storage, names.v, names.x, delta=delta, domain=domain
            )
            result["storage"] = Inequality(storage)
        return result
    e, f = _separated(model, names)
    if kind == "2.19":
        if ends:
            raise CertificateRejected("a linear model is stable everywhere: the claim has no box")
        result["stable"] = conditions.linear(*_linear_parts(e, f, names), delta)
        return result
    assert isinstance(storage, np.ndarray)
    condition = conditions.increments if kind == "2.12" else conditions.derivatives
    result["stable"] = condition(e, f, storage, names.x, delta=delta, domain=known)
    return result


def form(part: Inequality, names: Names) -> Polynomial:
    """The polynomial that has to be nonnegative: y'My, or the only entry of M."""
    used = part.variables(names.all)
    wide = np.array([[entry.over(used) for entry in row] for row in part.matrix], dtype=object)
    return wide[0, 0].exact() if len(wide) == 1 else quadratic_form(wide)


def prove(
    part: Inequality, gram: Gram, multipliers: list[Gram], names: Names, *, mode: Mode = "exact"
) -> float:
    """The margin of one inequality; raises CertificateRejected if its Gram matrices do not hold."""
    p = form(part, names)
    wide = [g.over(p.names).exact() for g in part.domain]
    return prove_lower_bound(p, 0, gram, domain=wide, multipliers=multipliers, mode=mode)


def exact_polynomials(parts: Polynomials, names: tuple[str, ...]) -> NDArray[np.object_]:
    """The stored polynomials with exact coefficients."""
    result = np.empty(parts.coefficients.shape[1], dtype=object)
    for i, column in enumerate(parts.coefficients.T):
        result[i] = Polynomial(parts.exponents, column, names).exact()
    return result


def _bound(claim: Json, about: Mapping[str, Json]) -> tuple[ImplicitModel, Ends]:
    """The model, and the box of the claim (empty: everywhere)."""
    if set(about) != {"model"}:
        raise CertificateRejected("a claim about an implicit model is about one file, the model")
    model = ImplicitModel.from_document(about["model"], source="model")
    if not data.read_list(claim, "box", source="claim"):
        return model, []
    size = len(model) + len(model.inputs)
    return model, _json.array(claim, "box", (size, 2), source="claim").tolist()


def _decided(
    model: ImplicitModel, parts: dict[str, Inequality], proof: Json, others: set[str], mode: Mode
) -> float:
    """The least margin of the inequalities, each by its Gram matrices in the proof."""
    data.only(proof, {"inequalities"} | others, source="proof")
    given, names = _json.member(proof, "inequalities", dict, source="proof"), Names.of(model)
    data.only(given, set(parts), source="proof inequalities")
    margins = []
    for key, part in parts.items():
        gram, multipliers = _read_identity(given, key, form(part, names).names)
        margins.append(prove(part, gram, multipliers, names, mode=mode))
    return float(min(margins))


def _well_posed(
    model: ImplicitModel, h: NDArray[np.object_], names: Names, domain: Domain
) -> dict[str, Inequality]:
    m = model.monotonicity
    if model.centre is None:
        return {"monotone": conditions.monotone(h, names.v, m, domain=domain)}
    centre = exact_polynomials(model.centre, names.v)
    bijective = conditions.regular if model.has_linear_centre else conditions.monotone
    return {
        "centre": bijective(centre, names.v, m),
        "centred": conditions.centred(h, centre, names.v, domain=domain),
    }


def _separated(
    model: ImplicitModel, names: Names
) -> tuple[NDArray[np.object_], NDArray[np.object_]]:
    found = model.separated()
    if found is None:
        raise CertificateRejected("the model is not e(x+) = f(x, w); this set is for such models")
    e, f = found
    return exact_polynomials(e, names.x), exact_polynomials(f, (*names.x, *names.w))


def _linear_parts(
    e: NDArray[np.object_], f: NDArray[np.object_], names: Names
) -> tuple[NDArray[np.object_], NDArray[np.object_]]:
    E, F = (
        np.array([[p.derivative(name) for name in names.x] for p in part], dtype=object)
        for part in (e, f)
    )
    if any(entry.degree for row in (*E, *F) for entry in row):
        raise CertificateRejected("the model is not linear in its states")
    if any(E[i, j] != E[j, i] for i in range(len(E)) for j in range(i)):
        raise CertificateRejected("E is not symmetric; multiply the model's equation by E' first")
    return E, F


def _refuse_offset(V: Polynomial, names: Names) -> None:
    gaps = {name: 0.0 for name in Names.gaps(names.x) if name in V.names}
    if len(V.substitute(gaps)):
        raise CertificateRejected("V(x, x) is not zero")


def _refuse_curved(M: NDArray[np.object_], names: Names, ends: Ends) -> None:
    states = [entry.exponents[:, [n in names.x for n in entry.names]] for entry in M.ravel()]
    if ends and any(used.any() for used in states):
        raise CertificateRejected("on a box M should be constant: curved paths can leave the box")


def _domain(names: tuple[str, ...], ends: Ends) -> Domain:
    for name, (low, high) in zip(names, ends, strict=bool(ends)):
        if not low < high:
            raise CertificateRejected(f"the box of {name} is empty: {low:g} to {high:g}")
    return tuple(g.exact() for g in conditions.box(names, ends)) if ends else ()


def _read_storage(kind: str, proof: Json, names: Names) -> Storage:
    n = len(names.x)
    if kind == "2.19":
        return None
    key = STORAGE[kind]
    if key == "V":
        both = names.x + Names.gaps(names.x)
        return data.read_polynomial(
            _json.member(proof, "V", dict, source="proof"), both, source="V"
        ).exact()
    if key == "P":
        P = _json.array(proof, "P", (n, n), source="proof").tolist()
        if not exact.is_positive_definite(exact.rational(P)):
            raise CertificateRejected("P is not symmetric positive definite")
        return conditions.constants(P)
    rows = _json.member(proof, "M", list, source="proof")
    if len(rows) != n or any(not isinstance(row, list) or len(row) != n for row in rows):
        raise DocumentError(f"proof: M should be {n}x{n} polynomials")
    M = np.empty((n, n), dtype=object)
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            M[i, j] = data.read_polynomial(entry, names.x, source=f"M[{i}][{j}]").exact()
    return M


def _read_identity(given: Json, key: str, names: tuple[str, ...]) -> tuple[Gram, list[Gram]]:
    part = _json.member(given, key, dict, source="proof inequalities")
    data.only(part, {"gram", "multipliers"}, source=key)
    gram = data.read_gram(_json.member(part, "gram", dict, source=key), names, source=key)
    multipliers = data.read_list(part, "multipliers", source=key)
    return gram, [data.read_gram(m, names, source=f"{key} multiplier") for m in multipliers]
