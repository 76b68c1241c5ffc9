"""Claim `tube`: outputs stay near the model's own simulation, or near a policy's plan.

The model runs twice under the same inputs: the simulation x, and the observer x̂ with L e injected
after each step, e the innovation. x̄ = x̂ - x, x̄⁺ = F ζ + L e, o = y - y° = H ζ + e, ζ = (ν, x̄), and
the inequality of `increments` has to hold, with the funnel's ρ, P, R,
    for G = [F L], Q = P: V = x̄'Px̄ grows by no more than the innovation's energy,
    for G = [H_j 1_j], Q = τ_j: V bounds output j.
Where a policy acts, F is F - κBK and H is H - κDK, κ in [0, 1], and its ends decide all between.
A level may follow the commands, E <= level g(k) at every sample, g(k) = Σ_i w_i G_i(k) with
    G(k) = fading G(k-1) + v(k)²,   G = 0 before the run,
v = (s - centre)/scale, or the change of s since the last sample over scale, s a product of inputs:
the theorem needs only that g >= 0, and whoever uses it that g is known from the commands up to k.
Why that is enough: docs/certificate_tube.md.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

from . import text
from .exact import Matrix, Rows, at_most, definite, unit
from .files import (
    Node,
    Read,
    Rejected,
    Table,
    bound_files,
    each,
    itself,
    limit,
    one_of,
    refuse_if,
    whole,
)
from .increments import Model, gap, positive
from .models import read_model
from .signals import Signal, apart, ranges

MAX_SAMPLES = 10**9
MAX_TUBES = 8  # of one funnel
MAX_PLAN = 10**6  # samples of a plan

MAX_TERMS = 200
MAX_FACTORS = 4
WORDS = ("E", "e", "g", "i", "x", "sum", "change")  # of a formula: names that are these are quoted
TERM: Table = {
    "inputs": lambda node: node.wholes(None),
    "of": one_of("value", "change"),
    "centre": (),
    "scale": (),
    "fading": (),
}

Term = dict[str, Any]  # one G, the members of TERM
CommandLevel = list[tuple[Fraction, Term]]  # its weights, not negative, some positive, and terms

Tube = dict[str, Any]  # the members of a tube in a funnel's file
Policy = dict[str, Any]  # the members of a policy's file

ASSUMPTION: Table = {  # what was measured is no part of the claim
    "kind": one_of("fading", "energy"),
    "samples?": whole(1, MAX_SAMPLES),
    **dict.fromkeys(("measured", "safety_factor", "designed_on", "measured_on"), itself),
}

SENTENCE = (
    "tube: the measured output stays near the model's simulation under the same inputs, {tubes}, "
    "{where}{plan}"
)
PLAN = (
    "; and as near the policy's plan, which is the simulation from its start under its inputs, for "
    "at most its {samples}, {how}"
)
PLAYED = "with those inputs played (no feedback)"
ENGAGED = (
    "whether those inputs are played, the policy is engaged around them, or anything between the "
    "two acts, such as the policy's input clipped to a range that holds the plan's, as {clipped} "
    "does"
)
START = "after {settling} samples ({span:up} s) the simulation starts at {whose}{inlet}{plan}"
INLET = ", or where V = xbar'P xbar <= {inlets}, xbar the observer's state minus its own"
INSIDE = (
    "the inputs, and the outputs and states of simulation and observer, stay in {ranges}; that any "
    "do is not stated"
)


def decide(claim: Node, proof: Node, read: Read) -> text.Verdict:
    """Decide {kind, about: {model, funnel}}, or with a policy beside them, by {multipliers}."""
    about = claim.members("kind about")["about"]
    planned = type(about.value) is dict and "policy" in about.value
    roles = "model policy funnel" if planned else "model funnel"
    documents, digests = bound_files(about, read, roles)
    made_for = {role: digests[role] for role in roles.split()[:-1]}
    table: Table = {"settling": whole(0, MAX_SAMPLES), "tubes": itself, "box?": itself}
    if not planned:
        table |= {"response?": itself, "cusum?": itself}
    funnel = documents["funnel"].document("funnel", table, "tube", made_for)
    model = read_model(documents["model"], funnel["box"])
    policy = _read_policy(documents["policy"], model, digests["model"]) if planned else None
    tubes = [_read_tube(node, model) for node in funnel["tubes"].items(1, MAX_TUBES)]

    given = proof.members("", "multipliers").get("multipliers")
    trees = [None] * len(tubes) if given is None else given.items(len(tubes), len(tubes))
    modes = _modes(model, policy)
    pairs = zip(tubes, trees, strict=True)
    margin = min(_decide_tube(tube, tree, modes, policy) for tube, tree in pairs)

    assumptions = [_start(model, policy, tubes, funnel["settling"])]
    if funnel["box"] is not None:
        assumptions.append(_inside(model, funnel["box"]))
    own = " of its own observer" if _several(tubes) else ""
    shown = []
    for i, tube in enumerate(tubes, 1):
        label = f"({i}) " if len(tubes) > 1 else ""
        shown.append(label + _shown(model, tube))
        assumptions.append(f"{label}innovation energy{own}: {_energy(model, tube)}")
    plan = _around_plan(model, policy)
    said = text.say(SENTENCE, tubes="; ".join(shown), where=model.where, plan=plan)
    return text.Verdict(said, margin, tuple(assumptions), digests)


def _decide_tube(
    tube: Tube, tree: Node | None, modes: Sequence[tuple[str, Model]], policy: Policy | None
) -> Fraction:
    """The part of the half-widths' squares that one tube leaves."""
    if policy:
        refuse_if(tube["L"] != policy["L"], "the observer of a tube is not the policy's")
        refuse_if(tube["follows"], "with a policy no level follows the commands")
    definite(tube["P"], "P")
    definite(tube["R"], "R")
    for mode, model in modes:
        positive(model, tree, _gaps(model, tube, mode))

    used = tube["level"] + tube["rho"] * tube["inlet"]
    shares: list[Fraction] = []
    for tau, width, signal in zip(tube["tau"], tube["half_widths"], modes[0][1].y, strict=True):
        shares.append(used / (tau * width**2))
        at_most(shares[-1], 1, f"{signal.name} can leave the stated half-width {text.above(width)}")
    return 1 - max(shares)


