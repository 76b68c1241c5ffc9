"""Claim `tube`: outputs stay near the model's own simulation, or near a policy's plan.

The model runs twice under the same inputs: the simulation x, and the observer x̂ with L e injected
after each step, e the innovation. x̄ = x̂ - x, x̄⁺ = F ζ + L e, o = y - y° = H ζ + e, ζ = (ν, x̄), and
at every vertex E of the increment form, with multipliers N:
    diag(0, ρP, R) - [F L]'P[F L] + sym(N [E 0]) ≻ 0,
    diag(0, ρP, R) - τ_j [H_j 1_j]'[H_j 1_j] + sym(N_j [E 0]) ≻ 0.
Where a policy acts, F is F - κBK and H is H - κDK, κ in [0, 1], and its ends decide all between.
Why that is enough: docs/certificate_tube.md.
"""

from dataclasses import dataclass, replace
from fractions import Fraction

from . import text
from .decision import Decision
from .exact import Matrix, at_most, block_diagonal, combined, congruence, definite, scaled, zero
from .files import Node, Read, Rejected, bound_files
from .increments import MAX_WORK, Model, positive, read_model
from .levels import CommandLevel, formula, read_level
from .polynomials import Work
from .signals import Signal, apart, within
from .trials import MEASURED, Measured, Recorded, calibration, read_measured, read_trials

MAX_SAMPLES = 10**9
MAX_TUBES = 8  # of one funnel
MAX_PLAN = 10**6  # samples of a plan
BESIDE = "watched as well, not needed for this sentence"  # what (D) and (O_j) do not use


@dataclass(frozen=True)
class Assumption:
    """E <= level g, with what measured it. samples: None is for ever, else an energy's (ρ = 1).

    follows: g, 1 if it is None. peak: e'Re <= peak max(1, g), and what measured it.
    """

    level: Fraction
    samples: int | None
    measured: Measured
    follows: CommandLevel | None
    peak: tuple[Fraction, Measured] | None


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

    @property
    def acts(self) -> bool:
        """Whether there is any feedback."""
        return any(self.K[0])


def decide(claim: Node, proof: Node, read: Read) -> Decision:
    """Decide {kind, about: {model, funnel}}, or with a policy beside them, by {multipliers}."""
    return decide_tube(claim, proof, read)[0]


def decide_tube(claim: Node, proof: Node, read: Read) -> tuple[Decision, Model, Node, list[Tube]]:
    """`decide`; also the model in increment form and as its file has it, and the tubes."""
    about = claim.members("kind about")["about"]
    planned = type(about.value) is dict and "policy" in about.value
    roles = "model policy funnel" if planned else "model funnel"
    documents, digests = bound_files(about, read, roles)
    if documents["funnel"].kind() == "linear":
        raise Rejected("a funnel of kind 'linear' is now a tube: run `nlsid funnel` again")
    made_for = {role: digests[role] for role in roles.split()[:-1]}
    beside = "box" if planned else "box response cusum"
    funnel = documents["funnel"].document(
        "funnel", "settling tubes", "tube", optional=beside, made_for=made_for
    )
    model = read_model(documents["model"], funnel.get("box"))
    policy = _read_policy(documents["policy"], model, digests["model"]) if planned else None
    tubes = [_read(node, model) for node in funnel["tubes"].items(1, MAX_TUBES)]
    given = proof.members("", "multipliers").get("multipliers")
    trees: list[Node] | list[None] = [None] * len(tubes)
    if given is not None:
        trees = given.items(len(tubes), len(tubes))
    margin, work = Fraction(1), Work(MAX_WORK)
    for tube, tree in zip(tubes, trees, strict=True):
        if policy and tube.L != policy.L:
            raise Rejected("the observer of a tube is not the policy's: L is another")
        if policy and tube.assumed.follows:
            raise Rejected("a level that follows the commands is for a tube without a policy")
        definite(tube.P, "P")
        definite(tube.R, "R")
        for mode, moved in _modes(model, policy):
            positive(moved, tree, _forms(moved, tube, mode), work)
        for tau, width, signal in zip(tube.tau, tube.half_widths, model.y, strict=True):
            used = (tube.assumed.level + tube.rho * tube.inlet) / (tau * width**2)
            left = f"{signal.name} can leave the stated half-width {text.above(width)}"
            at_most(used, 1, left)
            margin = min(margin, 1 - used)
    content = documents["model"].value
    named = type(content) is dict and "bags" in content
    fitted = read_trials(documents["model"].member("bags")) if named else None
    settling = funnel["settling"].whole(0, MAX_SAMPLES)
    assumptions = [_start(model, policy, tubes, settling)]
    if "box" in funnel:
        assumptions.append(_inside(model, funnel["box"]))
    for i, tube in enumerate(tubes, 1):
        label = f"({i}) " if len(tubes) > 1 else ""
        said = _assumed(model, tube, fitted, own=_several(tubes))
        assumptions += [label + line for line in said]
    if "response" in funnel:
        assumptions += _response(model, funnel["response"], fitted)
    if "cusum" in funnel:
        _read_cusum(model, funnel["cusum"])
    decision = Decision(_statement(model, policy, tubes), margin, tuple(assumptions), digests)
    return decision, model, documents["model"], tubes


