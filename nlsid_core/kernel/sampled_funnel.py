"""Claim `sampled_funnel`: a tube and an inlet around a motion of an identified model hold.

With x̄ = xhat - x_k and d_k the observer's correction, x̄⁺ = f̄_k(x̄) + d_k exactly. Sizes are |S_k x̄|.
For both chains of radii, the tube and the inlet, and at each step: `positive` proves that
|ξ| <= radius implies |f̄_k(ξ)| <= reach; and the reach, with what the disturbance adds to it in the
assumption's form, is within the next radius. A trapezoidal model's f̄ is any root of its equation
h(z, w) = 0 within the stated bound. Coordinates are stated: x̄ = T z, and v̄⁺ = T⁺w.
Why that is enough: docs/certificate_sampled_funnel.md.
"""

from dataclasses import dataclass
from fractions import Fraction
from math import comb

from . import text
from .decision import Decision
from .exact import Matrix, at_most, inverse_forms, product, transposed, unit
from .files import Node, Read, bound_files, refuse_if
from .polynomials import FREE_OF_S, Polynomial, Ring, at_width
from .positivity import expanded, positive, powers_of_two, read_squares
from .sampled_step import Link, Model, Sample, nonnegative, read_link, stretch, triangular
from .signals import apart, ranges, read_signals
from .text import above

CHAINS = ("tube", "inlet")
MAX_SAMPLES = 10**6  # times the cube of the states
MAX_SIGNALS = 16
MAX_MONOMIALS = 1000  # of all degrees up to the model's, in one step's variables
PROVENANCE = "measured safety_factor measured_on"  # of the bound; no part of the claim

SENTENCE = (
    "funnel: a state estimate that starts with |S[0] (xhat - x[0])| <= {tube:down}, such as xhat = "
    "x[0], stays in the tube, |S[k] (xhat - x[k])| <= tube[k]{bound}, at all {samples} samples "
    "over {span:down} s and ends within {ends} of the nominal; one that starts with "
    "|S[0] (xhat - x[0])| <= {inlet:down} ends within {goal} of it; at the samples both stay in "
    "the box of the model's data, {box}"
)
DISTURBANCE = "disturbance {form} {kept} at every sample, d = xhat+ - f(xhat, u)"
KEPT = {
    "response": "|S r| <= {bound:down}, r+ = A r + d from r = 0,",
    "peak": "|S d| <= {bound:down}",
    "energy": "sqrt(E) <= {bound:down}, E+ = E + {gain:up} |S d|^2 from E = 0,",
    "fading": "sqrt(E) <= {bound:down}, E+ = {rate:up} E + {gain:up} |S d|^2 from E = 0,",
}
APPLIED = "the input applied at every sample is the policy's, u[k] - K[k] (xhat - x[k])"
ROOTS = (
    "every step of the model ends at a root with |S_vv (v+ - v[k+1])| <= roots[k+1], {low:down} to "
    "{high:down}; that there is one is not stated"
)


@dataclass(frozen=True)
class Funnel:
    """Shapes, radii of both chains, half-widths of the tube, bounds of roots; the assumption."""

    S: list[Matrix]
    A: list[Matrix]
    radii: dict[str, list[Fraction]]
    half_widths: Matrix
    roots: list[Fraction]
    form: str
    bound: Fraction
    rate: Fraction
    gain: Fraction

    @property
    def widens(self) -> Fraction:
        """What the disturbance adds to a radius."""
        return Fraction(0) if self.form == "peak" else self.bound


