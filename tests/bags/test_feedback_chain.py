"""Bags of an oscillator whose spring stiffens: identified, checked, given a tube and monitored."""

import re
from pathlib import Path

import numpy as np
import pytest

from bags.chain.config import load_config
from tests.duffing import trials
from tests.identified_bags import FUNNEL, write_bag, write_config
from tests.verbs import nlsid

RUNS, SAMPLES = 8, 240


@pytest.mark.slow
def test_init_proposes_feedback_where_linear_models_say_little(tmp_path: Path) -> None:
    for k, trial in enumerate(trials([0.1, 0.15, 0.2, 0.25] * 3, samples=400, damping=0.25)):
        write_bag(tmp_path / "bags", f"run_{k}", trial.y, trial.u)
    config = tmp_path / "out" / "robot.yaml"
    drive, answer = ("/joint_commands:effort[name=joint_0]", "/joint_states:position[name=joint_0]")
    nlsid("init", config.parent, tmp_path / "bags", "-u", drive, "-y", answer)
    assert load_config(config).identification.given["model"] == "feedback"
    said = " ".join(config.read_text().replace("#", "").split())
    polynomial = re.search(r"polynomial, [^%]*: ([0-9.]+) %", said)
    promised = re.search(r"simulation of [0-9.]+ to ([0-9.]+) %", said)
    assert polynomial
    assert promised
    assert float(promised[1]) < float(polynomial[1]), "even at its worst"


@pytest.mark.slow
def test_feedback_goes_from_bags_to_a_monitor(tmp_path: Path) -> None:
    for k, trial in enumerate(trials([0.15] * RUNS, samples=SAMPLES, seed=4)):
        write_bag(tmp_path / "bags", f"run_{k}", trial.y, trial.u)
    broken = trials([0.15], samples=SAMPLES, seed=9).trajectories[0]
    y = np.where(np.arange(SAMPLES)[:, None] < SAMPLES // 2, broken.y, 0.6 * broken.y)
    write_bag(tmp_path / "bags", "broken", y, broken.u)
    section = {"model": "feedback", "stages": 2, "imitated": 20}
    config = write_config(tmp_path / "config.yaml", section, **FUNNEL)
    bags = [tmp_path / "bags" / f"run_{k}" for k in range(RUNS)]
    out = tmp_path / "out"
    nlsid("identify", out, *bags, "--config", config)
    nlsid("funnel", out, "--config", config)
    assert nlsid("check", out).count("PROVED") == 2
    nlsid("monitor", out, bags[5])
    nlsid("monitor", out, tmp_path / "bags" / "broken", status=1)
