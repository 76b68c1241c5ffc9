"""Claim `tube` about a policy: an output stays near a plan while an assumption holds.

With x̄ = x̂ - x_k, the innovation e and the input u_k - κKx̄, 0 <= κ <= 1, the observer gives
    x̄⁺ = (A - κBK) x̄ + L e,    o = y - y_k = (C - κDK) x̄ + e.
Proved for κ = 0 and 1, hence (both are concave in κ) for every κ between, at each sample its own:
    (1 - slack) diag(ρP, R) - [A - κBK, L]'P[A - κBK, L] ≻ 0,
    diag(ρP, R) - τ_j [C_j - κD_jK, 1_j]'[C_j - κD_jK, 1_j] ≻ 0.
With E_{k+1} = ρE_k + e_k'Re_k, E_0 = 0: V(x̄_k) <= ρ^k V(x̄_0) + E_k and τ_j o_j² <= ρV + e'Re, at
most `level` while V(x̄_0) <= inlet and E <= budget. What the stored nominal departs from the model
by is added to √level. Source: docs/certificate_driven_tube.md.
"""

from dataclasses import dataclass
from fractions import Fraction

from . import text
from .decision import Decision
from .exact import Matrix, at_most, combined, congruence, definite
from .files import Node, Read, Rejected, bound_files
from .increments import Linear, Model, Signal, read_model
from .trials import Recorded, calibration, read_trials, shared

MAX_SAMPLES = 10**6
MAX_NOMINAL = 10**7  # samples of the nominal times the square of the states: a minute


@dataclass(frozen=True)
class Tube:
    """The numbers of a policy file and a funnel file; N nominal samples, n states, p outputs.

    x: (N, n), u: (N, 1), K: (1, n), L: (n, p). P: (n, n), R: (p, p), tau, half_widths: (p,).
    measured_on, designed_on, fitted_to: what calibrated the assumption, designed the tube, made the
    model.
    """

    x: Matrix
    u: Matrix
    K: Matrix
    L: Matrix
    P: Matrix
    R: Matrix
    rho: Fraction
    level: Fraction
    inlet: Fraction
    tau: list[Fraction]
    half_widths: list[Fraction]
    assumption: str
    budget: Fraction
    samples: int
    measured: Fraction
    safety_factor: Fraction
    measured_on: list[Recorded]
    designed_on: list[Recorded]
    fitted_to: list[Recorded]


def decide(claim: Node, proof: Node, read: Read) -> Decision:
    """Decide {kind, about: {model, policy, funnel}} by {slack}."""
    parts = claim.members("kind about")
    documents, digests = bound_files(parts["about"], read, "model policy funnel")
    model = read_model(documents["model"])
    linear = model.linear
    if linear is None:
        raise Rejected("a tube is decided for a model of kind difference_equation")
    fitted_to = read_trials(documents["model"].member("bags"))
    tube = _read(documents["policy"], documents["funnel"], model, digests, fitted_to)
    slack = proof.members("slack")["slack"].number()
    if not 0 < slack < 1:
        raise Rejected("slack should be between 0 and 1")
    definite(tube.P, "P")
    definite(tube.R, "R")
    _check_assumption(tube, linear)
    for kappa in (0, 1):
        _check_growth(model, linear, tube, slack, kappa)
    for tau, width, signal in zip(tube.tau, tube.half_widths, model.y, strict=True):
        if width <= 0:
            raise Rejected("half-widths should be positive")
        left = f"{signal.name} can leave the stated half-width {text.above(width)}"
        at_most(tube.level, tau * width**2, left)
    _check_level(model, linear, tube)
    return Decision(_statement(model, linear, tube), slack, _assumptions(model, tube), digests)


def _check_growth(model: Model, linear: Linear, tube: Tube, slack: Fraction, kappa: int) -> None:
    """The two inequalities of the module's docstring at one κ."""
    n, p = model.states, len(model.H)
    mode = "the policy engaged" if kappa else "the nominal inputs played"
    supply = [[tube.rho * entry for entry in row] + [Fraction(0)] * p for row in tube.P]
    supply += [[Fraction(0)] * n + row for row in tube.R]
    F = [
        [f - kappa * b * k for f, k in zip(row, tube.K[0], strict=True)] + gain
        for row, b, gain in zip(model.F, linear.B, tube.L, strict=True)
    ]
    kept = [[(1 - slack) * entry for entry in row] for row in supply]
    what = f"the decrease of V up to the innovation's energy, {mode},"
    definite(combined(kept, congruence(F, tube.P), -1), what)
    for j, (row, tau) in enumerate(zip(model.H, tube.tau, strict=True)):
        output = [c - kappa * linear.D * k for c, k in zip(row, tube.K[0], strict=True)]
        output += [Fraction(int(i == j)) for i in range(p)]
        what = f"the bound on {model.y[j].name} by V, {mode},"
        definite(combined(supply, congruence([output], [[tau]]), -1), what)


def _check_assumption(tube: Tube, linear: Linear) -> None:
    if tube.assumption not in ("energy", "fading"):
        raise Rejected(f"assumption {tube.assumption!r} is unknown; known: energy, fading")
    if not 0 < tube.rho <= 1 or (tube.assumption == "energy") != (tube.rho == 1):
        raise Rejected("rho should be 1 for the assumption energy, between 0 and 1 for fading")
    if tube.samples > len(tube.u):
        raise Rejected(f"the assumption covers {tube.samples} samples, the nominal {len(tube.u)}")
    if min(tube.inlet, tube.budget, tube.measured) < 0 or tube.safety_factor < 1:
        raise Rejected("inlet, budget, measured should be 0 or more, the safety factor 1 or more")
    at_most(
        tube.safety_factor**2 * tube.measured,
        tube.budget,
        "the budget is below safety_factor^2 x measured",
    )
    if not tube.measured_on:
        raise Rejected("the assumption was measured on no trial")
    if shared(tube.measured_on, tube.designed_on):
        raise Rejected(
            "a trial that the assumption was measured on also designed the tube: the largest of "
            "such trials says nothing of the next one"
        )
    low, high = linear.input_range
    if any(not low <= entry <= high for (entry,) in tube.u):
        raise Rejected("a nominal input is outside the model's input range")


