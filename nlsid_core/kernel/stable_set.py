"""Claim: an implicit model is well posed and, if a set is named, forgets its start.

The model is 0 = h(v, x, w), x⁺ = [v; ã(x, w)]. Well posed means that h has exactly one zero v for
every state x and input w:
    h is strongly monotone in v,   2y'(∂h/∂v y) - 2m|y|² >= 0 with m > 0            (Theorem 2.5)
or it follows a centre e₀ that is a bijection,
    2(E₀y)'(∂h/∂v y) - |E₀y|² >= 0,   E₀ = ∂e₀/∂v                              (Proposition 2.7)
e₀ being linear with |E₀y|² - m²|y|² >= 0, or strongly monotone itself; each for every v and y.

For two solutions x, x̂ = x - x~ with the same input, a storage falls by δ|x~|² or more a sample, so
that Σ|x~|² is finite: one inequality for each set, thesis (2.10)-(2.19), on the box of states and
inputs, if there is one. Then the claim is about solutions that stay in it, the unknown v included,
which is a next state; and in 2.11 M has to be constant: then straight lines join two states, and
stay inside. The inequalities: docs/certificate_stable_set.md.
"""

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

from . import text
from .exact import definite
from .files import Node, Read, Table, Terms, bound_files, itself, limit, one_of, refuse_if
from .implicit_models import ImplicitModel, derivative, read_implicit_model
from .polynomials import FREE_OF_S, Polynomial, Ring, at_width
from .positivity import WITNESS, positive_on

MAX_VARIABLES = 100
SETS = ("2.10", "2.11", "2.12", "2.13", "2.19")
STORAGE = {"2.10": " V", "2.11": " M", "2.12": " P", "2.13": " P", "2.19": "", "": ""}
SENTENCE = "the implicit model with {size} has exactly one next state for {where}{stable}"
STABLE = (
    "; two of its solutions with the same input have differences whose squares have a finite sum "
    "(set {kind}: a storage falls by {delta:down} times the squared difference or more a sample)"
)
STAY = "both solutions stay in this box of states and inputs; that any do is not stated"

Vector = list[Polynomial]
Inequality = tuple[Polynomial, Vector]  # >= 0 where each of the domain is >= 0


def decide(claim: Node, proof: Node, read: Read) -> text.Verdict:
    """Rebuild the inequalities of the set from the model's numbers; each has its own witness."""
    table: Table = {"kind": itself, "about": itself, "set?": one_of(*SETS), "delta?": ()}
    stated = claim.read({**table, "box?": (None, 2)})
    documents, digests = bound_files(stated["about"], read, "model")
    model = read_implicit_model(documents["model"])
    n, m = model.states, model.inputs
    kind, delta, box = stated["set"] or "", stated["delta"], stated["box"] or []
    sized = stated["box"] is None or len(box) == n + m
    claim.require(
        {
            "a set needs a delta, and a delta needs a set": (delta is None) == (not kind),
            "the box should have a range for every state and input": sized,
        }
    )
    claim.require({"delta should be positive": not kind or delta > 0}, "not_below")
    full = all(low < high for low, high in box)
    claim.require({"no interval of the box should be empty": full}, "not_valid")
    given = proof.members("inequalities" + STORAGE[kind])
    storage = _read_storage(kind, given, n, local=bool(box))
    count = 2 * model.unknowns + 2 * n + m + 2 * n + 1  # v, x, w, v~, x~, and y
    limit(count, MAX_VARIABLES, "variables")

    def prove(ring: Ring, _: None) -> None:
        wanted = _inequalities(model, kind, storage, delta, box, ring)
        witnesses = given["inequalities"].members(" ".join(wanted))
        for name, (c, domain) in wanted.items():
            witness = witnesses[name].members(WITNESS, "multipliers")
            positive_on(c, domain, witness, ring, f"inequality {name}")

    at_width(count, [None], prove, FREE_OF_S)
    stable = text.say(STABLE, kind=kind, delta=delta) if kind else ""
    size = f"{n} state{'s' if n > 1 else ''}"
    said = text.say(SENTENCE, size=size, where=_where(box, n), stable=stable)
    stay = (STAY,) if box and kind else ()
    return text.Verdict(said, delta if kind else model.monotonicity, stay, digests)


def _where(box: list[Any], n: int) -> str:
    if not box:
        return "every state and input"
    shown = [text.PRINTED["exact_range"](ends) for ends in box]
    inputs = f" and every input in {' x '.join(shown[n:])}" if shown[n:] else ""
    return f"every state in {' x '.join(shown[:n])}{inputs}"


def _along(ps: Sequence[Terms], at: Vector, direction: Vector, ring: Ring) -> Vector:
    """Σ_j ∂p/∂(variable j) direction[j] of each p, with `at` in the variables' place."""
    put, size = ring.substitution(at), len(direction)
    return [ring.dot([put(derivative(p, j)) for j in range(size)], direction) for p in ps]


