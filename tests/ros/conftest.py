"""What every test over DDS needs, and what most do: a ROS domain, and the F1TENTH chain's files."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags
from bags.designs import documents
from bags.samples import f1tenth
from nlsid_core.progress import silent
from tests.ros.domains import own_domain


@pytest.fixture(autouse=True)
def domain() -> Iterator[None]:
    with own_domain():
        yield


@pytest.fixture(scope="session")
def funnel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The F1TENTH chain's funnel.json, with everything it needs beside it; not to be changed."""
    out = tmp_path_factory.mktemp("chain")
    config = load_config(config_file("f1tenth.yaml"))
    identify_bags(f1tenth(), config, out, progress=silent)
    design_funnel_files(out / documents.MODEL, config, out)
    return out / documents.FUNNEL


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    """Ends what a test started."""
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def bench(stack: ExitStack) -> Any:
    """A node beside those that a test starts."""
    from tests.ros.processes import Bench  # where ROS is there

    return Bench(stack)


@pytest.fixture
def robot(stack: ExitStack, funnel: Path) -> Any:
    """A car that the test drives, and its funnel, latched."""
    from tests.ros.robot import Robot

    return Robot(stack, funnel.parent)
