"""Signals read from bags are those of a full decoder, bit for bit: values, stamps, clocks."""

import hashlib
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

from bags.recordings.bag import Bag
from bags.recordings.batch import Batch, joined
from bags.recordings.cdr import MAX_LAYOUTS, Gatherer, UnreadableMessageError
from bags.recordings.message_types import decode, standard_types, types_in_bag
from bags.recordings.writer import BagWriter
from bags.signals.message_reader import MessageReader
from bags.signals.reader import HEADER_STAMP, LOG_TIME, bag_digest, bag_origin, read_signals
from bags.signals.signal import SignalPath
from nlsid_core.errors import BagError
from tests.bag_messages import (
    COMMAND,
    JOINT_TYPE,
    ODOM_TYPE,
    PERIOD_NS,
    SPEED,
    START_NS,
    header,
    odometry,
    put,
    serialised,
    speed_bag,
    twist,
)

RESOURCES = Path(__file__).parents[2].parent / "shared" / "data" / "rosbag2_resources"


def test_values_and_header_stamps_come_back_bit_equal(tmp_path: Path) -> None:
    speeds = [0.1, 1 / 3, float(np.nextafter(0.2, 1))]
    stamps = [START_NS + 5, START_NS + PERIOD_NS + 7, START_NS + 2 * PERIOD_NS + 11]
    bag = speed_bag(tmp_path / "trial", speeds, [0.0, -0.5, 1e-300], stamps_ns=stamps)
    read = read_signals(bag, [SPEED, COMMAND])
    values = {name: samples.values.tolist() for name, samples in read.items()}
    assert values == {SPEED: speeds, COMMAND: [0.0, -0.5, 1e-300]}
    assert read[SPEED].stamp_ns.tolist() == stamps
    assert read[SPEED].clock == HEADER_STAMP
    assert not read[SPEED].values.flags.writeable


def test_a_single_mcap_file_reads_as_its_folder_does(tmp_path: Path) -> None:
    bag = speed_bag(tmp_path / "trial", [0.1, 0.2], [0.3, 0.4], custom={"repeat_group": "step"})
    file = bag / "trial.mcap"
    assert read_signals(file, [SPEED])[SPEED].values.tolist() == [0.1, 0.2]
    assert bag_origin(file)["custom"] == bag_origin(bag)["custom"] == {"repeat_group": "step"}
    assert bag_digest(file) == bag_digest(bag)
    assert bag_digest(bag) == "sha256:" + hashlib.sha256(file.read_bytes()).hexdigest()


def test_a_type_without_a_header_is_stamped_by_log_time_and_says_so(tmp_path: Path) -> None:
    kind = "geometry_msgs/msg/Twist"
    with BagWriter(tmp_path / "plain") as bag:
        for k in range(3):
            stamp = START_NS + k
            put(bag, stamp, "/cmd", kind, serialised(kind, twist(0.5 * k)))
    samples = read_signals(tmp_path / "plain", ["/cmd:linear.x"])["/cmd:linear.x"]
    assert samples.clock == LOG_TIME
    pairs = zip(samples.stamp_ns.tolist(), samples.values.tolist(), strict=True)
    assert list(pairs) == [(START_NS, 0.0), (START_NS + 1, 0.5), (START_NS + 2, 1.0)]


def test_messages_come_in_log_order_with_ties_as_recorded(tmp_path: Path) -> None:
    bag = speed_bag(tmp_path / "trial", [0.1, 0.2], [0.3, 0.4])
    with Bag(bag) as source:
        topics = [message.topic for message in source.messages()]
        only = [message.topic for message in source.messages(["/odom"])]
    assert topics == ["/cmd_vel", "/odom", "/cmd_vel", "/odom"]
    assert only == ["/odom", "/odom"]


@pytest.mark.skipif(not RESOURCES.is_dir(), reason=f"needs {RESOURCES.name} beside the repository")
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_bags_that_ros2_recorded_itself_are_read(storage: str) -> None:
    bag = RESOURCES / "rosbag2_tests" / "resources" / storage / "cdr_test"
    with Bag(bag) as source:
        messages = list(source.messages())
        arrays = [t for t, kind in source.topics.items() if kind == "test_msgs/msg/Arrays"]
    assert len(messages) == 7
    path = f"{arrays[0]}:float64_values[0]"
    samples = read_signals(bag, [path])[path]
    assert samples.clock == LOG_TIME
    assert len(samples) > 0


