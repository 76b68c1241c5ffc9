"""Claim: an implicit model is well posed and, if a set is named, forgets its start.

For two solutions x, x̂ = x - x~ with the same input, in each set a storage falls by δ|x~|² or more a
sample, so that Σ|x~|² is finite. For every v, x, w, v~, x~ and y (v~ = v - v̂, Δ = y):
    2.10  2v~'(h - ĥ) + V(x, x~) - V(x⁺, x~⁺) - δ|x~|² >= 0, V(x, x~) >= 0, V(x, 0) = 0
    2.11  2ν'(∂h/∂v ν + ∂h/∂x Δ) + |Δ|²_M(x) - δ|Δ|² - |[ν; ∂ã/∂x Δ]|²_M(x⁺) >= 0, |y|²_M(x) >= 0
    2.12  (2x~'(e - ê) - |x~|²_P - δ|x~|²) y₀² + 2y₀ y'(f - f̂) + |y|²_P >= 0, P ≻ 0
    2.13  2Δ'(∂e/∂x Δ) - |Δ|²_P - δ|Δ|² + 2y'(∂f/∂x Δ) + |y|²_P >= 0, P ≻ 0
    2.19  Δ'EΔ - δ|Δ|² + 2y'(FΔ) + y'Ey >= 0 for a linear model E x⁺ = F x + …, E = E'
each on the box of states and inputs, if there is one: then the claim is about solutions that stay
in it, the unknown v included, which is a next state. In 2.11 a box needs a constant M: then
straight lines join two states, and stay inside. Source: thesis Lemmas 2.10 to 2.13, (2.19).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from . import text
from .decision import Decision
from .exact import definite
from .files import Node, Read, Rejected, bound_files
from .implicit_models import ImplicitModel, read_implicit_model, well_posed
from .polynomials import FREE_OF_S, MOST_WORK, Polynomial, Ring, Work, at_width
from .positivity import positive_on
from .terms import MAX_VARIABLES, Terms, along, derivative, dot, form, read_terms, substituted

STORAGE = {"2.10": " V", "2.11": " M", "2.12": " P", "2.13": " P", "2.19": "", "": ""}
Ends = list[list[Fraction]]
Vector = list[Polynomial]
Inequality = tuple[Polynomial, Sequence[Polynomial]]  # >= 0 where each of the domain is >= 0


@dataclass(frozen=True)
class Variables:
    """The ring's variables: v, x, w, v~, x~, and y (as many as x, one more, and as many again)."""

    v: Vector
    x: Vector
    w: Vector
    gap_v: Vector
    gap_x: Vector
    y: Vector


def decide(claim: Node, proof: Node, read: Read) -> Decision:
    """Rebuild the inequalities of the set from the model's numbers; each has its own witness."""
    parts = claim.members("kind about", "set delta box")
    documents, digests = bound_files(parts["about"], read, "model")
    model = read_implicit_model(documents["model"])
    n, m = model.states, model.inputs
    kind = parts["set"].text() if "set" in parts else ""
    if kind not in STORAGE:
        raise Rejected(f"the set {kind!r} is unknown; known: {', '.join(filter(None, STORAGE))}")
    if ("delta" in parts) != bool(kind):
        raise Rejected("a set needs a delta, and a delta needs a set")
    delta = parts["delta"].number() if kind else Fraction(0)
    if kind and delta <= 0:
        raise Rejected("delta should be positive")
    box: Ends = parts["box"].array(n + m, 2) if "box" in parts else []
    if any(not low < high for low, high in box):
        raise Rejected("an interval of the box is empty")
    given = proof.members("inequalities" + STORAGE[kind])
    storage = _read_storage(kind, given, model, local=bool(box))
    sizes = (model.unknowns, n, m, model.unknowns, n, 2 * n + 1)
    if sum(sizes) > MAX_VARIABLES:
        raise Rejected(f"{sum(sizes)} variables; at most {MAX_VARIABLES} are taken")

    def build(ring: Ring) -> None:
        everything = [ring.variable(i) for i in range(ring.count)]
        z = Variables(
            *(everything[sum(sizes[:i]) : sum(sizes[: i + 1])] for i in range(len(sizes)))
        )
        wanted = _inequalities(model, kind, storage, delta, box, z, ring)
        witnesses = given["inequalities"].members(" ".join(wanted))
        for name, (c, domain) in wanted.items():
            positive_on(c, domain, witnesses[name], ring, f"inequality {name}")

    at_width(sum(sizes), Work(MOST_WORK), build, first=FREE_OF_S)
    shown = [f"[{text.exact(low)}, {text.exact(high)}]" for low, high in box]
    inputs = f" and every input in {' x '.join(shown[n:])}" if m else ""
    where = f"every state in {' x '.join(shown[:n])}{inputs}" if box else "every state and input"
    size = f"{n} state{'s' if n > 1 else ''}"
    posed = f"the implicit model with {size} has exactly one next state for {where}"
    if not kind:
        return Decision(posed, model.monotonicity, (), digests)
    sentence = (
        f"{posed}; two of its solutions with the same input have differences whose squares have a "
        f"finite sum (set {kind}: a storage falls by {text.below(delta)} times the squared "
        "difference or more a sample)"
    )
    stay = ("both solutions stay in this box of states and inputs",) if box else ()
    return Decision(sentence, delta, stay, digests)


