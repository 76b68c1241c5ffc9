"""`python -m benchmarks`: every benchmark is listed, and each result says where it comes from."""

import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from benchmarks.__main__ import BENCHMARKS, Benchmark, measured
from benchmarks.bag_reading import generated_bag
from benchmarks.machine import peers
from benchmarks.nonlinear import PublicSet
from benchmarks.subspace import n4sid
from nlsid_core.data.trajectory import Dataset, Trajectory
from tests.house.sources import ROOT, sources


def test_every_benchmark_is_in_the_list() -> None:
    runnable = {s.parts[-1] for s in sources("benchmarks") if "--json" in s.text} - {"__main__"}
    assert {entry.module for entry in BENCHMARKS.values()} == runnable


@pytest.mark.slow
def test_a_result_has_its_date_machine_load_and_commit() -> None:
    found = measured(Benchmark("first_order_bias", ("--trials", "1")), None, 120.0)
    assert set(found) == {"command", "date", "machine", "commit", "load", "seconds", "result"}
    assert found["command"][-3:] == ["--trials", "1", "--json"]
    assert found["result"]


def test_generated_data_stays_out_of_the_folder_that_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given, cache = tmp_path / "given", tmp_path / "cache"
    given.mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    bag = generated_bag(given, 30)
    assert bag.parent == cache / "nlsid"
    assert not list(given.iterdir())
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
    command = [sys.executable, "-m", "benchmarks", "first_order_bias", "--limit", "0.2",
               "--out", str(tmp_path)]  # fmt: skip
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "no result: first_order_bias: " in done.stdout
    assert "timed out after 0.2 seconds" in done.stdout
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_processes_of_a_benchmark_end_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A child that a benchmark waits for, and that would hold its output open for a minute."""
    started = tmp_path / "started"
    child = f"import os, pathlib; pathlib.Path({str(started)!r}).write_text(str(os.getpid()))"
    script = ["-c", f"import subprocess, sys; subprocess.run([sys.executable, '-c', "
              f"{child + '; import time; time.sleep(60)'!r}])"]  # fmt: skip
    monkeypatch.setattr(Benchmark, "command", lambda *_: [sys.executable, *script])
    with pytest.raises(subprocess.TimeoutExpired):
        measured(Benchmark("any"), None, 2.0)
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


def test_n4sid_finds_a_known_linear_system_of_two_outputs() -> None:
    A, B = np.array([[0.9, 0.3], [-0.3, 0.8]]), np.array([[1.0], [0.5]])
    C = np.array([[1.0, 0.0], [20.0, 5.0]])
    rng = np.random.default_rng(0)
    trials = []
    for k in range(2):
        u, x = rng.uniform(-1.0, 1.0, (400, 1)), np.zeros((400, 2))
        for t in range(1, 400):
            x[t] = A @ x[t - 1] + B @ u[t - 1]
        trials.append(Trajectory(t=0.1 * np.arange(400), y=x @ C.T, u=u, name=f"trial {k}"))
    model = n4sid(Dataset(tuple(trials[:1])), 2)
    assert np.sort_complex(np.linalg.eigvals(model.A)) == pytest.approx(
        np.sort_complex(np.linalg.eigvals(A)), abs=1e-3
    )
    error = model.simulate(trials[1]) - trials[1].y
    assert np.abs(error).max() < 0.01 * np.std(trials[1].y)


def test_the_score_of_a_public_set_is_the_rms_of_what_it_says() -> None:
    t = np.arange(5.0)
    data = Dataset((Trajectory(t=t, y=np.array([0.0, 2.0, 2.0, 2.0, 2.0]), u=t),))
    outputs = [np.array([[9.0], [1.0], [3.0], [1.0], [3.0]])]
    plain = PublicSet("p", ".", lambda _: (data, data, data), "mV", {}, factor=1e3)
    assert plain.score(outputs, data, skipped=1) == pytest.approx(1e3)
    summed = PublicSet("s", ".", lambda _: (data, data, data), "m", {}, integrated=True)
    assert summed.score(outputs, data, skipped=1) == pytest.approx(np.sqrt(0.5)), "-1, 0, -1, 0"
