"""Where a design's signals are in messages, and what makes samples of them."""

from collections.abc import Iterable, Sequence

from bags.signals.expressions import Expression
from bags.signals.sampling import Sampler
from bags.signals.signal import SignalPath
from bags.signals.vector import SignalVector
from nlsid_core.designs import AnyDesign, Wiring
from nlsid_core.dynamics import VectorField


def wiring_of(
    response: Iterable[str] | None, command: Iterable[str] | None, period: float
) -> Wiring | None:
    """Where the state and the inputs of a continuous funnel are, each `topic:field.path[index]`.

    None if nothing was said. Raises BagError if one of them is not on one topic.
    """
    if not (response or command):
        return None
    wiring = Wiring(tuple(response or ()), tuple(command or ()), period)
    SignalVector.parse(wiring.response)
    SignalVector.parse(wiring.command)
    return wiring


def sampler_of(design: AnyDesign) -> Sampler:
    """What makes samples of messages, by the rule that the model was identified with."""
    if isinstance(design.model, VectorField):
        y, u = (
            [str(Expression.parse(text).path) for text in part]
            for part in (design.wired.response, design.wired.command)
        )
    else:
        y, u = ([signal.path for signal in part] for part in design.signals)
    return Sampler(y, u, period=design.period)


def read_at(design: AnyDesign) -> SignalPath | SignalVector:
    """Where a policy reads outputs or state; BagError if they are not on one topic."""
    if isinstance(design.model, VectorField):
        return SignalVector.parse(design.wired.response)
    return _place([signal.path for signal in design.signals[0]], single=design.is_single)


def written_at(design: AnyDesign) -> SignalPath | SignalVector:
    """Where a policy writes the inputs; BagError if they are not on one topic."""
    if isinstance(design.model, VectorField):
        return SignalVector.parse(design.wired.command)
    return _place([signal.path for signal in design.signals[1]], single=design.is_single)


def _place(texts: Sequence[str], *, single: bool) -> SignalPath | SignalVector:
    return Expression.parse(texts[0]).path if single else SignalVector.parse(texts)