def _inequalities(
    model: ImplicitModel, kind: str, storage: Any, delta: Fraction, box: list[Any], ring: Ring
) -> dict[str, Inequality]:
    """What has to be >= 0, and where, by the name of its witness."""
    n, k, dot, at, form = model.states, model.unknowns, ring.dot, ring.substituted, ring.form
    rest = iter(ring.variables)
    v, x, w, gap_v, gap_x = (
        [next(rest) for _ in range(size)] for size in (k, n, model.inputs, k, n)
    )
    y, known, here = list(rest), [*x, *w], [*v, *x, *w]
    hat_v, hat_x = _minus(v, gap_v), _minus(x, gap_x)
    at_known, at_hat, at_next = _inside(known, box), _inside(hat_x, box[:n]), _inside(v, box[:k])
    found: dict[str, Inequality] = {
        name: (c, [] if name == "centre" else at_known)
        for name, c in _well_posed(model, here, y[:k], ring).items()
    }
    shift = at(model.shift, known)
    if kind == "2.10":
        moved = _minus(at(model.h, here), at(model.h, [*hat_v, *hat_x, *w]))
        after = [*v, *shift, *gap_v, *_minus(shift, at(model.shift, [*hat_x, *w]))]
        (V,), (V_next,) = at([storage], [*x, *gap_x]), at([storage], after)
        c = 2 * dot(gap_v, moved) + V - V_next - delta * dot(gap_x, gap_x)
        found["stable"] = c, [*at_known, *at_next, *at_hat, *_inside(hat_v, box[:k])]
        found["storage"] = V, [*at_known[:n], *at_hat]
    elif kind == "2.11":
        nu, gap = y[:k], y[k : k + n]
        M, M_next = ([at(row, point) for row in storage] for point in (x, [*v, *shift]))
        moved = _along(model.h, here, [*nu, *gap], ring)
        gap_next = [*nu, *_along(model.shift, known, gap, ring)]
        c = 2 * dot(nu, moved) + form(M, gap) - delta * dot(gap, gap) - form(M_next, gap_next)
        found["stable"] = c, [*at_known, *at_next]
        found["storage"] = form(M, y[:n]), []
    elif kind == "2.12":
        e, f = model.separated()
        y0, y = y[0], y[1 : 1 + n]
        rise, moved = _minus(at(e, x), at(e, hat_x)), _minus(at(f, known), at(f, [*hat_x, *w]))
        corner = 2 * dot(gap_x, rise) - form(storage, gap_x) - delta * dot(gap_x, gap_x)
        c = corner * (y0 * y0) + 2 * (y0 * dot(y, moved)) + form(storage, y)
        found["stable"] = c, [*at_known, *at_hat]
    elif kind:
        e, f = model.separated()
        gap, y = y[:n], y[n : 2 * n]
        slope, turned = dot(gap, _along(e, x, gap, ring)), dot(y, _along(f, known, gap, ring))
        if kind == "2.13":
            c = 2 * slope - form(storage, gap) + form(storage, y)
        else:
            _check_linear(e, f, box)
            c = slope + dot(y, _along(e, x, y, ring))
        found["stable"] = c + 2 * turned - delta * dot(gap, gap), at_known
    return found


def _well_posed(model: ImplicitModel, here: Vector, y: Vector, ring: Ring) -> dict[str, Polynomial]:
    """`monotone`, or `centre` (everywhere) and `centred`."""
    m, dot, v = model.monotonicity, ring.dot, here[: model.unknowns]
    slope = _along(model.h, here, y, ring)
    if not model.centre:
        return {"monotone": 2 * (dot(y, slope) - m * dot(y, y))}
    inner = _along(model.centre, v, y, ring)
    square = dot(inner, inner)
    if all(sum(e) <= 1 for p in model.centre for e, _ in p):
        regular = square - m**2 * dot(y, y)
    else:
        regular = 2 * (dot(y, inner) - m * dot(y, y))
    return {"centre": regular, "centred": 2 * dot(inner, slope) - square}


def _check_linear(e: list[Terms], f: list[Terms], box: list[Any]) -> None:
    n = len(e)
    refuse_if(box, "a linear model is stable everywhere: the claim has no box")
    refuse_if(
        any(sum(a[:n]) > 1 or (any(a[:n]) and any(a[n:])) for p in (*e, *f) for a, _ in p),
        "the model is not linear in its states",
    )
    refuse_if(
        any(derivative(e[i], j) != derivative(e[j], i) for i in range(n) for j in range(i)),
        "E is not symmetric; multiply the model's equation by E' first",
    )


def _minus(a: Vector, b: Vector) -> Vector:
    return [p - q for p, q in zip(a, b, strict=True)]


def _inside(values: Vector, ends: list[Any]) -> Vector:
    """(z - low)(high - z) of each value z; nothing without a box."""
    pairs = zip(values, ends, strict=True) if ends else ()
    return [(z - low) * (high - z) for z, (low, high) in pairs]


def _read_storage(kind: str, given: dict[str, Node], n: int, *, local: bool) -> Any:
    """V as terms in (x, x~), M as rows of terms in x, P as numbers; None for other claims."""
    if kind == "2.10":
        V = given["V"].polynomial(2 * n)
        refuse_if(any(c and not any(e[n:]) for e, c in V), "V(x, x) is not zero")
        return V
    if kind == "2.11":
        rows = given["M"].items(n, n)
        M = [[entry.polynomial(n) for entry in row.items(n, n)] for row in rows]
        refuse_if(any(M[i][j] != M[j][i] for i in range(n) for j in range(i)), "M is not symmetric")
        refuse_if(
            local and any(any(e) for row in M for entry in row for e, _ in entry),
            "on a box M should be constant: curved paths can leave the box",
        )
        return M
    if "P" in given:
        P = given["P"].array(n, n)
        definite(P, "P")
        return P
    return None