def decide(claim: Node, proof: Node, read: Read) -> Decision:
    """Decide {kind, about: {model, policy, funnel}} by {basis, ball_basis, ..., steps}."""
    about = claim.members("kind about")["about"]
    documents, digests = bound_files(about, read, "model policy funnel")
    model = _read_model(documents["model"])
    x, u, K = _read_policy(documents["policy"], model, digests["model"])
    funnel = _read_funnel(documents["funnel"], model, len(u), digests)
    for k, (point, inputs, gain) in enumerate(zip(x, [*u, []], [*K, []], strict=True)):
        _prove_box(model, funnel, k, [*point, *inputs], gain)
    names = "basis ball_basis steps" + " roots_basis equation_basis" * model.trapezoidal
    bases = proof.members(names)

    steps, rooms = bases["steps"].items(len(u), len(u)), []

    def prove(ring: Ring, k: int) -> None:
        at = Sample(x[k], u[k], K[k], x[k + 1], funnel.S[k], funnel.S[k + 1], funnel.A[k])
        stated, link = read_link(steps[k], model, at, funnel.form, ring)
        rooms.extend([_prove_step(link, stated[c], bases, funnel, c, k) for c in CHAINS])

    at_width(_variables(model), range(len(u)), prove, FREE_OF_S)
    said, assumptions = _sentence(model, funnel, len(u)), _assumptions(model, funnel)
    return Decision(said, min(rooms), assumptions, digests)


def _prove_step(
    link: Link, node: Node, bases: dict[str, Node], funnel: Funnel, chain: str, k: int
) -> Fraction:
    """Prove one step of one chain; the part of the next radius that it leaves free."""
    ring, d, what = link.size.ring, len(link.h), f"{chain}, step {k}"
    names = "reach columns squares ball" + " roots equations" * bool(d)
    names += " spread extents" * (bool(d) and funnel.form == "response")
    stated = node.members(names)
    reach, (radius, following) = nonnegative(stated["reach"]), funnel.radii[chain][k : k + 2]
    parts = [reach**2 - ring.dot(link.rows, link.rows)]
    parts.append(_ball(stated["ball"], bases["ball_basis"], radius, link.size))
    if d:
        far, added = _implicit_addition(link, stated, funnel, radius, reach, k, what)
        w = ring.variables[-d:]
        parts.append(_ball(stated["roots"], bases["roots_basis"], far, ring.dot(w, w)))
        parts += _equations(stated["equations"], bases["equation_basis"], link)
    else:
        added = _explicit_addition(link, funnel, radius, what)
    exceeds = f"{what}: reach {above(reach)} and disturbance {above(added)} exceed the next radius"
    at_most(reach + added, following, exceeds)
    squares = read_squares(stated | {"basis": bases["basis"]}, ring)
    positive(ring.sum(parts), squares, ring, f"{what}: reach", strict=False)
    return (following - reach - added) / following


def _ball(node: Node, basis: Node, radius: Fraction, size: Polynomial) -> Polynomial:
    """-σ (radius² - size), σ a sum of squares: not positive where size <= radius²."""
    squares = read_squares(node.members("columns squares") | {"basis": basis}, size.ring)
    return expanded(squares, size.ring) * (size - radius**2)


def _equations(node: Node, basis: Node, link: Link) -> list[Polynomial]:
    """-ν_i h_i, zero at a root: ν_i = Σ_m rows[i][m] 2^columns[m] monomial_m."""
    stated, ring = node.members("columns rows"), link.size.ring
    monomials = [ring.monomial(row) for row in basis.monomials(ring.count)]
    columns = powers_of_two(stated["columns"], len(monomials))
    rows = stated["rows"].wholes(len(link.h), len(monomials))
    nu = ([-e * Fraction(2) ** c for e, c in zip(row, columns, strict=True)] for row in rows)
    return [ring.dot(row, monomials) * h for row, h in zip(nu, link.h, strict=True)]


def _explicit_addition(link: Link, funnel: Funnel, radius: Fraction, what: str) -> Fraction:
    """What the disturbance adds to the reach of an explicit model from `radius`."""
    if funnel.form == "peak":
        return funnel.bound
    kappa, rate, gain = link.bounds["kappa"], funnel.rate, funnel.gain
    mu = kappa * stretch(link.curvature, kappa * radius, kappa * funnel.bound, least=1)
    if funnel.form == "response":
        return mu * funnel.bound
    much = f"too much for rate {above(rate)} and gain {above(gain)}"
    at_most(gain * mu**2, (gain - 1) * rate, f"{what}: deviations stretch by {above(mu)}, {much}")
    return Fraction(0)


