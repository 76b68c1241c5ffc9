"""What stands still or cannot hear says so and ends: watchdog, and what the dead left in memory."""

import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from sensor_msgs.msg import JointState

from nlsid_ros import qos, shared_memory
from tests.ros.processes import ROOT, STARTED, node_here, process, ros_test, stop

pytestmark = ros_test
RECORDER = "nlsid_ros.trajectory_recorder"
STUCK = """
import ctypes, threading
from nlsid_ros.starting import entry_point
from nlsid_ros.trajectory_recorder import TrajectoryRecorder

class Stuck(TrajectoryRecorder):
    def _keep_up(self):
        {how}

entry_point(Stuck)()
"""
SAID = "trajectory_recorder: the executor has stood still for 2 s: ended by its watchdog"


@contextmanager
def stuck(how: str, bag: Path) -> Iterator[subprocess.Popen[str]]:
    """A recorder whose executor is held up by what stands in `how`."""
    settings = ["--ros-args", "-p", "topics:=[/joints]", "-p", f"bag:={bag}"]
    with subprocess.Popen(
        [sys.executable, "-c", STUCK.format(how=how), *settings],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=ROOT,
    ) as running:
        try:
            yield running
        finally:
            running.kill()


@pytest.mark.parametrize(
    "how",
    [
        "threading.Lock().acquire(); (lock := threading.Lock()).acquire(); lock.acquire()",
        "ctypes.PyDLL(None).pause()",
    ],
    ids=["a lock", "a call that keeps Python's lock"],
)
def test_a_recorder_whose_executor_stands_still_says_so_and_ends(how: str, tmp_path: Path) -> None:
    with stuck(how, tmp_path / "bag") as recorder:
        output = recorder.communicate(timeout=STARTED)[0]
    assert SAID in output
    assert recorder.returncode == -signal.SIGABRT


@pytest.mark.parametrize("held", ["starved", "stopped", "at work"])
def test_a_recorder_that_is_starved_or_stopped_or_works_for_long_goes_on(
    held: str, tmp_path: Path
) -> None:
    how = "end = time.monotonic() + 5\n        while time.monotonic() < end: pass"
    working = f"import time\n        {how if held == 'at work' else 'super()._keep_up()'}"
    burners: list[subprocess.Popen[bytes]] = []
    with stuck(working, tmp_path / "bag") as recorder:
        while not (tmp_path / "bag").exists():
            assert recorder.poll() is None
            time.sleep(0.05)
        try:
            if held == "starved":
                os.sched_setaffinity(recorder.pid, {0})
                for thread in Path(f"/proc/{recorder.pid}/task").iterdir():
                    os.sched_setaffinity(int(thread.name), {0})
                    os.setpriority(os.PRIO_PROCESS, int(thread.name), 19)
                for _ in range(6):
                    burners.append(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
                    os.sched_setaffinity(burners[-1].pid, {0})
            if held == "stopped":
                recorder.send_signal(signal.SIGSTOP)
            time.sleep(5.0)
        finally:
            for burner in burners:
                burner.kill()
                burner.wait()
        if held == "stopped":
            recorder.send_signal(signal.SIGCONT)
            time.sleep(1.0)
        assert SAID not in stop(recorder)


def test_the_recorder_after_many_that_were_killed_hears_the_sender(tmp_path: Path) -> None:
    """The sender may write into the memory of the dead; the living hear it all the same."""
    with node_here("test_robot") as (node, spin_until):
        publisher = node.create_publisher(JointState, "/joints", qos.STREAM)
        node.create_timer(0.002, lambda: publisher.publish(JointState(name=["wheel"])))
        for k in range(4):
            bag = tmp_path / f"bag_{k}"
            with process(RECORDER, topics=["/joints"], bag=bag, repair=False):
                file = bag / f"{bag.name}.mcap"
                spin_until(lambda file=file: file.exists() and file.stat().st_size > 10_000)  # type: ignore[misc]


def test_what_the_dead_left_is_removed_and_ports_that_the_living_may_write_to_are_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def participant(number: int) -> list[Path]:
        names = [f"fastrtps_{number:016x}", f"fastrtps_port{number}"]
        files = [tmp_path / f"{name}{end}" for name in names for end in ("", "_el")]
        for file in [*files, tmp_path / f"sem.{names[1]}_mutex"]:
            file.touch()
            os.utime(file, (0.0, 0.0))
        return files

    monkeypatch.setenv(shared_memory.RANGE, "LOCALHOST")
    monkeypatch.delenv(shared_memory.TRANSPORTS, raising=False)
    monkeypatch.delenv(shared_memory.PROFILES, raising=False)
    others = [tmp_path / name for name in ("fast_datasharing_01.0f", "fastcache")]
    for file in others:
        file.touch()
    dead, alive = participant(1), participant(2)
    locks = [file.open() for file in alive if file.name.endswith("_el")]
    for lock in locks:
        fcntl.flock(lock, fcntl.LOCK_EX)
    shared_memory.avoid_what_is_stale(tmp_path)
    assert [file.exists() for file in dead] == [False, False, True, True]
    assert all(file.exists() for file in alive)
    assert os.environ[shared_memory.TRANSPORTS] == "UDPv4"
    assert Path(os.environ[shared_memory.PROFILES]).exists()

    for lock in locks:
        lock.close()
    assert shared_memory.clear(tmp_path), "nobody lives who could write"
    assert sorted(tmp_path.iterdir()) == others, "they are not of this transport"
