"""The page: one HTML file and a stream of server-sent events, from the standard library alone.

Nothing is loaded from elsewhere, the page may run its own script only, and names from the network
are shown as text. On a loopback address requests that name another host are refused, so that no
foreign page can read the stream through the browser.
"""

import base64
import hashlib
import json
import math
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final

from bags.viewing.scene import MONITORING, Sample, Scene
from nlsid_core.errors import DataError

LOCAL: Final = "127.0.0.1"
PORT: Final = 8080
TICK: Final = 0.1  # s between what is sent
PER_TICK: Final = 20  # samples at most; of more the worst
PER_START: Final = 2000  # samples of the past that a new reader gets
MOST_READERS: Final = 16
SLOWEST: Final = 5.0  # s until a reader that takes nothing is let go
LOOPBACK: Final = ("127.0.0.1", "localhost", "::1")
PAGE: Final = Path(__file__).with_name("page.html")
_INLINE = re.compile(r"<(script|style)>(.*?)</\1>", re.DOTALL)


@contextmanager
def serve_page(scene: Scene, *, host: str, port: int) -> Iterator[str]:
    """Serve until the block ends; gives the address. port 0: a free one.

    DataError if the port is taken or the host is none of this machine's.
    """
    try:
        server = _Server(scene, host, port)
    except OSError as error:
        raise DataError(f"cannot serve on {host}, port {port}: {error}") from error
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": TICK})
    thread.start()
    try:
        yield f"http://{host}:{server.server_address[1]}/"
    finally:
        server.closing.set()
        server.shutdown()
        thread.join()
        server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, scene: Scene, host: str, port: int) -> None:
        self.scene, self.host = scene, host
        self.closing = threading.Event()
        self.readers = threading.BoundedSemaphore(MOST_READERS)
        self.page = PAGE.read_bytes()
        super().__init__((host, port), _Handler)


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = SLOWEST

    def do_GET(self) -> None:
        """The page, or the stream."""
        named = self.headers.get("Host", "").rpartition(":")[0] or self.headers.get("Host", "")
        if self.server.host in LOOPBACK and named.strip("[]") not in LOOPBACK:
            self.send_error(HTTPStatus.FORBIDDEN)
        elif self.path == "/":
            self._head("text/html; charset=utf-8")
            self.wfile.write(self.server.page)
        elif self.path == "/stream":
            self._stream()
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing of each request."""

    def _head(self, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", _policy(self.server.page))
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.end_headers()

    def _stream(self) -> None:
        if not self.server.readers.acquire(blocking=False):
            self.send_error(HTTPStatus.SERVICE_UNAVAILABLE)
            return
        try:
            self._head("text/event-stream")
            for news in _news(self.server.scene, self.server.closing):
                self.wfile.write(f"data: {json.dumps(news, allow_nan=False)}\n\n".encode())
                self.wfile.flush()
        except OSError:
            return  # the reader is gone
        finally:
            self.server.readers.release()


def _news(scene: Scene, closing: threading.Event) -> Iterator[dict[str, Any]]:
    """What changed, every TICK; first what is known of the past."""
    sampled = told = foreseen = 0
    most, wait = PER_START, 0.0
    while not closing.wait(wait):
        foreseen, forecasts = scene.forecasts_after(foreseen)
        sampled, samples = scene.samples_after(sampled, most)
        told, events = scene.events_after(told)
        verdict, now = scene.verdict(), time.monotonic()
        yield {
            "first": most == PER_START,
            "source": scene.source,
            "verdict": [verdict.word, verdict.level, verdict.text],
            "names": scene.names,
            "samples": [_sample(sample, now) for sample in samples],
            "forecasts": [_forecast(each, len(scene.names)) for each in forecasts],
            "events": [[e.stamp_ns / 1e9, e.level, e.node, e.text] for e in events],
            "nodes": [
                [name, said.level, said.text, round(now - said.came, 1)]
                for name, said in sorted(scene.nodes().items())
            ],
        }
        most, wait = PER_TICK, TICK


def _sample(sample: Sample, now: float) -> list[Any]:
    """Stamp in s, age in s, the four numbers of the monitor, then three of every signal."""
    numbers = [sample.numbers.get(name, math.nan) for name in MONITORING]
    signals = [
        [_number(sample.signal(name, i)) for name in ("nominal", "half_width", "measured")]
        for i in range(sample.signals)
    ]
    age = round(now - sample.came, 3)
    return [sample.stamp_ns / 1e9, age, *map(_number, numbers), signals]


def _forecast(forecast: Sample, signals: int) -> list[Any]:
    """Stamp in s, then low and high of every signal."""
    ends = [[_number(forecast.signal(n, i)) for n in ("low", "high")] for i in range(signals)]
    return [forecast.stamp_ns / 1e9, ends]


def _number(value: float) -> float | str | None:
    """JSON has no NaN (null) and no infinity (a word)."""
    if math.isfinite(value):
        return float(f"{value:.6g}")
    return None if math.isnan(value) else ("inf" if value > 0 else "-inf")


def _policy(page: bytes) -> str:
    """The page's own script and style, by digest; its own stream; nothing else."""
    parts = {
        kind: base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        for kind, text in _INLINE.findall(page.decode())
    }
    return (
        f"default-src 'none'; script-src 'sha256-{parts['script']}'; "
        f"style-src 'sha256-{parts['style']}'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
