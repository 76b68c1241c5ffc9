"""Claim: an implicit model is well posed and, if a set is named, forgets its start.

The model is 0 = h(v, x, w), x⁺ = [v; ã(x, w)]. Well posed: h has exactly one zero v for every state
x and input w, as h is strongly monotone in v, or follows a centre e₀ that is a bijection.
Of two solutions x, x̂ = x - x~ with the same input, a storage falls by δ|x~|² or more a sample: one
inequality for each set of thesis (2.10)-(2.19), on the box of states and inputs, if there is one.
Then the claim is about solutions that stay in it, the unknown v included, which is a next state.
The inequalities, and why they are enough: docs/certificate_stable_set.md.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

from . import text
from .exact import definite
from .files import Node, Read, Table, Terms, bound_files, itself, limit, one_of, refuse_if
from .implicit_models import Implicit, derivative, read_implicit
from .polynomials import FREE_OF_S, Polynomial, Ring, at_width
from .positivity import WITNESS, expanded, read_squares, remainder

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
    optional: Table = {"set?": one_of(*SETS), "delta?": (), "box?": (None, 2)}
    stated = claim.read({"kind": itself, "about": itself, **optional})
    documents, digests = bound_files(stated["about"], read, "model")
    model = read_implicit(documents["model"])
    k, n, m = len(model["h"]), len(model["states"]), len(model["inputs"])
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
    count = 2 * k + 2 * n + m + 2 * n + 1  # v, x, w, v~, x~, and y
    limit(count, MAX_VARIABLES, "variables")

    def prove(ring: Ring, _: None) -> None:
        wanted = _inequalities(model, kind, storage, delta, box, ring)
        witnesses = given["inequalities"].members(" ".join(wanted))
        for name, (c, domain) in wanted.items():
            witness = witnesses[name].members(WITNESS, "multipliers")
            _positive_on(c, domain, witness, f"inequality {name}")

    at_width(count, [None], prove, FREE_OF_S)
    stable = text.say(STABLE, kind=kind, delta=delta) if kind else ""
    size = f"{n} state{'s' if n > 1 else ''}"
    said = text.say(SENTENCE, size=size, where=_where(box, n), stable=stable)
    stay = (STAY,) if box and kind else ()
    return text.Verdict(said, delta if kind else model["monotonicity"], stay, digests)


def _where(box: list[Any], n: int) -> str:
    shown = [text.PRINTED["exact_range"](ends) for ends in box]
    inputs = f" and every input in {' x '.join(shown[n:])}" if shown[n:] else ""
    states = f"every state in {' x '.join(shown[:n])}{inputs}"
    return states if box else "every state and input"


def _positive_on(c: Polynomial, domain: Vector, parts: Mapping[str, Node], what: str) -> None:
    """Raise Rejected unless c - Σ_k σ_k domain[k] >= 0, σ_k sums of squares.

    parts: a witness, and perhaps `multipliers`, each with `of`, the index k of its part of the
    domain, increasing, and the same three members; a part without one has σ = 0.
    """
    terms, last = [c], -1
    for entry in parts["multipliers"].items(0, len(domain)) if "multipliers" in parts else []:
        members = entry.members(f"of {WITNESS}")
        last = members["of"].whole(last + 1, len(domain) - 1)
        terms.append(-1 * (expanded(members, c.ring) * domain[last]))
    remainder(c.ring.sum(terms), read_squares(parts, c.ring), c.ring, what)


def _inequalities(
    model: Implicit, kind: str, storage: Any, delta: Fraction, box: list[Any], ring: Ring
) -> dict[str, Inequality]:
    """What has to be >= 0, and where, by the name of its witness."""
    h, shift, n, m = model["h"], model["shift"], len(model["states"]), len(model["inputs"])
    k, dot, at, form = len(h), ring.dot, ring.substituted, ring.form
    rest = iter(ring.variables)
    v, x, w, gap_v, gap_x = ([next(rest) for _ in range(size)] for size in (k, n, m, k, n))
    y, known, here = list(rest), [*x, *w], [*v, *x, *w]
    hat_v, hat_x = _minus(v, gap_v), _minus(x, gap_x)
    at_known, at_hat, at_next = _inside(known, box), _inside(hat_x, box[:n]), _inside(v, box[:k])
    found = _well_posed(model, here, y[:k], at_known, ring)
    if kind == "2.10":
        stacked = at(shift, known)
        moved = _minus(at(h, here), at(h, [*hat_v, *hat_x, *w]))
        after = [*v, *stacked, *gap_v, *_minus(stacked, at(shift, [*hat_x, *w]))]
        (V,), (V_next,) = at([storage], [*x, *gap_x]), at([storage], after)
        c = 2 * dot(gap_v, moved) + V - V_next - delta * dot(gap_x, gap_x)
        found["stable"] = c, [*at_known, *at_next, *at_hat, *_inside(hat_v, box[:k])]
        found["storage"] = V, [*at_known[:n], *at_hat]
    elif kind == "2.11":
        nu, gap = y[:k], y[k : k + n]
        M, M_next = ([at(row, point) for row in storage] for point in (x, [*v, *at(shift, known)]))
        moved = _along(h, here, [*nu, *gap], ring)
        gap_next = [*nu, *_along(shift, known, gap, ring)]
        c = 2 * dot(nu, moved) + form(M, gap) - delta * dot(gap, gap) - form(M_next, gap_next)
        found["stable"] = c, [*at_known, *at_next]
        found["storage"] = form(M, y[:n]), []
    elif kind == "2.12":
        e, f = _separated(h, n)
        y0, y = y[0], y[1 : 1 + n]
        rise, moved = _minus(at(e, x), at(e, hat_x)), _minus(at(f, known), at(f, [*hat_x, *w]))
        corner = 2 * dot(gap_x, rise) - form(storage, gap_x) - delta * dot(gap_x, gap_x)
        c = corner * (y0 * y0) + 2 * (y0 * dot(y, moved)) + form(storage, y)
        found["stable"] = c, [*at_known, *at_hat]
    elif kind:
        e, f = _separated(h, n)
        gap, y = y[:n], y[n : 2 * n]
        slope, turned = dot(gap, _along(e, x, gap, ring)), dot(y, _along(f, known, gap, ring))
        if kind == "2.13":
            c = 2 * slope - form(storage, gap) + form(storage, y)
        else:
            _check_linear(e, f, box)
            c = slope + dot(y, _along(e, x, y, ring))
        found["stable"] = c + 2 * turned - delta * dot(gap, gap), at_known
    return found


def _well_posed(
    model: Implicit, here: Vector, y: Vector, domain: Vector, ring: Ring
) -> dict[str, Inequality]:
    """`monotone`, or `centre` (everywhere) and `centred`."""
    m, dot, centre = model["monotonicity"], ring.dot, model["centre"]
    slope = _along(model["h"], here, y, ring)
    if not centre:
        return {"monotone": (2 * (dot(y, slope) - m * dot(y, y)), domain)}
    inner = _along(centre, here[: len(y)], y, ring)
    square = dot(inner, inner)
    linear = all(sum(e) <= 1 for p in centre for e, _ in p)
    regular = square - m**2 * dot(y, y) if linear else 2 * (dot(y, inner) - m * dot(y, y))
    return {"centre": (regular, []), "centred": (2 * dot(inner, slope) - square, domain)}


def _along(ps: Sequence[Terms], at: Vector, direction: Vector, ring: Ring) -> Vector:
    """Σ_j ∂p/∂(variable j) direction[j] of each p, with `at` in the variables' place."""
    put, size = ring.substitution(at), len(direction)
    return [ring.dot([put(derivative(p, j)) for j in range(size)], direction) for p in ps]


