"""Claim `tube`: outputs stay near the model's own simulation, or near a policy's plan.

The model runs twice under the same inputs: the simulation x, and the observer x̂ with L e injected
after each step, e the innovation. x̄ = x̂ - x, x̄⁺ = F ζ + L e, o = y - y° = H ζ + e, ζ = (ν, x̄), and
the inequality of `increments` has to hold, with the funnel's ρ, P, R,
    for G = [F L], Q = P: V = x̄'Px̄ grows by no more than the innovation's energy,
    for G = [H_j 1_j], Q = τ_j: V bounds output j.
Where a policy acts, F is F - κBK and H is H - κDK, κ in [0, 1], and its ends decide all between.
Why that is enough: docs/certificate_tube.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

from . import text
from .decision import Decision
from .exact import Matrix, Rows, at_most, definite, unit
from .files import Node, Read, Rejected, bound_files, refuse_if
from .increments import Model, gap, positive
from .levels import CommandLevel, formula, read_level
from .models import read_model
from .signals import Signal, apart, ranges

MAX_SAMPLES = 10**9
MAX_TUBES = 8  # of one funnel
MAX_PLAN = 10**6  # samples of a plan
PROVENANCE = "measured safety_factor designed_on measured_on"  # of a level; no part of the claim

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


@dataclass(frozen=True)
class Assumption:
    """E <= level g. samples: None is for ever, else an energy's (ρ = 1). follows: g; None: 1."""

    level: Fraction
    samples: int | None
    follows: CommandLevel | None


@dataclass(frozen=True)
class Tube:
    """One tube of a funnel file; n states, p outputs.

    L: (n, p), P: (n, n), R: (p, p), tau, half_widths: (p,).
    """

    rho: Fraction
    L: Matrix
    P: Matrix
    R: Matrix
    tau: list[Fraction]
    half_widths: list[Fraction]
    inlet: Fraction
    assumed: Assumption


@dataclass(frozen=True)
class Policy:
    """What the claim needs of a policy file: K (1, n), L (n, p), and the samples of its plan."""

    K: Matrix
    L: Matrix
    samples: int


def decide(claim: Node, proof: Node, read: Read) -> Decision:
    """Decide {kind, about: {model, funnel}}, or with a policy beside them, by {multipliers}."""
    about = claim.members("kind about")["about"]
    planned = type(about.value) is dict and "policy" in about.value
    roles = "model policy funnel" if planned else "model funnel"
    documents, digests = bound_files(about, read, roles)
    made_for = {role: digests[role] for role in roles.split()[:-1]}
    beside = "box" if planned else "box response cusum"
    funnel = documents["funnel"].document(
        "funnel", "settling tubes", "tube", optional=beside, made_for=made_for
    )
    model = read_model(documents["model"], funnel.get("box"))
    policy = _read_policy(documents["policy"], model, digests["model"]) if planned else None
    tubes = [_read(node, model) for node in funnel["tubes"].items(1, MAX_TUBES)]
    settling = funnel["settling"].whole(0, MAX_SAMPLES)

    given = proof.members("", "multipliers").get("multipliers")
    trees: Sequence[Node | None] = [None] * len(tubes)
    if given is not None:
        trees = given.items(len(tubes), len(tubes))
    modes = _modes(model, policy)
    margin = min(_decide_tube(*pair, modes, policy) for pair in zip(tubes, trees, strict=True))

    assumptions = [_start(model, policy, tubes, settling)]
    if "box" in funnel:
        assumptions.append(_inside(model, funnel["box"]))
    whose = " of its own observer" if _several(tubes) else ""
    for label, tube in zip(_labels(tubes), tubes, strict=True):
        assumptions.append(f"{label}innovation energy{whose}: {_energy(model, tube)}")
    shown = (label + _shown(model, tube) for label, tube in zip(_labels(tubes), tubes, strict=True))
    plan = _around_plan(model, policy)
    said = text.say(SENTENCE, tubes="; ".join(shown), where=model.where, plan=plan)
    return Decision(said, margin, tuple(assumptions), digests)