def _check_level(model: Model, linear: Linear, tube: Tube) -> None:
    """√level >= √(inlet + budget) + Σ_k |δ_k|_P, δ_k what the nominal departs from the model by.

    (Σ|δ_k|_P)² <= N Σ|δ_k|²_P =: q, and √level >= √s + √q is decided without roots: level - s - q
    >= 0 and (level - s - q)² >= 4 s q.
    """
    departures = Fraction(0)
    for x, (u,), after in zip(tube.x, tube.u, tube.x[1:], strict=False):
        delta = [
            [sum((f * v for f, v in zip(row, x, strict=True) if f and v), b * u + c - later)]
            for row, b, c, later in zip(model.F, linear.B, linear.f, after, strict=True)
        ]
        departures += congruence(delta, tube.P)[0][0]
    q = len(tube.u) * departures
    s = tube.inlet + tube.budget
    room = tube.level - s - q
    if room < 0 or room**2 < 4 * s * q:
        raise Rejected(
            f"level {text.below(tube.level)} is below inlet + budget {text.above(s)} plus the "
            f"nominal's departure from the model {text.above(text.root_above(q))}"
        )


def _statement(model: Model, linear: Linear, tube: Tube) -> str:
    widths = " and ".join(
        f"{signal.name} stays within {signal.quantity(text.above(width))}"
        for signal, width in zip(model.y, tube.half_widths, strict=True)
    )
    how = "with the trajectory's inputs played (no feedback)"
    if any(tube.K[0]):
        low, high = linear.input_range
        clipped = model.u[0].quantity(f"[{text.exact(low)}, {text.exact(high)}]")
        how = (
            "whether the trajectory's inputs are played, the policy is engaged around it, or "
            "anything between the two acts, such as the policy's input clipped to a range that "
            f"holds the trajectory's, as {clipped} holds the nominal's"
        )
    return (
        f"tube: {widths} of every trajectory of the model that starts as assumed, the policy's "
        f"nominal among them, for {tube.samples} samples, which span "
        f"{text.below((tube.samples - 1) * model.period)} s, "
        f"{how}"
    )


def _assumptions(model: Model, tube: Tube) -> tuple[str, ...]:
    # One output: e is a number in its unit, and R multiplies its square.
    single = len(model.y) == 1
    squared = Signal("", f"({model.y[0].unit})^2" if single and model.y[0].unit else "")
    energy = "e'Re" if not single else "e^2" if tube.R == [[1]] else f"{tube.R[0][0]} e^2"
    start = "the observer starts at the trajectory's state"
    if tube.inlet:
        start = (
            "the observer starts with V = xbar'P xbar <= "
            f"{squared.quantity(text.below(tube.inlet))}, xbar its state minus the trajectory's"
        )
    budget = squared.quantity(text.below(tube.budget))
    bound = f"sum of {energy} <= {budget} over {tube.samples} samples"
    if tube.assumption == "fading":
        bound = (
            f"E <= {budget} after each of {tube.samples} samples, E+ = {text.exact(tube.rho)} E + "
            f"{energy} from 0"
        )
    return (
        start,
        f"innovation energy: {bound} "
        f"({calibration(tube.measured, tube.safety_factor, tube.measured_on, tube.fitted_to)})",
    )


def _read(
    policy: Node, funnel: Node, model: Model, digests: dict[str, str], fitted_to: list[Recorded]
) -> Tube:
    n, p = model.states, len(model.H)
    made_for = {"model": digests["model"]}
    plan = policy.document("policy", "period K L u x", "linear", made_for=made_for)
    if plan["period"].number() != model.period:
        raise Rejected("the policy's period is not the model's")
    u = plan["u"].array(None, 1)
    if not 0 < len(u) <= MAX_SAMPLES:
        raise Rejected(f"the nominal should have 1 to {MAX_SAMPLES} samples")
    if len(u) * n**2 > MAX_NOMINAL:
        raise Rejected(f"{len(u)} samples of {n} states take too long to decide")
    names = "rho P R level inlet tau half_widths assumption"
    made_for["policy"] = digests["policy"]
    parts = funnel.document("funnel", names, "linear", made_for=made_for)
    names = "kind budget samples measured safety_factor measured_on designed_on"
    given = parts["assumption"].members(names)
    tau = parts["tau"].array(p)
    if min(tau) <= 0:
        raise Rejected("tau should be positive")
    return Tube(
        x=plan["x"].array(len(u), n), u=u, K=plan["K"].array(1, n), L=plan["L"].array(n, p),
        P=parts["P"].array(n, n), R=parts["R"].array(p, p), rho=parts["rho"].number(),
        level=parts["level"].number(), inlet=parts["inlet"].number(),
        tau=tau, half_widths=parts["half_widths"].array(p),
        assumption=given["kind"].text(), budget=given["budget"].number(),
        samples=given["samples"].whole(1, MAX_SAMPLES), measured=given["measured"].number(),
        safety_factor=given["safety_factor"].number(),
        measured_on=read_trials(given["measured_on"]),
        designed_on=read_trials(given["designed_on"]),
        fitted_to=fitted_to,
    )  # fmt: skip
