"""The live chain over real DDS, every node a process of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from bags.designs import documents
from bags.samples import f1tenth
from tests.ros.domains import fresh_domain

pytest.importorskip("rclpy", reason="needs rclpy (extra `ros`)")

pytestmark = pytest.mark.ros


@pytest.fixture
def environment() -> dict[str, str]:
    """Discovery kept to this machine and to this test."""
    return os.environ | {
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": fresh_domain(),
    }


def test_live_nodes_agree_with_the_offline_replay(
    funnel: Path, tmp_path: Path, environment: dict[str, str]
) -> None:
    trial = next(bag for bag in f1tenth() if bag.name == "trial_05")
    command = [sys.executable, "-m", "nlsid_ros.demo.live", "--json"]
    options = ["--funnel", str(funnel), "--bag", str(trial), "--out", str(tmp_path / "live")]
    done = subprocess.run(
        command + options, capture_output=True, text=True, env=environment, timeout=200, check=False
    )
    assert done.stdout, done.stderr
    seen = json.loads(done.stdout.splitlines()[-1])
    assert seen["recording_equal"], done.stdout
    assert seen["sent"] == seen["recorded"] == 241
    assert seen["margins"] == seen["margins_expected"] == 117
    assert seen["margin_difference"] <= 1e-9
    assert abs(seen["alarm_ms"]) <= 50
    assert "above the budget" in seen["expected"]
    assert seen["expected"] in seen["alarm"]
    assert done.returncode == 0


@pytest.mark.parametrize("damage", ["forged", "no proof", "no funnel"])
def test_the_publisher_refuses_what_is_not_proved(
    funnel: Path, tmp_path: Path, environment: dict[str, str], damage: str
) -> None:
    for name in (documents.MODEL, documents.POLICY, documents.FUNNEL, documents.FUNNEL_PROOF):
        (tmp_path / name).write_bytes((funnel.parent / name).read_bytes())
    if damage == "forged":
        text = (tmp_path / documents.FUNNEL).read_text()
        (tmp_path / documents.FUNNEL).write_text(text.replace('"budget": 0.0', '"budget": 0.1'))
    elif damage == "no proof":
        (tmp_path / documents.FUNNEL_PROOF).unlink()
    else:
        (tmp_path / documents.FUNNEL).unlink()
    parameter = f"funnel:={tmp_path / documents.FUNNEL}"
    done = subprocess.run(
        [sys.executable, "-m", "nlsid_ros.funnel_publisher", "--ros-args", "-p", parameter],
        capture_output=True, text=True, env=environment, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert "not published, not proved" in done.stderr + done.stdout
