"""The recorder's clock is set back while it records: log times go back inside a file."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bags.monitoring.replay import replay_messages
from bags.recordings.bag import Bag
from bags.recordings.writer import BagWriter
from bags.signals.reader import read_signals
from nlsid import Dataset, Design, Fit, Grid, OutputTube, Status, read_bags
from nlsid_core.design import design_output_tube
from nlsid_core.designs import AnyDesign
from nlsid_core.errors import BagError
from nlsid_core.models import DifferenceEquation, Signal
from nlsid_core.running.comparison import Centre
from tests.bag_messages import (
    CMD,
    CMD_TYPE,
    COMMAND,
    ODOM,
    ODOM_TYPE,
    SPEED,
    START_NS,
    command,
    odometry,
)
from tests.conftest import PERIOD, simulate_truth

SET_AT, BACK = 40, 20  # samples; from the first on, log times are those of so many before


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A drive of a healthy robot; only its log times are wrong."""
    u = np.repeat([0.0, 0.4, 0.1, 0.8, 0.3, 0.6, 0.2, 0.9], 10)
    with BagWriter(tmp_path / "drive") as target:
        for k, (speed, value) in enumerate(zip(simulate_truth(u), u, strict=True)):
            log_ns = START_NS + round((k - BACK * (k >= SET_AT)) * PERIOD * 1e9)
            times = {"log_time_ns": log_ns, "publish_time_ns": log_ns}
            target.write(CMD, CMD_TYPE, command(1, value), **times)
            target.write(ODOM, ODOM_TYPE, odometry(1, speed), **times)
    return tmp_path / "drive"


def test_identification_refuses_it_as_it_does_header_stamps(bag: Path) -> None:
    with pytest.raises(BagError) as caught:
        read_bags(
            [bag], responses=[SPEED], excitations=[COMMAND], grid=Grid(max_gap=0.3, clock="log")
        )
    assert f"time goes back by 1.9 s at message {SET_AT}: log time 1700000003.900" in str(
        caught.value
    )
    assert "then 1700000002.000000000 s (1 such place)" in str(caught.value)
    [asked_for] = read_signals(bag, [f"{SPEED}|clock(log)"], sort=True).values()
    assert (np.diff(asked_for.stamp_ns) >= 0).all()


def test_the_monitor_says_it_and_does_not_blame_the_robot(
    bag: Path, fit: Fit[DifferenceEquation], train: Dataset
) -> None:
    model = replace(
        fit.model,
        y=Signal("speed", "m/s", f"{SPEED}|clock(log)"),
        u=Signal("command", "m/s", f"{COMMAND}|clock(log)"),
    )
    design = design_output_tube(OutputTube(model, train))
    wired: AnyDesign = Design(design.model, None, design.funnel)
    said = replay_messages(wired, bag, centre=Centre.COMMAND)
    readings = [entry.reading for entry in said]
    assert [r.status for r in readings[len(model) : SET_AT]] == [Status.INSIDE] * (
        SET_AT - len(model)
    )
    assert f"time went back by 1.9 s on {ODOM}" in {r.reason for r in readings}
    assert {r.status for r in readings[SET_AT : SET_AT + BACK]} == {Status.UNKNOWN}
    assert readings[-1].status is Status.INSIDE, "a new run, once the stamps are new again"
    assert {r.status for r in readings} == {Status.UNKNOWN, Status.INSIDE}


def test_messages_are_read_as_recorded_or_by_log_time(bag: Path) -> None:
    with Bag(bag) as source:
        recorded = [(m.topic, m.log_time_ns) for m in source.messages(as_recorded=True)]
        assert [topic for topic, _ in recorded] == [CMD, ODOM] * 80
        assert recorded[2 * SET_AT][1] < recorded[2 * SET_AT - 1][1]
        by_log = [(m.topic, m.log_time_ns) for m in source.messages()]
    assert by_log == sorted(recorded, key=lambda message: message[1])
