"""Claim `sampled_funnel`: a tube and an inlet around a motion of an identified model hold.

With x̄ = xhat - x_k and d_k the observer's correction, x̄⁺ = f̄_k(x̄) + d_k exactly. Sizes are |S_k x̄|.
The disturbance keeps |S_k r_k| <= bound, where r_{k+1} = A_k r_k + d_k from r_0 = 0.
For both chains of radii, the tube and the inlet, and at each step: `positive` proves that
|ξ| <= radius implies |f̄_k(ξ)| <= reach; and the reach, with what |r| <= bound adds to it, is within
the next radius. Coordinates are stated: x̄ = T z.
Why that is enough: docs/certificate_sampled_funnel.md.
"""

from fractions import Fraction
from math import comb
from typing import Any

from . import text
from .exact import at_most, identity, inverse_forms, product, transposed
from .files import Members, Node, Read, Table, bound_files, limit, one_of, refuse_if
from .polynomials import Polynomial, Ring, at_width
from .positivity import positive, read_squares
from .sampled_step import Sample, nonnegative, read_step, stretch, triangular
from .signals import apart, ranges, signals

CHAINS = ("tube", "inlet")
MAX_SAMPLES = 10**6  # times the cube of the states
MAX_SIGNALS = 16
MAX_MONOMIALS = 1000  # of all degrees up to the model's, in one step's variables
LEFT = ("peak", "energy", "fading")  # forms of the assumption that are not decided any more
LEFT_MODELS = ("trapezoidal",)

SENTENCE = (
    "funnel: a state estimate that starts with |S[0] (xhat - x[0])| <= {tube:down}, such as xhat = "
    "x[0], stays in the tube, |S[k] (xhat - x[k])| <= tube[k] + bound, at all {samples} samples "
    "over {span:down} s and ends within {ends} of the nominal; one that starts with "
    "|S[0] (xhat - x[0])| <= {inlet:down} ends within {goal} of it; at the samples both stay in "
    "the box of the model's data, {box}"
)
DISTURBANCE = (
    "disturbance response |S r| <= {bound:down}, r+ = A r + d from r = 0, at every sample, "
    "d = xhat+ - f(xhat, u)"
)
APPLIED = "the input applied at every sample is the policy's, u[k] - K[k] (xhat - x[k])"


def decide(claim: Node, proof: Node, read: Read) -> text.Verdict:
    """Decide {kind, about: {model, policy, funnel}} by {basis, ball_basis, ..., steps}."""
    about = claim.members("kind about")["about"]
    documents, digests = bound_files(about, read, "model policy funnel")
    model = _read_model(documents["model"])
    policy = _read_policy(documents["policy"], model, digests["model"])
    x, u, K = policy["x"], policy["u"], policy["K"]
    funnel = _read_funnel(documents["funnel"], model, len(u), digests)
    S, A = funnel["S"], funnel["A"]
    for k, (point, inputs, gain) in enumerate(zip(x, [*u, []], [*K, []], strict=True)):
        _prove_box(model, funnel, k, [*point, *inputs], gain)
    bases = proof.members("basis ball_basis steps")
    steps, rooms = bases["steps"].items(len(u), len(u)), []

    def prove(ring: Ring, k: int) -> None:
        at = Sample(x=x[k], u=u[k], K=K[k], S=S[k], A=A[k], x_next=x[k + 1], S_next=S[k + 1])
        step = read_step(steps[k], model, at, ring)
        rooms.extend([_prove_chain(step, bases, funnel, chain, k) for chain in CHAINS])

    at_width(len(model["x"]), range(len(u)), prove)
    assumptions = text.say(DISTURBANCE, bound=funnel["bound"]), APPLIED
    return text.Verdict(_sentence(model, funnel, len(u)), min(rooms), assumptions, digests)


def _prove_chain(
    step: Members, bases: dict[str, Node], funnel: Members, chain: str, k: int
) -> Fraction:
    """Prove one step of one chain; the part of the next radius that it leaves free."""
    ring, what = step["size"].ring, f"{chain}, step {k}"
    stated = step[chain].members("reach columns squares ball")
    reach, (radius, following) = nonnegative(stated["reach"]), funnel[chain][k : k + 2]
    z, r = step["kappa"] * radius, step["kappa"] * funnel["bound"]
    added = stretch(step["curvature"], z, r) * r
    shown = text.above(reach), text.above(added)
    exceeds = f"{what}: reach {shown[0]} and disturbance {shown[1]} exceed the next radius"
    at_most(reach + added, following, exceeds)
    squares = read_squares(stated | {"basis": bases["basis"]}, ring)
    parts = [reach**2 - ring.dot(step["rows"], step["rows"])]
    parts.append(_ball(stated["ball"], bases["ball_basis"], radius, step["size"]))
    positive(ring.sum(parts), squares, ring, f"{what}: reach", strict=False)
    return Fraction((following - reach - added) / following)


def _ball(node: Node, basis: Node, radius: Fraction, size: Polynomial) -> Polynomial:
    """-σ (radius² - size), σ a sum of squares: not positive where size <= radius²."""
    stated = node.members("columns squares") | {"basis": basis}
    sigma: Polynomial = read_squares(stated, size.ring).form
    return sigma * (size - radius**2)


