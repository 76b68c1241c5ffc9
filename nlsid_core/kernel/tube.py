"""Claim `tube`: outputs stay near the model's own simulation, for ever, while innovations fade.

The model runs twice under the same inputs: the simulation x, and the observer x̂ with L e injected
after each step, e the innovation. With x̄ = x̂ - x and the increment form of the model,
    E ζ = 0,    x̄⁺ = F ζ + L e,    o = y - y° = H ζ + e,    ζ = (ν, x̄).
At every vertex E, with multipliers N:
    diag(0, ρP, R) - [F L]'P[F L] + sym(N [E 0]) ≻ 0,
    diag(0, ρP, R) - τ_j [H_j 1_j]'[H_j 1_j] + sym(N_j [E 0]) ≻ 0.
With E_{k+1} = ρE_k + e_k'Re_k, E_0 = 0: V(x̄_k) <= ρ^k V(x̄_0) + E_k and τ_j o_j² <= ρV + e'Re, at
most inlet + level while E <= level. ρ = 1 is a bound on the energy of so many samples. A funnel may
hold several such tubes, each with its assumption. Source: docs/certificate_tube.md.
"""

from dataclasses import dataclass
from fractions import Fraction

from . import driven_tube, text
from .decision import Decision
from .exact import Matrix, at_most, combined, congruence, definite
from .files import Node, Read, Rejected, bound_files
from .increments import Model, Signal, block_diagonal, positive, read_model, scaled, zero
from .levels import CommandLevel, formula, read_level
from .trials import Recorded, calibration, read_trials, shared

MAX_SAMPLES = 10**9
MAX_TUBES = 8  # of one funnel


@dataclass(frozen=True)
class Tube:
    """One tube of a funnel file; n states, p outputs. samples: None is for ever.

    L: (n, p), P: (n, n), R: (p, p), tau, half_widths: (p,). measured_on: the trials of `measured`.
    """

    rho: Fraction
    L: Matrix
    P: Matrix
    R: Matrix
    tau: list[Fraction]
    half_widths: list[Fraction]
    level: Fraction
    inlet: Fraction
    samples: int | None
    measured: Fraction
    safety_factor: Fraction
    measured_on: list[Recorded]
    follows: CommandLevel | None


def decide(claim: Node, proof: Node, read: Read) -> Decision:
    """Decide {kind, about: {model, funnel}} by {multipliers}, or a tube about a policy."""
    about = claim.members("kind about")["about"]
    if type(about.value) is dict and "policy" in about.value:
        return driven_tube.decide(claim, proof, read)
    documents, digests = bound_files(about, read, "model funnel")
    made_for, names = {"model": digests["model"]}, "settling tubes"
    stated = documents["funnel"]
    funnel = stated.document(
        "funnel", names, "tube", optional="box response cusum", made_for=made_for
    )
    model = read_model(documents["model"], funnel.get("box"))
    tubes = [_read(node, model) for node in funnel["tubes"].items(1, MAX_TUBES)]
    given = proof.members("", "multipliers").get("multipliers")
    trees: list[Node] | list[None] = [None] * len(tubes)
    if given is not None:
        trees = given.items(len(tubes), len(tubes))
    margin = Fraction(1)
    for tube, tree in zip(tubes, trees, strict=True):
        definite(tube.P, "P")
        definite(tube.R, "R")
        positive(model, tree, _forms(model, tube))
        for tau, width, signal in zip(tube.tau, tube.half_widths, model.y, strict=True):
            used = (tube.level + tube.inlet) / (tau * width**2)
            left = f"{signal.name} can leave the stated half-width {text.above(width)}"
            at_most(used, 1, left)
            margin = min(margin, 1 - used)
    content = documents["model"].value
    named = type(content) is dict and "bags" in content
    fitted = read_trials(documents["model"].member("bags")) if named else None
    assumptions = [_start(model, tubes, funnel["settling"].whole(0, MAX_SAMPLES))]
    if "box" in funnel:
        assumptions.append(_inside(model, funnel["box"]))
    for i, tube in enumerate(tubes, 1):
        label = f"({i}) " if len(tubes) > 1 else ""
        assumptions.append(label + _assumption(model, tube, fitted))
    if "response" in funnel:
        assumptions += _response(model, funnel["response"], fitted)
    if "cusum" in funnel:
        _read_cusum(model, funnel["cusum"])
    return Decision(_statement(model, tubes), margin, tuple(assumptions), digests)


