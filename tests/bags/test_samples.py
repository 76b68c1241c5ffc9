"""The shipped F1TENTH bags hold the published numbers, bit for bit."""

from pathlib import Path

import numpy as np
import pytest

from bags.recordings.bag import Bag
from bags.recordings.message_types import header_stamp_ns
from bags.samples import f1tenth
from bags.signals.reader import bag_origin, read_signals

SOURCE = Path(__file__).parents[2].parent / "shared" / "data" / "f1tenth" / "F1tenthCar"
needs_source = pytest.mark.skipif(not SOURCE.is_dir(), reason="needs ../shared/data")

SIGNALS = {
    "/steering_command:position[0]": ("input", 0),
    "/cmd_vel:twist.linear.x": ("input", 1),
    "/odom:pose.pose.position.x": ("trajectory", 0),
    "/odom:pose.pose.position.y": ("trajectory", 1),
    "/odom:twist.twist.linear.x": ("trajectory", 3),
}


def test_41_trials_ship_in_order_and_are_small() -> None:
    bags = f1tenth()
    assert [bag.name for bag in bags] == [f"trial_{k:02d}" for k in range(1, 42)]
    size = sum(file.stat().st_size for bag in bags for file in bag.iterdir())
    assert size < 1.5e6


@needs_source
def test_every_shipped_number_is_the_published_one_bit_for_bit() -> None:
    for trial, bag in enumerate(f1tenth(), start=1):
        tables = {
            name: np.loadtxt(SOURCE / f"measurement_{trial}" / f"{name}.csv", delimiter=",")
            for name in ("input", "trajectory")
        }
        yaw = ["/odom:pose.pose.orientation.z", "/odom:pose.pose.orientation.w"]
        read = read_signals(bag, [*SIGNALS, *yaw])
        for path, (name, column) in SIGNALS.items():
            np.testing.assert_array_equal(read[path].values, tables[name][:, column])
        z, w = (read[path].values for path in yaw)
        np.testing.assert_allclose(2 * np.arctan2(z, w), tables["trajectory"][:, 2], atol=1e-15)


def test_stamps_are_25_ms_apart_and_commands_come_before_the_motion() -> None:
    starts = []
    for bag in f1tenth():
        with Bag(bag) as source:
            messages = list(source.messages())
        assert [m.topic for m in messages[:3]] == ["/cmd_vel", "/steering_command", "/odom"]
        start = messages[0].log_time_ns
        starts.append(start)
        for topic, count in {"/cmd_vel": 120, "/steering_command": 120, "/odom": 121}.items():
            of_topic = [m for m in messages if m.topic == topic]
            times = [m.log_time_ns for m in of_topic]
            assert times == [start + k * 25_000_000 for k in range(count)]
            assert [header_stamp_ns(m.data) for m in of_topic] == times
    assert min(np.diff(starts)) > 3 * 10**9


def test_repeats_excitation_source_and_licence_are_in_the_metadata() -> None:
    metadata = {int(bag.name[-2:]): bag_origin(bag)["custom"] for bag in f1tenth()}
    groups = {k: data["repeat_group"] for k, data in metadata.items() if "repeat_group" in data}
    expected: dict[int, str] = {}
    for first, speed in ((1, "0.4"), (12, "0.3"), (23, "0.35")):
        expected |= dict.fromkeys(range(first, first + 5), f"speed step 0 to {speed} m/s")
    assert groups == expected
    assert metadata[38]["excitation"] == (
        "speed [m/s] 0.35, 0.4 at 0.025 s, 0.35 at 1.025 s, 0.3 at 2.025 s; steering [rad] 0"
    )
    assert all(data["licence"] == "CC0-1.0" for data in metadata.values())
    assert all("Kochdumper" in data["source"] for data in metadata.values())


def test_licence_and_citation_ship_beside_the_bags() -> None:
    folder = f1tenth()[0].parent
    assert "CC0 1.0 Universal" in (folder / "LICENSE").read_text()
    assert "Kochdumper" in (folder / "README.md").read_text()