def _modes(model: Model, policy: Policy | None) -> list[tuple[str, Model]]:
    """The increments with the plan's inputs played, and with the policy engaged if it acts."""
    if policy is None or not policy.acts:
        return [("", model)]
    linear, (K,) = model.linear, policy.K
    if linear is None:
        raise Rejected("a policy with feedback is decided for a model of kind difference_equation")
    engaged = replace(
        model,
        F=[[f - b * k for f, k in zip(row, K, strict=True)]
           for row, b in zip(model.F, linear.B, strict=True)],
        H=[[h - linear.D * k for h, k in zip(row, K, strict=True)] for row in model.H],
    )  # fmt: skip
    return [(", the plan's inputs played,", model), (", the policy engaged,", engaged)]


def _forms(model: Model, tube: Tube, mode: str) -> list[tuple[str, Matrix]]:
    """The two inequalities of the module's docstring, without the multipliers."""
    p = len(model.H)
    supply = block_diagonal(zero(model.unknowns), scaled(tube.P, tube.rho), tube.R)
    F = [row + gain for row, gain in zip(model.F, tube.L, strict=True)]
    growth = combined(supply, congruence(F, tube.P), -1)
    forms = [(f"the decrease of V up to the innovation's energy{mode}", growth)]
    for j, (row, tau) in enumerate(zip(model.H, tube.tau, strict=True)):
        output = row + [Fraction(int(i == j)) for i in range(p)]
        bound = combined(supply, congruence([output], [[tau]]), -1)
        forms.append((f"the bound on {model.y[j].name} by V{mode}", bound))
    return forms


def _read(node: Node, model: Model) -> Tube:
    n, p = model.states, len(model.H)
    parts = node.members("rho L P R tau half_widths level inlet assumption", "follows peak")
    rho = parts["rho"].number()
    tube = Tube(
        rho=rho, L=parts["L"].array(n, p), P=parts["P"].array(n, n), R=parts["R"].array(p, p),
        tau=parts["tau"].array(p), half_widths=parts["half_widths"].array(p),
        inlet=parts["inlet"].number(), assumed=_read_assumption(parts, rho, len(model.u)),
    )  # fmt: skip
    if min(tube.tau) <= 0 or min(tube.half_widths) <= 0:
        raise Rejected("tau and half-widths should be positive")
    if tube.inlet < 0:
        raise Rejected("the inlet should be 0 or more")
    if tube.assumed.follows is not None and (rho == 1 or tube.inlet):
        raise Rejected("a level that follows the commands is for fading, without an inlet")
    return tube


