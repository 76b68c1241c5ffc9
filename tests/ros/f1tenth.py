"""The F1TENTH chain's files, which most tests over DDS need."""

from pathlib import Path

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags
from bags.monitoring import documents
from bags.samples import f1tenth


def design_f1tenth(folder: Path) -> Path:
    """Identify the car and design its funnel in `folder`; funnel.json, with all it needs beside."""
    config = load_config(config_file("f1tenth.yaml"))
    identify_bags(f1tenth(), config, folder, progress=lambda _what, _fraction: None)
    design_funnel_files(folder / documents.MODEL, config, folder)
    return folder / documents.FUNNEL
