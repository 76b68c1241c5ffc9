"""A synthetic robot with a known truth, small enough for every test to fit its own model."""

import functools
import gc
import os
import signal
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.main import get_command

from bags.chain.shipped import config_file
from bags.designs.documents import FUNNEL
from nlsid import Dataset, Fit, OutputTube, Polynomial, Trajectory, f1tenth, identify
from nlsid_core.design import OutputTubeDesign, design_output_tube
from nlsid_core.models import DifferenceEquation
from tests.verbs import nlsid

# A shell's background jobs ignore interrupts, and so would every process the tests start from one.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # and under nohup those that a closed terminal sends

# Tests in which pages and pictures are drawn. In others the commands find no matplotlib, as where
# it is not installed: drawing takes half of their time.
DRAW = {"pictures", "ros", "colcon", "coq"}

# Thousands of collected tests live to the end: nothing of them is garbage, and to look for it among
# them takes a quarter of the collection's time.
gc.disable()

# A runner reads the signatures of all commands whenever it runs one: 35 ms of processor time.
pytest.MonkeyPatch().setattr("typer.testing._get_command", functools.cache(get_command))

# What tests decide is remembered in no user's cache.
os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="nlsid-test-cache-")

TRUE_A = np.array([1.5, -0.56])  # poles 0.7 and 0.8
TRUE_B = np.array([0.0, 0.05, 0.03])
PERIOD = 0.1
SHARED = Path(__file__).resolve().parent.parent.parent / "shared" / "data"


def pytest_collection_finish() -> None:
    """From here on garbage is collected, but not looked for among what was collected by pytest."""
    gc.freeze()
    gc.enable()


def simulate_truth(u: np.ndarray) -> np.ndarray:
    """The synthetic robot's response from rest to u (N,)."""
    y = np.zeros(len(u))
    for t in range(2, len(u)):
        y[t] = TRUE_A @ y[t - 2 : t][::-1] + TRUE_B @ u[t - 2 : t + 1][::-1]
    return y


def synthetic_dataset(noise: float, *, trials: int = 6, samples: int = 80) -> Dataset:
    """Steps of random height and length, measured with white noise."""
    rng = np.random.default_rng(7)
    trajectories = []
    for index in range(trials):
        u = np.repeat(rng.uniform(0.0, 1.0, samples // 8), 8)
        u[:8] = 0.0
        y = simulate_truth(u) + noise * rng.standard_normal(samples)
        trajectories.append(
            Trajectory(
                t=np.linspace(0.0, PERIOD * (samples - 1), samples),
                y=y,
                u=u,
                y_names=("speed",),
                u_names=("command",),
                y_units=("m/s",),
                u_units=("m/s",),
                name=f"run_{index}",
                digest=f"sha256:{index:064x}",
            )
        )
    return Dataset(tuple(trajectories))


@pytest.fixture(autouse=True)
def undrawn(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """No matplotlib, unless the test is about what is drawn."""
    if not DRAW & {mark.name for mark in request.node.iter_markers()}:
        monkeypatch.setitem(sys.modules, "matplotlib", None)


@pytest.fixture(scope="session")
def train() -> Dataset:
    """Noisy recordings of the synthetic robot."""
    return synthetic_dataset(0.01)


@pytest.fixture(scope="session")
def fit(train: Dataset) -> Fit[DifferenceEquation]:
    """A model with two lags of the synthetic robot."""
    return identify(train, Polynomial(2))


@pytest.fixture(scope="session")
def design(fit: Fit[DifferenceEquation], train: Dataset) -> OutputTubeDesign:
    """Two tubes for it, one for ever and one for 7 s, and around a plan with a policy."""
    model = replace(fit.model, training="sha256:0")
    return design_output_tube(
        OutputTube(
            model,
            train,
            profile=[(0.0, 0.0), (1.0, 0.0), (3.0, 0.5), (7.0, 0.5)],
            horizon=7.0,
            inlet=0.02,
            safety_factor=1.5,
        )
    )


@pytest.fixture(name="tube")
def _tube(design: OutputTubeDesign) -> OutputTubeDesign:
    """The same, by a name that is not the verb's."""
    return design


@pytest.fixture(scope="session")
def f1tenth_chain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that `nlsid identify` and `nlsid funnel` write for F1TENTH; to be read only."""
    out, shared = tmp_path_factory.mktemp("chain"), ("--config", config_file("f1tenth.yaml"))
    assert "robust simulation error" in nlsid("identify", out, f1tenth()[0].parent, *shared)
    nlsid("funnel", out, *shared)
    return out


@pytest.fixture(scope="session")
def funnel(f1tenth_chain: Path) -> Path:
    """Its funnel.json, with everything it needs beside it."""
    return f1tenth_chain / FUNNEL