def _decide_tube(
    tube: Tube, tree: Node | None, modes: Sequence[tuple[str, Model]], policy: Policy | None
) -> Fraction:
    """The part of the half-widths' squares that one tube leaves."""
    refuse_if(
        policy and tube.L != policy.L, "the observer of a tube is not the policy's: L is another"
    )
    refuse_if(
        policy and tube.assumed.follows,
        "a level that follows the commands is for a tube without a policy",
    )
    definite(tube.P, "P")
    definite(tube.R, "R")
    for mode, model in modes:
        positive(model, tree, _gaps(model, tube, mode))

    margin = Fraction(1)
    for tau, width, signal in zip(tube.tau, tube.half_widths, modes[0][1].y, strict=True):
        used = (tube.assumed.level + tube.rho * tube.inlet) / (tau * width**2)
        at_most(used, 1, f"{signal.name} can leave the stated half-width {text.above(width)}")
        margin = min(margin, 1 - used)
    return margin


def _modes(model: Model, policy: Policy | None) -> list[tuple[str, Model]]:
    """The increments with the plan's inputs played, and with the policy engaged if it acts."""
    if policy is None or model.linear is None or not any(policy.K[0]):
        return [("", model)]
    linear, (K,) = model.linear, policy.K
    F = [_minus(row, b, K) for row, b in zip(model.F, linear.B, strict=True)]
    engaged = replace(model, F=F, H=[_minus(row, linear.D, K) for row in model.H])
    return [(", the plan's inputs played,", model), (", the policy engaged,", engaged)]


def _minus(row: list[Fraction], gain: Fraction, K: list[Fraction]) -> list[Fraction]:
    return [entry - gain * k for entry, k in zip(row, K, strict=True)]


def _gaps(model: Model, tube: Tube, mode: str) -> list[tuple[str, Matrix]]:
    """The two inequalities of the module's docstring, without the multipliers."""

    def form(G: Rows, Q: Rows) -> Matrix:
        return gap(model, tube.rho, tube.P, tube.R, G, Q)

    F, p = [row + gain for row, gain in zip(model.F, tube.L, strict=True)], len(model.H)
    found = [(f"the decrease of V up to the innovation's energy{mode}", form(F, tube.P))]
    for j, (row, tau) in enumerate(zip(model.H, tube.tau, strict=True)):
        what = f"the bound on {model.y[j].name} by V{mode}"
        found.append((what, form([row + unit(j, p)], [[tau]])))
    return found


def _read(node: Node, model: Model) -> Tube:
    n, p = model.states, len(model.H)
    parts = node.members("rho L P R tau half_widths level inlet assumption", "follows peak")
    rho = parts["rho"].number()
    tube = Tube(
        rho,
        parts["L"].array(n, p),
        parts["P"].array(n, n),
        parts["R"].array(p, p),
        parts["tau"].array(p),
        parts["half_widths"].array(p),
        parts["inlet"].number(),
        _read_assumption(parts, rho, len(model.u)),
    )
    refuse_if(
        min(tube.tau) <= 0 or min(tube.half_widths) <= 0,
        "tau and half-widths should be positive",
        "not_below",
    )
    refuse_if(
        min(tube.inlet, tube.assumed.level) < 0, "level and inlet should be 0 or more", "not_below"
    )
    refuse_if(
        tube.assumed.follows is not None and (rho == 1 or tube.inlet),
        "a level that follows the commands is for fading, without an inlet",
    )
    return tube


def _read_assumption(parts: dict[str, Node], rho: Fraction, inputs: int) -> Assumption:
    """The level of a tube's members, and what it bounds."""
    given = parts["assumption"].members(f"kind {PROVENANCE}", "samples")
    kind = given["kind"].text()
    refuse_if(
        kind not in ("fading", "energy"), f"assumption {kind!r} is unknown; known: fading, energy"
    )
    refuse_if(
        (kind == "energy") != ("samples" in given),
        "the assumption energy is for a number of samples, fading for ever",
    )
    refuse_if(
        not 0 < rho <= 1 or (kind == "energy") != (rho == 1),
        "rho should be 1 for the assumption energy, between 0 and 1 for fading",
        "not_below",
    )
    samples = given["samples"].whole(1, MAX_SAMPLES) if "samples" in given else None
    follows = read_level(parts["follows"], inputs) if "follows" in parts else None
    return Assumption(parts["level"].number(), samples, follows)