def _modes(model: Model, policy: Policy | None) -> list[tuple[str, Model]]:
    """The increments with the plan's inputs played, and with the policy engaged if it acts."""
    if policy is None or model.linear is None or not any(policy["K"][0]):
        return [("", model)]
    linear, (K,) = model.linear, policy["K"]
    F = [_minus(row, b, K) for row, b in zip(model.F, linear.B, strict=True)]
    engaged = replace(model, F=F, H=[_minus(row, linear.D, K) for row in model.H])
    return [(", the plan's inputs played,", model), (", the policy engaged,", engaged)]


def _minus(row: list[Fraction], gain: Fraction, K: list[Fraction]) -> list[Fraction]:
    return [entry - gain * k for entry, k in zip(row, K, strict=True)]


def _gaps(model: Model, tube: Tube, mode: str) -> list[tuple[str, Matrix]]:
    """The two inequalities of the module's docstring, without the multipliers."""

    def form(G: Rows, Q: Rows) -> Matrix:
        return gap(model, tube["rho"], tube["P"], tube["R"], G, Q)

    F, p = [row + gain for row, gain in zip(model.F, tube["L"], strict=True)], len(model.H)
    found = [(f"the decrease of V up to the innovation's energy{mode}", form(F, tube["P"]))]
    for j, (row, tau) in enumerate(zip(model.H, tube["tau"], strict=True)):
        what = f"the bound on {model.y[j].name} by V{mode}"
        found.append((what, form([row + unit(j, p)], [[tau]])))
    return found


def _read_tube(node: Node, model: Model) -> Tube:
    n, p = model.states, len(model.H)
    table: Table = {
        "rho": (),
        "L": (n, p),
        "P": (n, n),
        "R": (p, p),
        "tau": (p,),
        "half_widths": (p,),
        "level": (),
        "inlet": (),
        "assumption": lambda entry: entry.read(ASSUMPTION),
        "follows?": lambda entry: read_level(entry, len(model.u)),
        "peak?": itself,
    }
    tube = node.read(table)
    rho, energy = tube["rho"], tube["assumption"]["kind"] == "energy"
    ends = tube["assumption"]["samples"] is not None
    apart = not tube["follows"] or (rho < 1 and not tube["inlet"])
    node.require(
        {
            "energy is for a number of samples, fading for ever": energy == ends,
            "a level that follows the commands is for fading, without an inlet": apart,
        }
    )
    rated = 0 < rho <= 1 and energy == (rho == 1)
    node.require(
        {
            "rho should be 1 for energy, between 0 and 1 for fading": rated,
            "tau and half_widths should be positive": min(tube["tau"] + tube["half_widths"]) > 0,
            "inlet and level should be 0 or more": min(tube["inlet"], tube["level"]) >= 0,
        },
        "not_below",
    )
    return tube


def _read_policy(node: Node, model: Model, made_for: str) -> Policy:
    n, p, m = model.states, len(model.H), len(model.u)
    table: Table = {"period": (), "start": (n,), "u": (None, m), "K": (m, n), "L": (n, p)}
    policy = node.document("policy", table, "tube", {"model": made_for})
    node.require({"the period should be the model's": policy["period"] == model.period})
    limit(len(policy["u"]), MAX_PLAN, "samples of a plan", least=1)
    if model.linear is None:
        raise Rejected("a plan is decided for a model of kind difference_equation")
    low, high = model.linear.input_range
    inside = all(low <= entry <= high for row in policy["u"] for entry in row)
    node.require({"u should be in the model's input range": inside}, "not_valid")
    return policy


def _shown(model: Model, tube: Tube) -> str:
    """The half-widths of one tube, and for how long they hold."""
    root, samples = " sqrt(g)" if tube["follows"] else "", tube["assumption"]["samples"]
    widths = " and ".join(
        f"{signal.name} within {signal.quantity(text.above(width))}{root}"
        for signal, width in zip(model.y, tube["half_widths"], strict=True)
    )
    return f"{widths} for {_samples(model, samples) if samples else 'ever'}"