def _minus(a: Vector, b: Vector) -> Vector:
    return [p - q for p, q in zip(a, b, strict=True)]


def _inside(values: Vector, ends: list[Any]) -> Vector:
    """(z - low)(high - z) of each value z; nothing without a box."""
    pairs = zip(values, ends, strict=True) if ends else ()
    return [(z - low) * (high - z) for z, (low, high) in pairs]


def _separated(h: list[Terms], n: int) -> tuple[list[Terms], list[Terms]]:
    """(e in x, f in (x, w)) of a model e(x⁺) = f(x, w); Rejected if it is not of that form."""
    mixed = any(any(e[:n]) and any(e[n:]) for p in h for e, _ in p)
    refuse_if(mixed or len(h) < n, "the set is for models e(x+) = f(x, w)")
    left = [[(e[:n], c) for e, c in p if any(e[:n])] for p in h]
    return left, [[(e[n:], -c) for e, c in p if not any(e[:n])] for p in h]


def _check_linear(e: list[Terms], f: list[Terms], box: list[Any]) -> None:
    n = len(e)
    refuse_if(box, "a linear model is stable everywhere: the claim has no box")
    curved = any(sum(a[:n]) > 1 or (any(a[:n]) and any(a[n:])) for p in (*e, *f) for a, _ in p)
    refuse_if(curved, "the model is not linear in its states")
    even = all(derivative(e[i], j) == derivative(e[j], i) for i in range(n) for j in range(i))
    refuse_if(not even, "E is not symmetric; multiply the model's equation by E' first")


def _read_storage(kind: str, given: dict[str, Node], n: int, *, local: bool) -> Any:
    """V as terms in (x, x~), M as rows of terms in x, P as numbers; None for other claims."""
    if kind == "2.10":
        V = given["V"].polynomial(2 * n)
        refuse_if(any(c and not any(e[n:]) for e, c in V), "V(x, x) is not zero")
        return V
    if kind == "2.11":
        M = [[entry.polynomial(n) for entry in row.items(n, n)] for row in given["M"].items(n, n)]
        even = all(M[i][j] == M[j][i] for i in range(n) for j in range(i))
        constant = not any(any(e) for row in M for entry in row for e, _ in entry)
        refuse_if(not even, "M is not symmetric")
        refuse_if(local and not constant, "on a box M should be constant: curved paths leave it")
        return M
    P = given["P"].array(n, n) if "P" in given else None
    if P:
        definite(P, "P")
    return P