def _prove_box(
    model: Members, funnel: Members, k: int, centres: list[Fraction], K: list[Any]
) -> None:
    """At sample k both chains stay in the box of the data, inputs included; and the half-widths.

    |g'x̄| <= room where |S x̄| <= radius if radius² g'(S'S)⁻¹g <= room².
    """
    S, n = funnel["S"][k], len(model["x"])
    tube, inlet = (funnel[chain][k] + funnel["bound"] for chain in CHAINS)
    forms = inverse_forms(product(transposed(S), S), identity(n) + K, "S'S")
    rooms = [(tube, width, "its stated half-width") for width in funnel["half_widths"][k]]
    for centre, (low, high) in zip(centres, model["box"], strict=False):
        rooms.append((max(tube, inlet), min(high - centre, centre - low), "the box of the data"))
    entries = [*range(n), *range(len(forms))]
    for i, (radius, room, kept) in zip(entries, rooms, strict=True):
        leaves = room < 0 or radius**2 * forms[i] > room**2
        refuse_if(leaves, f"sample {k}: {model['named'][i].name} can leave {kept}", "not_valid")


def _read_model(node: Node) -> Members:
    """The members of a model; its map; the box and names of all signals; variables of a step."""
    table: Table = {
        **dict.fromkeys(("equation", "noise", "disturbance", "bags")),
        "period": (),
        "x": signals("states", 1, MAX_SIGNALS),
        "u": signals("inputs", 1, MAX_SIGNALS),
        **dict.fromkeys(("exponents", "coefficients", "x_range", "u_range")),
    }
    given = node.document("model", table, "state_map", former=LEFT_MODELS)
    x, u = given["x"], given["u"]
    box = given["x_range"].array(len(x), 2) + given["u_range"].array(len(u), 2)
    exponents = given["exponents"].monomials(len(box))
    node.require(
        {
            "the period should be positive": given["period"] > 0,
            "there should be monomials": exponents,
        }
    )
    columns = given["coefficients"].array(len(exponents), len(x))
    polynomials = [list(zip(exponents, column, strict=True)) for column in transposed(columns)]
    degree = max(map(sum, exponents))
    limit(comb(len(x) + degree, degree), MAX_MONOMIALS, f"monomials of degree {degree}")
    return {**given, "map": polynomials, "box": box, "named": [*x, *apart(u, x)]}


def _read_policy(node: Node, model: Members, made_for: str) -> Members:
    n, p = len(model["x"]), len(model["u"])
    table: Table = {
        "law": None,
        "period": (),
        "L": (n, n),
        "u": (None, p),
        "x": (None, n),
        "K": (None, p, n),
    }
    policy = node.document("policy", table, "sampled", {"model": made_for})
    steps = limit(len(policy["u"]), MAX_SAMPLES // n**3, f"steps of {n} states", least=1)
    node.require(
        {
            "the period should be the model's": policy["period"] == model["period"],
            "there should be a sample more than steps": len(policy["x"]) == steps + 1,
            "there should be one K a step": len(policy["K"]) == steps,
        }
    )
    return policy


def _read_funnel(node: Node, model: Members, steps: int, digests: dict[str, str]) -> Members:
    """The members of a funnel, and the bound of its assumption."""
    n, samples = len(model["x"]), (steps + 1,)
    assumed: Table = {  # what was measured is no part of the claim
        "form": one_of("response", former=LEFT),
        "bound": nonnegative,
        "rate": (),
        "gain": (),
        **dict.fromkeys(("measured", "safety_factor", "measured_on")),
    }
    table: Table = {
        "set": None,
        "assumption": lambda entry: entry.read(assumed),
        **dict.fromkeys(CHAINS, samples),
        "half_widths": (*samples, n),
        "S": (*samples, n, n),
        "A": (steps, n, n),
    }
    made_for = {role: digests[role] for role in ("model", "policy")}
    given = node.document("funnel", table, "sampled", made_for)
    assumption = given["assumption"]
    fits = assumption["rate"] == assumption["gain"] == 1
    node.require({"rate and gain should be 1": fits}, "not_below")
    funnel = {**given, "bound": assumption["bound"]}
    starts = funnel["tube"][0] <= funnel["inlet"][0]
    positive_radii = min(funnel["tube"] + funnel["inlet"]) > 0
    wanted = "radii should be positive, and the tube start in the inlet"
    node.require({wanted: positive_radii and starts}, "not_below")
    for S in funnel["S"]:
        triangular(S, node)
    return funnel


def _sentence(model: Members, funnel: Members, steps: int) -> str:
    """What is proved, its numbers rounded outward."""
    tube, inlet = (funnel[chain] for chain in CHAINS)
    wider = (inlet[-1] + funnel["bound"]) / (tube[-1] + funnel["bound"])
    ends, goal = (
        ", ".join(
            signal.quantity(f"{signal.name} {text.above(width * factor)}")
            for signal, width in zip(model["x"], funnel["half_widths"][-1], strict=True)
        )
        for factor in (1, wider)
    )
    return text.say(
        SENTENCE,
        tube=tube[0],
        samples=steps + 1,
        span=steps * model["period"],
        ends=ends,
        inlet=inlet[0],
        goal=goal,
        box=ranges(model["named"], list(map(text.PRINTED["outer_range"], model["box"]))),
    )
