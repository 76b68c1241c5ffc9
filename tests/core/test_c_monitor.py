"""The monitor in C beside the one in Python, on recordings: the same verdicts and numbers."""

import ctypes
import math
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nlsid import (
    Dataset,
    Grid,
    OutputTube,
    Polynomial,
    Status,
    f1tenth,
    identify,
    read_bags,
    replay,
)
from nlsid_core.design import OutputTubeDesign, design_output_tube
from nlsid_core.errors import DataError
from nlsid_core.running.c_table import c_table, write_table
from tests.core.kernel.tube_claims import MODELS, design

CORE = Path(__file__).parents[2] / "examples" / "rclcpp_monitor"
COMPILER = shutil.which("cc") or shutil.which("gcc")


class Read(ctypes.Structure):
    """A reading in C."""

    _fields_ = (
        ("status", ctypes.c_int),
        ("margin", ctypes.c_double),
        ("assumption", ctypes.c_double),
        ("nominal", ctypes.c_double),
    )


@pytest.fixture(scope="module")
def trials() -> Dataset:
    """F1TENTH's, as shipped."""
    speed, command = "/odom:twist.twist.linear.x", "/cmd_vel:twist.linear.x"
    grid = Grid(max_gap=0.1)
    return read_bags(f1tenth(), responses=[speed], excitations=[command], grid=grid)


@pytest.fixture(scope="module")
def made(trials: Dataset) -> OutputTubeDesign:
    """Two tubes of constant width."""
    model = identify(trials, Polynomial(6)).model
    return design_output_tube(OutputTube(model, trials, level="constant"))


def compiled(made: OutputTubeDesign, folder: Path) -> Any:
    if COMPILER is None:
        pytest.skip("no C compiler")
    write_table(made, folder / "table.c")
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O2", "-ffp-contract=off"]
    sources = [folder / "table.c", CORE / "nlsid_monitor.c", "-lm"]
    library = folder / "monitor.so"
    command = [COMPILER, *flags, f"-I{CORE}", "-shared", "-fPIC", "-o", library, *sources]
    subprocess.run(list(map(str, command)), check=True)
    loaded = ctypes.CDLL(str(library))
    loaded.nlsid_update.argtypes = [ctypes.c_void_p, *[ctypes.c_double] * 3]
    loaded.nlsid_update.restype = Read
    return loaded


def test_c_says_what_python_says_of_every_sample(
    made: OutputTubeDesign, trials: Dataset, tmp_path: Path
) -> None:
    library, monitor = compiled(made, tmp_path), made.monitor()
    place = ctypes.create_string_buffer(1 << 14)
    statuses = list(Status)
    seen = set()
    for number, trial in enumerate(trials):
        monitor.restart()
        library.nlsid_start(place, ctypes.byref(ctypes.c_char.in_dll(library, "nlsid_table")))
        t, y, u = trial.t.copy(), trial.y[:, 0].copy(), trial.u[:, 0].copy()
        y[60:] += (0.0, 0.08, 0.3)[number % 3]  # a fault
        y[30], u[40] = math.nan, math.nan if number % 2 else u[40]
        t[50:] += made.model.period * (number % 4)  # samples that are lost
        for row in zip(t.tolist(), y.tolist(), u.tolist(), strict=True):
            expected, read = monitor.update(*row), library.nlsid_update(place, *row)
            assert statuses[read.status] is expected.status, (trial.name, row)
            seen.add(expected.status)
            if expected.status is Status.UNKNOWN:
                continue
            found = read.margin, read.assumption, read.nominal
            assert found == (expected.margin, expected.assumption, expected.nominal[0])
    assert seen == set(Status)


def test_the_program_of_the_page_reads_a_table_of_samples(
    made: OutputTubeDesign, trials: Dataset, tmp_path: Path
) -> None:
    compiled(made, tmp_path)  # writes the table
    page = (CORE.parents[1] / "docs" / "howto-offline.md").read_text()
    (line,) = re.findall(r"^    (gcc .*)$", page, re.MULTILINE)
    shutil.copytree(CORE, tmp_path, dirs_exist_ok=True)
    subprocess.run(line.split(), cwd=tmp_path, check=True)
    run = replace(trials.trajectories[0], y=0.6 * trials.trajectories[0].y)
    np.savetxt(tmp_path / "run.csv", np.column_stack([run.t, run.y, run.u]), "%.17g", ",")
    said = subprocess.run(
        tmp_path / "monitor",
        input=(tmp_path / "run.csv").read_text(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert said.returncode == 1
    assert (  # neither the heading nor the other line is a sample
        subprocess.run(tmp_path / "monitor", input=b"t,y,u\nhello\n", check=False).returncode == 2
    )
    assert re.findall(r" (.*) ", said.stdout) == [
        reading.status.value for reading in replay(made, run).readings
    ]


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("two_outputs", "linear model of one"),
        ("cascade", "linear model of one"),
        ("following", "level: constant"),
    ],
)
def test_other_designs_have_no_table_and_it_says_why(name: str, why: str) -> None:
    with pytest.raises(DataError, match=why):
        c_table(MODELS[name](), design("following").funnel)


def test_a_name_cannot_end_the_comment(made: OutputTubeDesign) -> None:
    model = replace(made.model, y=replace(made.model.y, name="*/ int evil; /*"))
    assert c_table(model, made.funnel).split("\n")[0].count("*/") == 1


def test_a_clock_and_a_hold_change_no_number_and_other_operations_do(
    made: OutputTubeDesign,
) -> None:
    y = replace(made.model.y, path="/y:data|clock(log)|hold(0.1 s)")
    assert "nlsid_table" in c_table(replace(made.model, y=y), made.funnel)
    y = replace(y, path="/y:data|derivative(0.1 s)")
    with pytest.raises(DataError, match="these have operations: /y:data"):
        c_table(replace(made.model, y=y), made.funnel)
