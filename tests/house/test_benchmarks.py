"""`python -m benchmarks`: every benchmark is listed, and each result says where it comes from."""

import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from benchmarks.__main__ import BENCHMARKS, Benchmark, measured
from benchmarks.machine import peers
from benchmarks.nonlinear import PublicSet
from nlsid_core.data.trajectory import Dataset, Trajectory
from tests.house.sources import ROOT, sources


def test_every_benchmark_is_in_the_list() -> None:
    runnable = {s.parts[-1] for s in sources("benchmarks") if "__name__" in s.text} - {"__main__"}
    assert {entry.module for entry in BENCHMARKS.values()} == runnable


@pytest.mark.slow
def test_a_result_has_its_date_machine_load_and_commit() -> None:
    found = measured(Benchmark("funnel_scaling", ("--most", "2")), None, 120.0)
    assert set(found) == {"command", "date", "machine", "commit", "load", "seconds", "result"}
    assert found["command"][-3:] == ["--most", "2", "--json"]
    assert found["result"]


def test_peers_are_told_with_their_versions() -> None:
    assert peers("rosbags", "no-such-thing") == {
        "peers": {"rosbags": version("rosbags"), "no-such-thing": "not installed"}
    }


def test_a_benchmark_without_its_recordings_is_named_and_leaves_no_file(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks", "heat_exchanger", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "no result: heat_exchanger: needs --data with the folder exchanger" in done.stdout
    assert not list(tmp_path.iterdir())


def test_a_benchmark_that_takes_too_long_is_ended_with_what_it_started(tmp_path: Path) -> None:
    """--limit: named, status 1, no file, and no process of it left."""
    command = [
        sys.executable,
        "-m",
        "benchmarks",
        "funnel_scaling",
        "--limit",
        "0.2",
        "--out",
        str(tmp_path),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "no result: funnel_scaling: " in done.stdout
    assert "timed out after 0.2 seconds" in done.stdout
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_processes_of_a_benchmark_end_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A child that a benchmark waits for, and that would hold its output open for a minute."""
    started = tmp_path / "started"
    child = f"import os, pathlib; pathlib.Path({str(started)!r}).write_text(str(os.getpid()))"
    script = [
        "-c",
        f"import subprocess, sys; subprocess.run([sys.executable, '-c', "
        f"{child + '; import time; time.sleep(60)'!r}])",
    ]
    monkeypatch.setattr(Benchmark, "command", lambda *_: [sys.executable, *script])
    with pytest.raises(subprocess.TimeoutExpired):
        measured(Benchmark("any"), None, 8.0)
    patience = time.monotonic() + 10.0
    while (alive := _is_alive(int(started.read_text()))) and time.monotonic() < patience:
        time.sleep(0.01)
    assert not alive


def _is_alive(process: int) -> bool:
    """Whether it still runs: one that nobody has waited for yet is none."""
    try:
        return Path(f"/proc/{process}/stat").read_text().split()[2] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_the_score_of_a_public_set_is_the_rms_of_what_it_says() -> None:
    t = np.arange(5.0)
    data = Dataset((Trajectory(t=t, y=np.array([0.0, 2.0, 2.0, 2.0, 2.0]), u=t),))
    outputs = [np.array([[9.0], [1.0], [3.0], [1.0], [3.0]])]
    plain = PublicSet("p", ".", lambda _: (data, data), "mV", {}, factor=1e3)
    assert plain.score(outputs, data, skipped=1) == pytest.approx(1e3)
    summed = PublicSet("s", ".", lambda _: (data, data), "m", {}, integrated=True)
    assert summed.score(outputs, data, skipped=1) == pytest.approx(np.sqrt(0.5)), "-1, 0, -1, 0"
