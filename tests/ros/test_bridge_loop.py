"""Plant, controller, recorder and monitor as nodes on a sampled funnel of an identified model."""

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")
pytest.importorskip("mujoco", reason="simulated robots need the extra `sim`")

from benchmarks.bridge_live import design_swing, live
from tests.ros.processes import ros_test

pytestmark = [*ros_test, pytest.mark.slow]


def test_live_verdicts_on_an_identified_robot_equal_the_replay_bit_for_bit(
    tmp_path: Path,
) -> None:
    result = live(design_swing(tmp_path), tmp_path / "bag", seconds=8.0)
    assert result.runs == result.replayed >= 3
    assert result.judged == result.expected > 200
    assert result.live_equals_replay
    # The assumption is measured on runs without ROS, so that a late command can break it here; what
    # is proved is that no run leaves the funnel before it is broken.
    assert 1 <= result.flagged_runs < result.runs
    assert result.left_with_assumption_kept == 0
    assert 0 < result.push_detect_ms < 100
    assert "disturbance response" in result.alarm
