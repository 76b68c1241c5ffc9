"""Samples live: those of the grid whatever the order of topics, and nothing lost silently."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bags.recordings.bag import Bag
from bags.samples import f1tenth
from bags.signals.grid import read_dataset
from bags.signals.sampling import LOST, Sample, Sampler
from bags.signals.timing import seconds
from tests.bag_messages import COMMAND, SPEED


@pytest.mark.parametrize("bag", [f1tenth()[k] for k in (4, 10, 37)], ids=lambda bag: bag.name)
def test_a_bag_in_log_order_gives_exactly_the_samples_of_the_grid(bag: Path) -> None:
    pairing = Sampler([SPEED], [COMMAND], period=0.025)
    samples: list[Sample] = []
    with Bag(bag) as source:
        for topic in pairing.topics:
            pairing.check(topic, *source.types_on(topic))
        for message in source.messages(pairing.topics):
            stamp_ns = pairing.stamp(message.data, message.log_time_ns)
            samples += pairing.take(stamp_ns, pairing.numbers(message.topic, message.data))
    assert len(samples) == 120  # the last response waits for a command that never comes
    samples += pairing.flush()
    [expected] = read_dataset([bag], responses=[SPEED], excitations=[COMMAND])
    origin = samples[0].stamp_ns
    assert [seconds(s.stamp_ns, origin) for s in samples] == expected.t.tolist()
    assert [list(s.y) for s in samples] == expected.y.tolist()
    assert [list(s.u) for s in samples] == expected.u.tolist()


def sampler() -> Sampler:
    """Of one response and one command, in ns."""
    return Sampler(["/y:data"], ["/u:data"], period=1e-8)


def sample(stamp_ns: int, y: float, u: float) -> Sample:
    return Sample(stamp_ns, (y,), (u,))


# a number of a signal (0 responds, 1 drives) with its stamp, or a stamp to which all is flushed;
# the samples that are certain then; late, late responses, duplicates and incomplete ones at the end
STORIES: list[tuple[list[tuple[Any, list[Sample]]], tuple[int, int, int, int]]] = [
    (  # a response waits for an excitation at or after its stamp
        [
            ((1, 5, 0.5), []),
            ((0, 10, 1.0), []),
            ((1, 9, 0.9), []),  # a command at 10 may still come
            ((1, 12, 1.2), [sample(10, 1.0, 0.9)]),
            ((0, 12, 2.0), [sample(12, 2.0, 1.2)]),
            ((0, 13, 3.0), []),
            (13, [sample(13, 3.0, 1.2)]),
        ],
        (0, 0, 0, 0),
    ),
    (  # before the first command there are no samples
        [
            ((0, 10, 1.0), []),
            ((0, 20, 2.0), []),
            (19, []),
            ((1, 20, 0.5), [sample(20, 2.0, 0.5)]),
        ],
        (0, 0, 0, 1),
    ),
    (  # those that wait are released in the order of their stamps
        [
            ((1, 5, 0.0), []),
            ((0, 30, 3.0), []),
            ((0, 10, 1.0), []),
            ((0, 20, 2.0), []),
            ((1, 30, 0.0), [sample(10, 1.0, 0.0), sample(20, 2.0, 0.0), sample(30, 3.0, 0.0)]),
        ],
        (0, 0, 0, 0),
    ),
    (  # what cannot be released is counted
        [
            ((0, 10, 1.0), []),
            ((0, 10, 1.5), []),
            ((1, 10, 0.0), [sample(10, 1.0, 0.0)]),
            ((0, 10, 1.0), []),
            ((0, 9, 0.9), []),
        ],
        (0, 1, 2, 0),
    ),
    (  # a command that comes too late still holds afterwards
        [
            ((1, 0, 0.0), []),
            ((0, 10, 1.0), []),
            (10, [sample(10, 1.0, 0.0)]),
            ((1, 8, 0.8), []),
            ((0, 11, 1.1), []),
            (11, [sample(11, 1.1, 0.8)]),
        ],
        (1, 0, 0, 0),
    ),
]


@pytest.mark.parametrize(("story", "counts"), STORIES)
def test_a_sample_is_given_as_soon_as_it_is_certain(
    story: list[tuple[Any, list[Sample]]], counts: tuple[int, int, int, int]
) -> None:
    pairing = sampler()
    for event, given_then in story:
        found = pairing.flush(event) if isinstance(event, int) else pairing.feed(*event)
        assert found == given_then
    assert counts == (
        pairing.late,
        pairing.late_responses,
        pairing.duplicate_responses,
        pairing.incomplete,
    )


@given(st.data())
def test_any_interleaving_of_ordered_topics_gives_the_zero_order_hold(data: st.DataObject) -> None:
    stamps = st.lists(st.integers(0, 50), min_size=1, max_size=30)
    responses = sorted(set(data.draw(stamps)))
    commands = sorted(data.draw(stamps))
    order = data.draw(st.permutations(["y"] * len(responses) + ["u"] * len(commands)))
    pairing, samples = sampler(), []
    left_y, left_u = list(responses), list(enumerate(commands))
    for kind in order:
        if kind == "y":
            samples += pairing.feed(0, stamp := left_y.pop(0), float(stamp))
        else:
            number, stamp = left_u.pop(0)
            samples += pairing.feed(1, stamp, float(number))
    samples = [sample for sample in [*samples, *pairing.flush()] if sample.missing != LOST]
    held = np.searchsorted(commands, responses, side="right") - 1
    complete = [stamp for stamp, k in zip(responses, held, strict=True) if k >= 0]
    assert [s.stamp_ns for s in samples] == complete
    assert pairing.incomplete == len(responses) - len(complete)
    if pairing.late == 0:
        assert [s.u[0] for s in samples] == [float(k) for k in held if k >= 0]
    else:  # only a repeated command stamp can come after it has been used
        assert len(set(commands)) < len(commands)
