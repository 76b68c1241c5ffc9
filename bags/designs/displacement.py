"""How far a displacement can be from the simulated one: what a tube of a washed-out signal proves.

q⁺ = a q + p⁺ - p, a = exp(-Δt/T) (`bags.signals.expressions.washout`), gives the position p back:
p_k - p_m = q_k - q_m + Σ_{m ≤ i < k} (1 - a_i) q_i. The same sum over the simulated q° is the
simulated displacement, so where |q_i - q°_i| ≤ w_i for i = m … k,
    |(p_k - p_m) - (p°_k - p°_m)| ≤ w_k + w_m + Σ (1 - a_i) w_i ≤ (2 + (t_k - t_m)/T) max w_i.
The position may leave the model's for ever; over a span it does so by no more than that. The sum is
over the messages of the signal, so every one of them has to be a sample.
"""

from collections.abc import Sequence
from fractions import Fraction

from bags.signals.expressions import Expression
from nlsid_core.errors import BagError
from nlsid_core.models import Signal


def washouts_of(signals: Sequence[Signal]) -> list[Fraction | None]:
    """T in s of each response of a model that is washed out and whose every message is a sample.

    None of others: on another topic than the first response's, messages may come between samples,
    and what they add to a displacement is in no sample.
    """
    parsed: list[Expression | None] = []
    for signal in signals:
        try:
            parsed.append(Expression.parse(signal.path))
        except BagError:  # not read from a topic
            parsed.append(None)
    first = parsed[0]
    windows = [
        one.washed_out if one and first and one.path.topic == first.path.topic else None
        for one in parsed
    ]
    return [None if window is None else Fraction(window) for window in windows]


def displacement_half_width(half_width: float, span: Fraction, washout: Fraction) -> Fraction:
    """Bound the displacement over `span` s; half_width: the largest meanwhile, in its unit."""
    return Fraction(half_width) * (2 + span / washout)
