"""The same for Foxglove: its websocket protocol, by foxglove-sdk (extra `view`).

Topics: /nlsid/margin, /nlsid/signals, /nlsid/forecast, /nlsid/status (JSON) and /nlsid/events
(foxglove.Log), logged at the judged samples' stamps, a forecast at that of the sample it was made
after. config/foxglove_layout.json shows them. The first viewer that comes is sent the events of
before, which bear their stamps; it draws samples when they arrive.
"""

import importlib.util
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

from bags.viewing.scene import ERROR, MONITORING, OK, STALE, WARN, Event, Sample, Scene
from nlsid_core.errors import DataError

TICK: Final = 0.05  # s between looks at the scene
REPEAT: Final = 10  # ticks: the status is said twice a second while it stays the same
MARGIN, SIGNALS, FORECAST, STATUS, EVENTS = (
    f"/nlsid/{name}" for name in ("margin", "signals", "forecast", "status", "events")
)
_NUMBER = {"type": "number"}
_TEXT = {"type": "string"}
SCHEMAS: Final[dict[str, dict[str, Any]]] = {
    MARGIN: dict.fromkeys(MONITORING, _NUMBER),
    SIGNALS: {
        "signals": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {"name": _TEXT}
                | dict.fromkeys(("nominal", "lower", "upper", "measured"), _NUMBER),
            },
        }
    },
    FORECAST: {
        "ahead": _NUMBER,
        "signals": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {"name": _TEXT, "lower": _NUMBER, "upper": _NUMBER},
            },
        },
    },
    STATUS: {"word": _TEXT, "level": {"type": "integer"}, "text": _TEXT, "source": _TEXT},
}


@contextmanager
def serve_foxglove(scene: Scene, *, host: str, port: int) -> Iterator[str]:
    """Serve until the block ends; gives the address. port 0: a free one.

    DataError if foxglove-sdk is not installed; RuntimeError if the port is taken.
    """
    if importlib.util.find_spec("foxglove") is None:
        raise DataError("foxglove-sdk is not installed: pip install 'nlsid[view]', or use --page")
    import foxglove

    class Viewers(foxglove.websocket.ServerListener):
        """Who hears of events; the first of them sets `first`."""

        def __init__(self) -> None:
            self.first = threading.Event()
            self._ids = set[int]()

        def on_subscribe(self, client: Any, channel: Any) -> None:
            if channel.topic == EVENTS:
                if not self._ids:
                    self.first.set()
                self._ids.add(client.id)

        def on_unsubscribe(self, client: Any, channel: Any) -> None:
            if channel.topic == EVENTS:
                self._ids.discard(client.id)

    context, viewers = foxglove.Context(), Viewers()
    server = foxglove.start_server(
        name="nlsid view", host=host, port=port, context=context, server_listener=viewers
    )
    closing = threading.Event()
    thread = threading.Thread(target=_send, args=(scene, context, viewers.first, closing))
    thread.start()
    try:
        yield f"ws://{host}:{server.port}"
    finally:
        closing.set()
        thread.join()
        server.stop()


def _send(scene: Scene, context: Any, first: threading.Event, closing: threading.Event) -> None:
    import foxglove
    from foxglove.channels import LogChannel

    channels = {
        topic: foxglove.Channel(
            topic, schema={"type": "object", "properties": properties}, context=context
        )
        for topic, properties in SCHEMAS.items()
    }
    log = LogChannel(EVENTS, context=context)
    sampled = told = tick = foreseen = 0
    newest_ns, before = 0, None
    while not closing.wait(TICK):
        if first.is_set():
            first.clear()
            told = 0
        sampled, samples = scene.samples_after(sampled, 10**9)
        told, events = scene.events_after(told)
        for sample in samples:
            newest_ns = max(newest_ns, sample.stamp_ns)
            channels[MARGIN].log(_margin(sample), log_time=sample.stamp_ns)
            channels[SIGNALS].log(_signals(sample, scene.names), log_time=sample.stamp_ns)
        foreseen, forecasts = scene.forecasts_after(foreseen)
        for each in forecasts:
            ahead = each.numbers.get("ahead", 0.0)
            made_ns = each.stamp_ns - round(ahead * 1e9)
            said_ahead = {"ahead": ahead, "signals": _ends(each, scene.names)}
            channels[FORECAST].log(said_ahead, log_time=made_ns)
        for event in events:
            newest_ns = max(newest_ns, event.stamp_ns)
            log.log(_log(event), log_time=event.stamp_ns)
        said, tick = scene.verdict(), tick + 1
        if said != before or tick % REPEAT == 0:
            before = said
            status = {"word": said.word, "level": said.level, "text": said.text}
            channels[STATUS].log(status | {"source": scene.source}, log_time=newest_ns or None)


def _margin(sample: Sample) -> dict[str, float]:
    """What is not finite is left out: JSON has no word for it."""
    return {n: v for n in MONITORING if math.isfinite(v := sample.numbers.get(n, math.nan))}


def _signals(sample: Sample, names: tuple[str, ...]) -> dict[str, Any]:
    entries = []
    for i in range(sample.signals):
        nominal, width = sample.signal("nominal", i), sample.signal("half_width", i)
        numbers = {
            "nominal": nominal,
            "lower": nominal - width,
            "upper": nominal + width,
            "measured": sample.signal("measured", i),
        }
        known: dict[str, Any] = {n: v for n, v in numbers.items() if math.isfinite(v)}
        entries.append({"name": names[i] if i < len(names) else f"signal {i + 1}"} | known)
    return {"signals": entries}


def _ends(forecast: Sample, names: tuple[str, ...]) -> list[dict[str, Any]]:
    """Lower and upper of every signal, where they are finite."""
    found = []
    for i, name in enumerate(names):
        numbers = {"lower": forecast.signal("low", i), "upper": forecast.signal("high", i)}
        known: dict[str, Any] = {n: v for n, v in numbers.items() if math.isfinite(v)}
        found.append({"name": name} | known)
    return found


def _log(event: Event) -> Any:
    from foxglove.messages import Log, LogLevel, Timestamp

    levels = {
        OK: LogLevel.Info,
        WARN: LogLevel.Warning,
        ERROR: LogLevel.Error,
        STALE: LogLevel.Warning,
    }
    return Log(
        timestamp=Timestamp(sec=event.stamp_ns // 10**9, nsec=event.stamp_ns % 10**9),
        level=levels.get(event.level, LogLevel.Warning),
        message=event.text,
        name=event.node,
    )