# -- Fields gathered from serialised messages are those of a full decoder, bit for bit

MIXED = """
bool flag
uint8[] blob
string note
float32 small
Part[] parts
int64 big
Part[2] pair
float64[3] fixed
string[] names
uint16[] counts
string[2] two
float64 last
================================================================================
MSG: pkg/Part
uint8 kind
string label
float64 weight
int16[] steps
"""
TYPES = types_in_bag("pkg/msg/Mixed", MessageDefinition(MessageDefinitionFormat.MSG, MIXED))
PATHS = [
    "flag",
    "small",
    "parts[0].weight",
    "parts[1].steps[0]",
    "parts[1].kind",
    "big",
    "pair[1].weight",
    "pair[0].kind",
    "fixed[2]",
    "counts[names=b]",
    "counts[1]",
    "last",
]

text = st.sampled_from(["", "x", "abc", "abcd", "déjà vu", "a longer note of some length"])
double = st.floats(width=64)
part = st.tuples(st.integers(0, 255), text, double, st.lists(st.integers(-9, 9), min_size=1))
mixed = st.tuples(
    st.booleans(),
    st.lists(st.integers(0, 255)),
    text,
    st.floats(width=32),
    st.lists(part, min_size=2, max_size=4),
    st.integers(-(2**63), 2**63 - 1),
    st.tuples(part, part),
    st.lists(double, min_size=3, max_size=3),
    st.permutations(["a", "b", "long name"]),
    st.lists(st.integers(0, 65535), min_size=3, max_size=5),
    st.tuples(text, text),
    double,
)


def batch_of(messages: list[bytes]) -> Batch:
    return joined(messages, range(len(messages)))


def make_part(entry: tuple[int, str, float, list[int]]) -> Any:
    kind, label, weight, steps = entry
    return TYPES.types["pkg/msg/Part"](kind, label, weight, np.array(steps, dtype=np.int16))


def make_mixed(entry: tuple) -> object:  # type: ignore[type-arg]
    flag, blob, note, small, parts, big, pair, fixed, names, counts, two, last = entry
    return TYPES.types["pkg/msg/Mixed"](
        flag,
        np.array(blob, dtype=np.uint8),
        note,
        small,
        [make_part(p) for p in parts],
        big,
        [make_part(p) for p in pair],
        np.array(fixed),
        list(names),
        np.array(counts, dtype=np.uint16),
        list(two),
        last,
    )


@settings(max_examples=60, deadline=None)
@given(st.lists(mixed, min_size=1, max_size=12), st.booleans())
def test_any_mixture_of_layouts_gives_what_the_decoder_gives(
    entries: list[tuple],  # type: ignore[type-arg]
    little: bool,
) -> None:
    serialised = [
        bytes(TYPES.serialize_cdr(make_mixed(e), "pkg/msg/Mixed", little_endian=little))
        for e in entries
    ]
    paths = [SignalPath.parse(f"/x:{path}") for path in PATHS]
    gatherer = Gatherer("pkg/msg/Mixed", TYPES, [path.steps for path in paths])
    found = np.array([column.astype(float) for column in gatherer.gather(batch_of(serialised))])
    one_by_one = MessageReader(paths, "pkg/msg/Mixed", TYPES)
    for column, data in enumerate(serialised):
        assert np.array(one_by_one.numbers(data)).tobytes() == found[:, column].tobytes()
        decoded = decode(data, "pkg/msg/Mixed", TYPES)
        expected = np.array([path.value(decoded) for path in paths])
        np.testing.assert_array_equal(found[:, column].view(np.uint64), expected.view(np.uint64))


