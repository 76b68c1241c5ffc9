"""The L-step benchmark runs, its solvers agree, and what it prints last is one JSON object."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

KEYS = {"ours_ms", "cvxpy_ms", "clarabel_ms", "ratio_cvxpy"}


@pytest.mark.slow
def test_the_l_step_benchmark_prints_its_figures() -> None:
    shown = subprocess.run(
        [sys.executable, "-m", "benchmarks.lstep", "--json", "--no-scaling"],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
    )
    result = json.loads(shown.stdout.splitlines()[-1])
    assert set(result) >= KEYS
    assert result["ratio_cvxpy"] > 5
