"""Offline monitoring: a bag's messages through the same pairing and monitor as the live node."""

from dataclasses import dataclass
from pathlib import Path

from bags.documents import ProvedFunnel
from bags.pairing import Pairing
from bags.reader import read_signals
from nlsid_core.errors import BagError
from nlsid_core.monitor import Nominal, Reading, Status

NANOSECONDS = 1e-9


@dataclass(frozen=True, eq=False)
class Replay:
    """One bag's readings, and what a summary says of them."""

    name: str
    readings: tuple[Reading, ...]
    axis: str
    unit: str
    half_width: float

    @property
    def judged(self) -> tuple[Reading, ...]:
        """The readings that are not unknown."""
        return tuple(r for r in self.readings if r.status is not Status.UNKNOWN)

    @property
    def worst(self) -> Reading | None:
        """The reading with the least margin."""
        return min(self.judged, key=lambda r: r.margin, default=None)

    @property
    def first_bad(self) -> Reading | None:
        """The first reading that is outside or whose assumption is violated."""
        return next((r for r in self.judged if r.status is not Status.INSIDE), None)

    @property
    def budget_spent(self) -> float:
        """The fraction of the disturbance budget spent at the last judged sample."""
        return self.judged[-1].budget_spent if self.judged else float("nan")

    @property
    def verdict(self) -> str:
        """The status at the first bad sample, else inside, else unknown."""
        bad = self.first_bad
        if bad is not None:
            return bad.status.value
        return Status.INSIDE.value if self.judged else Status.UNKNOWN.value

    @property
    def reason(self) -> str:
        """Why it is not inside; empty if it is."""
        if self.first_bad is not None:
            return self.first_bad.reason
        return "" if self.judged or not self.readings else self.readings[-1].reason


def replay_bag(proved: ProvedFunnel, bag: Path | str, *, nominal: Nominal) -> Replay:
    """Every response in `bag` held against the funnel, in stamp order.

    Raises BagError if the bag cannot be read or does not hold the funnel's signals.
    """
    bag = Path(bag)
    model = proved.model
    signals = read_signals(bag, [model.y.path, model.u.path], finite=False)
    responses, excitations = signals[model.y.path], signals[model.u.path]
    if not len(responses.stamps):
        raise BagError(f"{bag}: no message on {model.y.path}")
    pairing = Pairing()
    for stamp, value in zip(excitations.stamps, excitations.values, strict=True):
        pairing.excitation(int(stamp), float(value))
    for stamp, value in zip(responses.stamps, responses.values, strict=True):
        pairing.response(int(stamp), float(value))
    monitor = proved.monitor(nominal)
    start = int(responses.stamps[0])
    readings = tuple(
        monitor.update((stamp - start) * NANOSECONDS, y, u) for stamp, y, u in pairing.flush()
    )
    return Replay(
        name=bag.name,
        readings=readings,
        axis=model.y.name,
        unit=model.y.unit,
        half_width=proved.funnel.output_half_width,
    )
