"""Claim: solutions of dx/dt = f(x) that start in {V <= level} stay there and tend to the origin.

Obligations: f(0) = 0;
    V > 0 and -dV/dt - σ·(level - V) > 0 except at the origin, where both are 0,
V unbounded with |x|, σ a sum of squares, dV/dt = Σ_j ∂V/∂x_j f_j. So {V <= level} is compact and
dV/dt < 0 on it except at the origin. Without a level σ = 0, and every solution is attracted.
Source: Lyapunov's theorem; Parrilo 2000, Section 7.3.
"""

from fractions import Fraction

from . import text
from .decision import Decision
from .files import Node, Read, Rejected, bound_files
from .polynomials import FREE_OF_S, MOST_WORK, Ring, Work, at_width
from .positivity import expanded, positive_except_origin, read_witness
from .terms import along, read_names, shown

LEVEL_DIGITS = 12  # of the level in the sentence


def decide(claim: Node, proof: Node, read: Read) -> Decision:
    """Rebuild V and its derivative along the field from the claim's numbers."""
    parts = claim.members("kind about variables field V", "level")
    _, digests = bound_files(parts["about"], read, "")
    names = read_names(parts["variables"])
    n = len(names)
    field = [entry.polynomial(n) for entry in parts["field"].items(n, n)]
    V = parts["V"].polynomial(n)
    level = parts["level"].rational() if "level" in parts else None
    if any(c and not any(e) for f in field for e, c in f):
        raise Rejected("the origin is not an equilibrium: f(0) is not zero")
    if level is not None and level <= 0:
        raise Rejected("the level should be positive")
    witnesses = proof.members("V decrease" + " multiplier" * (level is not None))

    def build(ring: Ring) -> Fraction:
        value, *f = ring.substituted([V, *field], ring.variables)
        positive_except_origin(value, read_witness(witnesses["V"], ring), ring, "V")
        decrease = -1 * along([V], ring.variables, f, ring)[0]
        if level is not None:
            decrease += expanded(read_witness(witnesses["multiplier"], ring), ring) * (
                value - level
            )
        witness = read_witness(witnesses["decrease"], ring)
        return positive_except_origin(decrease, witness, ring, "the decrease of V")

    margin = at_width(n, Work(MOST_WORK, FREE_OF_S), build)
    rates = enumerate(zip(names, field, strict=True))
    dynamics = ", ".join(f"d{x}/dt = {shown(f, names, f'field[{i}]')}" for i, (x, f) in rates)
    start = ""
    if level is not None:
        start = f" that starts in {{{shown(V, names, 'V')} <= {text.below(level, LEVEL_DIGITS)}}}"
    sentence = f"every solution of {dynamics}{start} tends to the origin"
    return Decision(sentence, margin, (), digests)