def _read_assumption(parts: dict[str, Node], rho: Fraction, inputs: int) -> Assumption:
    """level, assumption, follows and peak of a tube's members."""
    given = parts["assumption"].members(f"kind {MEASURED}", "samples")
    kind = given["kind"].text()
    if kind not in ("fading", "energy"):
        raise Rejected(f"assumption {kind!r} is unknown; known: fading, energy")
    if (kind == "energy") != ("samples" in given):
        raise Rejected("the assumption energy is for a number of samples, fading for ever")
    if not 0 < rho <= 1 or (kind == "energy") != (rho == 1):
        raise Rejected("rho should be 1 for the assumption energy, between 0 and 1 for fading")
    measured = read_measured(given, "tube")
    return Assumption(
        level=_level(parts, measured, "the level"),
        samples=given["samples"].whole(1, MAX_SAMPLES) if "samples" in given else None,
        measured=measured,
        follows=read_level(parts["follows"], inputs, 1) if "follows" in parts else None,
        peak=_read_peak(parts["peak"], measured) if "peak" in parts else None,
    )


def _read_peak(node: Node, energy: Measured) -> tuple[Fraction, Measured]:
    """The level of a peak, measured on the trials of the energy, with its safety factor."""
    parts = node.members("level measured")
    measured = replace(energy, value=parts["measured"].number())
    if measured.value < 0:
        raise Rejected("a measured peak should be 0 or more")
    return _level(parts, measured, "the level of the peak"), measured


def _level(parts: dict[str, Node], measured: Measured, what: str) -> Fraction:
    """A level of squares that is not below what was measured."""
    level = parts["level"].number()
    at_most(
        measured.factor**2 * measured.value, level, f"{what} is below safety_factor^2 x measured"
    )
    return level


def _read_policy(node: Node, model: Model, made_for: str) -> Policy:
    n, p = model.states, len(model.H)
    plan = node.document("policy", "period start u K L", "tube", made_for={"model": made_for})
    if plan["period"].number() != model.period:
        raise Rejected("the policy's period is not the model's")
    plan["start"].array(n)
    u = plan["u"].array(None, len(model.u))
    if not 0 < len(u) <= MAX_PLAN:
        raise Rejected(f"a plan should have 1 to {MAX_PLAN} samples")
    if model.linear is None:
        raise Rejected("a plan is decided for a model of kind difference_equation")
    low, high = model.linear.input_range
    if any(not low <= entry <= high for row in u for entry in row):
        raise Rejected("a planned input is outside the model's input range")
    return Policy(plan["K"].array(len(model.u), n), plan["L"].array(n, p), len(u))


def _response(model: Model, node: Node, fitted_to: list[Recorded] | None) -> list[str]:
    """What is assumed of the output error itself, one line for each output."""
    p = len(model.y)
    parts = node.members("half_widths assumption", "follows")
    widths = parts["half_widths"].array(p)
    measured = read_measured(parts["assumption"].members(MEASURED), "response")
    follows = read_level(parts["follows"], len(model.u), p) if "follows" in parts else None
    if min(widths) <= 0:
        raise Rejected("a response's half-widths should be positive")
    needed = measured.factor * measured.value
    at_most(needed, 1, "the response is below safety_factor x measured")
    worth = calibration(measured, fitted_to)
    said = []
    for j, (signal, width) in enumerate(zip(model.y, widths, strict=True)):
        bound = signal.quantity(text.below(width))
        g = ""
        if follows is not None:
            bound, g = f"({bound} sqrt(g))", f", g = {formula(follows, j, model.u)}"
        said.append(
            f"output error, {BESIDE}: |{signal.name} - simulated| / {bound} <= 1 at every "
            f"sample{g} ({worth})"
        )
    return said


def _read_cusum(model: Model, node: Node) -> None:
    """An alarm that no claim rests on: it only has to make sense."""
    parts = node.members("deviation drift threshold")
    least = min(*parts["deviation"].array(len(model.y)), parts["threshold"].number())
    if least <= 0 or parts["drift"].number() < 0:
        raise Rejected("cusum: deviation and threshold should be positive, drift 0 or more")


def _statement(model: Model, policy: Policy | None, tubes: list[Tube]) -> str:
    said = []
    for i, tube in enumerate(tubes, 1):
        widths = " and ".join(
            f"{signal.name} within {signal.quantity(text.above(width))}"
            + (" sqrt(g)" if tube.assumed.follows else "")
            for signal, width in zip(model.y, tube.half_widths, strict=True)
        )
        how_long = "for ever"
        if tube.assumed.samples is not None:
            how_long = f"for {_samples(model, tube.assumed.samples)}"
        said.append(f"{f'({i}) ' if len(tubes) > 1 else ''}{widths} {how_long}")
    return (
        f"tube: the measured output stays near the model's simulation under the same inputs, "
        f"{'; '.join(said)}, {model.inputs}{_around_plan(model, policy)}"
    )