def _forms(model: Model, tube: Tube) -> list[tuple[str, Matrix]]:
    """The two inequalities of the module's docstring, without the multipliers."""
    p = len(model.H)
    supply = block_diagonal(zero(model.unknowns), scaled(tube.P, tube.rho), tube.R)
    F = [row + gain for row, gain in zip(model.F, tube.L, strict=True)]
    growth = combined(supply, congruence(F, tube.P), -1)
    forms = [("the decrease of V up to the innovation's energy", growth)]
    for j, (row, tau) in enumerate(zip(model.H, tube.tau, strict=True)):
        output = row + [Fraction(int(i == j)) for i in range(p)]
        bound = combined(supply, congruence([output], [[tau]]), -1)
        forms.append((f"the bound on {model.y[j].name} by V", bound))
    return forms


def _read(node: Node, model: Model) -> Tube:
    n, p = model.states, len(model.H)
    parts = node.members("rho L P R tau half_widths level inlet assumption", "follows")
    names = "kind measured safety_factor designed_on measured_on"
    given = parts["assumption"].members(names, "samples")
    kind = given["kind"].text()
    if kind not in ("fading", "energy"):
        raise Rejected(f"assumption {kind!r} is unknown; known: fading, energy")
    if (kind == "energy") != ("samples" in given):
        raise Rejected("the assumption energy is for a number of samples, fading for ever")
    tube = Tube(
        rho=parts["rho"].number(), L=parts["L"].array(n, p), P=parts["P"].array(n, n),
        R=parts["R"].array(p, p), tau=parts["tau"].array(p),
        half_widths=parts["half_widths"].array(p), level=parts["level"].number(),
        inlet=parts["inlet"].number(),
        samples=given["samples"].whole(1, MAX_SAMPLES) if "samples" in given else None,
        measured=given["measured"].number(), safety_factor=given["safety_factor"].number(),
        measured_on=read_trials(given["measured_on"]),
        follows=read_level(parts["follows"], len(model.u), 1) if "follows" in parts else None,
    )  # fmt: skip
    if not 0 < tube.rho <= 1 or (kind == "energy") != (tube.rho == 1):
        raise Rejected("rho should be 1 for the assumption energy, between 0 and 1 for fading")
    if min(tube.tau) <= 0 or min(tube.half_widths) <= 0:
        raise Rejected("tau and half-widths should be positive")
    if min(tube.inlet, tube.measured) < 0 or tube.safety_factor < 1:
        raise Rejected("inlet and measured should be 0 or more, the safety factor 1 or more")
    if tube.follows is not None and (kind == "energy" or tube.inlet):
        raise Rejected("a level that follows the commands is for fading, without an inlet")
    if not tube.measured_on:
        raise Rejected("the assumption was measured on no trial")
    if shared(tube.measured_on, read_trials(given["designed_on"])):
        raise Rejected("a trial that the tube was designed on cannot measure its assumption")
    least = tube.safety_factor**2 * tube.measured
    at_most(least, tube.level, "the level is below safety_factor^2 x measured")
    return tube


