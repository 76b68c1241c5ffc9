"""Two publishers of one signal, told from a recording: nobody knows whose it is."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from bags.monitoring.replay import replay_messages
from bags.recordings.writer import BagWriter
from bags.signals.publishers import two_curves
from bags.tools.fitness import Level, check_fitness
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

SAMPLES = 400
U = np.repeat(0.2 * (np.arange(SAMPLES // 20) % 5), 20)
TRUTH = simulate_truth(U)


class Sent(NamedTuple):
    """What one publisher of speeds sends: from when to when, how often, and its own count."""

    gain: float
    late: float = 0.0  # s
    every: float = PERIOD  # s
    first: int = 0  # its count of the first
    during: tuple[float, float] = (0.0, SAMPLES * PERIOD)

    def messages(self) -> Iterable[tuple[int, int, float]]:
        """Stamp (ns), count and speed of each."""
        rng = np.random.default_rng(3)
        begin, end = self.during
        for k, t in enumerate(np.arange(begin + self.late, end, self.every)):
            speed = self.gain * np.interp(t, PERIOD * np.arange(SAMPLES), TRUTH)
            yield START_NS + round(t * 1e9), self.first + k, speed + 0.002 * rng.standard_normal()


ROBOT = Sent(0.5, late=0.001)
TWO = {
    "1 ms earlier": (ROBOT, Sent(1.0)),
    "between the robot's": (ROBOT, Sent(1.0, late=0.051)),
    "faster": (ROBOT, Sent(1.0, every=0.04)),
    "slower": (ROBOT, Sent(1.0, every=0.25)),
    "three": (ROBOT, Sent(1.0), Sent(1.0, late=0.0005)),
    "four": (ROBOT, Sent(1.0), Sent(0.9, late=0.0005), Sent(1.0, late=0.002)),
    "for a while": (ROBOT, Sent(1.0, during=(10.0, 25.0))),
}
ONE = {
    "the robot": (Sent(1.0),),
    "replaced": (Sent(1.0, during=(0.0, 20.0)), Sent(1.0, during=(20.0, 40.0))),
}


def bag_of(path: Path, senders: Iterable[Sent], *, counted: bool) -> Path:
    """A bag of what they send on /odom, in the order of the stamps, and of the commands."""
    rows = sorted(row for sender in senders for row in sender.messages())
    with BagWriter(path) as bag:
        for k, value in enumerate(U):
            at = START_NS + round((k * PERIOD - 0.002) * 1e9)
            bag.write(CMD, CMD_TYPE, command(at, value), log_time_ns=at, publish_time_ns=at)
        for at, count, speed in rows:
            bag.write(
                *(ODOM, ODOM_TYPE, odometry(at, speed)),
                log_time_ns=at + 10**6,
                publish_time_ns=at,
                sequence=count if counted else 0,
            )
    return path


@pytest.fixture(scope="module")
def resampled(fit: Fit[DifferenceEquation], train: Dataset) -> AnyDesign:
    model = replace(
        fit.model,
        y=Signal("speed", "m/s", f"{SPEED}|linear(0.3 s)"),
        u=Signal("command", "m/s", COMMAND),
    )
    design = design_output_tube(OutputTube(model, train))
    return Design(design.model, None, design.funnel)


COUNTED = ("between the robot's", "for a while")  # what counts say does not depend on the times


@pytest.mark.parametrize(
    ("how", "counted"), [*((how, False) for how in TWO), *((how, True) for how in COUNTED)]
)
def test_a_signal_of_two_publishers_is_unknown_bad_and_refused(
    how: str, counted: bool, resampled: AnyDesign, tmp_path: Path
) -> None:
    bag = bag_of(tmp_path / "bag", TWO[how], counted=counted)
    readings = [r.reading for r in replay_messages(resampled, bag, centre=Centre.COMMAND)]
    assert {reading.status for reading in readings} == {Status.UNKNOWN}
    assert all("several publishers" in reading.reason for reading in readings)

    [fitness] = check_fitness([bag], excitations=[COMMAND], responses=[SPEED])
    assert fitness.verdict is Level.BAD
    [told] = [f.what for f in fitness.findings if f.check == "publishers"]
    assert ("the counts in its messages do not rise" in told) is counted

    with pytest.raises(BagError, match="several publishers"):
        read_bags(
            [bag],
            responses=[SPEED],
            excitations=[COMMAND],
            grid=Grid(PERIOD, max_gap=0.3, resample="linear"),
        )


@pytest.mark.parametrize("senders", ONE.values(), ids=ONE)
def test_a_signal_of_one_publisher_after_another_is_known(
    senders: tuple[Sent, ...], resampled: AnyDesign, tmp_path: Path
) -> None:
    bag = bag_of(tmp_path / "bag", senders, counted=True)
    readings = replay_messages(resampled, bag, centre=Centre.COMMAND)
    assert sum(r.reading.status is Status.INSIDE for r in readings) > SAMPLES - 10
    [fitness] = check_fitness([bag], excitations=[COMMAND], responses=[SPEED])
    assert not any(f.check == "publishers" for f in fitness.findings)


@pytest.mark.parametrize(
    "kind",
    [
        *("white", "coarse", "steps", "irregular", "square", "walk", "in pairs", "in threes"),
        *("bursts", "counter", "rings"),
    ],
)
def test_noise_steps_and_uneven_stamps_are_not_two_curves(kind: str) -> None:
    rng = np.random.default_rng(5)
    n = 5000
    t = 0.025 * np.arange(n)
    noise = rng.standard_normal(n)
    ticks = np.where(np.arange(n) // 500 == 2, 20.5, 40.0 * np.sin(t))  # half a tick: it flickers
    kicks = np.where(np.arange(n) % 100 == 0, 50.0, 0.1) * noise
    if kind == "bursts":
        t = 0.05 * (np.arange(n) // 2) + 0.001 * (np.arange(n) % 2)
    values = {
        "coarse": np.round(8.0 * np.sin(t) + 0.5 * rng.standard_normal(n)) / 8.0,
        "steps": np.sign(np.sin(3.0 * t)) + 0.01 * rng.standard_normal(n),
        "square": np.where(np.arange(n) % 9 < 4, 1.0, 0.0) + 0.01 * rng.standard_normal(n),
        "walk": np.cumsum(rng.standard_normal(n)),
        "counter": np.diff(np.floor(np.cumsum(ticks)), prepend=0.0) + 0.02 * noise,
        "rings": np.cumsum(kicks) + 0.5 * np.convolve(kicks, (-0.7) ** np.arange(50))[:n],
        "in pairs": np.sin(t) + 0.01 * rng.standard_normal(n),
        "bursts": np.sin(5.0 * t) + 0.001 * rng.standard_normal(n),
        "in threes": np.sin(5.0 * t) + 0.001 * rng.standard_normal(n),
    }.get(kind, noise)
    t = {
        "irregular": np.cumsum(rng.exponential(0.025, n)),
        "in pairs": t - 0.02 * (np.arange(n) % 2),
        "in threes": t - 0.02 * (np.arange(n) % 3),
    }.get(kind, t)
    assert not two_curves(np.round(t * 1e9).astype(np.int64), values)
