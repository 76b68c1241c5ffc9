"""What is tried is the same to the last bit, whoever tries it."""

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
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
identification: {lags: 1, iterations: 1}
select: {lags: [1, 2, 100]}
"""


def selected(folder: Path, *who: str) -> tuple[str, list[bytes]]:
    """What `nlsid identify --select` says of all that it tried, and what it writes."""
    (folder / "robot.yaml").write_text(CONFIG)
    bags = [str(path) for path in f1tenth()[:12]]
    done = CliRunner().invoke(app, ["identify", str(folder), *bags, "--select", *who])
    assert done.exit_code == 0, done.output
    written = (documents.MODEL, documents.MODEL_PROOF, documents.TRAINING, documents.HELD_BACK)
    _, chosen, rest = done.output.partition("chosen by")  # workers say first what they read
    assert chosen
    said = rest.partition(" test trials")[0]  # what follows says how long it took
    return said, [(folder / name).read_bytes() for name in written]


@contextmanager
def dask() -> Iterator[tuple[str, str]]:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        yield "--scheduler", cluster.scheduler_address


@pytest.mark.slow
def test_a_selection_is_the_same_whoever_tries(tmp_path: Path) -> None:
    for name in ("here", "two", "dask"):
        (tmp_path / name).mkdir()
    here = selected(tmp_path / "here")
    assert "parameters" in here[0], "of the class that does not fit, the reason"
    assert selected(tmp_path / "two", "--workers", "2") == here
    with dask() as who:
        assert selected(tmp_path / "dask", *who) == here


def pendulum(x: Any, u: Any) -> Any:
    return np.array([x[1], -x[0] + x[0] ** 3 / 6 - x[1] / 5 + u[0]])


@pytest.mark.slow
def test_the_l_steps_of_a_funnel_are_the_same_whoever_solves_them() -> None:
    field = VectorField.from_function(pendulum, 2, 1)
    t = np.linspace(0, 1, 3)
    nominal = integrate_nominal(field, lambda _: np.zeros(1), t=t, start=np.zeros(2))
    problem = ContinuousTracking(field, nominal, goal=20 * np.eye(2), shape="P")
    here = design_funnel(problem)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
        shared = design_funnel(problem, executor=executor)
    assert len(here.found.history) > 1
    assert here.found.history == shared.found.history
    assert here.funnel.document() == shared.funnel.document()


def test_a_sweep_whose_worker_dies_ends_with_a_sentence() -> None:
    def sweep(workers: Workers) -> list[None]:
        with workers.sharing() as executor:
            return [] if executor is None else list(executor.map(die, [0]))

    with pytest.raises(DataError, match="a worker died"):
        sweep(Workers(1))
    assert sweep(Workers()) == [], "in this process nothing is shared"
