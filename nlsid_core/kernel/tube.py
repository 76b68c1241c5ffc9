"""Claim `tube`: outputs stay near the model's own simulation, or near a policy's plan.

The model runs twice under the same inputs: the simulation x, and the observer x̂ with L e injected
after each step, e the innovation. Of x̄ = x̂ - x, x̄⁺ = F ζ + L e, o = y - y° = H ζ + e, ζ = (ν, x̄),
the inequality of `increments` has to hold, with the funnel's ρ, P, R,
    for G = [F L], Q = P: V = x̄'Px̄ grows by no more than the innovation's energy,
    for G = [H_j (1 - c_j) 1_j], Q = τ_j: V bounds what output j has beside the part c_j of e_j that
    reaches it directly; |e_j| <= peak_j bounds that one. c_j = 0 if nothing is stated.
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
from math import prod

from . import text
from .exact import Matrix, at_most, combined, definite, unit
from .files import Members, Node, Read, Table, bound_files, each, limit, one_of, refuse_if, whole
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
    **dict.fromkeys(("centre", "scale", "fading"), ()),
}
ASSUMPTION: Table = {  # what was measured is no part of the claim
    "kind": one_of("fading", "energy"),
    "samples?": whole(1, MAX_SAMPLES),
    **dict.fromkeys(("measured", "rank?", "safety_factor", "designed_on", "measured_on")),
}
CommandLevel = list[tuple[Fraction, Members]]  # weights, not negative, some positive; and terms G

SENTENCE = (
    "tube: the measured {names} within {widths} of what the model predicts from the inputs alone, "
    "{where}, for {lasting}, as long as its assumptions hold{remarks}{others}{plan}"
)
ALSO = "; also within {widths} for {lasting}{remarks}"
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
SUM = "sum of {energy} <= {level} over {samples} samples"
FADING = "E <= {level}{g} after every sample, E+ = {rho:exact} E + {energy} from 0{sum}"
PEAK = "; the innovation of {name} at most {peak} in size at every sample"
NEARLY = "nearly what was measured, carried to every command"
LITTLE = Fraction(1, 5)  # of a half-width, below which this is said
PAST = ", sums over the run's samples, each i samples ago"
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
    table: Table = {"settling": whole(0, MAX_SAMPLES), "tubes": None, "box?": None}
    if not planned:
        table |= {"response?": None, "cusum?": None, "commands?": None}
    funnel = documents["funnel"].document("funnel", table, "tube", made_for)
    model = read_model(documents["model"], funnel["box"])
    policy = _read_policy(documents["policy"], model, digests["model"]) if planned else None
    tubes = [_read_tube(node, model, policy) for node in funnel["tubes"].items(1, MAX_TUBES)]

    given = proof.read({"multipliers?": None})["multipliers"]
    trees = given.items(len(tubes), len(tubes)) if given else [None] * len(tubes)
    modes = _modes(model, policy)
    margin = min(_decide_tube(*pair, modes) for pair in zip(tubes, trees, strict=True))

    several = any(tube["L"] != tubes[0]["L"] for tube in tubes)
    assumptions = [_start(model, policy, tubes, funnel["settling"], several)]
    if funnel["box"] is not None:
        assumptions.append(_inside(model, funnel["box"]))
    own = " of its own observer" if several else ""
    shown: list[Members] = []
    for i, tube in enumerate(tubes, 1):
        label = f"tube {i}" if len(tubes) > 1 else ""
        lasts, size = tube["assumption"]["samples"] or 0, prod(tube["half_widths"])
        plainness = (bool(tube["follows"]), lasts, size, i)
        shown.append({**_shown(model, tube, label), "plainness": plainness})
        which = f"{label}: " if label else ""
        assumptions.append(f"{which}innovation energy{own}: {_energy(model, tube)}")
    first, *others = sorted(shown, key=lambda words: words["plainness"])
    stay = " stays" if len(model.y) == 1 else " stay"
    said = text.say(
        SENTENCE,
        names=" and ".join(signal.name for signal in model.y) + stay,
        **first,
        where=model.where,
        others="".join(text.say(ALSO, **other) for other in others),
        plan=_around_plan(model, policy) if policy else "",
    )
    return text.Verdict(said, margin, tuple(assumptions), digests)


def _decide_tube(tube: Members, tree: Node | None, modes: Sequence[tuple[str, Model]]) -> Fraction:
    """The part of the half-widths' squares that one tube leaves."""
    definite(tube["P"], "P")
    definite(tube["R"], "R")
    for mode, model in modes:
        positive(model, tree, _gaps(model, tube, mode))
    used, shares = tube["level"] + tube["rho"] * tube["inlet"], []
    rows = zip(tube["tau"], tube["half_widths"], tube["direct"], modes[0][1].y, strict=True)
    for tau, width, (part, peak), signal in rows:
        away = f"{signal.name} can leave the stated half-width {text.above(width)}"
        refuse_if(part * peak >= width, away, "not_below")
        shares.append(Fraction(used / (tau * (width - part * peak) ** 2)))
        at_most(shares[-1], 1, away)
    return 1 - max(shares)