def _inequalities(
    model: ImplicitModel, kind: str, storage: Any, delta: Fraction, box: Ends, z: Variables,
    ring: Ring,
) -> dict[str, Inequality]:  # fmt: skip
    n, k = model.states, model.unknowns
    known, here = [*z.x, *z.w], [*z.v, *z.x, *z.w]
    hat_v, hat_x = ([ring.minus(a, b) for a, b in zip(p, q, strict=True)]
                    for p, q in ((z.v, z.gap_v), (z.x, z.gap_x)))  # fmt: skip
    at_known, at_hat = _in_box(known, box, ring), _in_box(hat_x, box[:n], ring)
    at_next = _in_box(z.v, box[:k], ring)
    found: dict[str, Inequality] = {
        name: (c, [] if name == "centre" else at_known)
        for name, c in well_posed(model, z.v, known, z.y[:k], ring).items()
    }
    if kind == "2.10":
        V, gaps = storage, [*z.x, *z.gap_x]
        moved = [_moved(h, here, [*hat_v, *hat_x, *z.w], ring) for h in model.h]
        after = [*z.v, *(substituted(a, known, ring) for a in model.shift)]
        after += [*z.gap_v, *(_moved(a, known, [*hat_x, *z.w], ring) for a in model.shift)]
        change = ring.minus(substituted(V, gaps, ring), substituted(V, after, ring))
        c = _total([(2, dot(z.gap_v, moved, ring)), (1, change), (-delta, _size(z.gap_x, ring))],
                   ring)  # fmt: skip
        domain = [*at_known, *at_next, *at_hat, *_in_box(hat_v, box[:k], ring)]
        found["stable"] = (c, domain)
        states = [*_in_box(z.x, box[:n], ring), *at_hat]
        found["storage"] = (substituted(V, gaps, ring), states)
    elif kind == "2.11":
        nu, gap = z.y[:k], z.y[k : k + n]
        M = [[substituted(entry, z.x, ring) for entry in row] for row in storage]
        after = [*z.v, *(substituted(a, known, ring) for a in model.shift)]
        next_M = [[substituted(entry, after, ring) for entry in row] for row in storage]
        moved = [along(h, here, [*nu, *gap], ring) for h in model.h]
        next_gap = [*nu, *(along(a, known, gap, ring) for a in model.shift)]
        c = _total([(2, dot(nu, moved, ring)), (1, form(M, gap, ring)),
                            (-delta, _size(gap, ring)), (-1, form(next_M, next_gap, ring))],
                   ring)  # fmt: skip
        found["stable"] = (c, [*at_known, *at_next])
        found["storage"] = (form(M, z.y[:n], ring), [])
    elif kind == "2.12":
        e, f = model.separated()
        P = [[ring.constant(entry) for entry in row] for row in storage]
        y0, y = z.y[0], z.y[1 : 1 + n]
        rise = [_moved(p, z.x, hat_x, ring) for p in e]
        moved = [_moved(p, known, [*hat_x, *z.w], ring) for p in f]
        corner = _total([(2, dot(z.gap_x, rise, ring)), (-1, form(P, z.gap_x, ring)),
                         (-delta, _size(z.gap_x, ring))], ring)  # fmt: skip
        c = _total([(1, ring.times(corner, ring.times(y0, y0))),
                    (2, ring.times(y0, dot(y, moved, ring))), (1, form(P, y, ring))],
                   ring)  # fmt: skip
        found["stable"] = (c, [*at_known, *at_hat])
    elif kind:
        e, f = model.separated()
        gap, y = z.y[:n], z.y[n : 2 * n]
        if kind == "2.19":
            _check_linear(e, f, box)
        slope = dot(gap, [along(p, z.x, gap, ring) for p in e], ring)
        turned = dot(y, [along(p, known, gap, ring) for p in f], ring)
        c = _total([(2 if storage else 1, slope), (-delta, _size(gap, ring)), (2, turned)], ring)
        if storage:
            P = [[ring.constant(entry) for entry in row] for row in storage]
            c = _total([(1, c), (-1, form(P, gap, ring)), (1, form(P, y, ring))], ring)
        else:
            c = ring.sum([c, dot(y, [along(p, z.x, y, ring) for p in e], ring)])
        found["stable"] = (c, at_known)
    return found