def _read_policy(node: Node, model: Model, made_for: str) -> Policy:
    n, p = model.states, len(model.H)
    plan = node.document("policy", "period start u K L", "tube", made_for={"model": made_for})
    refuse_if(plan["period"].number() != model.period, "the policy's period is not the model's")
    plan["start"].array(n)
    u = plan["u"].array(None, len(model.u))
    refuse_if(
        not 0 < len(u) <= MAX_PLAN, f"a plan should have 1 to {MAX_PLAN} samples", "too_large"
    )
    if model.linear is None:
        raise Rejected("a plan is decided for a model of kind difference_equation")
    low, high = model.linear.input_range
    refuse_if(
        any(not low <= entry <= high for row in u for entry in row),
        "a planned input is outside the model's input range",
        "not_valid",
    )
    return Policy(plan["K"].array(len(model.u), n), plan["L"].array(n, p), len(u))


def _labels(tubes: list[Tube]) -> list[str]:
    return [f"({i}) " if len(tubes) > 1 else "" for i in range(1, len(tubes) + 1)]


def _shown(model: Model, tube: Tube) -> str:
    """The half-widths of one tube, and for how long they hold."""
    root = " sqrt(g)" if tube.assumed.follows else ""
    widths = " and ".join(
        f"{signal.name} within {signal.quantity(text.above(width))}{root}"
        for signal, width in zip(model.y, tube.half_widths, strict=True)
    )
    samples = tube.assumed.samples
    return f"{widths} " + ("for ever" if samples is None else f"for {_samples(model, samples)}")


def _samples(model: Model, count: int) -> str:
    return f"{count} samples, which span {text.below((count - 1) * model.period)} s"


def _around_plan(model: Model, policy: Policy | None) -> str:
    """What is claimed of the plan beside what is claimed of every simulation."""
    if policy is None or model.linear is None:
        return ""
    how = PLAYED
    if any(policy.K[0]):
        clipped = text.PRINTED["exact_range"](model.linear.input_range)
        how = text.say(ENGAGED, clipped=model.u[0].quantity(clipped))
    return text.say(PLAN, samples=_samples(model, policy.samples), how=how)


def _several(tubes: list[Tube]) -> bool:
    """Whether the tubes have observers of their own."""
    return any(tube.L != tubes[0].L for tube in tubes)


def _start(model: Model, policy: Policy | None, tubes: list[Tube], settling: int) -> str:
    whose, inlet = "the observer's state", ""
    if _several(tubes):
        whose = "one state with the observers, one for each tube"
    if any(tube.inlet for tube in tubes):
        inlet = text.say(INLET, inlets=" and ".join(text.below(tube.inlet) for tube in tubes))
    plan = ", as the plan does" if policy else ""
    span = settling * model.period
    return text.say(START, settling=settling, span=span, whose=whose, inlet=inlet, plan=plan)


def _inside(model: Model, box: Node) -> str:
    signals, ends = [*model.y, *apart(model.u, model.y)], box.members("y u")
    rows = ends["y"].array(len(model.y), 2) + ends["u"].array(len(model.u), 2)
    return text.say(INSIDE, ranges=ranges(signals, list(map(text.PRINTED["inner_range"], rows))))


def _energy(model: Model, tube: Tube) -> str:
    """The bound on the innovations' energy; of one output with R = 1 in its unit, squared."""
    unit_, energy, assumed = "", "e'Re", tube.assumed
    if len(model.y) == 1 and tube.R == [[1]]:
        unit_, energy = f"({model.y[0].unit})^2" if model.y[0].unit else "", "e^2"
    elif len(model.y) == 1:
        energy = f"{text.exact(tube.R[0][0])} e^2"
    level = Signal("", unit_).quantity(text.below(assumed.level))
    if assumed.samples is not None:
        return f"sum of {energy} <= {level} over {assumed.samples} samples"
    growth = f"after every sample, E+ = {text.exact(tube.rho)} E + {energy} from 0"
    if assumed.follows is None:
        return f"E <= {level} {growth}"
    return f"E <= {level} g {growth}, g = {formula(assumed.follows, model.u)}"
