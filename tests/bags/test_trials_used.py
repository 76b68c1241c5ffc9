"""Which recordings are identified from, and which of them only score."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from bags.chain.config import SplitConfig, load_config
from bags.chain.finished import finished_bags
from bags.chain.shipped import config_file
from bags.chain.steps import split
from bags.recordings.writer import BagWriter
from bags.signals.recording import Arrival, Recent
from nlsid_core.errors import BagError, DataError
from tests.bag_messages import CMD, CMD_TYPE, START_NS, command, speed_bag
from tests.conftest import synthetic_dataset

CONFIG = config_file("f1tenth.yaml")


def recordings(folder: Path) -> None:
    """Three recordings of which the names do not tell the order, a snapshot, an unfinished one."""
    for name, begun in (("run", 2), ("run_2", 3), ("run_10", 1)):
        speed_bag(folder / name, [0.0, 0.1], [0.1, 0.1], start_ns=START_NS + begun * 10**9)
    recent = Recent(5.0)
    at = START_NS + 10**10
    recent.add(Arrival(CMD, CMD_TYPE, command(at, 0.1), at, at))
    recent.save(folder / "run_snapshot_1")
    growing = BagWriter(folder / "run_4")
    growing.write(CMD, CMD_TYPE, command(at, 0.1), log_time_ns=at, publish_time_ns=at)
    growing.close_chunk()
    growing.abandon()


def test_recordings_that_are_finished_and_have_the_topics_are_used(tmp_path: Path) -> None:
    recordings(tmp_path)
    speed_bag(tmp_path / "run_5", [0.0, 0.1], [0.1, 0.1], start_ns=START_NS + 5 * 10**9)
    bags, left_out = finished_bags([tmp_path], last=1)
    assert bags == [tmp_path / "run_5"]
    bags, _ = finished_bags([tmp_path], last=3)
    assert bags == [tmp_path / name for name in ("run", "run_2", "run_5")]
    bags, left_out = finished_bags([tmp_path], ["/odom", CMD])
    assert bags == [tmp_path / name for name in ("run", "run_10", "run_2", "run_5")]
    assert left_out.keys() == {tmp_path / "run_4", tmp_path / "run_snapshot_1"}
    assert "not closed" in left_out[tmp_path / "run_4"]
    assert "snapshot" in left_out[tmp_path / "run_snapshot_1"]
    with pytest.raises(BagError, match=r"5 recordings are asked for, 4 can be used in .*run_4: it"):
        finished_bags([tmp_path], last=5)
    with pytest.raises(BagError, match=r"1 recordings are asked for, 0 .* has nothing on /none"):
        finished_bags([tmp_path], ["/none"])


def test_a_share_of_every_trial_scores_and_the_rest_of_it_is_fitted() -> None:
    data = synthetic_dataset(0.01, trials=2, samples=80)
    trials = split(data, SplitConfig(share=0.25))
    train, test = trials.train, trials.test
    assert train.names == test.names == data.names
    for whole, fitted, scored in zip(data, train, test, strict=True):
        assert (len(fitted), len(scored)) == (60, 20)
        np.testing.assert_array_equal(np.concatenate([fitted.y, scored.y]), whole.y)
        np.testing.assert_array_equal(np.concatenate([fitted.u, scored.u]), whole.u)
        assert scored.t[0] == 0.0
    with pytest.raises(DataError, match=r"0\.01 of 80 samples"):
        split(data, SplitConfig(share=0.01))


def test_trials_of_another_use_are_left_whole() -> None:
    data = synthetic_dataset(0.01, trials=2, samples=80)
    trials = split(data, SplitConfig(share=0.25, calibration=data.names[:1]))
    assert [len(trial) for trial in trials.by_use["calibration"]] == [80]
    assert trials.train.names == trials.test.names == data.names[1:]
    with pytest.raises(DataError, match="all of the bags are calibration trials"):
        split(data, SplitConfig(share=0.25, calibration=data.names))


def test_a_configuration_names_test_bags_or_a_share_but_not_both(tmp_path: Path) -> None:
    config = yaml.safe_load(CONFIG.read_text())
    config["split"]["share"] = 0.25
    file = tmp_path / "config.yaml"
    file.write_text(yaml.safe_dump(config))
    with pytest.raises(DataError, match="name test bags or give a share, not both"):
        load_config(file)
