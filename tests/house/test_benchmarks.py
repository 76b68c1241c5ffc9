"""`python -m benchmarks`: every benchmark is listed, and each result says where it comes from."""

import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from benchmarks.__main__ import BENCHMARKS, Benchmark, measured
from benchmarks.bag_reading import generated_bag
from benchmarks.machine import peers
from tests.house.sources import ROOT, sources


def test_every_benchmark_is_in_the_list() -> None:
    runnable = {s.parts[-1] for s in sources("benchmarks") if "--json" in s.text} - {"__main__"}
    assert {entry.module for entry in BENCHMARKS.values()} == runnable


def test_a_result_has_its_date_machine_and_commit() -> None:
    found = measured(Benchmark("first_order_bias", ("--trials", "1")), None, 120.0)
    assert set(found) == {"command", "date", "machine", "commit", "seconds", "result"}
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
