"""A bag of what a running robot publishes now, recorded by the node that records trials."""

import importlib.util
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Final

from bags.recordings.bag import Bag
from nlsid_core.errors import BagError, DataError

RECORDER: Final = "nlsid_ros.trajectory_recorder"  # a process: bags knows nothing of ROS
OWN: Final = ("/diagnostics", "/trajectory_recorder/")  # what the recorder itself publishes
FOUND_WITHIN: Final = 5.0  # s for discovery, which are recorded too
PATIENCE: Final = 30.0  # s for the recorder to come up, and to close its bag


def listen(bag: Path, seconds: float) -> Path:
    """Every topic for so many seconds after the first message was logged, as `bag`.

    Raises DataError without rclpy or if the recorder ends by itself, BagError if nothing came.
    """
    if importlib.util.find_spec("rclpy") is None:
        raise DataError("rclpy is not installed (pip install 'nlsid[ros]', or a ROS shell)")
    parameters = {"topics": "['/*']", "bag": bag, "repair": "false", "chunk_period": 0.5}
    settings = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    recorder = subprocess.Popen(
        [sys.executable, "-m", RECORDER, "--ros-args", *settings],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        began = time.monotonic()
        while not bag.is_dir() and recorder.poll() is None:
            if time.monotonic() - began > PATIENCE:
                raise DataError(f"the recorder made no bag within {PATIENCE:g} s")
            time.sleep(0.05)
        with_discovery = time.monotonic() + FOUND_WITHIN + seconds
        while recorder.poll() is None and time.monotonic() < with_discovery:
            time.sleep(0.05)
        if recorder.poll() is None:
            recorder.send_signal(signal.SIGINT)
        said = recorder.communicate(timeout=PATIENCE)[0]
    finally:
        recorder.kill()  # nothing happens to one that has ended
        recorder.wait()
    if recorder.returncode or not bag.is_dir():
        raise DataError(f"the recorder ended with status {recorder.returncode}: {said[-500:]}")
    with Bag(bag) as recorded:
        if all(topic.startswith(OWN) or not recorded.count(topic) for topic in recorded.topics):
            raise BagError(
                f"nothing was heard in {seconds:g} s; is the robot running, and is this its "
                "ROS_DOMAIN_ID?"
            )
    return bag