def _modes(model: Model, policy: Members | None) -> list[tuple[str, Model]]:
    """The increments with the plan's inputs played, and with the policy engaged if it acts."""
    linear = model.linear
    if policy is None or linear is None or not any(policy["K"][0]):
        return [("", model)]
    BK, DK = ([[b * k for k in policy["K"][0]] for b in rows] for rows in (linear.B, [linear.D]))
    engaged = replace(model, F=combined(model.F, BK, -1), H=combined(model.H, DK, -1))
    return [(", the plan's inputs played,", model), (", the policy engaged,", engaged)]


def _gaps(model: Model, tube: Members, mode: str) -> list[tuple[str, Matrix]]:
    """The two inequalities of the module's docstring, without the multipliers."""
    rho, P, R, p = tube["rho"], tube["P"], tube["R"], len(model.H)
    F = [row + gain for row, gain in zip(model.F, tube["L"], strict=True)]
    what = f"the decrease of V up to the innovation's energy{mode}"
    found = [(what, gap(model, rho, P, R, F, P))]
    for j, (row, tau, (part, _)) in enumerate(
        zip(model.H, tube["tau"], tube["direct"], strict=True)
    ):
        what = f"the bound on {model.y[j].name} by V{mode}"
        beside = [(1 - part) * entry for entry in unit(j, p)]
        found.append((what, gap(model, rho, P, R, [row + beside], [[tau]])))
    return found


def _read_tube(node: Node, model: Model, policy: Members | None) -> Members:
    n, p = model.states, len(model.H)
    table: Table = {
        **dict.fromkeys(("rho", "level", "inlet"), ()),
        "L": (n, p),
        "P": (n, n),
        "R": (p, p),
        **dict.fromkeys(("tau", "half_widths"), (p,)),
        "assumption": lambda entry: entry.read(ASSUMPTION),
        "follows?": lambda entry: read_level(entry, len(model.u)),
        "direct?": (p,),
        "peak?": None,  # alone it is no part of the claim
    }
    tube = node.read(table)
    direct = tube["direct"] or [Fraction(0)] * p
    peaks = direct
    if tube["direct"]:
        node.require({"what is direct needs a peak": tube["peak"]})
        peaks = tube["peak"].read({"at_most": (p,), "measured": None})["at_most"]
    tube["direct"] = list(zip(direct, peaks, strict=True))
    rho, energy = tube["rho"], tube["assumption"]["kind"] == "energy"
    ends = tube["assumption"]["samples"] is not None
    free = not tube["follows"] or (rho < 1 and not tube["inlet"])
    node.require(
        {
            "energy is for a number of samples, fading for ever": energy == ends,
            "a level that follows the commands is for fading, without an inlet": free,
            "the observer should be the policy's": policy is None or tube["L"] == policy["L"],
            "with a policy no level follows the commands": not (policy and tube["follows"]),
            "with a policy, or a level that follows commands, nothing is direct": not (
                any(direct) and (policy or tube["follows"])
            ),
        }
    )
    node.require(
        {
            "rho should be above 0, and 1 for energy, below 1 for fading": 0 < rho <= 1
            and energy == (rho == 1),
            "tau and half_widths should be positive": min(tube["tau"] + tube["half_widths"]) > 0,
            "inlet and level should be 0 or more": min(tube["inlet"], tube["level"]) >= 0,
            "peaks should be 0 or more, direct at most 1": min(direct + peaks) >= 0
            and max(direct) <= 1,
        },
        "not_below",
    )
    return tube


def _read_policy(node: Node, model: Model, made_for: str) -> Members:
    n, p, m, linear = model.states, len(model.H), len(model.u), model.linear
    table: Table = {"period": (), "start": (n,), "u": (None, m), "K": (m, n), "L": (n, p)}
    policy = node.document("policy", table, "tube", {"model": made_for})
    node.require({"the period should be the model's": policy["period"] == model.period})
    limit(len(policy["u"]), MAX_PLAN, "samples of a plan", least=1)
    node.require({"a plan is decided for a model of kind difference_equation": linear})
    low, high = linear.input_range if linear else (0, 0)
    inside = all(low <= entry <= high for row in policy["u"] for entry in row)
    node.require({"u should be in the model's input range": inside}, "not_valid")
    return policy


