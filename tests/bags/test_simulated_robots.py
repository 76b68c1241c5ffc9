"""MuJoCo robots as sources of recordings, and the whole chain on one of them through bags."""

from pathlib import Path

import numpy as np
import pytest

from bags.chain.joint_bags import write_joint_bag
from bags.chain.plants import ARM, PENDULUM, PERIOD, Plant
from bags.chain.simulation import record_repeats
from bags.chain.steps import read_signals_of
from bags.chain.tracking_config import load_tracking_config
from tests.verbs import nlsid

pytest.importorskip("mujoco", reason="simulated robots need the extra `sim`")

ROOT = Path(__file__).resolve().parents[2]


def test_a_pendulum_swings_at_the_period_of_small_oscillations_and_comes_to_rest() -> None:
    plant = Plant(PENDULUM, np.random.default_rng(0))
    plant.reset([0.1, 0.0])
    angles = []
    for _ in range(3000):
        angles.append(plant.state[0])
        plant.step([0.0])
    crossings = np.flatnonzero(np.diff(np.sign(angles[:300])))
    inertia = 1.0 + 0.01  # kg m², of the mass at 1 m and of its own
    expected = np.pi * np.sqrt(inertia / 9.81)
    assert np.diff(crossings).mean() * PERIOD == pytest.approx(expected, rel=0.05)
    assert abs(angles[-1]) <= 0.02 / 9.81  # dry friction holds it that near to the bottom


def test_sensor_noise_has_the_stated_size_and_runs_repeat_with_their_seed() -> None:
    def recorded(seed: int) -> np.ndarray:
        plant = Plant(ARM, np.random.default_rng(seed))
        return np.array([plant.measure() for _ in range(4000)])

    np.testing.assert_allclose(recorded(1).std(axis=0), [1e-3, 1e-3, 1e-2, 1e-2], rtol=0.06)
    assert (recorded(1) == recorded(1)).all()
    assert (recorded(1) != recorded(2)).any()


def test_drives_do_not_give_more_than_their_limit() -> None:
    states = []
    for torque in (20.0, 1000.0):
        plant = Plant(PENDULUM, np.random.default_rng(0))
        plant.step([torque])
        states.append(plant.state)
    np.testing.assert_array_equal(states[0], states[1])


def test_bags_of_a_simulated_robot_read_back_bit_for_bit_as_repeats(tmp_path: Path) -> None:
    data = record_repeats(ARM, peak=np.array([4.0, 2.0]), groups=1, repeats=2, seconds=1.0, seed=0)
    bags = [write_joint_bag(tmp_path, trial) for trial in data]
    again = read_signals_of(bags, load_tracking_config(ROOT / "config" / "arm.yaml"))
    for trial, read in zip(data, again, strict=True):
        np.testing.assert_array_equal(read.y, trial.y)
        np.testing.assert_array_equal(read.u, trial.u)
        assert read.name == trial.name
    assert len(again.repeats()) == 1


def test_an_unknown_simulated_robot_is_an_error(tmp_path: Path) -> None:
    config = tmp_path / "robot.yaml"
    text = (ROOT / "config" / "pendulum.yaml").read_text()
    config.write_text(text.replace("  robot: pendulum\n", "  robot: pendulums\n"))
    said = nlsid("demo", "--robot", config, "--out", tmp_path, status=None)
    assert "there are: pendulum, arm" in said


@pytest.mark.slow
@pytest.mark.pictures
def test_the_whole_chain_runs_from_one_configuration(tmp_path: Path) -> None:
    text = (ROOT / "config" / "pendulum.yaml").read_text()
    for given, shorter in (
        ("[pendulum_4_0, pendulum_4_1, pendulum_4_2, pendulum_4_3]", "[pendulum_2_0]"),
        ("duration: 1.5\n", "duration: 0.3\n"),
        ("[0.6,", "[0.1,"),
        ("groups: 5", "groups: 3"),
        ("repeats: 4", "repeats: 2"),
        ("seconds: 60.0", "seconds: 12.0"),
        ("runs: 30", "runs: 3"),
        ("identification:\n", "identification:\n  degrees: [[3, 1, 1]]\n"),
    ):
        assert given in text
        text = text.replace(given, shorter)
    config = tmp_path / "pendulum.yaml"
    config.write_text(text)
    out = tmp_path / "out"
    said = nlsid("demo", "--robot", config, "--out", out)
    assert "PROVED funnel" in said
    assert "3 of 3 bags are inside" in said
    for name in ("free_run.png", "funnel.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
        assert f"wrote {out / name}" in said
    assert nlsid("check", out).startswith("PROVED")
    nlsid("monitor", out, out / "runs")
    refused = nlsid("funnel", out, out / "excitations", "--config", config, status=None)
    assert "fitted on" in refused