def _implicit_addition(
    link: Link,
    stated: dict[str, Node],
    funnel: Funnel,
    radius: Fraction,
    reach: Fraction,
    k: int,
    what: str,
) -> tuple[Fraction, Fraction]:
    """|w| that the reach has to be proved for, and what the disturbance adds to the reach."""
    b = link.bounds
    far = b["kappa_next"] * funnel.roots[k + 1]
    if funnel.form == "peak":
        return far, funnel.bound
    z, r, spread = b["kappa"] * radius, b["kappa"] * funnel.bound, nonnegative(stated["spread"])
    wide, near = (nonnegative(entry) for entry in stated["extents"].items(2, 2))
    # The root of ξ: Δ, with |Δ| <= spread |r|, is mapped to at most (state + ...) |r|.
    far += spread * r
    at_most(z**2 + far**2, wide**2, f"{what}: the first extent is too small")
    mu = stretch(link.curvature, wide, (1 + spread) * r, least=2)
    mapped_to = b["state"] + b["rates"] * spread + mu * (1 + spread)
    refuse_if(
        b["rates"] >= 1 or mapped_to > spread,
        f"{what}: two roots may differ by more than the stated spread",
        "not_below",
    )
    # From it Δ = -B r + (1 - C) Δ - (a change of N), and |w| <= kappa_next reach at the root of ξ.
    own = b["kappa_next"] * reach
    at_most(z**2 + own**2, near**2, f"{what}: the second extent is too small")
    mu = stretch(link.curvature, near, (1 + spread) * r, least=2)
    shrink = 1 - b["rates"] - mu
    if shrink > 0:
        spread = min(spread, (b["state"] + mu) / shrink)
    return far, (b["direct"] + b["through"] * (b["rates"] * spread + mu * (1 + spread))) * r


def _prove_box(model: Model, funnel: Funnel, k: int, centres: list[Fraction], K: Matrix) -> None:
    """At sample k both chains stay in the box of the data, inputs included; and the half-widths.

    |g'x̄| <= room where |S x̄| <= radius if radius² g'(S'S)⁻¹g <= room².
    """
    n = model.states
    tube, inlet = (funnel.radii[chain][k] + funnel.widens for chain in CHAINS)
    rows = [unit(i, n) for i in range(n)] + K
    forms = inverse_forms(product(transposed(funnel.S[k]), funnel.S[k]), rows, "S'S")
    names, stays = [signal.name for signal in model.signals], "the box of the model's data"
    rooms = [(tube, width, "its stated half-width") for width in funnel.half_widths[k]]
    for centre, (low, high) in zip(centres, model.box, strict=False):
        rooms.append((max(tube, inlet), min(high - centre, centre - low), stays))
    named = zip(rooms, [*forms[:n], *forms], [*names[:n], *names], strict=False)
    for (radius, room, kept), form, name in named:
        refuse_if(
            room < 0 or radius**2 * form > room**2,
            f"sample {k}: {name} can leave {kept}",
            "not_valid",
        )


def _read_model(node: Node) -> Model:
    parts = node.document(
        "model",
        "equation period x u exponents coefficients x_range u_range noise disturbance bags",
        "state_map trapezoidal",
    )
    trapezoidal = parts["kind"].value == "trapezoidal"
    x = read_signals(parts["x"], "states", 1, MAX_SIGNALS)
    u = read_signals(parts["u"], "inputs", 1, MAX_SIGNALS)
    box = parts["x_range"].array(len(x), 2) + parts["u_range"].array(len(u), 2)
    signals = [*x, *apart(u, x)]
    exponents, period = parts["exponents"].monomials(len(signals)), parts["period"].number()
    refuse_if(
        (trapezoidal and len(x) % 2) or period <= 0 or not exponents,
        "a model needs a positive period, monomials, and a rate for each position",
    )
    outputs = len(x) // 2 if trapezoidal else len(x)
    columns = transposed(parts["coefficients"].array(len(exponents), outputs))
    polynomials = [list(zip(exponents, column, strict=True)) for column in columns]
    model = Model(trapezoidal, polynomials, period, signals, box, len(x))
    degree, variables = max(map(sum, exponents)), _variables(model)
    refuse_if(
        comb(variables + degree, degree) > MAX_MONOMIALS,
        f"degree {degree} in {variables} variables is too large to decide",
        "too_large",
    )
    return model


