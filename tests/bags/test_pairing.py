"""Samples live: each as soon as it is certain, and nothing lost silently."""

from typing import Any

import pytest

from bags.signals.sampling import Sample, Sampler


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
