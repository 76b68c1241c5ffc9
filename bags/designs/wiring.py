"""Where a design's signals are in messages, and what makes samples of them."""

from collections.abc import Iterable, Sequence

from bags.signals.expressions import Expression
from bags.signals.message_reader import SignalVector
from bags.signals.sampling import Sampler
from nlsid_core.designs import AnyDesign, Wiring
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import BagError


def wiring_of(
    response: Iterable[str] | None, command: Iterable[str] | None, period: float
) -> Wiring | None:
    """Where the state and the inputs of a continuous funnel are, each `topic:field.path[index]`.

    None if nothing was said. Raises BagError if one is missing, or is not on one topic.
    """
    if not (response or command):
        return None
    if not (response and command):
        raise BagError(
            "give both, where the state is (-y, or the parameter response) and where the inputs "
            "are (-u, or command): one of them is missing"
        )
    wiring = Wiring(tuple(response or ()), tuple(command or ()), period)
    SignalVector.parse(wiring.response)
    SignalVector.parse(wiring.command)
    return wiring


def sampler_of(design: AnyDesign) -> Sampler:
    """What makes samples of messages, by the rule that the model was identified with."""
    y, u = _texts(design)
    if isinstance(design.model, VectorField):
        y, u = ([str(Expression.parse(text).path) for text in part] for part in (y, u))
    return Sampler(y, u, period=design.period)


def read_at(design: AnyDesign) -> SignalVector:
    """Where a policy reads outputs or state; BagError if they are not on one topic."""
    return SignalVector.parse(_texts(design)[0])


def written_at(design: AnyDesign) -> SignalVector:
    """Where a policy writes the inputs; BagError if they are not on one topic."""
    return SignalVector.parse(_texts(design)[1], "hold")


def _texts(design: AnyDesign) -> tuple[Sequence[str], Sequence[str]]:
    """The signals of outputs or state, and those of inputs."""
    if isinstance(design.model, VectorField):
        return design.wired.response, design.wired.command
    responses, commands = design.signals
    return [signal.path for signal in responses], [signal.path for signal in commands]
