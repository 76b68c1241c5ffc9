"""`nlsid view`: what is started, and how it ends."""

import signal
import sys
import threading

from bags.commands.launching import STOP_SIGNALS, run_together
from bags.viewing.page import serve_page
from bags.viewing.replay import MONITOR, Recording
from bags.viewing.scene import Scene


def view_live(monitor: str, *, host: str, port: int) -> int:
    """Run the node `viewer` until a stop signal; its exit status."""
    values = {"monitor": monitor, "host": f"'{host}'", "port": port}
    given = [part for name, value in values.items() for part in ("-p", f"{name}:={value}")]
    return run_together([[sys.executable, "-m", "nlsid_ros.viewer", "--ros-args", *given]])


def view_recording(recording: Recording, rate: float, *, host: str, port: int) -> None:
    """Play it once, and serve what came of it until a stop signal."""
    closing = threading.Event()
    for number in STOP_SIGNALS:
        signal.signal(number, lambda *_: closing.set())
    scene = Scene(f"recording: {recording.name}", MONITOR)
    with serve_page(scene, host=host, port=port) as address:
        print(f"{recording.name} is shown at {address}", flush=True)
        recording.play(scene, rate, closing)
        closing.wait()