def _samples(model: Model, count: int) -> str:
    return f"{count} samples, which span {text.below((count - 1) * model.period)} s"


def _around_plan(model: Model, policy: Policy | None) -> str:
    """What is claimed of the plan beside what is claimed of every simulation."""
    if policy is None or model.linear is None:
        return ""
    how = PLAYED
    if any(policy["K"][0]):
        clipped = text.PRINTED["exact_range"](model.linear.input_range)
        how = text.say(ENGAGED, clipped=model.u[0].quantity(clipped))
    return text.say(PLAN, samples=_samples(model, len(policy["u"])), how=how)


def _several(tubes: list[Tube]) -> bool:
    """Whether the tubes have observers of their own."""
    return any(tube["L"] != tubes[0]["L"] for tube in tubes)


def _start(model: Model, policy: Policy | None, tubes: list[Tube], settling: int) -> str:
    whose, inlet = "the observer's state", ""
    if _several(tubes):
        whose = "one state with the observers, one for each tube"
    if any(tube["inlet"] for tube in tubes):
        inlet = text.say(INLET, inlets=" and ".join(text.below(tube["inlet"]) for tube in tubes))
    plan = ", as the plan does" if policy else ""
    span = settling * model.period
    return text.say(START, settling=settling, span=span, whose=whose, inlet=inlet, plan=plan)


def _inside(model: Model, box: Node) -> str:
    signals, ends = [*model.y, *apart(model.u, model.y)], box.members("y u")
    rows = ends["y"].array(len(model.y), 2) + ends["u"].array(len(model.u), 2)
    return text.say(INSIDE, ranges=ranges(signals, list(map(text.PRINTED["inner_range"], rows))))


def _energy(model: Model, tube: Tube) -> str:
    """The bound on the innovations' energy; of one output with R = 1 in its unit, squared."""
    unit_, energy, samples = "", "e'Re", tube["assumption"]["samples"]
    if len(model.y) == 1 and tube["R"] == [[1]]:
        unit_, energy = f"({model.y[0].unit})^2" if model.y[0].unit else "", "e^2"
    elif len(model.y) == 1:
        energy = f"{text.exact(tube['R'][0][0])} e^2"
    level = Signal("", unit_).quantity(text.below(tube["level"]))
    if samples:
        return f"sum of {energy} <= {level} over {samples} samples"
    growth = f"after every sample, E+ = {text.exact(tube['rho'])} E + {energy} from 0"
    if tube["follows"] is None:
        return f"E <= {level} {growth}"
    return f"E <= {level} g {growth}, g = {formula(tube['follows'], model.u)}"


def read_level(node: Node, inputs: int) -> CommandLevel:
    """{terms, weights} for a model with so many inputs."""
    given = node.read({"terms": each(_term, 1, MAX_TERMS), "weights": (1, None)})
    (weights,), terms = given["weights"], given["terms"]
    known = all(0 <= i < inputs for term in terms for i in term["inputs"])
    one = len(weights) == len(terms)
    node.require({"one weight for each term": one, "inputs should be the model's": known})
    fits = min(weights) >= 0 and sum(weights)
    node.require({"weights should be 0 or more, some positive": fits}, "not_below")
    return list(zip(weights, terms, strict=True))


def _term(node: Node) -> Term:
    given = node.read(TERM)
    node.require({f"at most {MAX_FACTORS} inputs": len(given["inputs"]) <= MAX_FACTORS})
    fits = given["scale"] > 0 and 0 <= given["fading"] < 1
    node.require({"scale should be above 0, fading in [0, 1)": fits}, "not_below")
    return given


def formula(level: CommandLevel, u: tuple[Signal, ...]) -> str:
    """g as a sum, every number exact."""
    summands, past = [], ""
    for weight, term in level:
        if not weight:
            continue
        square = _square(term, u)
        if term["fading"]:
            square = f"(sum {text.exact(term['fading'])}^i {square or '1'})"
            past = ", sums over the run's samples, each i samples ago"
        summands.append(f"{text.exact(weight)} {square}".rstrip())
    return " + ".join(summands) + past


def _square(term: Term, u: tuple[Signal, ...]) -> str:
    """v² in words; empty where it is 1."""
    changes, centre, scale = term["of"] == "change", term["centre"], term["scale"]
    if not (term["inputs"] or changes or centre) and scale == 1:
        return ""
    used = [u[i] for i in term["inputs"]]
    product = " x ".join(_plain(signal.name, "()+*^/-") for signal in used) or "1"
    unit = Signal("", " ".join(_plain(signal.unit, "()+*^") for signal in used if signal.unit))
    if changes:
        product = f"change of {product}"
    elif centre:
        product = f"({product} - {unit.quantity(text.exact(centre))})"
    return f"({product} / {unit.quantity(text.exact(scale))})^2"


def _plain(word: str, operators: str) -> str:
    """A name or unit in a formula: quoted if it could be read as a part of it."""
    own = not word.startswith('"') and (word in WORDS or any(sign in operators for sign in word))
    return json.dumps(word) if own else word
