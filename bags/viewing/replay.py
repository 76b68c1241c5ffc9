"""A recording shown as a live robot is: the readings of `nlsid monitor`, at their stamps' pace."""

import threading
from pathlib import Path

from bags.monitoring.replay import replay_bag
from bags.viewing.drawn import HalfWidths, signal_names
from bags.viewing.scene import ERROR, OK, STALE, WARN, Scene
from nlsid_core.designs import AnyDesign
from nlsid_core.running.alarm import State, state_of
from nlsid_core.running.comparison import Centre
from nlsid_core.running.reading import Reading

MONITOR = "replay"
LEVELS = {
    State.INSIDE: OK,
    State.WARNING: WARN,
    State.UNKNOWN: STALE,
    State.ASSUMPTION_VIOLATED: ERROR,
    State.OUTSIDE: ERROR,
}


class Recording:
    """A bag's readings and what is drawn beside them; raises BagError as `replay_bag`."""

    def __init__(self, design: AnyDesign, bag: Path, *, centre: Centre) -> None:
        self.name = bag.name
        self._replay = replay_bag(design, bag, centre=centre)
        self._widths, self._names = HalfWidths(design), signal_names(design)
        self._said: tuple[State | None, str] = None, ""

    def play(self, scene: Scene, rate: float, closing: threading.Event) -> None:
        """Feed `scene` until the end, or until `closing` is set; rate 1: as recorded."""
        replay, waited = self._replay, 0.0
        for stamp_ns, reading in zip(replay.stamps_ns, replay.readings, strict=True):
            due = (stamp_ns - replay.stamps_ns[0]) / 1e9 / rate
            if due > waited and closing.wait(due - waited):
                return
            waited = max(waited, due)
            self._show(scene, stamp_ns, reading)
        scene.end(" ".join(filter(None, [f"verdict: {replay.verdict}.", replay.reason])))

    def _show(self, scene: Scene, stamp_ns: int, reading: Reading) -> None:
        state = state_of(reading, 0.0)
        if state is not self._said[0]:  # as the node does: an event is a change
            self._said = state, state.value + (f": {reading.reason}" if reading.reason else "")
        scene.say(stamp_ns, MONITOR, LEVELS[state], self._said[1], names=self._names)
        scene.sample(stamp_ns, {**reading.numbers, **self._widths.of(reading)})
