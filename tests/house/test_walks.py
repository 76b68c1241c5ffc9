"""The walks of docs/architecture.md, on F1TENTH: every file that they name runs on that walk."""

import re
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from bags.chain.shipped import config_file
from bags.samples import f1tenth
from tests.house.sources import ROOT
from tests.verbs import nlsid

# What a tube of recorded bags does not go through: the other two kinds, the live node, and the
# claim itself, which is decided in a process of its own.
ELSEWHERE = {
    "nlsid_core/kernel/checking.py",
    "nlsid_core/kernel/tube.py",
    "nlsid_core/design/sampled/design.py",
    "nlsid_core/design/continuous/design.py",
    "nlsid_ros/funnel_monitor.py",
}


def files_run_by(*arguments: object) -> set[str]:
    """Files of the checkout of which a function ran while the command line did this."""
    ran: set[str] = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_name != "<module>":
            ran.add(frame.f_code.co_filename)

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        nlsid(*arguments)
    finally:
        sys.setprofile(before)
    return {str(Path(file).relative_to(ROOT)) for file in ran if file.startswith(str(ROOT))}


@pytest.mark.slow
def test_every_file_of_a_walk_runs_on_it(tmp_path: Path) -> None:
    bags = f1tenth()
    walks: list[set[str]] = [set(), set(), set()]
    for name in ("f1tenth", "f1tenth_driven"):  # around a plan, and around the model's simulation
        config, out = config_file(f"{name}.yaml"), tmp_path / name
        walks[0] |= files_run_by("identify", out, *bags, "--config", config)
        walks[1] |= files_run_by("funnel", out, "--config", config)
        walks[2] |= files_run_by("check", out)
        walks[2] |= files_run_by("monitor", out, bags[4])
    pages = (ROOT / "docs" / "architecture.md").read_text().split("\n## Walk ")[1:]
    for page, ran in zip(pages, walks, strict=True):
        named = set(re.findall(r"`((?:nlsid_core|bags|nlsid_ros)/[\w/]+\.py)`", page))
        assert named - ELSEWHERE <= ran
