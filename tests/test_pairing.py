"""Pairing live: the grid's samples whatever the order of topics, and nothing lost silently."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bags.recordings.bag import Bag
from bags.recordings.message_types import decode, header_stamp_ns
from bags.samples import f1tenth
from bags.signals.grid import read_dataset, seconds
from bags.signals.pairing import Pairing, Sample
from bags.signals.signal import SignalPath
from tests.bag_messages import COMMAND, SPEED


@pytest.mark.parametrize("bag", [f1tenth()[k] for k in (4, 10, 37)], ids=lambda bag: bag.name)
def test_a_bag_in_log_order_gives_exactly_the_samples_of_the_grid(bag: Path) -> None:
    speed, command = SignalPath.parse(SPEED), SignalPath.parse(COMMAND)
    pairing = Pairing()
    samples: list[Sample] = []
    with Bag(bag) as source:
        for message in source.messages([speed.topic, command.topic]):
            msgtype, types = source.types_on(message.topic)
            decoded = decode(message.data, msgtype, types)
            stamp_ns = header_stamp_ns(message.data)
            if message.topic == speed.topic:
                samples += pairing.response(stamp_ns, speed.value(decoded))
            else:
                samples += pairing.excitation(stamp_ns, command.value(decoded))
    assert len(samples) == 120  # the last response waits for a command that never comes
    samples += pairing.flush()
    [expected] = read_dataset([bag], responses=[SPEED], excitations=[COMMAND])
    origin = samples[0].stamp_ns
    assert [seconds(s.stamp_ns, origin) for s in samples] == expected.t.tolist()
    assert [s.y for s in samples] == expected.y[:, 0].tolist()
    assert [s.u for s in samples] == expected.u[:, 0].tolist()


def test_a_response_waits_for_an_excitation_at_or_after_its_stamp() -> None:
    pairing = Pairing()
    assert pairing.excitation(5, 0.5) == []
    assert pairing.response(10, 1.0) == []
    assert pairing.excitation(9, 0.9) == [], "a command at 10 may still come"
    assert pairing.excitation(12, 1.2) == [Sample(10, 1.0, 0.9)]
    assert pairing.response(12, 2.0) == [Sample(12, 2.0, 1.2)]
    assert pairing.response(13, 3.0) == []
    assert pairing.flush(13) == [Sample(13, 3.0, 1.2)]


def test_flush_releases_only_up_to_the_given_stamp() -> None:
    pairing = Pairing()
    pairing.response(10, 1.0)
    pairing.response(20, 2.0)
    [sample] = pairing.flush(19)
    assert sample.stamp_ns == 10
    assert math.isnan(sample.u)
    assert pairing.flush(19) == []


def test_responses_that_wait_are_released_in_order_of_stamps() -> None:
    pairing = Pairing()
    for stamp in (30, 10, 20):
        assert pairing.response(stamp, float(stamp)) == []
    assert [s.stamp_ns for s in pairing.excitation(30, 0.0)] == [10, 20, 30]
    assert (pairing.late_responses, pairing.duplicate_responses) == (0, 0)


def test_what_cannot_be_released_is_counted() -> None:
    pairing = Pairing()
    pairing.response(10, 1.0)
    assert pairing.response(10, 1.5) == []
    assert pairing.duplicate_responses == 1
    assert pairing.excitation(10, 0.0) == [Sample(10, 1.0, 0.0)]
    assert pairing.response(10, 1.0) == []
    assert pairing.duplicate_responses == 2
    assert pairing.response(9, 0.9) == []
    assert pairing.late_responses == 1


def test_an_excitation_that_comes_too_late_is_counted_and_still_holds_afterwards() -> None:
    pairing = Pairing()
    pairing.excitation(0, 0.0)
    pairing.response(10, 1.0)
    assert pairing.flush(10) == [Sample(10, 1.0, 0.0)]
    assert pairing.excitation(8, 0.8) == []
    assert pairing.late == 1
    pairing.response(11, 1.1)
    assert pairing.flush(11) == [Sample(11, 1.1, 0.8)]


@given(st.data())
def test_any_interleaving_of_ordered_topics_gives_the_zero_order_hold(data: st.DataObject) -> None:
    stamps = st.lists(st.integers(0, 50), min_size=1, max_size=30)
    responses = sorted(set(data.draw(stamps)))
    commands = sorted(data.draw(stamps))
    order = data.draw(st.permutations(["y"] * len(responses) + ["u"] * len(commands)))
    pairing, samples = Pairing(), []
    left_y, left_u = list(responses), list(enumerate(commands))
    for kind in order:
        if kind == "y":
            samples += pairing.response(stamp := left_y.pop(0), float(stamp))
        else:
            number, stamp = left_u.pop(0)
            samples += pairing.excitation(stamp, float(number))
    samples += pairing.flush(51)
    held = np.searchsorted(commands, responses, side="right") - 1
    assert [s.stamp_ns for s in samples] == responses
    if pairing.late == 0:
        expected = [float(k) if k >= 0 else None for k in held]
        assert [None if math.isnan(s.u) else s.u for s in samples] == expected
    else:  # only a repeated command stamp can come after it has been used
        assert len(set(commands)) < len(commands)
