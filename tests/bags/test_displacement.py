"""What a tube of a washed-out position says of the position."""

import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from bags.designs.displacement import displacement_half_width, washouts_of
from bags.samples import f1tenth
from nlsid_core.models import Signal
from tests.verbs import nlsid

CONFIG = """\
robot: car
signals:
  response: {name: position, unit: m, path: "/odom:pose.pose.position.x|washout(1 s)"}
  excitation: {name: command, unit: m/s, path: "/cmd_vel:twist.linear.x"}
grid: {period: 0.025, max_gap: 0.1}
split: {test: [trial_37, trial_41], calibration: [trial_35, trial_38, trial_40]}
identification: {lags: 4}
funnel: {level: constant}
"""


@pytest.mark.parametrize("span", [0.1, 1.0, 2.0, 7.0])
def test_no_errors_of_the_washed_out_position_add_up_to_more_and_the_worst_do_to_nearly_that(
    span: float,
) -> None:
    """The worst p of all |errors of q| ≤ w is w times the sum of the weights of q in p."""
    w, T, period = 0.3, 2.0, 0.01
    a, steps = np.exp(-period / T), round(span / period)
    # the error of p from that of q by the filter's inverse, (1 - a/z)/(1 - 1/z), unit by unit
    units = np.vstack([np.zeros(steps + 1), np.eye(steps + 1)])
    p = lfilter([1.0, -a], [1.0, -1.0], units, axis=0)
    worst = w * np.abs(p[-1] - p[1]).sum()
    bound = float(displacement_half_width(w, Fraction(span), Fraction(T)))
    assert worst <= bound
    assert worst == pytest.approx(bound, rel=0.01)


def test_a_displacement_is_told_of_samples_that_are_washed_out_messages() -> None:
    x, y, other, plain = (
        Signal("x", "m", path)
        for path in ("/a:x|washout(0.5 s)", "/a:y|washout(2 s)", "/b:z|washout(1 s)", "/a:x")
    )
    assert washouts_of([x, y]) == [Fraction(1, 2), Fraction(2)]
    assert washouts_of([plain, y]) == [None, Fraction(2)]
    assert washouts_of([Signal("x", "m")]) == [None]
    # Of /b only the messages at the stamps of /a are samples, and others may come between them.
    assert washouts_of([x, other]) == [Fraction(1, 2), None]


@pytest.mark.slow
@pytest.mark.pictures
def test_the_shipped_cars_way_is_proved_and_held_against_its_tube(tmp_path: Path) -> None:
    config = tmp_path / "position.yaml"
    config.write_text(CONFIG)
    out = tmp_path / "out"
    bags = [bag for bag in f1tenth() if bag.name >= "trial_34"]
    nlsid("identify", out, *bags, "--config", config)
    designed = nlsid("funnel", out, "--config", config)
    said = " ".join(re.sub(r"[│\n]", " ", designed).split())
    found = re.search(r"position stays within (\S+) m of the model's simulation", said)
    moves = re.search(r"moves in at most 1 s is within (\S+) m of what the simulation moves", said)
    assert found
    assert moves
    assert 3 * float(found[1]) <= float(moves[1]) * 1.0001 < 0.5
    test = [bag for bag in bags if bag.name in ("trial_37", "trial_41")]
    held = nlsid("monitor", out, *test, status=1)  # an alarm of which nothing is proved
    verdicts = re.findall(r"^trial_\d+ (\w+(?:, \w+)?)", held, re.MULTILINE)
    assert verdicts == ["inside", "inside, alarm"]
