"""What most tests over DDS need: the F1TENTH chain's files."""

from pathlib import Path

import pytest

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags
from bags.designs import documents
from bags.samples import f1tenth
from nlsid_core.progress import silent


@pytest.fixture(scope="session")
def funnel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The F1TENTH chain's funnel.json, with everything it needs beside it; not to be changed."""
    out = tmp_path_factory.mktemp("chain")
    config = load_config(config_file("f1tenth.yaml"))
    identify_bags(f1tenth(), config, out, progress=silent)
    design_funnel_files(out / documents.MODEL, config, out)
    return out / documents.FUNNEL