def _shown(model: Model, tube: Members, label: str) -> dict[str, str]:
    """The half-widths of one tube, for how long they hold, and how much of them is inferred."""
    root, samples = " sqrt(g)" if tube["follows"] else "", tube["assumption"]["samples"]
    rows = list(zip(model.y, tube["half_widths"], tube["direct"], strict=True))
    remarks = [label] if label else []
    if any(part for _, _, (part, _) in rows):
        shares = [1 - part * peak / width for _, width, (part, peak) in rows]
        named = zip(model.y, shares, strict=True)
        shown = " and ".join(f"{signal.name} {text.below(share, 2)}" for signal, share in named)
        remarks.append(f"inferred share {shown}")
        if max(shares) < LITTLE:
            remarks.append(NEARLY)
    return {
        "widths": " and ".join(s.quantity(text.above(width)) + root for s, width, _ in rows),
        "lasting": _samples(model, samples) if samples else "ever",
        "remarks": f" ({', '.join(remarks)})" if remarks else "",
    }


def _samples(model: Model, count: int) -> str:
    return f"{count} samples, which span {text.below((count - 1) * model.period)} s"


def _around_plan(model: Model, policy: Members) -> str:
    """What is claimed of the plan beside what is claimed of every simulation."""
    how = PLAYED
    if model.linear and any(policy["K"][0]):
        clipped = text.PRINTED["exact_range"](model.linear.input_range)
        how = text.say(ENGAGED, clipped=model.u[0].quantity(clipped))
    return text.say(PLAN, samples=_samples(model, len(policy["u"])), how=how)


def _start(
    model: Model, policy: Members | None, tubes: list[Members], settling: int, several: bool
) -> str:
    own = "one state with the observers, one for each tube"
    inlets = " and ".join(text.below(tube["inlet"]) for tube in tubes)
    return text.say(
        START,
        settling=settling,
        span=settling * model.period,
        whose=own if several else "the observer's state",
        inlet=text.say(INLET, inlets=inlets) if any(tube["inlet"] for tube in tubes) else "",
        plan=", as the plan does" if policy else "",
    )


def _inside(model: Model, box: Node) -> str:
    ends = box.read({"y": (len(model.y), 2), "u": (len(model.u), 2)})
    shown = list(map(text.PRINTED["inner_range"], ends["y"] + ends["u"]))
    return text.say(INSIDE, ranges=ranges([*model.y, *apart(model.u, model.y)], shown))


def _energy(model: Model, tube: Members) -> str:
    """The bound on the innovations' energy; of one output with R = 1 in its unit, squared."""
    samples, follows, R = tube["assumption"]["samples"], tube["follows"], tube["R"]
    energy, squared = "e'Re", ""
    if len(model.y) == 1:
        energy = "e^2" if R == [[1]] else f"{text.exact(R[0][0])} e^2"
        squared = f"({model.y[0].unit})^2" if R == [[1]] and model.y[0].unit else ""
    said = text.say(
        SUM if samples else FADING,
        energy=energy,
        level=Signal("", squared).quantity(text.below(tube["level"])),
        samples=samples,
        rho=tube["rho"],
        g=" g" if follows else "",
        sum=f", g = {formula(follows, apart(model.u, model.y))}" if follows else "",
    )
    peaks = (
        text.say(PEAK, name=signal.name, peak=signal.quantity(text.below(peak)))
        for signal, (part, peak) in zip(model.y, tube["direct"], strict=True)
        if part
    )
    return said + "".join(peaks)


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


def _term(node: Node) -> Members:
    given = node.read(TERM)
    node.require({f"at most {MAX_FACTORS} inputs": len(given["inputs"]) <= MAX_FACTORS})
    fits = given["scale"] > 0 and 0 <= given["fading"] < 1
    node.require({"scale should be above 0, fading in [0, 1)": fits}, "not_below")
    return given


def formula(level: CommandLevel, u: Sequence[Signal]) -> str:
    """g as a sum, every number exact."""
    used = [(weight, term) for weight, term in level if weight]
    past = PAST if any(term["fading"] for _, term in used) else ""
    shown = (f"{text.exact(weight)} {_summand(term, u)}".rstrip() for weight, term in used)
    return " + ".join(shown) + past


def _summand(term: Members, u: Sequence[Signal]) -> str:
    """G in words; empty where it is 1."""
    used = [u[i] for i in term["inputs"]]
    product = " x ".join(_plain(signal.name, "()+*^/-") for signal in used) or "1"
    unit = Signal("", " ".join(_plain(signal.unit, "()+*^") for signal in used if signal.unit))
    centre, scale = (unit.quantity(text.exact(term[name])) for name in ("centre", "scale"))
    if term["of"] == "change":
        product = f"change of ({product})" if len(used) > 1 else f"change of {product}"
    elif term["centre"]:
        product = f"({product} - {centre})"
    square = "" if product == scale == "1" else f"({product} / {scale})^2"
    return f"(sum {text.exact(term['fading'])}^i {square or '1'})" if term["fading"] else square


def _plain(word: str, operators: str) -> str:
    """A name or unit in a formula: quoted if it could be read as a part of it."""
    own = not word.startswith('"') and (word in WORDS or any(sign in operators for sign in word))
    return json.dumps(word) if own else word
