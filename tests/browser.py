"""A real browser without a window: Debian's `chromium`, driven by its DevTools."""

import base64
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.websocket import WebSocket

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
MISSING = "needs a browser (apt install chromium)"
PATIENCE = 60.0  # s, on a loaded machine


class Page:
    """One tab."""

    def __init__(self, socket: WebSocket) -> None:
        self._socket, self._id = socket, 0
        self._session: str | None = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]

    def call(self, method: str, **parameters: object) -> Any:
        """One command of the DevTools protocol and its result; what comes between is dropped."""
        self._id += 1
        asked: dict[str, object] = {"id": self._id, "method": method, "params": parameters}
        if self._session is not None:
            asked["sessionId"] = self._session
        self._socket.send(json.dumps(asked))
        while True:
            answer = json.loads(self._socket.receive())
            if answer.get("id") == self._id:
                assert "error" not in answer, answer
                return answer["result"]

    def open(self, address: str, *, width: int = 1280, height: int = 860, scale: int = 1) -> None:
        """Load a page in a window of that size."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=scale,
            mobile=width < 600,
        )
        self.call("Page.navigate", url=address)

    def value(self, script: str) -> Any:
        """What a script gives; an exception in it fails the test."""
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def text(self, selector: str) -> str:
        """What an element shows."""
        return str(self.value(f"document.querySelector({selector!r})?.innerText ?? ''"))

    def wait(self, condition: Callable[[], object]) -> None:
        """Until it holds."""
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, self.text("body")
            time.sleep(0.05)

    def picture(self, path: Path) -> None:
        """A PNG of the window."""
        shot = self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(shot["data"]))


@contextmanager
def browser(profile: Path) -> Iterator[Page]:
    """A page of a browser that keeps what it has in `profile`."""
    assert CHROMIUM is not None
    running = subprocess.Popen(
        [
            CHROMIUM,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--no-first-run",
            "--disable-dev-shm-usage",
            "--remote-debugging-port=0",
            f"--user-data-dir={profile}",
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        with WebSocket(*_devtools(profile / "DevToolsActivePort")) as socket:
            yield Page(socket)
    finally:
        os.killpg(running.pid, signal.SIGKILL)
        running.wait()


def _devtools(written: Path) -> tuple[int, str]:
    """Port and path, once the browser has written them."""
    deadline = time.monotonic() + PATIENCE
    while not (written.exists() and len(lines := written.read_text().split()) == 2):
        assert time.monotonic() < deadline, "the browser did not start"
        time.sleep(0.05)
    return int(lines[0]), lines[1]
