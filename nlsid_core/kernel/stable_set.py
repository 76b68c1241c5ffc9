"""Claim: an implicit model is well posed and forgets its start.

The model is 0 = h(v, x, w), x⁺ = [v; ã(x, w)]. Well posed: h has exactly one zero v for every state
x and input w, as h is strongly monotone in v. Of two solutions with the same input, a storage of
their difference x~ falls by δ|x~|² or more a sample: one inequality for each set of thesis Chapter
2, on the box of states and inputs, if there is one. Then the claim is about solutions that stay in
it, the unknown v included, which is a next state.
The inequalities, and why they are enough: docs/certificate_stable_set.md.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

from . import text
from .exact import definite
from .files import Node, Read, Table, Terms, bound_files, limit, one_of, refuse_if
from .implicit_models import Implicit, derivative, read_implicit
from .polynomials import Polynomial, Ring, at_width
from .positivity import WITNESS, positive, read_squares

MAX_VARIABLES = 100
STORAGE = {"2.11": " M", "2.13": " P", "2.19": ""}  # what a proof states of it, by set
LEFT = ("2.10", "2.12")
SENTENCE = (
    "the implicit model with {size} has exactly one next state for {where}; two of its solutions "
    "with the same input have differences whose squares have a finite sum (set {kind}: a storage "
    "falls by {delta:down} times the squared difference or more a sample)"
)
STAY = "both solutions stay in this box of states and inputs; that any do is not stated"

Vector = list[Polynomial]
Inequality = tuple[Polynomial, Vector]  # >= 0 where each of the domain is >= 0


def decide(claim: Node, proof: Node, read: Read) -> text.Verdict:
    """Rebuild the inequalities of the set from the model's numbers; each has its own witness."""
    refuse_if(
        "set" not in claim.value,
        "a claim without a set is not decided since version 0.3",
        "left",
    )
    table: Table = {
        "kind": None,
        "about": None,
        "set": one_of(*STORAGE, former=LEFT),
        "delta": (),
        "box?": (None, 2),
    }
    stated = claim.read(table)
    documents, digests = bound_files(stated["about"], read, "model")
    model = read_implicit(documents["model"])
    k, n, m = len(model["h"]), len(model["states"]), len(model["inputs"])
    kind, delta, box = stated["set"], stated["delta"], stated["box"] or []
    sized = stated["box"] is None or len(box) == n + m
    claim.require({"the box should have a range for every state and input": sized})
    claim.require({"delta should be positive": delta > 0}, "not_below")
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
            witness = witnesses[name].members(f"{WITNESS} multipliers?")
            _positive_on(c, domain, witness, f"inequality {name}")

    at_width(count, [None], prove)
    size = f"{n} state{'s' if n > 1 else ''}"
    said = text.say(SENTENCE, size=size, where=_where(box, n), kind=kind, delta=delta)
    return text.Verdict(said, delta, (STAY,) if box else (), digests)


def _where(box: list[Any], n: int) -> str:
    shown = [text.PRINTED["exact_range"](ends) for ends in box]
    inputs = f" and every input in {' x '.join(shown[n:])}" if shown[n:] else ""
    return f"every state in {' x '.join(shown[:n])}{inputs}" if box else "every state and input"


def _positive_on(c: Polynomial, domain: Vector, parts: Mapping[str, Node], what: str) -> None:
    """Raise Rejected unless c - Σ_k σ_k domain[k] >= 0, σ_k sums of squares.

    parts: a witness, and perhaps `multipliers`, each with `of`, the index k of its part of the
    domain, increasing, and the same three members; a part without one has σ = 0.
    """
    terms, last = [c], -1
    for entry in parts["multipliers"].items(0, len(domain)) if "multipliers" in parts else []:
        members = entry.members(f"of {WITNESS}")
        last = members["of"].whole(last + 1, len(domain) - 1)
        terms.append(-1 * (read_squares(members, c.ring).form * domain[last]))
    positive(c.ring.sum(terms), read_squares(parts, c.ring), c.ring, what, strict=False)


def _inequalities(
    model: Implicit, kind: str, storage: Any, delta: Fraction, box: list[Any], ring: Ring
) -> dict[str, Inequality]:
    """What has to be >= 0, and where, by the name of its witness."""
    h, shift, n, m = model["h"], model["shift"], len(model["states"]), len(model["inputs"])
    k, dot, form = len(h), ring.dot, ring.form
    rest = iter(ring.variables)
    v, x, w, *_ = ([next(rest) for _ in range(size)] for size in (k, n, m, k, n))
    y, known, here = list(rest), [*x, *w], [*v, *x, *w]
    at_known, nu = _inside(known, box), y[:k]
    rise = dot(nu, _along(h, here, nu, ring))
    found = {"monotone": (2 * (rise - model["monotonicity"] * dot(nu, nu)), at_known)}
    if kind == "2.11":
        gap, after = y[k : k + n], [*v, *ring.substituted(shift, known)]
        M, M_next = ([ring.substituted(row, point) for row in storage] for point in (x, after))
        moved = dot(nu, _along(h, here, [*nu, *gap], ring))
        gap_next = [*nu, *_along(shift, known, gap, ring)]
        c = 2 * moved + form(M, gap) - delta * dot(gap, gap) - form(M_next, gap_next)
        found["stable"] = c, [*at_known, *_inside(v, box[:k])]
        found["storage"] = form(M, y[:n]), []
        return found
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


def _along(ps: Sequence[Terms], at: Vector, direction: Vector, ring: Ring) -> Vector:
    """Σ_j ∂p/∂(variable j) direction[j] of each p, with `at` in the variables' place."""
    put, size = ring.substitution(at), len(direction)
    return [ring.dot([put(derivative(p, j)) for j in range(size)], direction) for p in ps]


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
    """M as rows of terms in x, P as numbers; None for set 2.19."""
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
