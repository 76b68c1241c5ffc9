"""The live chain over real DDS, every node a process of its own."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags
from bags.designs import documents
from bags.samples import f1tenth
from bags.setup.candidates import look
from bags.setup.proposing import Chosen, propose
from bags.setup.written import yaml_text
from nlsid_core.progress import silent

pytest.importorskip("rclpy", reason="needs rclpy (extra `ros`)")

from tests.ros.processes import STARTED

pytestmark = pytest.mark.ros


def test_live_nodes_agree_with_the_offline_replay(funnel: Path, tmp_path: Path) -> None:
    seen = played_live(funnel, tmp_path)
    assert seen["sent"] == seen["recorded"] == 241
    assert seen["margins"] == seen["margins_expected"] == 117
    assert seen["margin_difference"] <= 1e-9
    assert abs(seen["alarm_ms"]) <= 50
    assert "above the level" in seen["expected"]
    assert seen["expected"] in seen["alarm"]


def test_a_demonstration_whose_fault_would_not_be_flagged_is_refused_by_name(
    funnel: Path, tmp_path: Path
) -> None:
    config = load_config(config_file("f1tenth.yaml"))
    assert config.funnel is not None
    wide = config.model_copy(
        update={"funnel": config.funnel.model_copy(update={"safety_factor": 100.0})}
    )
    design_funnel_files(funnel.with_name(documents.MODEL), wide, tmp_path)
    command = [sys.executable, "-m", "nlsid_ros.demo.live", "--out", str(tmp_path / "live")]
    options = ["--funnel", str(tmp_path / documents.FUNNEL), "--bag", str(f1tenth()[4])]
    done = subprocess.run(
        command + options, capture_output=True, text=True, timeout=STARTED, check=False
    )
    assert done.returncode == 1
    [said] = done.stderr.splitlines()
    assert "live: trial_05 with its sensor scaled by 0.6 is not flagged: inside" in said


def played_live(funnel: Path, folder: Path) -> dict[str, Any]:
    """What the live demonstration saw of trial 5; it says itself whether all is as it should be."""
    trial = next(bag for bag in f1tenth() if bag.name == "trial_05")
    command = [sys.executable, "-m", "nlsid_ros.demo.live", "--json"]
    options = ["--funnel", str(funnel), "--bag", str(trial), "--out", str(folder / "live")]
    done = subprocess.run(
        command + options, capture_output=True, text=True, timeout=200, check=False
    )
    assert done.stdout, done.stderr
    seen: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    assert seen["recording_equal"], done.stdout
    assert done.returncode == 0, done.stdout
    return seen


def test_two_commands_and_two_responses_on_three_topics_are_judged_live_as_in_replay(
    tmp_path: Path,
) -> None:
    """The F1TENTH car: speed and steering commands to speed and yaw rate, over DDS."""
    bags, config, out = f1tenth(), tmp_path / "robot.yaml", tmp_path / "two_by_two"
    chosen = Chosen(
        ("/odom:twist.twist.linear.x", "/odom:pose.pose.orientation.yaw|unwrap|derivative(0.12 s)"),
        ("/cmd_vel:twist.linear.x", "/steering_command:position[name=steering]"),
    )
    config.write_text(yaml_text(propose(bags, look(bags), chosen)))
    settings = load_config(config)
    identify_bags(bags, settings, out, progress=silent)
    design_funnel_files(out / documents.MODEL, settings, out)
    seen = played_live(out / documents.FUNNEL, tmp_path)
    assert seen["sent"] == seen["recorded"] == 361
    assert seen["margins"] == seen["margins_expected"] > 100
    assert seen["margin_difference"] == 0.0
    assert seen["expected"] in seen["alarm"]


@pytest.mark.parametrize("damage", ["forged", "no proof", "no funnel"])
def test_the_publisher_refuses_what_is_not_proved(
    funnel: Path, tmp_path: Path, damage: str
) -> None:
    for name in (documents.MODEL, documents.POLICY, documents.FUNNEL, documents.FUNNEL_PROOF):
        (tmp_path / name).write_bytes((funnel.parent / name).read_bytes())
    if damage == "forged":
        text = (tmp_path / documents.FUNNEL).read_text()
        forged = text.replace('"safety_factor": 1.5', '"safety_factor": 1.4')
        assert forged != text
        (tmp_path / documents.FUNNEL).write_text(forged)
    elif damage == "no proof":
        (tmp_path / documents.FUNNEL_PROOF).unlink()
    else:
        (tmp_path / documents.FUNNEL).unlink()
    parameter = f"funnel:={tmp_path / documents.FUNNEL}"
    done = subprocess.run(
        [sys.executable, "-m", "nlsid_ros.funnel_publisher", "--ros-args", "-p", parameter],
        capture_output=True,
        text=True,
        timeout=STARTED,
        check=False,
    )
    assert done.returncode == 1
    assert "not published, not proved" in done.stderr + done.stdout