def test_threads_that_read_bags_of_other_layouts_do_not_disturb_each_other() -> None:
    """As the workers of a Dask cluster do: what is known of a type is shared by its readers."""
    kind = standard_types().types[JOINT_TYPE]
    targets = [SignalPath.parse(f"/arm:{field}[0]").steps for field in ("position", "velocity")]

    def recorded(name: str, value: float) -> Batch:
        message = kind(header(1), [name], np.array([value]), np.array([-value]), np.zeros(0))
        return batch_of([bytes(standard_types().serialize_cdr(message, JOINT_TYPE))] * 3)

    def wrong(name: str, value: float) -> int:
        batch, expected = recorded(name, value), [[value] * 3, [-value] * 3]
        read = (Gatherer(JOINT_TYPE, standard_types(), targets).gather(batch) for _ in range(500))
        return sum([column.tolist() for column in found] != expected for found in read)

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as threads:
            counts = threads.map(wrong, ["a", "b" * 9, "c" * 21, "d" * 40], [1.0, 2.0, 3.0, 4.0])
            assert list(counts) == [0, 0, 0, 0]
    finally:
        sys.setswitchinterval(before)


def test_more_layouts_than_are_tried_at_once_still_read() -> None:
    kind = standard_types().types[JOINT_TYPE]
    empty = np.zeros(0)
    messages = []
    for k in range(3 * MAX_LAYOUTS):
        message = kind(header(k), ["n" * (k + 1)], np.array([float(k)]), empty, empty)
        messages.append(bytes(standard_types().serialize_cdr(message, JOINT_TYPE)))
    path = SignalPath.parse("/arm:position[0]")
    found = Gatherer(JOINT_TYPE, standard_types(), [path.steps]).gather(batch_of(messages))
    assert found[0].tolist() == list(range(3 * MAX_LAYOUTS))


def test_a_joint_is_followed_where_the_order_of_names_changes() -> None:
    kind = standard_types().types[JOINT_TYPE]
    empty = np.zeros(0)
    messages = []
    for k in range(6):
        names, values = ["shoulder", "elbow"], [10.0 + k, float(k)]
        if k % 3 == 1:
            names, values = names[::-1], values[::-1]
        message = kind(header(k), names, np.array(values), empty, empty)
        messages.append(bytes(standard_types().serialize_cdr(message, JOINT_TYPE)))
    path = SignalPath.parse("/arm:position[name=elbow]")
    path.check(JOINT_TYPE, standard_types())
    gatherer = Gatherer(JOINT_TYPE, standard_types(), [path.steps])
    assert gatherer.gather(batch_of(messages))[0].tolist() == [0, 1, 2, 3, 4, 5]
    absent = SignalPath.parse("/arm:position[name=wrist]")
    with pytest.raises(BagError, match="'name' has no 'wrist'; it has: shoulder, elbow"):
        Gatherer(JOINT_TYPE, standard_types(), [absent.steps]).gather(batch_of(messages))


@pytest.mark.parametrize("length", [0, 3, 4, 11, 40, 500, -100, -1])
def test_a_message_that_is_cut_is_refused_and_located(length: int) -> None:
    whole = odometry(1, 0.5)
    path = SignalPath.parse("/odom:twist.twist.linear.x")
    gatherer = Gatherer(ODOM_TYPE, standard_types(), [path.steps])
    with pytest.raises(UnreadableMessageError) as caught:
        gatherer.gather(batch_of([whole, whole, whole[:length], whole]))
    assert caught.value.row == 2


def test_a_message_that_is_too_long_is_refused() -> None:
    path = SignalPath.parse("/odom:twist.twist.linear.x")
    gatherer = Gatherer(ODOM_TYPE, standard_types(), [path.steps])
    whole = odometry(1, 0.5)
    assert gatherer.gather(batch_of([whole, whole + bytes(3)]))[0].tolist() == [0.5, 0.5]
    with pytest.raises(UnreadableMessageError, match=f"has {len(odometry(1, 0.5)) + 4} bytes"):
        gatherer.gather(batch_of([whole, whole + bytes(4)]))


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=80))
def test_random_bytes_are_refused_or_read_as_the_decoder_does(tail: bytes) -> None:
    data = b"\0\1\0\0" + tail
    path = SignalPath.parse("/arm:velocity[0]")
    try:
        decoded = decode(data, JOINT_TYPE, standard_types())
        expected = path.value(decoded)
    except BagError:
        with suppress(BagError):
            MessageReader([path], JOINT_TYPE, standard_types()).numbers(data)
        return  # the gatherer stops at the number and may read what a full decoder refuses
    found = Gatherer(JOINT_TYPE, standard_types(), [path.steps]).gather(batch_of([data]))
    np.testing.assert_array_equal(found[0][0], expected)