def _samples(model: Model, count: int) -> str:
    return f"{count} samples, which span {text.below((count - 1) * model.period)} s"


def _around_plan(model: Model, policy: Policy | None) -> str:
    """What is claimed of the plan beside what is claimed of every simulation."""
    if policy is None:
        return ""
    same = (
        "; and as near the policy's plan, which is the simulation from its start under its inputs, "
        f"for at most its {_samples(model, policy.samples)}, "
    )
    if not policy.acts or model.linear is None:
        return f"{same}with those inputs played (no feedback)"
    low, high = model.linear.input_range
    clipped = model.u[0].quantity(f"[{text.exact(low)}, {text.exact(high)}]")
    return (
        f"{same}whether those inputs are played, the policy is engaged around them, or anything "
        "between the two acts, such as the policy's input clipped to a range that holds the "
        f"plan's, as {clipped} does"
    )


def _several(tubes: list[Tube]) -> bool:
    """Whether the tubes have observers of their own."""
    return any(tube.L != tubes[0].L for tube in tubes)


def _start(model: Model, policy: Policy | None, tubes: list[Tube], settling: int) -> str:
    span = text.above(settling * model.period)
    whose = "the observer's state"
    if _several(tubes):
        whose = "one state with the observers, one for each tube"
    start = f"after {settling} samples ({span} s) the simulation starts at {whose}"
    if any(tube.inlet for tube in tubes):
        inlets = " and ".join(text.below(tube.inlet) for tube in tubes)
        start += f", or where V = xbar'P xbar <= {inlets}, xbar the observer's state minus its own"
    return start + ", as the plan does" * bool(policy)


def _inside(model: Model, box: Node) -> str:
    ranges = box.members("y u")
    shown = ", ".join(
        within(*pair)
        for signals, key in ((model.y, "y"), (apart(model.u, model.y), "u"))
        for pair in zip(signals, ranges[key].array(len(signals), 2), strict=True)
    )
    return f"the inputs, and the outputs and states of simulation and observer, stay in {shown}"


def _assumed(model: Model, tube: Tube, fitted_to: list[Recorded] | None, *, own: bool) -> list[str]:
    """What is assumed of the innovations. own: whether other tubes have other observers."""
    energy, *peak = bounds(model, tube)
    whose, assumed = " of its own observer" if own else "", tube.assumed
    said = [f"innovation energy{whose}: {energy} ({calibration(assumed.measured, fitted_to)})"]
    if assumed.peak is not None:
        worth = calibration(assumed.peak[1], fitted_to)
        said.append(f"innovation peak{whose}, {BESIDE}: {peak[0]} ({worth})")
    return said


def bounds(model: Model, tube: Tube) -> list[str]:
    """The bound on the innovations' energy, and that on a single one if there is one, in words."""
    # One output and R = 1: V and E carry its unit squared.
    unit, energy, assumed = "", "e'Re", tube.assumed
    if len(model.y) == 1:
        unit = f"({model.y[0].unit})^2" if model.y[0].unit and tube.R == [[1]] else ""
        energy = "e^2" if tube.R == [[1]] else f"{text.exact(tube.R[0][0])} e^2"
    level = Signal("", unit).quantity(text.below(assumed.level))
    growth = f"E+ = {text.exact(tube.rho)} E + {energy} from 0"
    said = [f"E <= {level} after every sample, {growth}"]
    if assumed.follows is not None:
        g = formula(assumed.follows, 0, model.u)
        said = [f"E <= {level} g after every sample, {growth}, g = {g}"]
    if assumed.samples is not None:
        said = [f"sum of {energy} <= {level} over {assumed.samples} samples"]
    if assumed.peak is not None:
        room = " max(1, g)" if assumed.follows else ""
        most = Signal("", unit).quantity(text.below(assumed.peak[0]))
        said.append(f"{energy} <= {most}{room} at every sample")
    return said
