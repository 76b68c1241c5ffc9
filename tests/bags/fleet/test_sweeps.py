"""What is tried is the same to the last bit, whoever tries it."""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from bags.commands.cli import app
from bags.designs import documents
from bags.fleet.workers import Workers
from bags.samples import f1tenth
from nlsid_core import files
from nlsid_core.design import ContinuousTracking, design_funnel, integrate_nominal
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import DataError
from tests.bags.fleet.deadly import die

CONFIG = """\
robot: car
signals:
  response: {name: speed, unit: m/s, path: "/odom:twist.twist.linear.x"}
  excitation: {name: command, unit: m/s, path: "/cmd_vel:twist.linear.x"}
grid: {period: 0.025, max_gap: 0.1}
split: {test: ["*0"], validation: ["*5"]}
identification: IDENTIFICATION
"""
LAGS = "{lags: 1, iterations: 1}\nselect: {lags: [1, 2, 100]}"
SEEDS = """{model: block_cascade, orders: [1, 0], phases: [1], intervals: [3], starts: 1}
select: {seed: [0, 1]}"""


def selected(folder: Path, identification: str, *who: str) -> tuple[str, list[bytes]]:
    """What `nlsid identify --select` says of all that it tried, and what it writes."""
    (folder / "robot.yaml").write_text(CONFIG.replace("IDENTIFICATION", identification))
    bags = [str(path) for path in f1tenth()]
    given = [*bags, "--config", str(folder / "robot.yaml"), "--select", *who]
    done = CliRunner().invoke(app, ["identify", str(folder / "out"), *given])
    assert done.exit_code == 0, done.output
    written = (documents.MODEL, documents.MODEL_PROOF, documents.TRAINING, documents.HELD_BACK)
    _, chosen, rest = done.output.partition("chosen by")  # workers say first what they read
    assert chosen
    said = rest.partition(" test trials")[0]  # what follows says how long it took
    return said, [(folder / "out" / name).read_bytes() for name in written]


def pendulum(x: Any, u: Any) -> Any:
    return np.array([x[1], -x[0] + x[0] ** 3 / 6 - x[1] / 5 + u[0]])


@pytest.mark.slow
@pytest.mark.parametrize("identification", [LAGS, pytest.param(SEEDS, marks=pytest.mark.slow)])
def test_a_selection_is_the_same_whoever_tries(tmp_path: Path, identification: str) -> None:
    folders = [tmp_path / "here", tmp_path / "two"]
    for folder in folders:
        folder.mkdir()
    here, two = (
        selected(folder, identification, *who)
        for folder, who in zip(folders, ((), ("--workers", "2")), strict=True)
    )
    assert here == two
    if identification == LAGS:
        assert "parameters" in here[0], "of the class that does not fit, the reason"


@pytest.mark.slow
def test_the_l_steps_of_a_funnel_are_the_same_whoever_solves_them() -> None:
    field = VectorField.from_function(pendulum, 2, 1)
    t = np.linspace(0, 2, 5)
    nominal = integrate_nominal(field, lambda _: np.zeros(1), t=t, start=np.zeros(2))
    here = design_funnel(ContinuousTracking(field, nominal, goal=20 * np.eye(2), shape="P"))
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
        shared = design_funnel(
            ContinuousTracking(field, nominal, goal=20 * np.eye(2), shape="P"), executor=executor
        )
    assert len(here.found.history) > 1
    assert here.found.history == shared.found.history
    assert [files.canonical(d.funnel.document()) for d in (here, shared)] == 2 * [
        files.canonical(here.funnel.document())
    ]


@pytest.mark.slow
def test_a_dask_cluster_selects_the_same(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    for name in ("here", "dask"):
        (tmp_path / name).mkdir()
    here = selected(tmp_path / "here", LAGS)
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        who = ("--scheduler", cluster.scheduler_address)
        assert selected(tmp_path / "dask", LAGS, *who) == here


def test_a_sweep_whose_worker_dies_ends_with_a_sentence() -> None:
    def sweep(workers: Workers) -> list[None]:
        with workers.sharing() as executor:
            return [] if executor is None else list(executor.map(die, [0]))

    with pytest.raises(DataError, match="a worker died"):
        sweep(Workers(1))
    assert sweep(Workers()) == [], "in this process nothing is shared"
