"""What every test over DDS needs, and what most do: a ROS domain, and the F1TENTH chain's files."""

from collections.abc import Iterator
from pathlib import Path

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
