"""As much of a websocket client (RFC 6455) as the tests need."""

import base64
import os
import socket
import struct
from types import TracebackType

TEXT, BINARY, CLOSE, PING, PONG = 1, 2, 8, 9, 10


class WebSocket:
    """Connected to `path` of a port of this machine."""

    def __init__(self, port: int, path: str = "/", *, protocol: str = "") -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=60.0)
        key = base64.b64encode(os.urandom(16)).decode()
        lines = [
            f"GET {path} HTTP/1.1",
            f"Host: 127.0.0.1:{port}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            f"Sec-WebSocket-Key: {key}",
            "Sec-WebSocket-Version: 13",
            *([f"Sec-WebSocket-Protocol: {protocol}"] if protocol else []),
            "",
            "",
        ]
        self._socket.sendall("\r\n".join(lines).encode())
        self._stream = self._socket.makefile("rb")
        self.accepted = self._stream.readline().startswith(b"HTTP/1.1 101")
        while self._stream.readline().strip():
            pass

    def __enter__(self) -> "WebSocket":
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        self._stream.close()
        self._socket.close()

    def send(self, text: str) -> None:
        """One text message."""
        self._frame(TEXT, text.encode())

    def receive(self) -> bytes:
        """The next message."""
        whole = b""
        while True:
            first, second = self._stream.read(2)
            size = second & 127
            if size > 125:
                form = ">H" if size == 126 else ">Q"
                [size] = struct.unpack(form, self._stream.read(struct.calcsize(form)))
            data = self._stream.read(size)
            kind = first & 15
            if kind == PING:
                self._frame(PONG, data)
            elif kind == CLOSE:
                raise ConnectionError("the server closed the connection")
            elif kind != PONG:
                whole += data
                if first & 128:
                    return whole

    def _frame(self, kind: int, data: bytes) -> None:
        size = len(data)
        head = bytes([128 | kind])
        if size < 126:
            head += bytes([128 | size])
        else:
            head += bytes([128 | 126]) + struct.pack(">H", size)
        assert size < 1 << 16
        self._socket.sendall(head + bytes(4) + data)  # masked with zeros
