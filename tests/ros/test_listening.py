"""`nlsid init --live`: a configuration from a robot that is running, over DDS."""

import subprocess
import sys
from pathlib import Path

import pytest

from bags.chain.config import load_config
from bags.samples import dart

pytest.importorskip("rclpy", reason="needs rclpy (extra `ros`)")

pytestmark = pytest.mark.ros


def init_live(config: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "bags.commands.cli", "init", str(config.parent), "--live"]
    return subprocess.run(
        [*command, "--yes", *options],
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )


def test_a_running_robot_is_looked_at_for_a_first_configuration(tmp_path: Path) -> None:
    """A real car's drive, played in real time to whoever listens."""
    drive = next(bag for bag in dart() if bag.name == "rubbery_20240916_151759")
    player = [sys.executable, "-m", "nlsid_ros.bag_player", "--ros-args", "-p", f"bag:={drive}"]
    topics = ["-p", "topics:=['/command', '/motion']", "-p", "wait_timeout:=120.0"]
    config = tmp_path / "robot.yaml"
    with subprocess.Popen([*player, *topics]) as robot:
        try:
            done = init_live(config, "--seconds", "12")
        finally:
            robot.kill()
    assert done.returncode == 0, done.stdout + done.stderr
    settings = load_config(config)
    assert settings.signals.response[0].path.startswith("/motion:")
    assert settings.signals.excitation[0].path.startswith("/command:")
    assert settings.grid.period == pytest.approx(0.05, rel=0.05)
    assert settings.split.share is not None
    assert "topics:=[/command, /motion]" in done.stdout
    assert f"nlsid identify {tmp_path} TRIALS" in done.stdout


def test_where_nothing_runs_this_is_said(tmp_path: Path) -> None:
    config = tmp_path / "robot.yaml"
    done = init_live(config, "--seconds", "1")
    assert done.returncode == 2
    assert "nothing was heard" in done.stderr
    assert not config.exists()
