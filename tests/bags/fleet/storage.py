"""A web server and an S3 server of this machine, and bags for them to serve."""

import math
import time
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from types import MappingProxyType
from typing import Any

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer

from bags.recordings.mcap_records import CUSTOM_DATA
from tests.bag_messages import (
    CMD,
    CMD_TYPE,
    ODOM,
    ODOM_TYPE,
    PERIOD_NS,
    START_NS,
    command,
    odometry,
)

PART = 4096  # bytes that are sent at a time
IMAGE = "/camera"
IMAGE_TYPE = "std_msgs/msg/ByteMultiArray"
Fault = Callable[[str, int], int | None]  # (path, number of the request) -> status, None: serve


@dataclass(frozen=True)
class Odd:
    """What is odd about a drive.

    held: the command throughout. without: samples of the speed that are not there. back_from: the
    sample from which on stamps, not log times, are ten samples earlier. odom: the speed's topic.
    lost: messages of it that the recorder says it lost. start_ns: of the first stamp.
    """

    held: float | None = None
    without: Container[int] = ()
    back_from: int | None = None
    odom: str = ODOM
    lost: int | None = None
    start_ns: int = START_NS


USUAL = Odd()


def drive(
    file: Path,
    *,
    samples: int = 200,
    seed: int = 0,
    image_bytes: int = 0,
    writer: Mapping[str, Any] = MappingProxyType({}),
    odd: Odd = USUAL,
) -> Path:
    """An MCAP file of a car's speed that follows commands, in chunks, with images between.

    writer: options of mcap's writer.
    """
    from bags.recordings.definitions import standard_definition

    rng = np.random.default_rng(seed)
    commands = np.repeat(rng.uniform(-1.0, 1.0, 1 + samples // 10), 10)[:samples]
    file.parent.mkdir(parents=True, exist_ok=True)
    speed = 0.0
    with file.open("wb") as stream:
        options = {"chunk_size": 64 * 2**10, "compression": CompressionType.NONE, **writer}
        mcap = Writer(stream, index_types=IndexType.ALL, **options)
        mcap.start(profile="ros2")
        channels = {}
        for topic, kind in ((CMD, CMD_TYPE), (odd.odom, ODOM_TYPE), (IMAGE, IMAGE_TYPE)):
            schema = mcap.register_schema(kind, "ros2msg", standard_definition(kind).text.encode())
            channels[topic] = mcap.register_channel(topic, "cdr", schema)
        for k, u in enumerate(commands.tolist()):
            u = u if odd.held is None else odd.held
            at = odd.start_ns + k * PERIOD_NS
            stamp = at if odd.back_from is None or k < odd.back_from else at - 10 * PERIOD_NS
            speed = 0.8 * speed + 0.2 * u + 1e-3 * rng.standard_normal()
            mcap.add_message(channels[CMD], at, command(stamp, u), at)
            if k not in odd.without:
                mcap.add_message(channels[odd.odom], at, odometry(stamp, speed), at)
            if image_bytes:
                mcap.add_message(channels[IMAGE], at, b"\0\1\0\0" + rng.bytes(image_bytes), at)
        if odd.lost is not None:
            mcap.add_metadata(CUSTOM_DATA, {f"{odd.odom} lost": str(odd.lost)})
        mcap.finish()  # type: ignore[no-untyped-call]
    return file


@contextmanager
def web_server(
    folder: Path,
    fault: Fault | None = None,
    *,
    bytes_per_s: Mapping[str, float] | None = None,
    moved: str = "",
) -> Iterator[str]:
    """The files of a folder over HTTP with ranges and ETags; yields the URL.

    fault: what a GET is answered with instead. Status 200 to it means: half of the bytes, and no
    connection any more.
    bytes_per_s: of an answer, by path; others are sent at once. moved: where status 302 points.
    """
    count: dict[str, int] = {}

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_HEAD(self) -> None:
            self._answer(body=False)

        def do_GET(self) -> None:
            self._answer(body=True)

        def _answer(self, *, body: bool) -> None:
            file = folder / self.path.lstrip("/")
            number = count[self.path] = count.get(self.path, 0) + int(body)
            status = fault(self.path, number) if fault is not None and body else None
            if status is not None and status != 200:
                self._send(status, b"")
                return
            if not file.is_file():
                self._send(404, b"")
                return
            size, span, code = file.stat().st_size, "", 200
            start, end = 0, size
            if wanted := self.headers.get("Range"):
                first, _, last = wanted.removeprefix("bytes=").partition("-")
                start, end, code = int(first), int(last) + 1, 206
                span = f"bytes {start}-{end - 1}/{size}"
            with file.open("rb") as stream:
                stream.seek(start)
                content = stream.read(end - start) if body else b""
            length = len(content) if body else size
            if status == 200:
                content, self.close_connection = content[: len(content) // 2], True
            tag = f'"{size}-{file.stat().st_mtime_ns}"'
            self._send(code, content, length=length, tag=tag, span=span)

        def _send(
            self, code: int, content: bytes, *, length: int = 0, tag: str = "", span: str = ""
        ) -> None:
            self.send_response(code)
            self.send_header("Content-Length", str(length))
            if code == 302:
                self.send_header("Location", moved)
            if span:
                self.send_header("Content-Range", span)
            if tag:
                self.send_header("ETag", tag)
                self.send_header("Last-Modified", "Mon, 01 Jan 2024 00:00:00 GMT")
            self.end_headers()
            rate = (bytes_per_s or {}).get(self.path, math.inf)
            with suppress(ConnectionError):  # whoever asked has lost patience
                for start in range(0, len(content), PART):
                    part = content[start : start + PART]
                    time.sleep(len(part) / rate)
                    self.wfile.write(part)

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = Thread(target=server.serve_forever, args=(0.01,), daemon=True)  # ends as soon
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