def _variables(model: Model) -> int:
    """z, and of an implicit model w."""
    return model.states + model.states // 2 * model.trapezoidal


def _read_policy(node: Node, model: Model, made_for: str) -> tuple[Matrix, Matrix, list[Matrix]]:
    parts = node.document("policy", "law period L u x K", "sampled", made_for={"model": made_for})
    refuse_if(
        parts["period"].number() != model.period,
        "the policy has another sample time than the model",
    )
    n, p = model.states, len(model.signals) - model.states
    u = parts["u"].array(None, p)
    refuse_if(
        not 0 < len(u) * n**3 <= MAX_SAMPLES,
        f"a policy of {n} states should have 1 to {MAX_SAMPLES // n**3} steps",
        "too_large",
    )
    parts["L"].array(n, n)
    return parts["x"].array(len(u) + 1, n), u, parts["K"].array(len(u), p, n)


def _read_funnel(node: Node, model: Model, steps: int, digests: dict[str, str]) -> Funnel:
    names = "set assumption tube inlet half_widths S A" + " roots" * model.trapezoidal
    made_for = {role: digests[role] for role in ("model", "policy")}
    parts, n = node.document("funnel", names, "sampled", made_for=made_for), model.states
    radii = {chain: parts[chain].array(steps + 1) for chain in CHAINS}
    roots = parts["roots"].array(steps + 1) if model.trapezoidal else []
    refuse_if(
        min(radii["tube"] + radii["inlet"] + roots) <= 0 or radii["tube"][0] > radii["inlet"][0],
        "radii and roots should be positive, and the tube start in the inlet",
        "not_below",
    )
    S = [triangular(S, "S") for S in parts["S"].array(steps + 1, n, n)]
    A, widths = parts["A"].array(steps, n, n), parts["half_widths"].array(steps + 1, n)

    stated = parts["assumption"].members(f"form bound rate gain {PROVENANCE}")
    form = stated["form"].text()
    bound, rate, gain = (nonnegative(stated[key]) for key in ("bound", "rate", "gain"))
    refuse_if(
        form not in ("response", "peak") + ("energy", "fading") * (not model.trapezoidal),
        f"form {form!r} is not for this kind of model; use response or peak",
    )
    plain = (form != "fading" and rate != 1) or (form in ("response", "peak") and gain != 1)
    refuse_if(
        rate > 1 or gain < 1 or plain,
        f"rate {above(rate)} or gain {above(gain)} is none of form {form}",
        "not_below",
    )
    return Funnel(S, A, radii, widths, roots, form, bound, rate, gain)


def _sentence(model: Model, funnel: Funnel, steps: int) -> str:
    """What is proved, its numbers rounded outward."""
    tube, inlet = (funnel.radii[chain] for chain in CHAINS)
    wider = (inlet[-1] + funnel.widens) / (tube[-1] + funnel.widens)
    ends, goal = (
        ", ".join(
            signal.quantity(f"{signal.name} {above(width * factor)}")
            for signal, width in zip(model.signals, funnel.half_widths[-1], strict=False)
        )
        for factor in (1, wider)
    )
    return text.say(
        SENTENCE,
        tube=tube[0],
        bound=" + bound" if funnel.widens else "",
        samples=steps + 1,
        span=steps * model.period,
        ends=ends,
        inlet=inlet[0],
        goal=goal,
        box=ranges(model.signals, list(map(text.PRINTED["outer_range"], model.box))),
    )


def _assumptions(model: Model, funnel: Funnel) -> tuple[str, ...]:
    kept = text.say(KEPT[funnel.form], bound=funnel.bound, rate=funnel.rate, gain=funnel.gain)
    said = (text.say(DISTURBANCE, form=funnel.form, kept=kept), APPLIED)
    if not model.trapezoidal:
        return said
    return (*said, text.say(ROOTS, low=min(funnel.roots[1:]), high=max(funnel.roots[1:])))