def _response(model: Model, node: Node, fitted_to: list[Recorded] | None) -> list[str]:
    """What is assumed of the output error itself, one line for each output."""
    p = len(model.y)
    parts = node.members("half_widths assumption", "follows")
    widths = parts["half_widths"].array(p)
    given = parts["assumption"].members("measured safety_factor designed_on measured_on")
    follows = read_level(parts["follows"], len(model.u), p) if "follows" in parts else None
    measured, factor = given["measured"].number(), given["safety_factor"].number()
    measured_on = read_trials(given["measured_on"])
    if min(widths) <= 0 or measured < 0 or factor < 1:
        raise Rejected("a response's half-widths should be positive, its safety factor 1 or more")
    if not measured_on:
        raise Rejected("the response was measured on no trial")
    if shared(measured_on, read_trials(given["designed_on"])):
        raise Rejected("a trial that the response's level was chosen on cannot measure it")
    at_most(factor * measured, 1, "the response is below safety_factor x measured")
    worth = calibration(measured, factor, measured_on, fitted_to)
    said = []
    for j, (signal, width) in enumerate(zip(model.y, widths, strict=True)):
        bound = signal.quantity(text.below(width))
        g = ""
        if follows is not None:
            bound, g = f"({bound} sqrt(g))", f", g = {formula(follows, j, model.u)}"
        said.append(
            f"output error: |{signal.name} - simulated| / {bound} <= 1 at every sample{g} ({worth})"
        )
    return said


def _read_cusum(model: Model, node: Node) -> None:
    """An alarm that no claim rests on: it only has to make sense."""
    parts = node.members("deviation drift threshold")
    least = min(*parts["deviation"].array(len(model.y)), parts["threshold"].number())
    if least <= 0 or parts["drift"].number() < 0:
        raise Rejected("cusum: deviation and threshold should be positive, drift 0 or more")


def _statement(model: Model, tubes: list[Tube]) -> str:
    said = []
    for i, tube in enumerate(tubes, 1):
        widths = " and ".join(
            f"{signal.name} within {signal.quantity(text.above(width))}"
            + (" sqrt(g)" if tube.follows else "")
            for signal, width in zip(model.y, tube.half_widths, strict=True)
        )
        how_long = "for ever"
        if tube.samples is not None:
            span = text.below((tube.samples - 1) * model.period)
            how_long = f"for {tube.samples} samples, which span {span} s"
        said.append(f"{f'({i}) ' if len(tubes) > 1 else ''}{widths} {how_long}")
    return (
        f"tube: the measured output stays near the model's simulation under the same inputs, "
        f"{'; '.join(said)}, {model.inputs}"
    )


def _start(model: Model, tubes: list[Tube], settling: int) -> str:
    span = text.above(settling * model.period)
    start = f"after {settling} samples ({span} s) the simulation starts at the observer's state"
    if not any(tube.inlet for tube in tubes):
        return start
    inlets = " and ".join(text.below(tube.inlet) for tube in tubes)
    return f"{start}, or where V = xbar'P xbar <= {inlets}, xbar the observer's state minus its own"


def _inside(model: Model, box: Node) -> str:
    ranges = box.members("y u")
    shown = ", ".join(
        signal.quantity(f"{signal.name} in [{text.above(low)}, {text.below(high)}]")
        for signals, key in ((model.y, "y"), (model.u, "u"))
        for signal, (low, high) in zip(signals, ranges[key].array(len(signals), 2), strict=True)
    )
    return f"the inputs, and the outputs and states of simulation and observer, stay in {shown}"


def _assumption(model: Model, tube: Tube, fitted_to: list[Recorded] | None) -> str:
    # One output and R = 1: V and E carry its unit squared.
    unit, energy = "", "e'Re"
    if len(model.y) == 1:
        unit = f"({model.y[0].unit})^2" if model.y[0].unit and tube.R == [[1]] else ""
        energy = "e^2" if tube.R == [[1]] else f"{text.exact(tube.R[0][0])} e^2"
    squared = Signal("", unit)
    level = squared.quantity(text.below(tube.level))
    growth = f"E+ = {text.exact(tube.rho)} E + {energy} from 0"
    bound = f"E <= {level} after every sample, {growth}"
    if tube.follows is not None:
        g = formula(tube.follows, 0, model.u)
        bound = f"E <= {level} g after every sample, {growth}, g = {g}"
    if tube.samples is not None:
        bound = f"sum of {energy} <= {level} over {tube.samples} samples"
    worth = calibration(tube.measured, tube.safety_factor, tube.measured_on, fitted_to)
    return f"innovation energy: {bound} ({worth})"
