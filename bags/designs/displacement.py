"""How far a displacement can be from the simulated one: what a tube of a washed-out signal proves.

q⁺ = a q + p⁺ - p, a = exp(-Δt/T) (`bags.signals.expressions.washout`), gives the position p back:
p_k - p_m = q_k - q_m + Σ_{m ≤ i < k} (1 - a_i) q_i. The same sum over the simulated q° is the
simulated displacement, so where |q_i - q°_i| ≤ w_i for i = m … k,
    |(p_k - p_m) - (p°_k - p°_m)| ≤ w_k + w_m + Σ (1 - a_i) w_i ≤ (2 + (t_k - t_m)/T) max w_i.
The position may leave the model's for ever; over a span it does so by no more than that. The sum is
over the messages of the signal, so every one of them has to be a sample.
"""

from fractions import Fraction

from bags.signals.expressions import Expression
from nlsid_core.errors import BagError
from nlsid_core.models import Signal


def washout_of(signal: Signal) -> Fraction | None:
    """T in s of a signal whose samples are messages, washed out; None if it is no such signal."""
    try:
        window = Expression.parse(signal.path).washed_out
    except BagError:  # not read from a topic
        return None
    return None if window is None else Fraction(window)


def displacement_half_width(half_width: float, span: Fraction, washout: Fraction) -> Fraction:
    """Of the displacement over `span` s, in the unit of `half_width`, the largest meanwhile."""
    return Fraction(half_width) * (2 + span / washout)