def _check_linear(e: Sequence[Terms], f: Sequence[Terms], box: Ends) -> None:
    n = len(e)
    if box:
        raise Rejected("a linear model is stable everywhere: the claim has no box")
    if any(sum(a[:n]) > 1 or (any(a[:n]) and any(a[n:])) for p in (*e, *f) for a, _ in p):
        raise Rejected("the model is not linear in its states")
    if any(derivative(e[i], j) != derivative(e[j], i) for i in range(n) for j in range(i)):
        raise Rejected("E is not symmetric; multiply the model's equation by E' first")


def _moved(p: Terms, at: Sequence[Polynomial], hat: Sequence[Polynomial], ring: Ring) -> Polynomial:
    """p(at) - p(hat)."""
    return ring.minus(substituted(p, at, ring), substituted(p, hat, ring))


def _size(a: Sequence[Polynomial], ring: Ring) -> Polynomial:
    return dot(a, a, ring)


def _total(parts: Sequence[tuple[Fraction | int, Polynomial]], ring: Ring) -> Polynomial:
    return ring.sum([ring.scaled(p, weight) for weight, p in parts])


def _in_box(values: Sequence[Polynomial], ends: Ends, ring: Ring) -> list[Polynomial]:
    """(z - low)(high - z) of each value z; nothing without a box."""
    return [
        ring.times(ring.minus(z, ring.constant(low)), ring.minus(ring.constant(high), z))
        for z, (low, high) in (zip(values, ends, strict=True) if ends else ())
    ]


def _read_storage(kind: str, given: dict[str, Node], model: ImplicitModel, *, local: bool) -> Any:
    """V as terms in (x, x~), M as rows of terms in x, P as numbers; None for other claims."""
    n = model.states
    if kind == "2.10":
        V = read_terms(given["V"], 2 * n)
        if any(c and not any(e[n:]) for e, c in V):
            raise Rejected("V(x, x) is not zero")
        return V
    if kind == "2.11":
        rows = [row.items(n, n) for row in given["M"].items(n, n)]
        M = [[read_terms(entry, n) for entry in row] for row in rows]
        if any(M[i][j] != M[j][i] for i in range(n) for j in range(i)):
            raise Rejected("M is not symmetric")
        if local and any(any(e) for row in M for entry in row for e, _ in entry):
            raise Rejected("on a box M should be constant: curved paths can leave the box")
        return M
    if kind:
        P = given["P"].array(n, n) if "P" in given else None
        if P is not None:
            definite(P, "P")
        return P
    return None
